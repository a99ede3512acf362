//! How far a depth measurement may be off, by sensor and distance.

use depth_camera::Sensor;

/// Depth at which a frontal measurement has weight 1: object scale.
const REFERENCE_DEPTH_M: f32 = 0.6;

/// Standard deviation of one depth pixel along the optical axis, quadratic in distance: `floor_m + growth·(z − z0)²`; and what a
/// pixel on a rim is worth.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct DepthNoise {
    floor_m: f32,
    growth_per_m: f32,
    reference_m: f32,
    mixes_at_rims: bool,
}

impl DepthNoise {
    /// The published noise of a sensor.
    ///
    /// Kinect I: Nguyen, Izadi, Lovell 2012, σ = 1.2 mm + 1.9 mm (z − 0.4)² at up to 60° of incidence.
    /// Kinect II: Fankhauser et al. 2015, σ = 1.5 − 0.5 z + 0.3 z² mm; completed to a square. On a rim its pixels mix the light
    /// of two surfaces and lie between them; those of a Kinect I are matched to one or the other.
    pub fn of_sensor(sensor: Sensor) -> Self {
        match sensor {
            Sensor::Kinect1 => DepthNoise {
                floor_m: 0.0012,
                growth_per_m: 0.0019,
                reference_m: 0.4,
                mixes_at_rims: false,
            },
            Sensor::Kinect2 => DepthNoise {
                floor_m: 0.0013,
                growth_per_m: 0.0003,
                reference_m: 0.83,
                mixes_at_rims: true,
            },
        }
    }

    /// Weight of a pixel without a normal, on a rim, beside one that faces the camera.
    #[inline(always)]
    pub fn rim_weight(&self) -> f32 {
        if self.mixes_at_rims { 0.01 } else { 0.1 }
    }

    /// Whether a pixel on a rim mixes two surfaces, so that it may lie where there is none.
    pub fn mixes_at_rims(&self) -> bool {
        self.mixes_at_rims
    }

    /// How much more precise a measurement of a standard deviation is than a frontal one at object scale; its square is what it weighs.
    #[inline(always)]
    pub fn precision(&self, sigma_m: f32) -> f32 {
        self.sigma_m(REFERENCE_DEPTH_M) / sigma_m
    }

    /// Standard deviation at a depth, metres.
    #[inline(always)]
    pub fn sigma_m(&self, depth_m: f32) -> f32 {
        let beyond = depth_m - self.reference_m;
        self.floor_m + self.growth_per_m * beyond * beyond
    }
}
