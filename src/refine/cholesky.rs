//! Cholesky factors of sparse symmetric matrices of one pattern, whose order of elimination is found once.

use super::selected_inverse::selected_diagonal;
use faer::dyn_stack::{MemBuffer, MemStack};
use faer::sparse::linalg::SupernodalThreshold;
use faer::sparse::linalg::cholesky::{
    CholeskySymbolicParams, LltRef, SymbolicCholesky, SymbolicCholeskyRaw, SymmetricOrdering,
    factorize_symbolic_cholesky,
};
use faer::sparse::{SparseColMatRef, SymbolicSparseColMatRef};
use faer::{Conj, MatMut, Par, Side};

/// The order of elimination for a pattern, and what fills in.
pub struct Analysis {
    symbolic: SymbolicCholesky<usize>,
}

/// The factor of one matrix: `A = L Lᵀ`.
pub struct Factor<'a> {
    symbolic: &'a SymbolicCholesky<usize>,
    values: Vec<f64>,
}

impl Analysis {
    /// Analyses the lower half of a pattern, by approximate minimum degree; `None` where memory does not suffice.
    pub fn new(lower: SymbolicSparseColMatRef<'_, usize>) -> Option<Analysis> {
        let params = CholeskySymbolicParams {
            // Always supernodes, which the inverse needs, even where nothing is to be eliminated.
            supernodal_flop_ratio_threshold: SupernodalThreshold(-1.0),
            ..CholeskySymbolicParams::default()
        };
        let ordering = SymmetricOrdering::Amd;
        let symbolic = factorize_symbolic_cholesky(lower, Side::Lower, ordering, params).ok()?;
        Some(Analysis { symbolic })
    }

    /// Factorises a matrix of the pattern; `None` if it is not positive definite or memory does not suffice.
    pub fn factorise(&self, lower: SparseColMatRef<'_, usize, f64>) -> Option<Factor<'_>> {
        let symbolic = &self.symbolic;
        let mut values = Vec::new();
        values.try_reserve_exact(symbolic.len_val()).ok()?;
        values.resize(symbolic.len_val(), 0.0);
        let scratch = symbolic.factorize_numeric_llt_scratch::<f64>(Par::Seq, Default::default());
        let mut memory = MemBuffer::try_new(scratch).ok()?;
        symbolic
            .factorize_numeric_llt(
                &mut values,
                lower,
                Side::Lower,
                Default::default(),
                Par::Seq,
                MemStack::new(&mut memory),
                Default::default(),
            )
            .ok()?;
        Some(Factor { symbolic, values })
    }
}

impl Factor<'_> {
    /// Solves `A X = B` for several columns at once, which stand one after the other in `columns`; `None` if memory does not
    /// suffice. The factor is read once for all of them, which is most of the cost.
    pub fn solve(&self, mut columns: Vec<f64>) -> Option<Vec<f64>> {
        let n_rows = self.symbolic.nrows();
        let n_columns = columns.len() / n_rows;
        let scratch = self
            .symbolic
            .solve_in_place_scratch::<f64>(n_columns, Par::Seq);
        let mut memory = MemBuffer::try_new(scratch).ok()?;
        LltRef::new(self.symbolic, &self.values).solve_in_place_with_conj(
            Conj::No,
            MatMut::from_column_major_slice_mut(&mut columns, n_rows, n_columns),
            Par::Seq,
            MemStack::new(&mut memory),
        );
        Some(columns)
    }

    /// The diagonal of `A⁻¹`. Costs about as much as two factorisations.
    pub fn inverse_diagonal(mut self) -> Vec<f64> {
        let SymbolicCholeskyRaw::Supernodal(supernodes) = self.symbolic.raw() else {
            unreachable!("the analysis asked for supernodes");
        };
        let permuted = selected_diagonal(supernodes, &mut self.values);
        let Some(permutation) = self.symbolic.perm() else {
            return permuted;
        };
        let (old_of_new, _) = permutation.arrays();
        let mut diagonal = vec![0.0; permuted.len()];
        for (&old, value) in old_of_new.iter().zip(permuted) {
            diagonal[old] = value;
        }
        diagonal
    }
}
