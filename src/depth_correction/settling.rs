//! Views of one surface that are moved, and freed of an error by range, until they agree best.
//!
//! Where views were tracked, most of what they are off by alike passes for motions of the camera, and a constant of the range for part
//! of a wiggle, which goes to and fro with range. So all of them are told at once, by Gauss-Newton steps over every pair of patches.
//! A wiggle is a sum of sines whose periods the sensor's frequencies give, not any smooth curve: but for the scale of the scene, which
//! no scan tells, a constant is a share of the range, and a curve that may grow with range is one.

use super::agreement::{Agreement, DAMPING, Pair, SCALE_M, View};
use crate::{
    geometry::{Pose, RangeError, increment, point_to_plane_row},
    robust::quantile,
};
use nalgebra::{DMatrix, DVector, Vector6};
use rayon::prelude::*;
use std::{f64::consts::TAU, ops::Range};

/// Periods of a Kinect II's wiggle, metres: a fourth and a third of the range at which 120 MHz begin anew, and a fourth of that of 80 MHz.
const PERIODS_M: [f64; 3] = [0.3123, 0.4164, 0.4684];
/// Parts of an error: a constant, and a sine and a cosine of each period.
const N_PARTS: usize = 1 + 2 * PERIODS_M.len();
/// How far a wiggle may be off before anything is known, metres,
const PRIOR_M: f64 = 0.005;
/// which counts as much as so many pairs: those of one place share their mistakes.
const PRIOR_PAIRS: f64 = 100.0;
/// Points in a metre that an error is stated at.
const POINTS_PER_METRE: f64 = 100.0;
/// Pairs that lie farther apart count for less than half, metres, step by step: in the end three times what agreeing ones scatter by.
const SCALES_M: [f64; 6] = [
    4.0 * SCALE_M,
    2.0 * SCALE_M,
    SCALE_M,
    SCALE_M,
    SCALE_M,
    SCALE_M,
];

/// What is told of views while they are settled.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Asked {
    Nothing,
    Constant,
    Wiggle,
    ConstantAndWiggle,
}

/// How views are settled.
pub(super) struct Settling<'a> {
    pub(super) agreement: &'a Agreement<'a>,
    /// Whether views move.
    pub(super) are_moved: bool,
    pub(super) asked: Asked,
}

/// An error by range: of each part, metres.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Curve([f64; N_PARTS]);

/// A part of the normal equations.
struct Equations {
    matrix: DMatrix<f64>,
    right: DVector<f64>,
    squares: f64,
    weight: f64,
}

impl Curve {
    /// How much too long ranges are at all ranges alike, metres.
    pub(super) fn constant_m(&self) -> f64 {
        self.0[0]
    }

    /// How much too long ranges are, by the same law at all of them.
    pub(super) fn at_all_ranges(&self) -> RangeError {
        RangeError::of(|range_m| self.at_m(range_m))
    }

    /// The same as far as it was seen at ranges, metres: beyond nine tenths of these what goes to and fro fades out.
    pub(super) fn error(&self, mut ranges_m: Vec<f64>) -> RangeError {
        let constant = RangeError::constant(self.constant_m());
        let [from_m, to_m] = [0.05, 0.95].map(|share| quantile(&mut ranges_m, share));
        let Some((from_m, to_m)) = from_m.zip(to_m) else {
            return constant;
        };
        let wiggle = |range_m| [range_m, self.at_m(range_m) - self.constant_m()];
        let n = ((to_m - from_m) * POINTS_PER_METRE).ceil().max(1.0);
        let points = (0..=n as u32).map(|k| wiggle(from_m + (to_m - from_m) * f64::from(k) / n));
        constant.plus(&RangeError::through(points.collect()))
    }

    fn at_m(&self, range_m: f64) -> f64 {
        let parts = parts(range_m).into_iter().zip(self.0);
        parts.map(|(part, of_it_m)| part * of_it_m).sum()
    }
}

/// What a unit of each part makes of a range.
fn parts(range_m: f64) -> [f64; N_PARTS] {
    let mut parts = [1.0; N_PARTS];
    for (pair, period_m) in parts[1..].chunks_exact_mut(2).zip(PERIODS_M) {
        let turn = TAU * range_m / period_m;
        pair.copy_from_slice(&[turn.sin(), turn.cos()]);
    }
    parts
}

impl Settling<'_> {
    /// The error by range with which views agree best, and they without it, where they then lie; `views` makes them, of an error that is
    /// taken off and of poses. `None` if they do not tell.
    pub(super) fn settled(
        &self,
        mut poses: Vec<Pose>,
        views: impl Fn(&Curve, &[Pose]) -> Vec<View>,
    ) -> Option<(Curve, Vec<View>)> {
        let parts = self.asked.parts();
        let mut curve = Curve::default();
        for scale_m in SCALES_M {
            let step = self.step(&views(&curve, &poses), &curve, scale_m)?;
            let (by_parts, by_motions) = step.as_slice().split_at(parts.len());
            for (part_m, by_m) in curve.0[parts.clone()].iter_mut().zip(by_parts) {
                *part_m += by_m;
            }
            for (pose, by) in poses.iter_mut().zip(by_motions.chunks_exact(6)) {
                *pose *= increment(&Vector6::from_column_slice(by));
            }
        }
        let views = views(&curve, &poses);
        Some((curve, views))
    }

    /// By how much the parts of an error change, and the views move, so that they agree better.
    fn step(&self, views: &[View], curve: &Curve, scale_m: f64) -> Option<DVector<f64>> {
        let parts = self.asked.parts();
        let n_motions = if self.are_moved { views.len() } else { 0 };
        let n = parts.len() + 6 * n_motions;
        let of_view = |index: usize| {
            let mut equations = Equations::empty(n);
            for pair in self.agreement.pairs(views, index) {
                let weight = 1.0 / (1.0 + (pair.apart_m / scale_m).powi(2));
                equations.add(&self.row(&pair, index), -pair.apart_m, weight);
            }
            equations
        };
        let each = (0..views.len()).into_par_iter().map(of_view);
        let mut equations = each.reduce(|| Equations::empty(n), Equations::plus);
        let variance = equations.squares / equations.weight;
        let prior = PRIOR_PAIRS * variance / (PRIOR_M * PRIOR_M);
        // A constant has none.
        for (row, part) in parts.clone().enumerate().filter(|(_, part)| *part > 0) {
            equations.matrix[(row, row)] += prior;
            equations.right[row] -= prior * curve.0[part];
        }
        for first in (parts.len()..n).step_by(6) {
            let diagonal = first..first + 6;
            let trace: f64 = diagonal.clone().map(|k| equations.matrix[(k, k)]).sum();
            for k in diagonal {
                equations.matrix[(k, k)] += DAMPING * trace;
            }
        }
        Some(equations.matrix.cholesky()?.solve(&equations.right))
    }

    /// How far apart a pair comes to lie by a unit of each unknown.
    fn row(&self, pair: &Pair, index: usize) -> Vec<(usize, f64)> {
        let Pair { patch, seen, .. } = pair;
        let asked = self.asked.parts();
        let mut row = Vec::with_capacity(N_PARTS + 12);
        let [here, there] = [&patch.centre, &seen.centre].map(|centre| centre.coords.norm());
        let by_here = pair.normal.dot(&patch.centre.coords) / here;
        let by_there = seen.normal.dot(&seen.centre.coords) / there;
        let parts = parts(here).into_iter().zip(parts(there));
        let by_parts = parts.map(|(here, there)| there * by_there - here * by_here);
        row.extend(by_parts.skip(asked.start).take(asked.len()).enumerate());
        if self.are_moved {
            let moved = point_to_plane_row(&patch.centre.coords, &pair.normal);
            let other_moved = -point_to_plane_row(&pair.at.coords, &seen.normal);
            for (view, motion) in [(index, moved), (pair.other, other_moved)] {
                let first = asked.len() + 6 * view;
                row.extend((first..).zip(motion.iter().copied()));
            }
        }
        row
    }
}

impl Asked {
    /// The parts of an error that are told.
    fn parts(self) -> Range<usize> {
        match self {
            Asked::Nothing => 0..0,
            Asked::Constant => 0..1,
            Asked::Wiggle => 1..N_PARTS,
            Asked::ConstantAndWiggle => 0..N_PARTS,
        }
    }
}

impl Equations {
    fn empty(n: usize) -> Self {
        Equations {
            matrix: DMatrix::zeros(n, n),
            right: DVector::zeros(n),
            squares: 0.0,
            weight: 0.0,
        }
    }

    fn plus(self, other: Self) -> Self {
        Equations {
            matrix: self.matrix + other.matrix,
            right: self.right + other.right,
            squares: self.squares + other.squares,
            weight: self.weight + other.weight,
        }
    }

    /// Adds that a row of unknowns is to explain a value.
    fn add(&mut self, row: &[(usize, f64)], value: f64, weight: f64) {
        for &(i, a) in row {
            self.right[i] += weight * a * value;
            for &(j, b) in row.iter().filter(|(j, _)| *j <= i) {
                self.matrix[(i, j)] += weight * a * b;
            }
        }
        self.squares += weight * value * value;
        self.weight += weight;
    }
}
