//! The factor by which a lens darkens the image towards its corners: a function of the ray, not of depth.

use crate::geometry::RayGrid;
use depth_camera::Image;
use serde::{Deserialize, Serialize};
use std::fmt;

/// The flat field: a factor for each ray (X/Z, Y/Z).
#[derive(Clone, Debug, PartialEq, Deserialize, Serialize)]
#[serde(tag = "model", rename_all = "snake_case", deny_unknown_fields)]
pub enum FlatField {
    /// `cos(angle to the optical axis)^power`.
    CosinePower {
        /// The exponent; 0 is a flat image.
        power: f64,
    },
    /// A smooth measured map.
    Spline(FlatMap),
}

impl FlatField {
    /// The factor for the ray (X/Z, Y/Z); 1 on the optical axis.
    pub fn factor(&self, x: f64, y: f64) -> f64 {
        match self {
            FlatField::CosinePower { power } => (1.0 + x * x + y * y).powf(-0.5 * power),
            FlatField::Spline(map) => map.log_factor(x, y).exp(),
        }
    }

    /// The factor for every pixel of an image with these rays; NaN where there is no ray.
    pub fn image(&self, rays: &RayGrid) -> Image<f64> {
        rays.rays().map(|&[x, y]| match x.is_nan() {
            true => f64::NAN,
            false => self.factor(f64::from(x), f64::from(y)),
        })
    }

    /// Checks the values against their bounds.
    ///
    /// # Errors
    /// Names the key, its value and the bound.
    pub fn validate(&self) -> Result<(), String> {
        match self {
            FlatField::CosinePower { power } if (0.0..=12.0).contains(power) => Ok(()),
            FlatField::CosinePower { power } => {
                Err(format!("flat_field.power is {power}, must be 0 to 12"))
            }
            FlatField::Spline(map) => map.validate(),
        }
    }
}

impl fmt::Display for FlatField {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            FlatField::CosinePower { power } => write!(f, "cosine to the power of {power}"),
            FlatField::Spline(FlatMap { grid, .. }) => {
                write!(f, "spline of {}x{} coefficients", grid.columns, grid.rows)
            }
        }
    }
}

/// The logarithm of a flat field as a uniform bicubic B-spline over rays; beyond its grid the border's value holds.
#[derive(Clone, Debug, PartialEq, Deserialize, Serialize)]
#[serde(deny_unknown_fields)]
pub struct FlatMap {
    /// The grid that carries it.
    #[serde(flatten)]
    pub grid: SplineGrid,
    /// Coefficients, row by row.
    pub log: Vec<f64>,
}

/// A uniform grid of bicubic B-splines over a rectangle of rays.
#[derive(Clone, Copy, Debug, PartialEq, Deserialize, Serialize)]
pub struct SplineGrid {
    /// First and last X/Z covered.
    pub x: [f64; 2],
    /// First and last Y/Z covered.
    pub y: [f64; 2],
    /// Coefficients in a row: the intervals and 3.
    pub columns: usize,
    /// Rows of coefficients: the intervals and 3.
    pub rows: usize,
}

impl SplineGrid {
    /// Coefficients in all.
    pub fn n_coefficients(&self) -> usize {
        self.columns * self.rows
    }

    /// The sixteen coefficients that a ray touches, and their weights, which sum to 1.
    pub fn weights(&self, x: f64, y: f64) -> [(usize, f64); 16] {
        let (column, across) = basis(x, self.x, self.columns);
        let (row, down) = basis(y, self.y, self.rows);
        std::array::from_fn(|k| {
            let (i, j) = (k % 4, k / 4);
            let index = (row + j) * self.columns + column + i;
            (index, across[i] * down[j])
        })
    }
}

impl FlatMap {
    /// Natural logarithm of the factor for a ray.
    pub fn log_factor(&self, x: f64, y: f64) -> f64 {
        let weights = self.grid.weights(x, y);
        weights.iter().map(|(index, w)| self.log[*index] * w).sum()
    }

    fn validate(&self) -> Result<(), String> {
        let SplineGrid {
            x,
            y,
            columns,
            rows,
        } = self.grid;
        for (key, count) in [("columns", columns), ("rows", rows)] {
            if !(4..=64).contains(&count) {
                return Err(format!("flat_field.{key} is {count}, must be 4 to 64"));
            }
        }
        for (key, [first, last]) in [("x", x), ("y", y)] {
            if !(first < last && first >= -10.0 && last <= 10.0) {
                return Err(format!(
                    "flat_field.{key} is {first} to {last}, must rise within -10 to 10"
                ));
            }
        }
        if self.log.len() != columns * rows {
            return Err(format!(
                "flat_field.log holds {} numbers, must be columns x rows, {}",
                self.log.len(),
                columns * rows
            ));
        }
        match self.log.iter().find(|log| !(-8.0..=8.0).contains(*log)) {
            Some(log) => Err(format!("flat_field.log holds {log}, must be -8 to 8")),
            None => Ok(()),
        }
    }
}

/// First coefficient and the four weights of a uniform cubic B-spline at `at`, held at the borders.
fn basis(at: f64, [first, last]: [f64; 2], count: usize) -> (usize, [f64; 4]) {
    let n_intervals = (count - 3) as f64;
    let place = ((at - first) / (last - first) * n_intervals).clamp(0.0, n_intervals);
    let interval = (place as usize).min(count - 4);
    let t = place - interval as f64;
    let s = 1.0 - t;
    let weights = [
        s * s * s / 6.0,
        (3.0 * t * t * t - 6.0 * t * t + 4.0) / 6.0,
        (3.0 * s * s * s - 6.0 * s * s + 4.0) / 6.0,
        t * t * t / 6.0,
    ];
    (interval, weights)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn map() -> FlatMap {
        let grid = SplineGrid {
            x: [-0.7, 0.7],
            y: [-0.6, 0.6],
            columns: 9,
            rows: 8,
        };
        // A uniform cubic B-spline reproduces straight lines exactly from coefficients on the line.
        let at = |index: usize, [first, last]: [f64; 2], count: usize| {
            first + (last - first) * (index as f64 - 1.0) / (count - 3) as f64
        };
        let log = (0..grid.n_coefficients())
            .map(|k| 0.3 * at(k % 9, grid.x, 9) - 0.2 * at(k / 9, grid.y, 8))
            .collect();
        FlatMap { grid, log }
    }

    #[test]
    fn a_spline_reproduces_a_plane_and_holds_beyond_its_border() {
        let map = map();
        for [x, y] in [[0.0, 0.0], [-0.7, 0.6], [0.69, -0.31], [0.13, 0.59]] {
            assert!((map.log_factor(x, y) - (0.3 * x - 0.2 * y)).abs() < 1e-12);
        }
        assert_eq!(map.log_factor(2.0, 0.0), map.log_factor(0.7, 0.0));
    }

    #[test]
    fn a_map_survives_toml_and_bad_ones_are_named() {
        let field = FlatField::Spline(map());
        let text = toml::to_string(&field).expect("serialises");
        assert_eq!(toml::from_str::<FlatField>(&text), Ok(field));
        let mut short = map();
        short.log.pop();
        assert_eq!(
            FlatField::Spline(short).validate(),
            Err("flat_field.log holds 71 numbers, must be columns x rows, 72".into())
        );
        let mut bad = map();
        bad.log[3] = f64::NAN;
        assert_eq!(
            FlatField::Spline(bad).validate(),
            Err("flat_field.log holds NaN, must be -8 to 8".into())
        );
    }
}
