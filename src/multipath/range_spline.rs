//! A cubic spline of the range, of which neither a constant nor a share of the range is left.

use crate::{geometry::RangeError, robust::quantile};

/// The parts of a spline between two ranges.
pub(super) struct RangeSpline {
    from_m: f64,
    to_m: f64,
    /// Constant and slope of each part over the ranges that it was made for.
    lines: Vec<[f64; 2]>,
}

/// Between knots, metres. The shortest wiggle of a Kinect II is a fourth of half the wave of its 120 MHz, 0.312 m.
const KNOT_M: f64 = 0.06;
/// A span between near and far that tells nothing, metres.
const MIN_SPAN_M: f64 = 0.1;
/// Share of the ranges that is nearer, and that is farther, than what is fitted.
const TAIL: f64 = 0.005;

impl RangeSpline {
    /// For these ranges, metres; `None` where they do not span enough.
    pub(super) fn new(ranges_m: &[f64]) -> Option<Self> {
        let mut ordered = ranges_m.to_vec();
        let from_m = quantile(&mut ordered, TAIL)?;
        let to_m = quantile(&mut ordered, 1.0 - TAIL)?;
        if to_m - from_m < MIN_SPAN_M {
            return None;
        }
        let n = ((to_m - from_m) / KNOT_M).ceil() as usize + 3;
        let mut spline = RangeSpline {
            from_m,
            to_m,
            lines: vec![[0.0; 2]; n],
        };
        let is_inside = |range: &&f64| (from_m..=to_m).contains(*range);
        let inside: Vec<f64> = ranges_m.iter().filter(is_inside).copied().collect();
        let count = inside.len() as f64;
        let mean = inside.iter().sum::<f64>() / count;
        let spread: f64 = inside.iter().map(|range| (range - mean).powi(2)).sum();
        let mut sums = vec![[0.0; 2]; n];
        for &range in &inside {
            for (part, value) in spline.parts(range) {
                sums[part][0] += value;
                sums[part][1] += value * (range - mean);
            }
        }
        for (line, [sum, moment]) in spline.lines.iter_mut().zip(&sums) {
            let slope = moment / spread;
            *line = [sum / count - slope * mean, slope];
        }
        Some(spline)
    }

    /// How many parts it has.
    pub(super) fn n_parts(&self) -> usize {
        self.lines.len()
    }

    /// Value of every part at a range; beyond the ends as at them.
    pub(super) fn row(&self, range_m: f64) -> Vec<f64> {
        let range = range_m.clamp(self.from_m, self.to_m);
        let lines = self.lines.iter();
        let mut row: Vec<f64> = lines
            .map(|[constant, slope]| -constant - slope * range)
            .collect();
        for (part, value) in self.parts(range) {
            row[part] += value;
        }
        row
    }

    /// The error that parts with these coefficients, metres, make.
    pub(super) fn error(&self, coefficients: &[f64]) -> RangeError {
        RangeError::stated(self.from_m, self.to_m, |range_m| {
            let parts = self.row(range_m).into_iter().zip(coefficients);
            parts.map(|(part, by)| part * by).sum()
        })
    }

    /// The four parts that are not zero at a range, lines included.
    fn parts(&self, range_m: f64) -> [(usize, f64); 4] {
        let n = self.lines.len();
        let at = (range_m - self.from_m) / (self.to_m - self.from_m) * (n - 3) as f64;
        let first = (at as usize).min(n - 4);
        let after = at - first as f64;
        let before = 1.0 - after;
        let outer = |x: f64| x * x * x / 6.0;
        let inner = |x: f64| (3.0 * x * x * x - 6.0 * x * x + 4.0) / 6.0;
        [
            (first, outer(before)),
            (first + 1, inner(after)),
            (first + 2, inner(before)),
            (first + 3, outer(after)),
        ]
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn parts_are_smooth_and_hold_neither_a_constant_nor_a_share_of_the_range() {
        let ranges: Vec<f64> = (0..2000)
            .map(|k| 0.5 + 0.4 * (f64::from(k) / 2000.0).powi(2))
            .collect();
        let spline = RangeSpline::new(&ranges).expect("0.4 m");
        let inside = |range: &&f64| (spline.from_m..=spline.to_m).contains(*range);
        for part in 0..spline.n_parts() {
            let (mut sum, mut moment, mut squares) = (0.0, 0.0, 0.0);
            for range in ranges.iter().filter(inside) {
                let value = spline.row(*range)[part];
                sum += value;
                moment += value * range;
                squares += value * value;
            }
            assert!(
                sum.abs() < 1e-9 && moment.abs() < 1e-9,
                "{part}: {sum}, {moment}"
            );
            assert!(squares > 0.0);
        }
        for range in [0.55, 0.6, 0.7, 0.85] {
            let sum: f64 = spline.parts(range).iter().map(|(_, value)| value).sum();
            assert!((sum - 1.0).abs() < 1e-12);
            let (near, far) = (spline.row(range - 1e-7), spline.row(range + 1e-7));
            assert!(near.iter().zip(&far).all(|(a, b)| (a - b).abs() < 1e-5));
        }
        assert!(RangeSpline::new(&[0.5; 100]).is_none());
        assert!(RangeSpline::new(&[]).is_none());
    }
}
