//! Tints: by which factor the albedo of each site differs from its group's. Print and paint finer than groups, stains, the grain of a
//! stone.
//!
//! What all views show too dark by the same share, wherever their light stood, is albedo and not shape: a tilt looks darker from one
//! side and brighter from the other. So a site's tint is an unknown beside the displacements. It touches that site's residuals alone and
//! is taken out of the normal equations site by site, at its best value for any surface (variable projection, Golub and Pereyra
//! 1973). It is held to 1 like albedo that differs little as a rule, and by much where something is printed. What else adds the same
//! share to all views, as light over other surfaces does, no longer turns the surface either.

use super::energy::Block;
use super::observations::{Observation, Shown};
use crate::robust::Tukey;

/// By which factor the albedo of a site differs from its group's, where its views tell.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Tint {
    /// The factor.
    pub factor: f64,
    /// Pixels of all views that see the site.
    n_told: f64,
}

/// Standard deviation of tints beside one pixel, in the units of the data term. The residuals of a site go together over views, so that
/// more of them do not tell it better. 0.15 refines the print of a Kinect I better by 7 % and the plain recorded surfaces worse.
const SIGMA: f64 = 0.08;
/// Tints are held as if by a Cauchy distribution of this scale: what differs by more is another paint.
const PAINT: f64 = 0.07;
/// A site that fewer views see keeps its tint: they are explained by a slope as well.
const MIN_VIEWS: usize = 3;
/// How often residuals are weighted anew, and what holds the tint after each time.
const ITERATIONS: usize = 2;
const STEPS: usize = 4;
/// No site is darker or brighter than its group by more than this factor.
const MAX_FACTOR: f64 = 5.0;

impl Tint {
    /// That for which the energy of a site is about least, if views enough see it: by what is `shown` of them, in a group of this
    /// albedo; where the light does not reach, nothing tells of it. `start` is the factor that residuals are first weighted by.
    pub fn best(
        seen: &[Observation],
        shown: &[Shown],
        group: f64,
        loss: Tukey,
        start: f64,
    ) -> Option<Tint> {
        if seen.len() < MIN_VIEWS {
            return None;
        }
        let mut tint = Tint::untold(seen, start);
        for iteration in 0..ITERATIONS {
            let albedo = group * tint.factor;
            let (mut n, mut d) = sums(shown, group, |view| loss.weight(view.residual(albedo)));
            if iteration == 0 {
                if d <= 0.0 {
                    // All of them are outliers to what it was thought to be.
                    (n, d) = sums(shown, group, |_| loss.weight(0.0));
                }
                // What is printed is not held back by that either.
                tint.factor = n / d;
            }
            if d <= 0.0 {
                return None;
            }
            let most_held = tint.most_held();
            for _ in 0..STEPS {
                // As by the weight that holds it, with one division for two.
                let apart = tint.apart();
                let factor = (n * apart + most_held) / (d * apart + most_held);
                tint.factor = factor.clamp(1.0 / MAX_FACTOR, MAX_FACTOR);
            }
        }
        Some(tint)
    }

    /// That of a site of which it is not told: as it was thought to be, and held no less than where it is.
    pub fn untold(seen: &[Observation], factor: f64) -> Tint {
        Tint {
            factor,
            n_told: seen.iter().map(|view| f64::from(view.covered)).sum(),
        }
    }

    /// What it adds to the energy.
    pub fn energy(&self) -> f64 {
        0.5 * PAINT * PAINT * self.most_held() * self.apart().ln()
    }

    /// The weight by which it is held to 1.
    fn held(&self) -> f64 {
        self.most_held() / self.apart()
    }

    /// The same of a factor of 1.
    fn most_held(&self) -> f64 {
        self.n_told * (1.0 / (SIGMA * SIGMA))
    }

    /// By how much less it is held, the farther from 1.
    fn apart(&self) -> f64 {
        let apart = (self.factor - 1.0) * (1.0 / PAINT);
        1.0 + apart * apart
    }
}

/// Numerator and denominator of the tint that weighted views tell, in a group of this albedo.
fn sums(shown: &[Shown], group: f64, weight: impl Fn(&Shown) -> f64) -> (f64, f64) {
    let (n, d) = shown.iter().fold((0.0, 0.0), |(n, d), view| {
        let by_unit = weight(view) * view.covered * view.unit;
        (n + by_unit * view.observed, d + by_unit * view.unit)
    });
    (group * n, group * group * d)
}

impl<const N: usize> Block<N> {
    /// The same sums once the site's tint, which has its best value, follows the surface and the albedo of its group.
    pub fn with_tint_following(mut self, tint: &Tint) -> Self {
        let (coupling, diagonal, _) = &mut self.by_albedo;
        // By the logarithm of the factor, as by that of the albedo.
        let held = tint.held() * tint.factor * tint.factor;
        let left = held / (*diagonal + held);
        self.jtj -= *coupling * coupling.transpose() / (*diagonal + held);
        *coupling *= left;
        *diagonal *= left;
        self
    }
}
