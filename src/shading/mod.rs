//! The near point light model, Eq. (1), forwards and inverted: light, response, flat field.
//!
//! `I_obs / full scale = (c · flat(pixel) · lobe(direction from the light) · rho · (n·l) / d²)^gamma`, with the unit vector l
//! from the surface to the light and the distance d between them. `c` and the scale of `rho` cannot be told apart; their product is called albedo here.
//! Ambient light is taken off beforehand ([`without_ambient`]) where an image without the lamp tells it; a Kinect II removes it by
//! demodulation.

mod calibration;
mod flat_field;
mod gloss;
mod light;
mod linear;

pub use calibration::{Calibration, ImageNoise, LightCalibration};
pub use flat_field::{FlatField, FlatMap, SplineGrid};
pub use gloss::{Gloss, Highlight};
pub use light::{LightTable, NearLight};
pub use linear::{
    LinearImage, LinearSamples, SATURATION, between_pixels, linearise, sharpen, without_ambient,
};
