//! Print: albedo that varies over a surface without changing its shape.

use std::f64::consts::TAU;

use nalgebra::Vector3;

/// A pattern of the albedo: waves along the solid's three axes, which print it without changing its shape.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Texture {
    /// Largest deviation of the albedo from its mean, as a share of it.
    pub contrast: f64,
    /// Length of a wave, metres; along y it is 1.3, along z 1.7 times as long, so that the pattern does not repeat soon.
    pub wavelength: f64,
}

impl Texture {
    /// The albedo at a point (solid frame) as a share of its mean.
    pub(crate) fn factor(&self, p: &Vector3<f64>) -> f64 {
        let k = TAU / self.wavelength;
        let waves = (k * p.x).sin() + (k / 1.3 * p.y).sin() + (k / 1.7 * p.z).sin();
        1.0 + self.contrast * waves / 3.0
    }
}
