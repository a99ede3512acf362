//! Views of one surface that are moved, and freed of an error by range or of a wrong focal length, until they agree best.
//!
//! Where views were tracked, most of what they are off by alike passes for motions of the camera, and a constant of the range for part
//! of a wiggle, which goes to and fro with range. So all of them are told at once, by Gauss-Newton steps over every pair of patches.
//! A wiggle is a sum of sines whose periods the sensor's frequencies give, not any smooth curve: but for the scale of the scene, which
//! no scan tells, a constant is a share of the range, and a curve that may grow with range is one. Focal lengths are told by surfaces that
//! face different ways: with a longer one all that was seen is narrower, and as deep as it was. A slow error of depth passes for one, and is
//! told beside them.

use super::agreement::{Agreement, Along, DAMPING, Pair, SCALE_M, View};
use super::slow_field::{self, SlowField};
use crate::{
    geometry::{Pose, RangeError, increment, point_to_plane_row},
    robust::quantile,
};
use nalgebra::{DMatrix, DVector, SMatrix, SVector, Vector6};
use rayon::prelude::*;
use std::{f64::consts::TAU, ops::Range};

/// Periods of a Kinect II's wiggle, metres: a fourth and a third of the range at which 120 MHz begin anew, and a fourth of that of 80 MHz.
/// Others between 0.25 and 0.94 m are made up of these well enough.
const PERIODS_M: [f64; 3] = [0.3123, 0.4164, 0.4684];
/// Parts of an error by range: a constant, and a sine and a cosine of each period.
const N_OF_RANGE: usize = 1 + 2 * PERIODS_M.len();
/// Parts of what is told: those, the focal lengths across and down, and those of a slow error.
const N_PARTS: usize = FIELD + slow_field::N_PARTS;
const CONSTANT: usize = 0;
const ACROSS: usize = N_OF_RANGE;
const DOWN: usize = ACROSS + 1;
const FIELD: usize = DOWN + 1;
/// Unknowns of the motions of a pair's two views.
const N_OF_MOTIONS: usize = 12;
/// Unknowns that a pair depends on, at most: the parts, and those.
const N_OF_PAIR: usize = N_PARTS + N_OF_MOTIONS;
/// How far each part of a wiggle may be off before anything is known, metres,
const PRIOR_M: f64 = 0.005;
/// which counts as much as so many pairs, a tenth of them: those of one surface share their mistakes, and the parts are nearly alike over
/// the ranges that are seen. With 100 a wiggle of 3 mm is told as 3.6, with 100 000 as 3.0 and one of 1 mm as 0.94.
const PRIOR_PAIRS: f64 = 30_000.0;
/// How far a focal length may be off before anything is known, as a share of it; which counts as much as this share of all pairs: where
/// views hardly tell it, it stays what it is said to be.
const FOCAL_PRIOR: f64 = 0.02;
/// How far each part of a slow error may be off, metres, likewise.
const FIELD_PRIOR_M: f64 = 0.003;
const LENS_PRIOR_SHARE: f64 = 0.0005;
/// Pairs that lie farther apart count for less than half, step by step, as multiples of what they do in the end. The last step changes a
/// constant by 0.2 mm at most.
const SCALES: [f64; 6] = [4.0, 2.0, 1.0, 1.0, 1.0, 1.0];
/// What goes to and fro is told of ranges of which no more than this share is nearer, or farther.
const TAIL: f64 = 0.01;

/// What is told of views while they are settled.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Asked {
    Nothing,
    Constant,
    Wiggle,
    ConstantAndWiggle,
    SlowField,
    /// And a slow error.
    FocalLengths,
}

/// How views are settled.
pub(super) struct Settling<'a> {
    pub(super) agreement: &'a Agreement<'a>,
    /// Whether views move.
    pub(super) are_moved: bool,
    pub(super) asked: Asked,
}

/// An error by range: coefficients of its parts, metres: the constant, then sine and cosine of each period.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Curve([f64; N_OF_RANGE]);

/// What is told of views.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Mistake {
    pub(super) curve: Curve,
    /// By what shares of themselves the focal lengths across and down are longer than those by which views are seen.
    pub(super) longer_focus: [f64; 2],
    /// What of a slow error passes for that.
    field: SlowField,
}

/// Normal equations, of which the lower triangle is filled.
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
        RangeError::tabulated(|range_m| self.at_m(range_m))
    }

    /// How much too long ranges are: what goes to and fro where nearly all of those that were seen are, metres, a constant everywhere.
    pub(super) fn error(&self, mut seen_m: Vec<f64>) -> RangeError {
        let end_m = |share| quantile(&mut seen_m, share).unwrap_or(0.0);
        let [from_m, to_m] = [TAIL, 1.0 - TAIL].map(end_m);
        let to_and_fro = |range_m| self.at_m(range_m) - self.constant_m();
        let wiggle = RangeError::stated(from_m, to_m, to_and_fro);
        match self.constant_m() == 0.0 {
            true => wiggle,
            false => RangeError::constant(self.constant_m()).plus(&wiggle),
        }
    }

    fn at_m(&self, range_m: f64) -> f64 {
        let parts = parts(range_m).into_iter().zip(self.0);
        parts.map(|(part, of_it_m)| part * of_it_m).sum()
    }

    /// The parts at the range that was measured, of one without the error.
    fn parts_of_corrected(&self, range_m: f64) -> [f64; N_OF_RANGE] {
        parts(range_m + self.at_m(range_m + self.constant_m()))
    }
}

/// What a unit of each part makes of a range.
fn parts(range_m: f64) -> [f64; N_OF_RANGE] {
    let mut parts = [1.0; N_OF_RANGE];
    for (pair, period_m) in parts[1..].chunks_exact_mut(2).zip(PERIODS_M) {
        let turn = TAU * range_m / period_m;
        pair.copy_from_slice(&[turn.sin(), turn.cos()]);
    }
    parts
}

impl Mistake {
    /// A view without it but for the error by range.
    pub(super) fn undone(&self, view: View) -> View {
        let is_lens_right = self.longer_focus == [0.0; 2] && self.field == SlowField::default();
        match is_lens_right {
            true => view,
            false => view
                .without(&self.field)
                .with_longer_focus(self.longer_focus),
        }
    }

    fn part(&self, part: usize) -> f64 {
        match part {
            ACROSS => self.longer_focus[0],
            DOWN => self.longer_focus[1],
            FIELD.. => self.field.0[part - FIELD],
            _ => self.curve.0[part],
        }
    }

    fn part_mut(&mut self, part: usize) -> &mut f64 {
        match part {
            ACROSS => &mut self.longer_focus[0],
            DOWN => &mut self.longer_focus[1],
            FIELD.. => &mut self.field.0[part - FIELD],
            _ => &mut self.curve.0[part],
        }
    }
}

impl Settling<'_> {
    /// Moves views, and tells what is wrong with them, until they agree best: that, and the views without it where they then lie. `views`
    /// makes views without it at poses. `None` if no pair tells anything.
    pub(super) fn settled(
        &self,
        mut poses: Vec<Pose>,
        views: impl Fn(&Mistake, &[Pose]) -> Vec<View>,
    ) -> Option<(Mistake, Vec<View>)> {
        let parts = self.asked.parts();
        let mut mistake = Mistake::default();
        for scale in SCALES {
            if parts.is_empty() && !self.are_moved {
                break;
            }
            let step = self.step(&views(&mistake, &poses), &mistake, scale * SCALE_M)?;
            let (by_parts, by_motions) = step.as_slice().split_at(parts.len());
            for (part, by) in parts.clone().zip(by_parts) {
                *mistake.part_mut(part) += by;
            }
            for (pose, by) in poses.iter_mut().zip(by_motions.chunks_exact(6)) {
                *pose *= increment(&Vector6::from_column_slice(by));
            }
        }
        let views = views(&mistake, &poses);
        Some((mistake, views))
    }

    /// By how much the parts change, and the views move, so that they agree better.
    fn step(&self, views: &[View], mistake: &Mistake, scale_m: f64) -> Option<DVector<f64>> {
        let parts = self.asked.parts();
        let n = parts.len() + if self.are_moved { 6 * views.len() } else { 0 };
        let of_view = |index: usize| self.equations(views, index, &mistake.curve, scale_m, n);
        let each: Vec<Equations> = (0..views.len()).into_par_iter().map(of_view).collect();
        // One after the other, so that the sum is the same on any number of threads.
        let mut equations = each.into_iter().fold(Equations::empty(n), Equations::plus);
        let variance = equations.squares / equations.weight;
        for (row, part) in parts.clone().enumerate() {
            let (pairs, known_to) = match part {
                // It may be anything.
                CONSTANT => continue,
                ACROSS | DOWN => (LENS_PRIOR_SHARE * equations.weight, FOCAL_PRIOR),
                FIELD.. => (LENS_PRIOR_SHARE * equations.weight, FIELD_PRIOR_M),
                _ => (PRIOR_PAIRS, PRIOR_M),
            };
            let prior = pairs * variance / (known_to * known_to);
            equations.matrix[(row, row)] += prior;
            equations.right[row] -= prior * mistake.part(part);
        }
        for first in (parts.len()..n).step_by(6) {
            let diagonal = first..first + 6;
            let trace: f64 = diagonal.clone().map(|k| equations.matrix[(k, k)]).sum();
            // A view that sees nothing of the others stays where it is.
            let damping = if trace > 0.0 { DAMPING * trace } else { 1.0 };
            for k in diagonal {
                equations.matrix[(k, k)] += damping;
            }
        }
        Some(equations.matrix.cholesky()?.solve(&equations.right))
    }

    /// What one view's pairs add to the equations of `n` unknowns.
    fn equations(
        &self,
        views: &[View],
        index: usize,
        curve: &Curve,
        scale_m: f64,
        n: usize,
    ) -> Equations {
        let mut equations = Equations::empty(n);
        let mut block = (
            SMatrix::<f64, N_OF_PAIR, N_OF_PAIR>::zeros(),
            SVector::<f64, N_OF_PAIR>::zeros(),
        );
        let mut with = index;
        let parts = self.asked.parts();
        let n_of_pair = parts.len() + N_OF_MOTIONS;
        // Pairs with one view come one after the other.
        for pair in self.agreement.pairs(views, index, self.asked.along()) {
            if pair.other != with {
                equations.add(&block, &self.unknowns(index, with));
                block = (SMatrix::zeros(), SVector::zeros());
                with = pair.other;
            }
            let weight = 1.0 / (1.0 + (pair.apart_m / scale_m).powi(2));
            let row = row(&pair, curve, parts.clone());
            let asked = row.rows(0, n_of_pair);
            let mut products = block.0.view_mut((0, 0), (n_of_pair, n_of_pair));
            products.syger(weight, &asked, &asked, 1.0);
            block.1.axpy(-weight * pair.apart_m, &row, 1.0);
            equations.squares += weight * pair.apart_m * pair.apart_m;
            equations.weight += weight;
        }
        equations.add(&block, &self.unknowns(index, with));
        equations
    }

    /// Where the unknowns of a pair of views are among all.
    fn unknowns(&self, index: usize, other: usize) -> [Option<usize>; N_OF_PAIR] {
        let n_parts = self.asked.parts().len();
        let mut unknowns = [None; N_OF_PAIR];
        for (at, unknown) in unknowns[..n_parts].iter_mut().enumerate() {
            *unknown = Some(at);
        }
        if self.are_moved {
            let motions = unknowns[n_parts..].chunks_exact_mut(6);
            for (motion, view) in motions.zip([index, other]) {
                for (k, unknown) in motion.iter_mut().enumerate() {
                    *unknown = Some(n_parts + 6 * view + k);
                }
            }
        }
        unknowns
    }
}

/// How much farther a pair comes to lie apart by a unit of each unknown: of some parts of what is taken off, beside a curve that is, and of
/// the motions of both views. What follows those is 0.
fn row(pair: &Pair, curve: &Curve, parts: Range<usize>) -> SVector<f64, N_OF_PAIR> {
    let Pair {
        centres,
        normals,
        levers,
        ..
    } = pair;
    let along_m = [0, 1].map(|view| normals[view].dot(&centres[view].coords));
    let mut by_parts = [0.0; N_PARTS];
    let (of_range, of_lens) = by_parts.split_at_mut(N_OF_RANGE);
    if !parts.is_empty() && parts.start < N_OF_RANGE {
        let [here, there] = [0, 1].map(|view| {
            let range_m = centres[view].coords.norm();
            let by = along_m[view] / range_m;
            curve.parts_of_corrected(range_m).map(|part| part * by)
        });
        for (value, (here, there)) in of_range.iter_mut().zip(here.into_iter().zip(there)) {
            *value = there - here;
        }
    }
    if parts.end > N_OF_RANGE {
        let (of_focus, of_field) = of_lens.split_at_mut(FIELD - ACROSS);
        // Across the axis all shrinks in proportion.
        for (axis, value) in of_focus.iter_mut().enumerate() {
            *value = normals[1][axis] * levers[1][axis] - normals[0][axis] * levers[0][axis];
        }
        let [here, there] = centres.map(|centre| slow_field::parts(&centre));
        for (value, (here, there)) in of_field.iter_mut().zip(here.into_iter().zip(there)) {
            *value = there * along_m[1] - here * along_m[0];
        }
    }
    let n_parts = parts.len();
    let mut row = SVector::<f64, N_OF_PAIR>::zeros();
    row.as_mut_slice()[..n_parts].copy_from_slice(&by_parts[parts]);
    let [moved, other_moved] =
        [0, 1].map(|view| point_to_plane_row(&levers[view].coords, &normals[view]));
    row.fixed_rows_mut::<6>(n_parts).copy_from(&moved);
    row.fixed_rows_mut::<6>(n_parts + 6)
        .copy_from(&-other_moved);
    row
}

impl Asked {
    /// Along which normal views are compared for it.
    pub(super) fn along(self) -> Along {
        match self {
            Asked::SlowField | Asked::FocalLengths => Along::Midway,
            _ => Along::Other,
        }
    }

    /// The parts that are told.
    fn parts(self) -> Range<usize> {
        match self {
            Asked::Nothing => 0..0,
            Asked::Constant => 0..1,
            Asked::Wiggle => 1..N_OF_RANGE,
            Asked::ConstantAndWiggle => 0..N_OF_RANGE,
            Asked::SlowField => FIELD..N_PARTS,
            Asked::FocalLengths => ACROSS..N_PARTS,
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

    /// Adds the lower triangle and the right side of two views' pairs, by where their unknowns are.
    fn add(
        &mut self,
        (matrix, right): &(SMatrix<f64, N_OF_PAIR, N_OF_PAIR>, SVector<f64, N_OF_PAIR>),
        unknowns: &[Option<usize>; N_OF_PAIR],
    ) {
        let told = || unknowns.iter().enumerate();
        for (i, at) in told().filter_map(|(i, at)| Some((i, (*at)?))) {
            self.right[at] += right[i];
            for (j, other) in told().filter_map(|(j, at)| Some((j, (*at)?))) {
                if other <= at {
                    self.matrix[(at, other)] += matrix[(i.max(j), i.min(j))];
                }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{depth_correction::wavy_wall, geometry::RayGrid};
    use depth_camera::Image;

    /// Depth (m) of the wall from where views are taken.
    fn depths_m(rays: &RayGrid) -> Vec<Image<f32>> {
        let poses = wavy_wall::poses();
        let seen = poses.iter().map(|pose| wavy_wall::seen(rays, pose));
        seen.collect()
    }

    /// Views at poses of depth (m) with an error taken off.
    fn views(
        agreement: &Agreement,
        rays: &RayGrid,
        depths_m: &[Image<f32>],
        poses: &[Pose],
        mistake: &Mistake,
    ) -> Vec<View> {
        let error = mistake.curve.at_all_ranges();
        let view =
            |(depth_m, pose)| mistake.undone(agreement.view(&error.corrected(depth_m, rays), pose));
        depths_m.iter().zip(poses).map(view).collect()
    }

    #[test]
    fn pairs_come_to_lie_apart_as_their_rows_say() {
        // A lens is asked for along the normal midway alone.
        let of_range_and_motions = (0..N_OF_RANGE).chain(N_PARTS..N_OF_PAIR);
        assert_rows_hold(Along::Other, of_range_and_motions);
        assert_rows_hold(Along::Midway, 0..N_OF_PAIR);
    }

    fn assert_rows_hold(along: Along, unknowns: impl Iterator<Item = usize>) {
        let rays = wavy_wall::rays();
        let agreement = Agreement::of(&rays);
        let depths_m = &depths_m(&rays)[..2];
        let poses = wavy_wall::poses();
        let mut mistake = Mistake::default();
        (mistake.curve.0[0], mistake.curve.0[2]) = (0.02, 0.003);
        mistake.longer_focus = [0.01, -0.005];
        (mistake.field.0[0], mistake.field.0[7]) = (0.002, -0.003);
        // Of two views the second is asked.
        let (index, other) = (1, 0);
        let here = views(&agreement, &rays, depths_m, &poses[..2], &mistake);
        let rows: Vec<_> = agreement
            .pairs(&here, index, along)
            .map(|pair| row(&pair, &mistake.curve, 0..N_PARTS))
            .collect();
        assert!(rows.len() > 100, "{} pairs", rows.len());
        for unknown in unknowns {
            // Depth is in single precision; a motion may bring a patch into another cell.
            let step = if unknown < N_PARTS { 2e-4 } else { 1e-6 };
            let at = |by: f64| {
                let (mut mistake, mut poses) = (mistake, poses.clone());
                match unknown.checked_sub(N_PARTS) {
                    None => *mistake.part_mut(unknown) += by,
                    Some(motion) => {
                        let mut xi = Vector6::zeros();
                        xi[motion % 6] = by;
                        poses[if motion < 6 { index } else { other }] *= increment(&xi);
                    }
                }
                let views = views(&agreement, &rays, depths_m, &poses[..2], &mistake);
                let pairs = agreement.pairs(&views, index, along);
                pairs.map(|pair| pair.apart_m).collect::<Vec<f64>>()
            };
            let (before, after) = (at(-step), at(step));
            assert_eq!(
                [before.len(), after.len()],
                [rows.len(); 2],
                "no pair comes or goes"
            );
            let (mut found, mut told) = (0.0, 0.0);
            for ((row, before), after) in rows.iter().zip(before).zip(after) {
                found += row[unknown] * (after - before) / (2.0 * step);
                told += row[unknown] * row[unknown];
            }
            // Planes turn a little as the error bends them, which rows leave out.
            assert!(
                (found / told - 1.0).abs() < 0.05,
                "{along:?}, {unknown}: {found} for {told}"
            );
        }
    }

    #[test]
    fn a_view_that_sees_nothing_stays_where_it_is_and_hides_nothing() {
        let rays = wavy_wall::rays();
        let agreement = Agreement::of(&rays);
        let mut depths_m = depths_m(&rays);
        for depth_m in &mut depths_m {
            *depth_m = RangeError::constant(-0.02).corrected(depth_m, &rays);
        }
        depths_m[3] = depths_m[3].map(|_| 0.0);
        let settling = Settling {
            agreement: &agreement,
            are_moved: true,
            asked: Asked::ConstantAndWiggle,
        };
        let found = settling.settled(wavy_wall::poses(), |mistake, poses| {
            views(&agreement, &rays, &depths_m, poses, mistake)
        });
        let (Mistake { curve, .. }, _) = found.expect("eleven views");
        assert!((curve.constant_m() - 0.02).abs() < 0.004, "{curve:?}");
    }
}
