//! What came out of a fit, with what is known of its certainty.

use super::state::State;
use nalgebra::{DMatrix, DVector};

/// Half the width of a 95 % confidence interval, in standard deviations.
pub const INTERVAL_SIGMAS: f64 = 1.96;

/// A value with its standard deviation.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Measured {
    /// The value.
    pub value: f64,
    /// Its standard deviation; infinite where nothing tells the value.
    pub sigma: f64,
}

impl Measured {
    /// Half the width of the 95 % confidence interval.
    pub fn half_width(&self) -> f64 {
        INTERVAL_SIGMAS * self.sigma
    }
}

/// What was fitted, and how well.
#[derive(Clone, Debug)]
pub struct Estimate {
    /// The unknowns.
    pub state: State,
    /// Their covariance, robust to residuals that are correlated within tiles of an image.
    pub covariance: DMatrix<f64>,
    /// Of each unknown: whether anything tells it, and its part of the covariance says how well.
    pub is_told: Vec<bool>,
    /// Of each session: robust deviation of log intensity from the model, and share of the samples that are outliers.
    pub fits: Vec<SessionFit>,
    /// Whether a wall measured the flat field.
    pub flat_is_measured: bool,
}

/// How well one session fits.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SessionFit {
    /// Images used.
    pub n_images: usize,
    /// Samples used.
    pub n_samples: usize,
    /// Robust standard deviation of observed over predicted intensity, as a share.
    pub deviation: f64,
    /// What noise alone would make of it: median over the samples.
    pub noise: f64,
    /// Share of the samples that count for nothing.
    pub outlier_share: f64,
}

impl Estimate {
    /// The exponent of the response.
    pub fn gamma(&self) -> Measured {
        self.measured(0, self.state.gamma)
    }

    /// The light's place on each axis, metres.
    pub fn light_position(&self) -> [Measured; 3] {
        std::array::from_fn(|axis| self.measured(1 + axis, self.state.light.position[axis]))
    }

    /// The power of the light's lobe.
    pub fn lobe_power(&self) -> Measured {
        self.measured(4, self.state.light.lobe_power)
    }

    /// The radius of a session's sphere, metres; `None` for a wall.
    pub fn radius(&self, session: usize) -> Option<Measured> {
        let sphere = self.state.sessions[session].sphere.as_ref()?;
        Some(self.measured(self.state.session_start(session) + 2, sphere.radius_m))
    }

    /// Log of the flat field and the lobe together for the ray (X/Z, Y/Z), over that of the optical axis: how a far wall
    /// darkens, where light and camera see it from the same side. It is better known than either.
    pub fn log_far_field(&self, x: f64, y: f64) -> Measured {
        let (start, map) = (self.state.flat_start(), &self.state.flat);
        let mut weights = DVector::zeros(self.covariance.nrows());
        let log_cosine = -0.5 * (1.0 + x * x + y * y).ln();
        weights[4] = log_cosine;
        for (index, weight) in map.grid.weights(x, y) {
            weights[start + index] += weight;
        }
        for (index, weight) in map.grid.weights(0.0, 0.0) {
            weights[start + index] -= weight;
        }
        let mut touched = weights.iter().zip(&self.is_told);
        let variance = match touched.all(|(weight, is_told)| *weight == 0.0 || *is_told) {
            true => weights.dot(&(&self.covariance * &weights)),
            false => f64::INFINITY,
        };
        Measured {
            value: map.log_factor(x, y) - map.log_factor(0.0, 0.0)
                + self.state.light.lobe_power * log_cosine,
            sigma: variance.max(0.0).sqrt(),
        }
    }

    /// Correlation of the exponent with the other shared unknowns: light x, y, z and lobe power.
    pub fn gamma_correlations(&self) -> [f64; 4] {
        std::array::from_fn(|k| self.correlation(0, 1 + k))
    }

    /// Correlation of the light's place, x, y, z, with the lobe's power.
    pub fn lobe_correlations(&self) -> [f64; 3] {
        std::array::from_fn(|axis| self.correlation(4, 1 + axis))
    }

    fn correlation(&self, a: usize, b: usize) -> f64 {
        let c = &self.covariance;
        c[(a, b)] / (c[(a, a)] * c[(b, b)]).sqrt()
    }

    fn measured(&self, index: usize, value: f64) -> Measured {
        let variance = match self.is_told[index] {
            true => self.covariance[(index, index)],
            false => f64::INFINITY,
        };
        Measured {
            value,
            sigma: variance.max(0.0).sqrt(),
        }
    }
}
