//! Errors of a sensor's depth that depend on range alone.

use super::RayGrid;
use depth_camera::Image;
use serde::{Deserialize, Serialize};

/// How much too long ranges are, by range alone: straight between points, level before the first and beyond the last.
#[derive(Clone, Debug, PartialEq, Deserialize, Serialize)]
#[serde(transparent)]
pub struct RangeError {
    /// Range and error, metres, by growing range.
    points: Vec<[f64; 2]>,
}

/// Most points; arbitrary, far more than are measured.
const MAX_POINTS: usize = 1000;
/// Farthest range, metres.
const MAX_RANGE_M: f64 = 20.0;
/// Larger errors are a mistake of units, metres.
const MAX_ERROR_M: f64 = 0.1;
/// Within so much beyond the ends of what was measured later it fades out, metres.
const FADE_M: f64 = 0.1;
/// Steps of a table that is straight between them, metres.
const TABLE_STEP_M: f64 = 0.005;
/// Ranges in a metre that a measured error is stated at.
const POINTS_PER_METRE: f64 = 100.0;

impl RangeError {
    /// Through points of range and error, metres, by growing range.
    ///
    /// # Panics
    /// Without points.
    pub fn through(points: Vec<[f64; 2]>) -> Self {
        assert!(!points.is_empty(), "an error has a value");
        RangeError { points }
    }

    /// The same at all ranges, metres.
    pub fn constant(error_m: f64) -> Self {
        RangeError::through(vec![[0.0, error_m], [MAX_RANGE_M, error_m]])
    }

    /// What a function tells of ranges from near to far, metres: in points as they are stated in a file, of whole micrometres.
    pub fn stated(from_m: f64, to_m: f64, error_m: impl Fn(f64) -> f64) -> Self {
        let [near, far] = [from_m, to_m].map(|range| (range * POINTS_PER_METRE).round() as u32);
        let range_m = |k: u32| f64::from(k) / POINTS_PER_METRE;
        let rounded = |error: f64| (1e6 * error).round() / 1e6;
        let points = (near..=far.max(near)).map(range_m);
        RangeError::through(points.map(|m| [m, rounded(error_m(m))]).collect())
    }

    /// What a function tells of all ranges, metres, in more points than a file may hold.
    pub fn tabulated(error_m: impl Fn(f64) -> f64) -> Self {
        RangeError::through(
            table_ranges_m()
                .map(|range| [range, error_m(range)])
                .collect(),
        )
    }

    /// How much too long a range is, metres.
    pub fn at_m(&self, range_m: f64) -> f64 {
        let points = &self.points;
        let after = points.partition_point(|[range, _]| *range <= range_m);
        match (after.checked_sub(1), points.get(after)) {
            (Some(before), Some([far, error_far])) => {
                let [near, error_near] = points[before];
                let share = (range_m - near) / (far - near);
                error_near + share * (error_far - error_near)
            }
            (Some(last), None) => points[last][1],
            (None, first) => first.map_or(0.0, |[_, error]| *error),
        }
    }

    /// This error and another one that was measured with it taken off, which fades out beyond the ranges it was measured at.
    pub fn plus(&self, further: &RangeError) -> Self {
        let faded = [further.from_m() - FADE_M, further.to_m() + FADE_M];
        let both = self.points.iter().chain(&further.points);
        let mut ranges: Vec<f64> = both.map(|[range, _]| *range).collect();
        ranges.extend(faded.map(|range| range.clamp(0.0, MAX_RANGE_M)));
        ranges.sort_by(f64::total_cmp);
        ranges.dedup();
        let sum = |range: f64| {
            let beyond = (further.from_m() - range).max(range - further.to_m());
            let left = 1.0 - (beyond / FADE_M).clamp(0.0, 1.0);
            [range, self.at_m(range) + left * further.at_m(range)]
        };
        RangeError::through(ranges.into_iter().map(sum).collect())
    }

    /// The largest error at the ranges that it was measured at, metres.
    pub fn largest_m(&self) -> f64 {
        let errors = self.points.iter().map(|[_, error]| error.abs());
        errors.fold(0.0, f64::max)
    }

    /// The nearest range that it is stated for, metres.
    pub fn from_m(&self) -> f64 {
        self.points.first().map_or(0.0, |[range, _]| *range)
    }

    /// The farthest one.
    pub fn to_m(&self) -> f64 {
        self.points.last().map_or(0.0, |[range, _]| *range)
    }

    /// A depth image (metres, 0 is none) without it.
    pub fn corrected(&self, depth_m: &Image<f32>, rays: &RayGrid) -> Image<f32> {
        let table: Vec<f32> = table_ranges_m()
            .map(|range| self.at_m(range) as f32)
            .collect();
        let last = table.len() - 2;
        let pixels = depth_m.data().iter().zip(rays.rays().data());
        let right = pixels.map(|(&z, [x, y])| {
            let range_per_depth = (1.0 + x * x + y * y).sqrt();
            let step = (z * range_per_depth / TABLE_STEP_M as f32).min(last as f32);
            let before = step as usize;
            let share = step - before as f32;
            let too_long = (1.0 - share) * table[before] + share * table[before + 1];
            match z > 0.0 {
                true => (z - too_long / range_per_depth).max(0.0),
                false => 0.0,
            }
        });
        Image::from_vec(depth_m.width(), depth_m.height(), right.collect())
    }

    /// Checks every value against its bound; `key` is what a file calls it.
    ///
    /// # Errors
    /// Names the key, the value and the bound.
    pub fn validate(&self, key: &str) -> Result<(), String> {
        let n = self.points.len();
        if !(1..=MAX_POINTS).contains(&n) {
            return Err(format!("{key} holds {n} points, must be 1 to {MAX_POINTS}"));
        }
        for [range, error] in &self.points {
            if !(0.0..=MAX_RANGE_M).contains(range) {
                return Err(format!(
                    "{key} holds a range of {range}, must be 0 to {MAX_RANGE_M}"
                ));
            }
            if !(-MAX_ERROR_M..=MAX_ERROR_M).contains(error) {
                return Err(format!(
                    "{key} holds an error of {error}, must be -{MAX_ERROR_M} to {MAX_ERROR_M}"
                ));
            }
        }
        let not_after = self.points.windows(2).find(|pair| pair[1][0] <= pair[0][0]);
        match not_after {
            Some([before, after]) => Err(format!(
                "{key} holds a range of {} after {}, must grow",
                after[0], before[0]
            )),
            _ => Ok(()),
        }
    }
}

/// Ranges of a table, metres.
fn table_ranges_m() -> impl Iterator<Item = f64> {
    let n = (MAX_RANGE_M / TABLE_STEP_M) as u32;
    (0..=n).map(|step| f64::from(step) * TABLE_STEP_M)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::camera::tests::distorted_camera;

    #[test]
    fn it_is_straight_between_its_points_and_level_beyond() {
        let error = RangeError::through(vec![[0.5, 0.001], [1.0, -0.003]]);
        for (range, expected) in [
            (0.0, 0.001),
            (0.5, 0.001),
            (0.75, -0.001),
            (1.0, -0.003),
            (5.0, -0.003),
        ] {
            assert!((error.at_m(range) - expected).abs() < 1e-12, "{range}");
        }
        assert_eq!(error.largest_m(), 0.003);
        let both = error.plus(&RangeError::through(vec![[0.75, 0.002], [2.0, 0.004]]));
        for (range, further) in [
            (0.3, 0.0),
            (0.65, 0.0),
            (0.7, 0.001),
            (0.75, 0.002),
            (1.5, 0.0032),
            (2.0, 0.004),
            (2.05, 0.002),
            (3.0, 0.0),
        ] {
            let expected = error.at_m(range) + further;
            assert!((both.at_m(range) - expected).abs() < 1e-12, "{range}");
        }
    }

    #[test]
    fn depth_is_freed_of_it_along_the_ray_of_each_pixel() {
        let rays = RayGrid::new(distorted_camera());
        let (width, height) = (rays.rays().width(), rays.rays().height());
        let wiggle = |range: f64| 0.004 * (20.0 * range).sin();
        let points = (0..100)
            .map(|k| f64::from(k) * 0.02)
            .map(|r| [r, wiggle(r)]);
        let error = RangeError::through(points.collect());
        let depth: Vec<f32> = (0..width * height)
            .map(|k| (k % 1500) as f32 * 1e-3)
            .collect();
        let depth = Image::from_vec(width, height, depth);
        let corrected = error.corrected(&depth, &rays);
        for (v, u) in [
            (0, 0),
            (3, 700 % width),
            (height / 2, width / 2),
            (height - 1, 5),
        ] {
            let z = *depth.at(u, v);
            let [x, y] = *rays.rays().at(u, v);
            let long = f64::from((1.0 + x * x + y * y).sqrt());
            let expected = f64::from(z) - error.at_m(f64::from(z) * long) / long;
            let expected = if z > 0.0 { expected.max(0.0) } else { 0.0 };
            let found = f64::from(*corrected.at(u, v));
            assert!((found - expected).abs() < 2e-6, "{found} for {expected}");
        }
    }

    #[test]
    fn what_makes_no_sense_is_refused_by_name() {
        for (points, expected) in [
            (vec![], "range_error_m holds 0 points, must be 1 to 1000"),
            (
                vec![[-1.0, 0.0]],
                "range_error_m holds a range of -1, must be 0 to 20",
            ),
            (
                vec![[1.0, 3.0]],
                "range_error_m holds an error of 3, must be -0.1 to 0.1",
            ),
            (
                vec![[1.0, 0.0], [1.0, 0.0]],
                "range_error_m holds a range of 1 after 1, must grow",
            ),
            (vec![[1.0, f64::NAN]], "range_error_m holds an error of NaN"),
        ] {
            let error = RangeError { points }.validate("range_error_m").unwrap_err();
            assert!(error.starts_with(expected), "{error}");
        }
        assert_eq!(RangeError::through(vec![[1.0, 0.01]]).validate("x"), Ok(()));
    }
}
