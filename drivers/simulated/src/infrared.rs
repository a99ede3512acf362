//! How the IR image comes about: response, lens and light.

use depth_camera::{Intrinsics, Light, Sensor};

use crate::{render::NearLight, sensor};

/// The model of a sensor's IR image: `I = (flat · lobe · albedo · cos / d²)^gamma` as shares of full scale.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Infrared {
    /// Exponent of the response.
    pub gamma: f64,
    /// The lens darkens the image by the cosine between ray and optical axis, to this power.
    pub lens_power: f64,
    /// The light shines by the cosine between the direction *from the light* and the optical axis, to this power.
    pub lobe_power: f64,
    /// Where the light is, camera frame, metres.
    pub light_position_m: [f64; 3],
    /// How far right of and below its place in the depth image a point lies in the IR image, pixels.
    pub offset_px: [f64; 2],
}

impl Infrared {
    /// A sensor of the kind, with no offset.
    pub fn of_sensor(sensor: Sensor) -> Self {
        let (gamma, lens_power, lobe_power) = match sensor {
            Sensor::Kinect1 => (0.80, 1.5, 0.0),
            Sensor::Kinect2 => (0.87, 1.0, 2.0),
        };
        Infrared {
            gamma,
            lens_power,
            lobe_power,
            light_position_m: sensor::light_position_m(sensor),
            offset_px: [0.0, 0.0],
        }
    }

    /// What the camera says of its light.
    pub(crate) fn light(&self, sensor: Sensor) -> Light {
        Light {
            position_m: self.light_position_m,
            kind: sensor::light_kind(sensor),
        }
    }

    /// The light for the renderer.
    pub(crate) fn near_light(&self) -> NearLight {
        NearLight {
            position_m: self.light_position_m,
            lobe_power: self.lobe_power,
            lens_power: self.lens_power,
        }
    }

    /// The lens of the IR image, given that of the depth image.
    pub(crate) fn shifted(&self, lens: &Intrinsics) -> Intrinsics {
        Intrinsics {
            cx: lens.cx + self.offset_px[0],
            cy: lens.cy + self.offset_px[1],
            ..*lens
        }
    }
}
