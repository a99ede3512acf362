//! What a rigid motion explains of values that were measured in many places: that much may be a mistake of the pose.

use nalgebra::{Cholesky, Matrix6, U6, Vector6};

/// The normal equations of a motion that is to explain values, whatever they are.
pub struct MotionEquations {
    /// How each value grows with an increment, and what it counts for.
    rows: Vec<(Vector6<f64>, f64)>,
    factor: Cholesky<f64, U6>,
}

impl MotionEquations {
    /// Of values that grow with an increment by these rows, each with its weight. `damping` is added in every direction, as a share
    /// of the trace, for motions that change no value. `None` if no motion changes any.
    pub fn new(rows: Vec<(Vector6<f64>, f64)>, damping: f64) -> Option<Self> {
        let normal_matrix = rows.iter().fold(Matrix6::zeros(), |sum, (row, weight)| {
            sum + *weight * row * row.transpose()
        });
        let damping = damping * normal_matrix.trace();
        let factor = (normal_matrix + Matrix6::identity() * damping).cholesky()?;
        Some(MotionEquations { rows, factor })
    }

    /// The increment that best explains values, of which there is one for each row.
    pub fn explaining(&self, values: impl Iterator<Item = f64>) -> Vector6<f64> {
        let rows = self.rows.iter().zip(values);
        let right = rows.fold(Vector6::zeros(), |sum, ((row, weight), value)| {
            sum + weight * value * row
        });
        self.factor.solve(&right)
    }

    /// What that leaves of the values.
    pub fn left_of(&self, values: &[f64]) -> impl Iterator<Item = f64> {
        let motion = self.explaining(values.iter().copied());
        let rows = values.iter().zip(&self.rows);
        rows.map(move |(value, (row, _))| value - row.dot(&motion))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::point_to_plane_row;
    use nalgebra::Vector3;

    #[test]
    fn a_motion_is_explained_and_nothing_else() {
        let scattered = |k: usize, step: f64| (k as f64 * step).fract() - 0.5;
        let vector = |k: usize| {
            Vector3::new(
                scattered(k, 0.618_034),
                scattered(k, 0.754_878),
                scattered(k, 0.569_840),
            )
        };
        let row = |k: usize| point_to_plane_row(&vector(k), &vector(k + 1000));
        let rows: Vec<_> = (0..500).map(|k| (row(k), 1.0 + (k % 3) as f64)).collect();
        let xi = Vector6::new(0.3, -0.2, 0.5, -0.1, 0.4, 0.2);
        let moved: Vec<f64> = rows.iter().map(|(row, _)| row.dot(&xi)).collect();
        let equations = MotionEquations::new(rows, 1e-12).expect("the places hold every motion");
        assert!((equations.explaining(moved.iter().copied()) - xi).norm() < 1e-6);
        assert!(equations.left_of(&moved).all(|left| left.abs() < 1e-6));
        // What goes up and down from place to place is no motion.
        let noise: Vec<f64> = (0..500u32).map(|k| f64::from(k % 2) - 0.5).collect();
        let squares: f64 = equations.left_of(&noise).map(|left| left * left).sum();
        assert!(squares > 0.95 * 125.0, "{squares}");
        assert!(MotionEquations::new(Vec::new(), 1e-12).is_none());
    }
}
