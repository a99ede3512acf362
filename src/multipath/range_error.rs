//! What a time-of-flight sensor gets wrong by range alone: its wiggle, or what is left of it once the sines of its frequencies are taken
//! off.
//!
//! The light of such a sensor is not modulated by a pure sine; its harmonics bend the phase, and depth is millimetres too long at one
//! range and too short at another, alike in all pixels (Lindner and Kolb, *Lateral and depth calibration of PMD-distance sensors*,
//! ISVC 2006; of a Kinect II Sarbolandi et al., *Kinect range sensing: structured-light versus time-of-flight Kinect*, CVIU 2015). No
//! form is taken for granted but that of a smooth curve.
//!
//! Views that see a place from different ranges disagree by it. Where the surface lies and how each view was moved are unknown:
//! what a place has in all views, and what a motion of a view explains, is projected out of what was found and of what each part of
//! the curve would make of it, so that tracking and fusion hide nothing. Multipath is fitted beside it, for it grows with range too.
//! A constant and a share of the range are projected out too: of a constant the model has taken up most, and a share is the scene's scale.

use super::evidence::{MIN_PATCHES, MIN_VIEWS, Sample, motion_of};
use super::range_spline::RangeSpline;
use crate::geometry::{MotionEquations, RangeError};
use crate::robust::{Tukey, median_absolute_deviation};
use nalgebra::{DMatrix, DVector};
use rayon::prelude::*;
use std::{
    collections::{BTreeMap, BTreeSet},
    ops::Range,
};

/// How far a wiggle may be off before anything is known, metres.
const PRIOR_M: f64 = 0.01;
/// How far the strength of multipath may be off before anything is known; plaster of a Kinect II has about 1.2.
const PRIOR_STRENGTH: f64 = 3.0;
/// Turns of places and motions until what both explain is gone.
const SWEEPS: usize = 30;
/// Rounds of weights.
const ROUNDS: usize = 3;
/// An error of which one half of the views explains less of the other's disagreement is not believed. What multipath and tracking
/// leave looks like 4 and 10 % on the recorded bust and relief, and to take that off helps neither; a wiggle of 1 mm is 21 and 24 %.
const MIN_EXPLAINED: f64 = 0.15;

/// The error that the views of a model, patch by patch, still show; `None` if one half of them does not show that of the other.
pub(super) fn range_error(views: &[Vec<Sample>]) -> Option<RangeError> {
    let differences = Differences::new(views)?;
    let mut weights = vec![1.0; differences.samples.len()];
    let mut projected = differences.projected(&weights);
    for _ in 0..ROUNDS {
        let left = projected.left_by(&projected.solved(&weights, |_| true)?);
        let scale = median_absolute_deviation(&mut left.clone());
        if scale <= 0.0 {
            return None;
        }
        let tukey = Tukey {
            scale,
            cutoff: Tukey::EFFICIENT_CUTOFF,
        };
        for (weight, left) in weights.iter_mut().zip(left) {
            *weight = tukey.weight(left) * scale * scale;
        }
        projected = differences.projected(&weights);
    }
    let found = projected.solved(&weights, |_| true)?;
    let explained = projected.explained_across(&weights)?;
    let error = differences.error(&found);
    tracing::info!(
        explained,
        largest_mm = 1e3 * error.largest_m(),
        patches = differences.samples.len(),
        "error by range: what one half of the views explains of the other"
    );
    (explained >= MIN_EXPLAINED).then_some(error)
}

/// Patches that several views have of one place, each with how deep it lies and what a unit of each unknown would make of that.
struct Differences<'a> {
    samples: Vec<&'a Sample>,
    /// Of each view, where its patches are.
    views: Vec<Range<usize>>,
    /// Of each patch.
    places: Vec<usize>,
    n_places: usize,
    spline: RangeSpline,
    /// A column each: how deep, the strength of multipath, the parts of the curve.
    columns: Vec<Vec<f64>>,
}

/// The same without what places and motions explain.
struct Projected<'a> {
    views: &'a [Range<usize>],
    found: Vec<f64>,
    /// A column each: the strength of multipath, the parts of the curve.
    unknowns: Vec<Vec<f64>>,
}

impl<'a> Differences<'a> {
    fn new(views: &'a [Vec<Sample>]) -> Option<Self> {
        let mut n_views: BTreeMap<[i32; 4], usize> = BTreeMap::new();
        for view in views.iter().filter(|view| view.len() >= MIN_PATCHES) {
            let places: BTreeSet<[i32; 4]> = view.iter().map(place).collect();
            for place in places {
                *n_views.entry(place).or_default() += 1;
            }
        }
        n_views.retain(|_, n| *n >= MIN_VIEWS);
        let shared = n_views.keys().enumerate();
        let shared: BTreeMap<[i32; 4], usize> =
            shared.map(|(index, place)| (*place, index)).collect();
        let mut samples: Vec<&Sample> = Vec::new();
        let (mut places, mut of_views) = (Vec::new(), Vec::new());
        for view in views {
            let compared = view
                .iter()
                .filter_map(|sample| Some((sample, *shared.get(&place(sample))?)));
            let compared: (Vec<&Sample>, Vec<usize>) = compared.unzip();
            if compared.0.len() >= MIN_PATCHES {
                let first = samples.len();
                samples.extend(compared.0);
                places.extend(compared.1);
                of_views.push(first..samples.len());
            }
        }
        let ranges: Vec<f64> = samples.iter().map(|sample| sample.range_m).collect();
        let spline = RangeSpline::new(&ranges)?;
        let mut columns = vec![
            samples.iter().map(|sample| sample.depth_m).collect(),
            samples.iter().map(|sample| sample.beta_m).collect(),
        ];
        columns.resize(2 + spline.n_parts(), Vec::with_capacity(samples.len()));
        for sample in &samples {
            let parts = spline.row(sample.range_m);
            for (column, part) in columns[2..].iter_mut().zip(parts) {
                column.push(part * sample.cosine);
            }
        }
        Some(Differences {
            samples,
            views: of_views,
            places,
            n_places: shared.len(),
            spline,
            columns,
        })
    }

    /// Takes off what places and motions explain, by turns.
    fn projected(&self, weights: &[f64]) -> Projected<'_> {
        let motions: Vec<Option<MotionEquations>> = self
            .views
            .iter()
            .map(|view| {
                let samples = self.samples[view.clone()].iter().copied();
                motion_of(samples.zip(weights[view.clone()].iter().copied()))
            })
            .collect();
        let mut place_weights = vec![f64::MIN_POSITIVE; self.n_places];
        for (place, weight) in self.places.iter().zip(weights) {
            place_weights[*place] += weight;
        }
        let without = |column: &Vec<f64>| {
            let mut left = column.clone();
            for _ in 0..SWEEPS {
                let mut means = vec![0.0; self.n_places];
                for ((value, place), weight) in left.iter().zip(&self.places).zip(weights) {
                    means[*place] += weight * value / place_weights[*place];
                }
                for (value, place) in left.iter_mut().zip(&self.places) {
                    *value -= means[*place];
                }
                for (view, motion) in self.views.iter().zip(&motions) {
                    if let Some(motion) = motion {
                        let of_view: Vec<f64> = motion.left_of(&left[view.clone()]).collect();
                        left[view.clone()].copy_from_slice(&of_view);
                    }
                }
            }
            left
        };
        let mut columns: Vec<Vec<f64>> = self.columns.par_iter().map(without).collect();
        let unknowns = columns.split_off(1);
        Projected {
            views: &self.views,
            found: columns.remove(0),
            unknowns,
        }
    }

    /// The error that the unknowns make.
    fn error(&self, unknowns: &DVector<f64>) -> RangeError {
        self.spline.error(&unknowns.as_slice()[1..])
    }
}

/// Where a patch is, and which way it faces: round an edge is another place.
fn place(sample: &Sample) -> [i32; 4] {
    let axis = sample.normal.iamax();
    let side = 2 * axis as i32 + i32::from(sample.normal[axis] > 0.0);
    let [x, y, z] = sample.place;
    [x, y, z, side]
}

impl Projected<'_> {
    /// The unknowns that explain best what was found in the views that are asked; `None` if rounding forbids.
    fn solved(&self, weights: &[f64], is_asked: impl Fn(usize) -> bool) -> Option<DVector<f64>> {
        let n = self.unknowns.len();
        let (mut matrix, mut right) = (DMatrix::zeros(n, n), DVector::zeros(n));
        let (mut squares, mut total) = (0.0, 0.0);
        let asked = self
            .views
            .iter()
            .enumerate()
            .filter(|(view, _)| is_asked(*view));
        for i in asked.flat_map(|(_, view)| view.clone()) {
            let (weight, found) = (weights[i], self.found[i]);
            for a in 0..n {
                let by_a = weight * self.unknowns[a][i];
                right[a] += by_a * found;
                for b in 0..=a {
                    matrix[(a, b)] += by_a * self.unknowns[b][i];
                }
            }
            squares += weight * found * found;
            total += weight;
        }
        let variance = squares / total;
        for a in 0..n {
            let prior = if a == 0 { PRIOR_STRENGTH } else { PRIOR_M };
            matrix[(a, a)] += variance / (prior * prior);
        }
        Some(matrix.cholesky()?.solve(&right))
    }

    /// What unknowns leave of what was found.
    fn left_by(&self, unknowns: &DVector<f64>) -> Vec<f64> {
        let mut left = self.found.clone();
        for (unknown, column) in unknowns.iter().zip(&self.unknowns) {
            for (left, value) in left.iter_mut().zip(column) {
                *left -= unknown * value;
            }
        }
        left
    }

    /// The share that the curve of one half of the views explains of what their multipath leaves in the other half; of both halves
    /// the mean.
    fn explained_across(&self, weights: &[f64]) -> Option<f64> {
        let of_half = |half: usize| {
            let with = self.solved(weights, |view| view % 2 != half)?;
            let mut without = DVector::zeros(with.len());
            without[0] = with[0];
            let squares = |unknowns: &DVector<f64>| -> f64 {
                let left = self.left_by(unknowns);
                let patches = self.views.iter().skip(half).step_by(2).cloned().flatten();
                patches.map(|i| weights[i] * left[i] * left[i]).sum()
            };
            Some(1.0 - squares(&with) / squares(&without))
        };
        Some(0.5 * (of_half(0)? + of_half(1)?))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::point_to_plane_row;
    use nalgebra::{Point3, Rotation3, Vector3};

    /// A number from −0.5 to 0.5 for every `k`.
    fn scattered(k: usize, step: f64) -> f64 {
        (k as f64 * step).fract() - 0.5
    }

    /// Views of a rough surface of 1 m² from 0.6 to 1.2 m, each moved by a mistake of its pose and with 2 mm of noise, of a sensor
    /// that makes ranges too long by `error_m(range)` and has by `strength` more multipath than is known.
    fn views(error_m: impl Fn(f64) -> f64, strength: f64) -> Vec<Vec<Sample>> {
        let of_view = |view: usize| {
            let eye = Point3::new(
                scattered(view, 0.618_034),
                scattered(view, 0.754_878),
                0.9 + 0.4 * scattered(view, 0.569_840),
            );
            let moved = point_to_plane_row(
                &Vector3::new(
                    scattered(view, 0.31),
                    scattered(view, 0.77),
                    scattered(view, 0.13),
                ),
                &Vector3::new(
                    scattered(view, 0.53),
                    scattered(view, 0.29),
                    scattered(view, 0.91),
                ),
            ) * 0.01;
            let sample = |k: usize| {
                let [x, y] = [k % 20, k / 20].map(|at| 0.05 * at as f64 - 0.5);
                let tilt = Rotation3::from_euler_angles(scattered(k, 0.7), scattered(k, 0.43), 0.0);
                let normal = tilt * Vector3::z();
                let point = Point3::new(x, y, 0.1 * scattered(k, 0.381_966));
                let towards = eye - point;
                let cosine = normal.dot(&towards) / towards.norm();
                let beta_m = 0.002 * (1.0 + scattered(k, 0.11)) / cosine.max(0.3) * cosine;
                let surface_m = 0.003 * scattered(k, 0.27);
                let noise_m = 0.007 * scattered(view * 400 + k, 0.618_034);
                let range_m = towards.norm();
                Sample {
                    place: [k as i32, 0, 0],
                    point,
                    normal,
                    cosine,
                    range_m,
                    beta_m,
                    depth_m: error_m(range_m) * cosine
                        + strength * beta_m
                        + surface_m
                        + noise_m
                        + point_to_plane_row(&point.coords, &normal).dot(&moved),
                }
            };
            (0..400)
                .map(sample)
                .filter(|sample| sample.cosine > 0.3)
                .collect()
        };
        (0..30).map(of_view).collect()
    }

    #[test]
    fn a_wiggle_is_found_whatever_places_and_poses_hide() {
        let wiggle = |range: f64| 0.003 * (20.0 * range).sin();
        let error = range_error(&views(wiggle, 0.3)).expect("3 mm of it");
        // A constant and a share of the range cannot be told.
        let ranges: Vec<f64> = (0..40).map(|k| 0.8 + 0.01 * f64::from(k)).collect();
        let wrong: Vec<f64> = ranges.iter().map(|r| error.at_m(*r) - wiggle(*r)).collect();
        let mean = |values: &mut dyn Iterator<Item = f64>| values.sum::<f64>() / 40.0;
        let (middle, level) = (
            mean(&mut ranges.iter().copied()),
            mean(&mut wrong.iter().copied()),
        );
        let moment = ranges
            .iter()
            .zip(&wrong)
            .map(|(r, w)| (r - middle) * w)
            .sum::<f64>();
        let slope = moment / ranges.iter().map(|r| (r - middle).powi(2)).sum::<f64>();
        for (range, wrong) in ranges.iter().zip(&wrong) {
            let off = wrong - level - slope * (range - middle);
            assert!(off.abs() < 0.0004, "{off} m at {range} m");
        }
    }

    #[test]
    fn what_is_none_is_not_believed() {
        for strength in [0.0, 0.5] {
            assert_eq!(range_error(&views(|_| 0.0, strength)), None);
            assert_eq!(
                range_error(&views(|range| 0.004 + 0.005 * range, strength)),
                None
            );
        }
        assert_eq!(range_error(&[]), None);
    }
}
