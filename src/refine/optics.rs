//! What refinement has to know of the camera and its light.

use crate::fusion::DepthNoise;
use crate::geometry::RayGrid;
use crate::interreflection::{PatchGrid, WhiteLevel};
use crate::shading::{Calibration, NearLight};
use depth_camera::{CameraInfo, Image, LightKind};

/// What all views of one camera share.
pub struct Optics<'a> {
    /// Rays and camera of the images.
    pub rays: &'a RayGrid,
    /// The light.
    pub light: NearLight,
    /// Whether it is as bright in every image, as a sensor's own emitter is; a lamp beside the sensor fades, or is exposed otherwise.
    pub is_steady: bool,
    /// IR counts at full scale.
    pub full_scale: f64,
    /// Response, flat field and noise.
    pub calibration: &'a Calibration,
    /// Noise of the depth.
    pub depth_noise: DepthNoise,
}

impl<'a> Optics<'a> {
    /// The optics of a camera; `None` if it does not say where its light is, or what full scale is.
    pub fn of(info: &CameraInfo, rays: &'a RayGrid, calibration: &'a Calibration) -> Option<Self> {
        let light = info.light?;
        Some(Optics {
            rays,
            light: calibration.light.near_light(light.position_m),
            is_steady: light.kind == LightKind::Emitter,
            full_scale: info.ir_full_scale?,
            calibration,
            depth_noise: DepthNoise::of_sensor(info.sensor),
        })
    }

    /// The flat field of each pixel.
    pub fn flat_image(&self) -> Image<f64> {
        self.calibration.flat_field.image(self.rays)
    }

    /// The same camera with another calibration, which says where the light is.
    pub(super) fn with<'b>(&self, calibration: &'b Calibration) -> Optics<'b>
    where
        'a: 'b,
    {
        let believed_m = self.light.position.coords.into();
        Optics {
            rays: self.rays,
            light: calibration.light.near_light(believed_m),
            is_steady: self.is_steady,
            full_scale: self.full_scale,
            calibration,
            depth_noise: self.depth_noise,
        }
    }

    /// The patches that light one another in an image.
    pub(super) fn patch_grid(&self) -> PatchGrid {
        PatchGrid::new(
            self.rays.clone(),
            self.light,
            self.full_scale,
            self.calibration,
        )
    }

    /// The white level, if the device's calibration tells it.
    pub(super) fn white_level(&self) -> Option<WhiteLevel> {
        self.calibration.light.white_level.map(WhiteLevel)
    }
}
