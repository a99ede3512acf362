//! Multipath: light that reaches a time-of-flight sensor over a second surface, and makes the first one look farther away.
//!
//! A Kinect II measures the mean path of all light that a pixel receives. Near a table, in corners and folds a good part of
//! it has come over a neighbouring surface (Fuchs, *Multipath interference compensation in time-of-flight camera images*,
//! ICPR 2010; Jiménez et al., *Modelling and correction of multipath interference in time of flight cameras*, 2012). On the
//! recorded bust that is 12 mm at the foot and nothing on top of the head. One infrared image and its depth hold what is
//! needed to predict it: how bright every neighbour is as seen, and where it is (`bounce.rs`). The bias is that light over the
//! direct one, which falls where light comes in slantingly: one frame's depth tells the surface's slant no finer than by patches of
//! 16 pixels, a fused model and brightness together by 4 ([`Multipath::predict_on`]). Unknown is one number,
//! how bright a perfectly white surface would be ([`WhiteLevel`]): it belongs to the device, and shows itself in a scan by how
//! views of one place disagree ([`Evidence`]).
//!
//! Pure; a frame costs about a million pairs of patches. Not handled: more than one bounce in the *paths* (in the brightness
//! all bounces are contained), gloss, and surfaces that neither the image nor the table's plane shows.

mod bounce;
mod evidence;
mod params;
mod range_bias;
mod search;

pub use evidence::{Evidence, Seen};
pub use params::MultipathParams;
pub use range_bias::RangeBias;
pub use search::{NextWhite, WhiteSearch};

#[cfg(test)]
mod tests;

use crate::geometry::{CameraModel, RayGrid};
use crate::interreflection::{Lit, LitScene, PatchGrid, Radiances, WhiteLevel, receivers};
use crate::shading::{Calibration, NearLight};
use bounce::Bounce;
use depth_camera::{CameraInfo, Frame, Image, LightKind, Sensor};
use nalgebra::{Point3, Vector3};

/// The strength of multipath, 1/(π white level); no white level is no multipath.
fn strength(white: Option<WhiteLevel>) -> f64 {
    white.map_or(0.0, WhiteLevel::strength)
}

/// Predicts multipath from the frames of one camera.
#[derive(Clone, Debug)]
pub struct Multipath {
    grid: PatchGrid,
}

/// What a frame tells of its own multipath.
#[derive(Clone, Debug)]
pub struct Prediction {
    /// How far too long every range is, for any [`WhiteLevel`].
    pub bias: RangeBias,
    /// How bright the image is.
    radiances: Radiances,
    /// The white level if the frame's brightest surfaces are plaster.
    pub plausible_white: WhiteLevel,
}

impl Multipath {
    /// A predictor for a camera that measures time of flight and lights the scene itself; `None` for any other.
    pub fn new(info: &CameraInfo, calibration: &Calibration) -> Option<Self> {
        let (light, full_scale) = (info.light.as_ref()?, info.ir_full_scale?);
        let is_lit_flight = info.sensor == Sensor::Kinect2 && light.kind == LightKind::Emitter;
        let light: NearLight = calibration.light.near_light(light.position_m);
        let rays = RayGrid::new(CameraModel::new(info.intrinsics));
        is_lit_flight.then(|| Multipath {
            grid: PatchGrid::new(rays, light, full_scale, calibration),
        })
    }

    /// Predicts the multipath of a frame; `None` if it lacks an image or shows next to nothing.
    pub fn predict(&self, frame: &Frame) -> Option<Prediction> {
        let (depth, ir) = (frame.depth.as_ref()?, frame.ir.as_ref()?);
        let radiances = self.grid.radiances(depth, ir);
        let scene = LitScene::of_radiances(&self.grid, depth, &radiances.patches);
        let plausible_white = scene.plausible_white()?;
        let bounces = bounce::bounces(scene.patches(), &scene.sources());
        Some(Prediction {
            bias: RangeBias::new(self.grid.cells(), &bounces),
            radiances,
            plausible_white,
        })
    }

    /// Predicts the multipath of a frame once more, and four times as finely, where the surface is known: `gradient_at` gives that
    /// of its signed distance near a point, both in the camera frame, `depth_m` is the frame's depth (m), and `prediction` what the
    /// frame told by itself (`is_its_own`) or one near it did. A frame's own image says, by how bright places are among their
    /// neighbours, how slanting they are where the model's normals do not.
    pub fn predict_on(
        &self,
        depth_m: &Image<f32>,
        prediction: &Prediction,
        is_its_own: bool,
        gradient_at: impl Fn(&Point3<f64>) -> Option<Vector3<f64>> + Sync,
    ) -> RangeBias {
        let Radiances { patches, places } = &prediction.radiances;
        let scene = LitScene::of_radiances(&self.grid, depth_m, patches);
        let shown = is_its_own.then_some(&places[..]);
        let receivers = receivers(&self.grid, depth_m, shown, gradient_at);
        let lit: Vec<Option<Lit>> = receivers.iter().map(|r| r.map(|r| r.lit)).collect();
        let bounces = bounce::bounces(&lit, &scene.sources());
        let bounces: Vec<Option<Bounce>> = bounces
            .iter()
            .zip(&receivers)
            .map(|(bounce, receiver)| {
                Some((*bounce)?.where_brighter_by((*receiver)?.relative_brightness))
            })
            .collect();
        RangeBias::new(self.grid.places(), &bounces)
    }

    /// Lets a prediction tell what it would by another calibration of the same camera; the bias by which its depth was corrected
    /// stays.
    pub fn recalibrate(&self, prediction: &mut Prediction, by: &Multipath) {
        prediction.radiances = self.grid.linearised_anew(&prediction.radiances, &by.grid);
    }

    /// The white level if the brightest surfaces of a frame of the given depth (m) are plaster.
    pub fn plausible_white(
        &self,
        depth_m: &Image<f32>,
        prediction: &Prediction,
    ) -> Option<WhiteLevel> {
        LitScene::of_radiances(&self.grid, depth_m, &prediction.radiances.patches).plausible_white()
    }

    /// A bias that was predicted finely, by the patches that views are compared by.
    pub fn by_patches(&self, bias: &RangeBias) -> RangeBias {
        bias.coarsened(self.grid.cells())
    }

    /// What the views of a scan tell that was fused with the multipath of `white`; `signed_distance` gives distance (m, positive
    /// outside) and gradient of the model at a point of the world. `None` where too little was seen.
    pub fn evidence(
        &self,
        views: &[Seen],
        white: Option<WhiteLevel>,
        signed_distance: impl Fn(&Point3<f64>) -> Option<(f64, Vector3<f64>)> + Sync,
    ) -> Option<Evidence> {
        evidence::evidence(views, self.grid.rays(), white, signed_distance)
    }

    /// A depth image (metres, 0 is none) with its bias changed from that of one white level to that of another; `None`
    /// stands for no multipath at all.
    pub fn corrected(
        &self,
        depth_m: &Image<f32>,
        bias: &RangeBias,
        from: Option<WhiteLevel>,
        to: Option<WhiteLevel>,
    ) -> Image<f32> {
        bias.corrected(depth_m, self.grid.rays(), from, to)
    }
}
