//! Normal equations: summed from rows, solved for a damped step, and inverted, with what they tell and what they do not.

use super::model::Row;
use crate::robust::Tukey;
use nalgebra::{DMatrix, DVector};

/// Normal equations and the cost at one state.
pub struct Normal {
    /// The matrix, JᵀJ.
    pub jtj: DMatrix<f64>,
    /// The right side, Jᵀr.
    pub jtr: DVector<f64>,
    /// The cost.
    pub cost: f64,
}

impl Normal {
    /// Of so many unknowns, without a row.
    pub fn zero(n: usize) -> Self {
        Normal {
            jtj: DMatrix::zeros(n, n),
            jtr: DVector::zeros(n),
            cost: 0.0,
        }
    }

    /// Adds a row under a robust loss.
    pub fn add(&mut self, row: &Row, loss: &Tukey) {
        self.cost += loss.loss(row.residual);
        self.add_weighted(row, loss.weight(row.residual));
    }

    /// Adds a row with its square and a weight.
    pub fn add_squared(&mut self, row: &Row, weight: f64) {
        self.cost += 0.5 * weight * row.residual * row.residual;
        self.add_weighted(row, weight);
    }

    fn add_weighted(&mut self, row: &Row, weight: f64) {
        if weight == 0.0 {
            return;
        }
        for (i, a) in &row.entries {
            let scaled = weight * a;
            self.jtr[*i] += scaled * row.residual;
            for (j, b) in &row.entries {
                self.jtj[(*i, *j)] += scaled * b;
            }
        }
    }

    /// The step of the damped equations; `None` if they are not definite. Unknowns that nothing touches stay as they are.
    pub fn step(&self, damping: f64) -> Option<DVector<f64>> {
        let mut damped = self.jtj.clone();
        for index in 0..damped.nrows() {
            let diagonal = &mut damped[(index, index)];
            *diagonal = match *diagonal > 0.0 {
                true => *diagonal * (1.0 + damping),
                false => 1.0,
            };
        }
        Some(damped.cholesky()?.solve(&-&self.jtr))
    }
}

/// The inverse of the normal equations, and which unknowns they tell: where an image shows how far away its sphere is and no more, the
/// centre there is not told, and all else is.
///
/// What is not told has a variance that only the ridge bounds; the others' is inflated by what they have in common no further than
/// priors let it be.
pub fn inverted(hessian: &DMatrix<f64>) -> (DMatrix<f64>, Vec<bool>) {
    const RIDGE: f64 = 1e-12;
    const MAX_INFLATION: f64 = 1e-2 / RIDGE;
    let n = hessian.nrows();
    // Each unknown in units of its deviation if all others were known.
    let units = hessian.diagonal().map(|told| match told > 0.0 {
        true => told.sqrt().recip(),
        false => 0.0,
    });
    let scaled = |m: &DMatrix<f64>| DMatrix::from_fn(n, n, |i, j| m[(i, j)] * units[i] * units[j]);
    let ridged = scaled(hessian) + DMatrix::<f64>::identity(n, n) * RIDGE;
    let Some(factor) = ridged.cholesky() else {
        return (DMatrix::zeros(n, n), vec![false; n]);
    };
    let inverse = factor.inverse();
    let is_told = (0..n).map(|index| inverse[(index, index)] < MAX_INFLATION);
    (scaled(&inverse), is_told.collect())
}
