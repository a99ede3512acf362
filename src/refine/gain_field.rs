//! A smooth gain over a view's image: what Eq. (1) leaves out and depth knows better.
//!
//! Interreflection, an imperfect flat field and slow changes of albedo move intensities by several percent over
//! centimetres. Read as shading, one percent at 30° of incidence is a degree of slope, a millimetre over 60 mm: far more than
//! the depth sensor's own slow error. The field takes such differences up, so that shading decides the detail and the anchor
//! the slow shape. It is estimated in turn with the displacements, from observed over predicted intensity.

use crate::geometry::Bilinear;
use crate::geometry::lanes::{LANES, Lane, floor};
use nalgebra::Vector2;

/// Gains on a grid of cells over the image, bilinear between them; 1 where nothing was observed.
#[derive(Clone, Debug)]
pub struct GainField {
    cell_px: f64,
    columns: usize,
    values: Vec<f64>,
}

/// Sums for a new field: weighted products of prediction with observation and with itself, by cell corner.
pub struct GainSums {
    field: GainField,
    by_corner: Vec<(f64, f64)>,
}

impl GainField {
    /// A field of 1 over an image.
    pub fn flat(width: usize, height: usize, cell_px: f64) -> Self {
        let columns = (width as f64 / cell_px).ceil() as usize + 1;
        let rows = (height as f64 / cell_px).ceil() as usize + 1;
        GainField {
            cell_px,
            columns,
            values: vec![1.0; columns * rows],
        }
    }

    /// Gain at a pixel inside the image.
    pub fn at(&self, pixel: &Vector2<f64>) -> f64 {
        self.corners(pixel)
            .map(|(corner, share)| share * self.values[corner])
            .sum()
    }

    /// Gain at places on the image, columns and rows.
    #[inline(always)]
    pub fn at_lanes(&self, u: &Lane, v: &Lane) -> Lane {
        let per_px = 1.0 / self.cell_px as f32;
        let (mut first, mut along, mut down) = ([0; LANES], [0.0; LANES], [0.0; LANES]);
        for i in 0..LANES {
            let (x, y) = (u[i] * per_px, v[i] * per_px);
            let (column, row) = (floor(x), floor(y));
            along[i] = x - column as f32;
            down[i] = y - row as f32;
            first[i] = row * self.columns as i32 + column;
        }
        let mut gain = [0.0; LANES];
        for i in 0..LANES {
            let first = first[i] as usize;
            let below = first + self.columns;
            let [a, b, c, d] = [first, first + 1, below, below + 1].map(|k| self.values[k] as f32);
            let (top, bottom) = (a + (b - a) * along[i], c + (d - c) * along[i]);
            gain[i] = top + (bottom - top) * down[i];
        }
        gain
    }

    /// The four corners of a pixel's cell and their shares of 1.
    fn corners(&self, pixel: &Vector2<f64>) -> impl Iterator<Item = (usize, f64)> {
        let place = Bilinear::new(&(pixel / self.cell_px), self.columns);
        place.corners.into_iter().zip(place.shares())
    }

    /// Empty sums for a field of the same grid.
    pub fn sums(&self) -> GainSums {
        GainSums {
            field: self.clone(),
            by_corner: vec![(0.0, 0.0); self.values.len()],
        }
    }
}

impl GainSums {
    /// Adds a pixel: prediction without any field, observation, and the weight of their difference squared.
    pub fn add(&mut self, pixel: &Vector2<f64>, predicted: f64, observed: f64, weight: f64) {
        for (corner, share) in self.field.corners(pixel) {
            let (numerator, denominator) = &mut self.by_corner[corner];
            *numerator += share * weight * predicted * observed;
            *denominator += share * weight * predicted * predicted;
        }
    }

    /// The gains that fit best; each is held to 1 as if by `prior` sums of squared predictions.
    pub fn solve(self, prior: f64) -> GainField {
        let values = self
            .by_corner
            .iter()
            .map(|(numerator, denominator)| (numerator + prior) / (denominator + prior))
            .collect();
        GainField {
            values,
            ..self.field
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_slow_gain_is_recovered_and_unseen_cells_stay_1() {
        let field = GainField::flat(100, 60, 20.0);
        let mut sums = field.sums();
        let truth = |p: &Vector2<f64>| 1.0 + 0.001 * p.x;
        for v in 0..60 {
            for u in 0..50 {
                let pixel = Vector2::new(u as f64, v as f64);
                sums.add(&pixel, 0.3, 0.3 * truth(&pixel), 100.0);
            }
        }
        let fitted = sums.solve(1e-3);
        let pixel = Vector2::new(25.0, 30.0);
        // Hat-weighted means of a ramp are exact inside.
        assert!((fitted.at(&pixel) - truth(&pixel)).abs() < 1e-3);
        assert_eq!(fitted.at(&Vector2::new(95.0, 30.0)), 1.0);
        let (u, v) = ([41.7; LANES], [12.3; LANES]);
        let many = f64::from(fitted.at_lanes(&u, &v)[5]);
        assert!((many - fitted.at(&Vector2::new(41.7, 12.3))).abs() < 1e-6);
    }
}
