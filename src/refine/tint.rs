//! Tints: by which factor the albedo of each site differs from its group's. Print and paint finer than groups, stains, the grain of a
//! stone.
//!
//! What all views show too dark by the same share, wherever their light stood, is albedo and not shape: a tilt looks darker from one
//! side and brighter from the other. So a site's tint is an unknown beside the displacements. It touches that site's residuals alone and
//! is taken out of the normal equations site by site, at its best value for any surface (variable projection, Golub and Pereyra
//! 1973). It is held to 1 like albedo that differs little as a rule, and by much where something is printed. What else adds the same
//! share to all views, as light over other surfaces does, no longer turns the surface either.

use super::observations::Observation;
use super::side_by_side::{OfSites, SITES, Shown};
use super::site_blocks::Block;
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
    /// That of a site of which it is not told: as it was thought to be, and held no less than where it is.
    pub fn untold(seen: &[Observation], factor: f64) -> Tint {
        Tint {
            factor,
            n_told: seen.iter().map(|view| f64::from(view.covered)).sum(),
        }
    }

    /// What it adds to the energy.
    pub fn energy(&self) -> f64 {
        0.5 * PAINT * PAINT * most_held(self.n_told) * apart(self.factor).ln()
    }

    /// The weight by which it is held to 1.
    fn held(&self) -> f64 {
        most_held(self.n_told) / apart(self.factor)
    }
}

/// Those for which the energy of sites side by side is about least, if views enough see them: by what is `shown` of them in groups of these
/// albedos; where the light does not reach, nothing tells of one. `start` are the factors that residuals are first weighted by.
#[inline(always)]
pub fn best_tints(
    shown: &[Shown],
    n_views: &[usize; SITES],
    group: &OfSites,
    loss: Tukey,
    start: &OfSites,
) -> [Option<Tint>; SITES] {
    let mut n_told = [0.0; SITES];
    for view in shown {
        for (sum, covered) in n_told.iter_mut().zip(&view.covered) {
            *sum += covered;
        }
    }
    let mut is_told = n_views.map(|n| n >= MIN_VIEWS);
    let mut factor = *start;
    for iteration in 0..ITERATIONS {
        let mut albedo = [0.0; SITES];
        for i in 0..SITES {
            albedo[i] = group[i] * factor[i];
        }
        let (mut n, mut d) = sums(shown, group, Some(&albedo), loss);
        if iteration == 0 {
            if d.iter().zip(&is_told).any(|(&d, told)| *told & (d <= 0.0)) {
                // All of them are outliers to what it was thought to be.
                let (every_n, every_d) = sums(shown, group, None, loss);
                for i in 0..SITES {
                    if d[i] <= 0.0 {
                        (n[i], d[i]) = (every_n[i], every_d[i]);
                    }
                }
            }
            // What is printed is not held back by that either.
            for i in 0..SITES {
                factor[i] = n[i] / d[i];
            }
        }
        for _ in 0..STEPS {
            for i in 0..SITES {
                // As by the weight that holds it, with one division for two.
                let (apart, held) = (apart(factor[i]), most_held(n_told[i]));
                let next = (n[i] * apart + held) / (d[i] * apart + held);
                factor[i] = next.clamp(1.0 / MAX_FACTOR, MAX_FACTOR);
            }
        }
        for i in 0..SITES {
            is_told[i] &= d[i] > 0.0;
        }
    }
    let mut tints = [None; SITES];
    for i in 0..SITES {
        if is_told[i] {
            tints[i] = Some(Tint {
                factor: factor[i],
                n_told: n_told[i],
            });
        }
    }
    tints
}

/// Numerators and denominators of the tints that views tell, in groups of these albedos: weighted by their residuals for `albedo`, or all
/// the same.
#[inline(always)]
fn sums(
    shown: &[Shown],
    group: &OfSites,
    albedo: Option<&OfSites>,
    loss: Tukey,
) -> (OfSites, OfSites) {
    let (mut n, mut d) = ([0.0; SITES], [0.0; SITES]);
    for view in shown {
        let residuals = match albedo {
            Some(albedo) => view.residuals(albedo),
            None => [0.0; SITES],
        };
        for i in 0..SITES {
            let by_unit = loss.weight(residuals[i]) * view.covered[i] * view.unit[i];
            n[i] += by_unit * view.observed[i];
            d[i] += by_unit * view.unit[i];
        }
    }
    for i in 0..SITES {
        n[i] *= group[i];
        d[i] *= group[i] * group[i];
    }
    (n, d)
}

/// The weight by which a tint of 1 is held there, of a site of which views tell so much.
#[inline(always)]
fn most_held(n_told: f64) -> f64 {
    n_told * (1.0 / (SIGMA * SIGMA))
}

/// By how much less a factor is held, the farther from 1.
#[inline(always)]
fn apart(factor: f64) -> f64 {
    let apart = (factor - 1.0) * (1.0 / PAINT);
    1.0 + apart * apart
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

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::lanes::arch_levels;
    use pulp::{Simd, WithSimd};

    /// What views show of each site, of which groups have an albedo of 0.6.
    struct Sought<'a> {
        shown: &'a [Shown],
        n_views: [usize; SITES],
    }

    impl WithSimd for Sought<'_> {
        type Output = [Option<Tint>; SITES];

        #[inline(always)]
        fn with_simd<S: Simd>(self, _: S) -> Self::Output {
            let loss = Tukey {
                scale: 1.0,
                cutoff: 4.0,
            };
            best_tints(
                self.shown,
                &self.n_views,
                &[0.6; SITES],
                loss,
                &[1.0; SITES],
            )
        }
    }

    /// Observations of sites in the lanes for which `is_in`: by how many views, and how much brighter than by the group's albedo.
    fn shown(sites: &[(usize, f64); SITES], is_in: impl Fn(usize) -> bool) -> Vec<Shown> {
        let of_view = |view: usize| {
            let mut shown = Shown {
                observed: [0.0; SITES],
                unit: [0.0; SITES],
                covered: [0.0; SITES],
            };
            let lanes = (0..SITES).filter(|lane| is_in(*lane) && view < sites[*lane].0);
            for lane in lanes {
                let unit = 50.0 + 7.0 * view as f64;
                shown.unit[lane] = unit;
                shown.observed[lane] = 0.6 * sites[lane].1 * unit + 0.2 * (view % 2) as f64;
                shown.covered[lane] = 0.4;
            }
            shown
        };
        (0..6).map(of_view).collect()
    }

    #[test]
    fn a_site_has_the_tint_beside_others_that_it_has_alone_with_any_instructions() {
        // The fifth and sixth are farther off than any residual that counts.
        let sites: [(usize, f64); SITES] = [
            (6, 1.0),
            (0, 1.0),
            (2, 1.05),
            (3, 1.05),
            (4, 3.0),
            (6, 0.2),
            (5, 0.95),
            (1, 3.0),
        ];
        let n_views = sites.map(|(n_views, _)| n_views);
        let all = shown(&sites, |_| true);
        let bits = |tint: &Option<Tint>| tint.map(|of| [of.factor, of.n_told].map(f64::to_bits));
        for arch in arch_levels() {
            let together = arch.dispatch(Sought {
                shown: &all,
                n_views,
            });
            for (lane, &(n_views, brighter)) in sites.iter().enumerate() {
                let one = shown(&sites, |other| other == lane);
                let mut n_views_alone = [0; SITES];
                n_views_alone[lane] = n_views;
                let alone = arch.dispatch(Sought {
                    shown: &one,
                    n_views: n_views_alone,
                });
                assert_eq!(bits(&together[lane]), bits(&alone[lane]), "site {lane}");
                match &together[lane] {
                    Some(tint) => {
                        let is_between = (tint.factor - 1.0).abs() <= (brighter - 1.0).abs() + 0.01;
                        assert!(is_between, "site {lane}: {tint:?}");
                        let is_told = (tint.factor - 1.0).abs() >= 0.5 * (brighter - 1.0).abs();
                        assert!(is_told, "site {lane}: {tint:?}");
                    }
                    None => assert!(n_views < MIN_VIEWS, "site {lane}"),
                }
                assert!(together[lane].is_none() || n_views >= MIN_VIEWS);
            }
        }
    }
}
