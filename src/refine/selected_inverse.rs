//! The diagonal of a sparse inverse, from its Cholesky factor alone (Takahashi, Fagan and Chin 1973).
//!
//! With `A = L Lᵀ` and `Z = A⁻¹`, the entries of Z within the pattern of L follow from those to their lower right:
//! `Z_IJ = −Z_II W` and `Z_JJ = L_JJ⁻ᵀ L_JJ⁻¹ − Wᵀ Z_IJ` with `W = L_IJ L_JJ⁻¹`, for a supernode's columns J and the rows I
//! below them. Going from the last supernode to the first, every entry of `Z_II` that is asked for is there already. It
//! costs about as much as two factorisations; no other entry of the inverse is ever computed.

use faer::linalg::matmul::matmul;
use faer::linalg::triangular_solve::solve_lower_triangular_in_place;
use faer::sparse::linalg::cholesky::supernodal::SymbolicSupernodalCholesky;
use faer::{Accum, Mat, MatMut, MatRef, Par};

/// Puts the inverse's entries in the place of the factor's, from the last supernode to the first; returns its diagonal.
pub fn selected_diagonal(
    supernodes: &SymbolicSupernodalCholesky<usize>,
    values: &mut [f64],
) -> Vec<f64> {
    let blocks = Blocks::new(supernodes);
    let mut diagonal = vec![0.0; supernodes.nrows()];
    for block in (0..supernodes.n_supernodes()).rev() {
        let columns = blocks.columns(block);
        let n = columns.len();
        let (start, end) = blocks.values(block);
        let (head, known) = values.split_at_mut(end);
        let m = blocks.below(block).len();
        let inverse = block_inverse(
            MatRef::from_column_major_slice(&head[start..], n + m, n),
            || blocks.gather(block, known, end),
        );
        MatMut::from_column_major_slice_mut(&mut head[start..], n + m, n).copy_from(&inverse);
        for (k, column) in columns.enumerate() {
            diagonal[column] = inverse[(k, k)];
        }
    }
    diagonal
}

/// `Z_JJ` over `Z_IJ` from the same columns of the factor; `below` gives `Z_II`.
fn block_inverse(factor: MatRef<'_, f64>, below: impl FnOnce() -> Mat<f64>) -> Mat<f64> {
    let n = factor.ncols();
    let m = factor.nrows() - n;
    let mut inverse = Mat::<f64>::identity(n, n);
    solve_lower_triangular_in_place(factor.subrows(0, n), inverse.as_mut(), Par::Seq);
    let mut result = Mat::<f64>::zeros(n + m, n);
    let (mut own, mut coupled) = result.as_mut().split_at_row_mut(n);
    let product = |to: MatMut<'_, f64>, accum, a: MatRef<'_, f64>, b: MatRef<'_, f64>, factor| {
        matmul(to, accum, a, b, factor, Par::Seq);
    };
    product(
        own.as_mut(),
        Accum::Replace,
        inverse.transpose(),
        inverse.as_ref(),
        1.0,
    );
    if m > 0 {
        let mut w = Mat::<f64>::zeros(m, n);
        let rows = factor.subrows(n, m);
        product(w.as_mut(), Accum::Replace, rows, inverse.as_ref(), 1.0);
        let below = below();
        product(
            coupled.as_mut(),
            Accum::Replace,
            below.as_ref(),
            w.as_ref(),
            -1.0,
        );
        product(own, Accum::Add, w.transpose(), coupled.as_ref(), -1.0);
    }
    result
}

/// Where the columns and rows of every supernode lie.
struct Blocks<'a> {
    supernodes: &'a SymbolicSupernodalCholesky<usize>,
    /// The supernode of each column.
    of_column: Vec<u32>,
}

impl<'a> Blocks<'a> {
    fn new(supernodes: &'a SymbolicSupernodalCholesky<usize>) -> Self {
        let mut of_column = vec![0; supernodes.nrows()];
        let ends = supernodes
            .supernode_begin()
            .iter()
            .zip(supernodes.supernode_end());
        for (block, (&begin, &end)) in ends.enumerate() {
            of_column[begin..end].fill(block as u32);
        }
        Blocks {
            supernodes,
            of_column,
        }
    }

    fn columns(&self, block: usize) -> std::ops::Range<usize> {
        self.supernodes.supernode_begin()[block]..self.supernodes.supernode_end()[block]
    }

    /// The rows below its columns, ascending.
    fn below(&self, block: usize) -> &'a [usize] {
        self.supernodes.supernode(block).pattern()
    }

    /// Where its entries begin and end, column by column.
    fn values(&self, block: usize) -> (usize, usize) {
        let starts = self.supernodes.col_ptr_for_val();
        (starts[block], starts[block + 1])
    }

    /// `Z_II` of a supernode's rows I, from the entries that are known: those from `offset` on. All of them are there: rows
    /// below a column are rows of its ancestors.
    fn gather(&self, block: usize, known: &[f64], offset: usize) -> Mat<f64> {
        let rows = self.below(block);
        let mut z = Mat::<f64>::zeros(rows.len(), rows.len());
        let mut first = 0;
        let mut places = Vec::new();
        while first < rows.len() {
            let ancestor = self.of_column[rows[first]] as usize;
            let columns = self.columns(ancestor);
            let end = first + rows[first..].partition_point(|row| columns.contains(row));
            let height = columns.len() + self.below(ancestor).len();
            places.clear();
            places.extend(self.places(ancestor, &rows[first..]));
            let (start, _) = self.values(ancestor);
            for column in first..end {
                let entries = &known[start - offset + (rows[column] - columns.start) * height..];
                for row in column..rows.len() {
                    let value = entries[places[row - first]];
                    z[(row, column)] = value;
                    z[(column, row)] = value;
                }
            }
            first = end;
        }
        z
    }

    /// Where rows, ascending, stand within a supernode's columns.
    fn places(&self, block: usize, rows: &[usize]) -> impl Iterator<Item = usize> {
        let (columns, below) = (self.columns(block), self.below(block));
        let mut at = 0;
        rows.iter().map(move |&row| {
            if columns.contains(&row) {
                return row - columns.start;
            }
            while below[at] < row {
                at += 1;
            }
            columns.len() + at
        })
    }
}

#[cfg(test)]
mod tests {
    use super::super::cholesky::Analysis;
    use faer::Mat;
    use faer::linalg::solvers::DenseSolveCore;
    use faer::sparse::{SparseColMat, SparseColMatRef, Triplet};

    fn inverse_diagonal(lower: SparseColMatRef<'_, usize, f64>) -> Option<Vec<f64>> {
        let analysis = Analysis::new(lower.symbolic())?;
        Some(analysis.factorise(lower)?.inverse_diagonal())
    }

    /// The Laplacian of a grid with a few long-range couplings, plus a little on the diagonal: fill at many levels.
    fn grid(side: usize) -> (SparseColMat<usize, f64>, Mat<f64>) {
        let n = side * side;
        let mut dense = Mat::<f64>::zeros(n, n);
        let mut couple = |i: usize, j: usize, weight: f64| {
            dense[(i, i)] += weight;
            dense[(j, j)] += weight;
            dense[(i, j)] -= weight;
            dense[(j, i)] -= weight;
        };
        for i in 0..n {
            let weight = 1.0 + (i as f64 * 0.618_034).fract();
            if i % side + 1 < side {
                couple(i, i + 1, weight);
            }
            if i + side < n {
                couple(i, i + side, 2.0 * weight);
            }
            if i % 7 == 0 {
                couple(i, (i * 31 + 5) % n, 0.3);
            }
        }
        for i in 0..n {
            dense[(i, i)] += 0.01 + 0.02 * (i % 3) as f64;
        }
        let entries = (0..n).flat_map(|column| (column..n).map(move |row| (row, column)));
        let entries: Vec<_> = entries
            .filter(|&(row, column)| dense[(row, column)] != 0.0)
            .map(|(row, column)| Triplet::new(row, column, dense[(row, column)]))
            .collect();
        let lower = SparseColMat::try_new_from_triplets(n, n, &entries).unwrap();
        (lower, dense)
    }

    #[test]
    fn the_diagonal_is_that_of_the_dense_inverse() {
        for side in [1, 2, 5, 18] {
            let (lower, dense) = grid(side);
            let exact = dense.partial_piv_lu().inverse();
            let diagonal = inverse_diagonal(lower.as_ref()).unwrap();
            for (k, value) in diagonal.iter().enumerate() {
                let relative = (value / exact[(k, k)] - 1.0).abs();
                assert!(relative < 1e-10, "{side}: entry {k} is off by {relative}");
            }
        }
    }

    #[test]
    fn a_matrix_that_is_not_positive_definite_has_none() {
        let entries = [
            Triplet::new(0, 0, 1.0),
            Triplet::new(1, 0, 2.0),
            Triplet::new(1, 1, 1.0),
        ];
        let lower = SparseColMat::try_new_from_triplets(2, 2, &entries).unwrap();
        assert!(inverse_diagonal(lower.as_ref()).is_none());
    }
}
