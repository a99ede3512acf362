//! The robust least squares problem: Levenberg–Marquardt over all unknowns, and their covariance.

use super::GoesOn;
use super::estimate::{Estimate, SessionFit};
use super::model::{Row, cap_row, intensity_row, limb_row};
use super::normal_equations::{Normal, inverted};
use super::refusal::NoEstimate;
use super::samples::{Place, Sample, Samples};
use super::state::{Priors, State};
use crate::robust::{Tukey, median, median_absolute_deviation};
use nalgebra::{DMatrix, DVector};
use rayon::prelude::*;
use std::collections::BTreeMap;

/// Samples, priors and the robust scales of one minimisation.
pub struct Problem<'a> {
    samples: Samples,
    priors: &'a Priors,
    /// Unknowns that stay as they are.
    frozen: Vec<bool>,
    flat_is_measured: bool,
}

/// The robust losses of intensities, by session, and of limbs.
struct Losses {
    intensities: Vec<Tukey>,
    limbs: Tukey,
}

/// Times that the robust scales are estimated anew.
const N_SCALES: usize = 3;
const MAX_STEPS: usize = 12;
/// Samples that one tile of a sum holds; sums are added in order.
const SUM_TILE: usize = 4096;
/// Second differences of the flat field's coefficients: the logarithm of a cosine to the third has 0.09.
const FLAT_BEND_SIGMA: f64 = 0.15;
/// On the optical axis the flat field is 1.
const GAUGE_WEIGHT: f64 = 1e8;

impl<'a> Problem<'a> {
    /// The problem of these samples; `state` gives the layout of the unknowns. Without samples of a wall the flat field stays
    /// as it is.
    pub fn new(samples: Samples, priors: &'a Priors, state: &State) -> Self {
        let is_wall = |sample: &Sample| matches!(sample.place, Place::Wall { .. });
        let flat_is_measured = samples.intensities.iter().any(is_wall);
        let mut frozen = vec![false; state.n_unknowns()];
        if samples.intensities.is_empty() {
            frozen[..state.session_start(0)].fill(true);
            for session in 0..state.sessions.len() {
                frozen[state.session_start(session)] = true;
            }
        }
        if !flat_is_measured {
            frozen[state.flat_start()..state.session_start(0)].fill(true);
        }
        Problem {
            samples,
            priors,
            frozen,
            flat_is_measured,
        }
    }

    /// Minimises the robust cost from `state` on.
    ///
    /// # Errors
    /// If `goes_on` says no; `state` is then somewhere on the way.
    pub fn minimise(&self, state: &mut State, goes_on: &GoesOn) -> Result<(), NoEstimate> {
        for _ in 0..N_SCALES {
            let losses = self.losses(state);
            self.descend(state, &losses, goes_on)?;
        }
        Ok(())
    }

    fn descend(
        &self,
        state: &mut State,
        losses: &Losses,
        goes_on: &GoesOn,
    ) -> Result<(), NoEstimate> {
        let mut normal = self.linearise(state, losses);
        let mut damping = 1e-4;
        for _ in 0..MAX_STEPS {
            if !goes_on() {
                return Err(NoEstimate::Stopped);
            }
            let Some(step) = normal.step(damping) else {
                damping *= 10.0;
                continue;
            };
            let next = state.moved(&step);
            let next_normal = self.linearise(&next, losses);
            if next_normal.cost < normal.cost {
                let gain = (normal.cost - next_normal.cost) / normal.cost;
                (*state, normal) = (next, next_normal);
                damping = (damping * 0.2).max(1e-9);
                if gain < 1e-7 {
                    break;
                }
            } else {
                damping *= 10.0;
                if damping > 1e6 {
                    break;
                }
            }
        }
        Ok(())
    }

    /// Robust scales of the residuals at a state, not below what is expected of them.
    fn losses(&self, state: &State) -> Losses {
        let scaled = |mut residuals: Vec<f64>| Tukey {
            scale: median_absolute_deviation(&mut residuals).max(1.0),
            cutoff: Tukey::EFFICIENT_CUTOFF,
        };
        let n_sessions = state.sessions.len();
        let mut by_session = vec![Vec::new(); n_sessions];
        let mut row = Row::default();
        for sample in &self.samples.intensities {
            if intensity_row(sample, state, &mut row).is_some() {
                by_session[sample.session].push(row.residual);
            }
        }
        let mut limbs = Vec::new();
        for limb in &self.samples.limbs {
            if limb_row(limb, state, &mut row).is_some() {
                limbs.push(row.residual);
            }
        }
        Losses {
            intensities: by_session.into_iter().map(scaled).collect(),
            limbs: scaled(limbs),
        }
    }

    fn linearise(&self, state: &State, losses: &Losses) -> Normal {
        let n = state.n_unknowns();
        let tiles: Vec<Normal> = self
            .samples
            .intensities
            .par_chunks(SUM_TILE)
            .map(|tile| {
                let (mut normal, mut row) = (Normal::zero(n), Row::default());
                for sample in tile {
                    let loss = &losses.intensities[sample.session];
                    match intensity_row(sample, state, &mut row) {
                        Some(()) => normal.add(&row, loss),
                        // What the state does not light costs as much as an outlier.
                        None => normal.cost += loss.loss(f64::MAX.sqrt()),
                    }
                }
                normal
            })
            .collect();
        let mut normal = self.outlines_and_priors(state, losses);
        for tile in tiles {
            normal.jtj += tile.jtj;
            normal.jtr += tile.jtr;
            normal.cost += tile.cost;
        }
        for index in (0..n).filter(|index| self.frozen[*index]) {
            normal.jtj.row_mut(index).fill(0.0);
            normal.jtj.column_mut(index).fill(0.0);
            normal.jtj[(index, index)] = 1.0;
            normal.jtr[index] = 0.0;
        }
        normal
    }

    fn outlines_and_priors(&self, state: &State, losses: &Losses) -> Normal {
        let (mut normal, mut row) = (Normal::zero(state.n_unknowns()), Row::default());
        for limb in &self.samples.limbs {
            if limb_row(limb, state, &mut row).is_some() {
                normal.add(&row, &losses.limbs);
            }
        }
        for cap in &self.samples.caps {
            if cap_row(cap, state, &mut row).is_some() {
                normal.add_squared(&row, 1.0);
            }
        }
        self.add_priors(state, &mut normal);
        normal
    }

    fn add_priors(&self, state: &State, normal: &mut Normal) {
        for (index, offset, weight) in state.prior_terms(self.priors) {
            let row = Row {
                residual: offset,
                entries: vec![(index, 1.0)],
            };
            normal.add_squared(&row, weight);
        }
        if !self.flat_is_measured {
            return;
        }
        let start = state.flat_start();
        let (grid, log) = (&state.flat.grid, &state.flat.log);
        let axis = Row {
            residual: state.flat.log_factor(0.0, 0.0),
            entries: grid.weights(0.0, 0.0).map(|(k, w)| (start + k, w)).into(),
        };
        normal.add_squared(&axis, GAUGE_WEIGHT);
        let mut bend = |[a, b, c]: [usize; 3]| {
            let row = Row {
                residual: log[a] - 2.0 * log[b] + log[c],
                entries: vec![(start + a, 1.0), (start + b, -2.0), (start + c, 1.0)],
            };
            normal.add_squared(&row, FLAT_BEND_SIGMA.powi(-2));
        };
        let (columns, rows) = (grid.columns, grid.rows);
        for row in 0..rows {
            for column in 0..columns {
                let at = row * columns + column;
                if column + 2 < columns {
                    bend([at, at + 1, at + 2]);
                }
                if row + 2 < rows {
                    bend([at, at + columns, at + 2 * columns]);
                }
            }
        }
    }

    /// The state with its covariance `H⁻¹ M H⁻¹`: H from the robust cost, M from the sums of the residuals' gradients over
    /// tiles and, once more, over whole images, so that neither errors of a patch nor of an image's pose are taken for
    /// noise; priors count with their own variance.
    pub fn estimate(&self, state: State) -> Estimate {
        let losses = self.losses(&state);
        let hessian = self.linearise(&state, &losses).jtj;
        let mut priors = Normal::zero(state.n_unknowns());
        self.add_priors(&state, &mut priors);
        let mut spread = priors.jtj;
        for clusters in [
            self.scores(&state, &losses, |sample| sample.tile),
            self.scores(&state, &losses, |sample| sample.image_number),
        ] {
            let n = clusters.len() as f64;
            let correction = n / (n - 1.0).max(1.0);
            for score in clusters.values() {
                spread.ger(correction, score, score, 1.0);
            }
        }
        self.add_outline_spread(&state, &losses, &mut spread);
        let (inverse, mut is_told) = inverted(&hessian);
        let mut covariance = &inverse * spread * &inverse;
        for index in (0..state.n_unknowns()).filter(|index| self.frozen[*index]) {
            covariance.row_mut(index).fill(0.0);
            covariance.column_mut(index).fill(0.0);
            is_told[index] = false;
        }
        Estimate {
            covariance,
            is_told,
            fits: self.fits(&state, &losses),
            flat_is_measured: self.flat_is_measured,
            state,
        }
    }

    /// Sums of the intensities' gradients over clusters.
    fn scores(
        &self,
        state: &State,
        losses: &Losses,
        cluster: impl Fn(&Sample) -> usize,
    ) -> BTreeMap<usize, DVector<f64>> {
        let mut scores = BTreeMap::new();
        let mut row = Row::default();
        for sample in &self.samples.intensities {
            if intensity_row(sample, state, &mut row).is_none() {
                continue;
            }
            let weight = losses.intensities[sample.session].weight(row.residual) * row.residual;
            let score = scores
                .entry(cluster(sample))
                .or_insert_with(|| DVector::zeros(state.n_unknowns()));
            for (index, derivative) in &row.entries {
                score[*index] += weight * derivative;
            }
        }
        scores
    }

    /// Outlines count with their own variance, limbs of one image as one: they share what blurs them.
    fn add_outline_spread(&self, state: &State, losses: &Losses, spread: &mut DMatrix<f64>) {
        let mut row = Row::default();
        let mut by_image: BTreeMap<(usize, usize), DVector<f64>> = BTreeMap::new();
        for limb in &self.samples.limbs {
            if limb_row(limb, state, &mut row).is_some() {
                let weight = losses.limbs.weight(row.residual) * row.residual;
                let score = by_image
                    .entry((limb.session, limb.image))
                    .or_insert_with(|| DVector::zeros(state.n_unknowns()));
                for (index, derivative) in &row.entries {
                    score[*index] += weight * derivative;
                }
            }
        }
        for score in by_image.values() {
            spread.ger(1.0, score, score, 1.0);
        }
        let mut caps = Normal::zero(state.n_unknowns());
        for cap in &self.samples.caps {
            if cap_row(cap, state, &mut row).is_some() {
                caps.add_squared(&row, 1.0);
            }
        }
        *spread += caps.jtj;
    }

    fn fits(&self, state: &State, losses: &Losses) -> Vec<SessionFit> {
        (0..state.sessions.len())
            .map(|session| {
                let loss = &losses.intensities[session];
                let of_session = self.samples.intensities.iter();
                let of_session = of_session.filter(|sample| sample.session == session);
                let (mut deviations, mut noises, mut n_outliers) = (Vec::new(), Vec::new(), 0);
                let mut images = std::collections::BTreeSet::new();
                let mut row = Row::default();
                for sample in of_session {
                    images.insert(sample.image_number);
                    noises.push(sample.noise);
                    match intensity_row(sample, state, &mut row) {
                        Some(()) => {
                            deviations.push(row.residual * sample.sigma);
                            n_outliers += usize::from(loss.weight(row.residual) == 0.0);
                        }
                        None => n_outliers += 1,
                    }
                }
                let n_samples = noises.len();
                SessionFit {
                    n_images: images.len(),
                    n_samples,
                    deviation: median_absolute_deviation(&mut deviations),
                    noise: median(&mut noises).unwrap_or(0.0),
                    outlier_share: n_outliers as f64 / n_samples.max(1) as f64,
                }
            })
            .collect()
    }
}
