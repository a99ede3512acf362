//! Cholesky factors, in single precision, of sparse symmetric matrices of one pattern, whose order of elimination is found once:
//! multifrontal (Duff and Reid 1983), over the tree of a [`Dissection`].
//!
//! A node's *front* has a row for each of its own unknowns, the pivots J, and for each later one that they meet, the boundary I. What it
//! subtracts from the boundary goes to its parent's front. With `A = L Lᵀ` and `Z = A⁻¹`, the inverse's entries within the fronts follow
//! from those of the parents (Takahashi, Fagan and Chin 1973): `Z_IJ = −Z_II W` and `Z_JJ = L_JJ⁻ᵀ L_JJ⁻¹ − Wᵀ Z_IJ` with
//! `W = L_IJ L_JJ⁻¹`. Branches are independent of one another, upwards and downwards, and every sum is in one order whatever
//! thread it is on.

use super::dissection::{Dissection, Graph, Node, both};
use faer::dyn_stack::{MemBuffer, MemStack};
use faer::linalg::cholesky::llt::factor::{cholesky_in_place, cholesky_in_place_scratch};
use faer::linalg::matmul::matmul;
use faer::linalg::matmul::triangular::{self, BlockStructure};
use faer::linalg::triangular_solve::{
    solve_lower_triangular_in_place, solve_upper_triangular_in_place,
};
use faer::{Accum, ColMut, ColRef, Mat, MatMut, MatRef, Par};
use nalgebra::Point3;
use rayon::prelude::*;
use std::ops::Range;

/// Branches of more unknowns than this are worth a thread.
const PARALLEL: usize = 2000;

/// The order of elimination for a pattern, and where every entry goes.
pub struct Analysis {
    dissection: Dissection,
    /// Of each node.
    fronts: Vec<Front>,
}

/// What is known beforehand of a node's front.
struct Front {
    n_boundary: usize,
    /// Where in the parent's front each row of the boundary is, ascending.
    in_parent: Vec<u32>,
    /// Off-diagonal entries of the pivots' columns: which one, row and column in the front.
    entries: Vec<[u32; 3]>,
    /// Values of the factor for its own columns and for all below it.
    n_values: usize,
}

/// The factor of one matrix.
pub struct Factor<'a> {
    analysis: &'a Analysis,
    /// Front by front, `L_JJ` over `L_IJ`, column by column.
    values: Vec<f32>,
}

impl Analysis {
    /// Analyses the matrix whose off-diagonal entries are those of some pairs of unknowns, each named once, which have places in
    /// space.
    pub fn new(places: &[Point3<f64>], pairs: &[[u32; 2]]) -> Analysis {
        let graph = Graph::new(places.len(), pairs);
        let dissection = Dissection::new(&graph, places);
        Analysis::of_dissection(dissection, &graph, pairs)
    }

    /// The same where each unknown halves a pair of this one's, or is one of its unknowns.
    pub fn finer(
        &self,
        parents: &[[u32; 2]],
        places: &[Point3<f64>],
        pairs: &[[u32; 2]],
    ) -> Analysis {
        let graph = Graph::new(places.len(), pairs);
        let dissection = self.dissection.finer(parents, &graph, places);
        Analysis::of_dissection(dissection, &graph, pairs)
    }

    fn of_dissection(dissection: Dissection, graph: &Graph, pairs: &[[u32; 2]]) -> Analysis {
        let Dissection { order, nodes } = &dissection;
        let mut place_of = vec![0u32; order.len()];
        for (place, &unknown) in (0..).zip(order) {
            place_of[unknown as usize] = place;
        }
        let mut boundaries: Vec<Vec<u32>> = Vec::with_capacity(nodes.len());
        let mut fronts: Vec<Front> = Vec::with_capacity(nodes.len());
        for node in nodes {
            let later = |place: &u32| *place as usize >= node.pivots.end;
            let own = order[node.pivots.clone()].iter();
            let met = own.flat_map(|&unknown| graph.neighbours(unknown));
            let mut boundary: Vec<u32> = met.map(|&other| place_of[other as usize]).collect();
            let children = node.children.into_iter().flatten();
            boundary.extend(children.clone().flat_map(|child| &boundaries[child]));
            boundary.retain(later);
            boundary.sort_unstable();
            boundary.dedup();
            let front = Rows {
                pivots: &node.pivots,
                boundary: &boundary,
            };
            let mut n_values = node.pivots.len() * (node.pivots.len() + boundary.len());
            for child in children {
                let rows = boundaries[child].iter().map(|&place| front.row_of(place));
                fronts[child].in_parent = rows.collect();
                n_values += fronts[child].n_values;
            }
            fronts.push(Front {
                n_boundary: boundary.len(),
                in_parent: Vec::new(),
                entries: Vec::new(),
                n_values,
            });
            boundaries.push(boundary);
        }
        let node_of = dissection.node_of_unknowns();
        let place_in_front = |pair: &[u32; 2]| {
            let [a, b] = pair.map(|unknown| place_of[unknown as usize]);
            let (column, row) = (a.min(b), a.max(b));
            let node = node_of[order[column as usize] as usize] as usize;
            let rows = Rows {
                pivots: &nodes[node].pivots,
                boundary: &boundaries[node],
            };
            (node, rows.row_of(row), rows.row_of(column))
        };
        let places: Vec<_> = pairs.par_iter().map(place_in_front).collect();
        for (entry, (node, row, column)) in (0..).zip(places) {
            fronts[node].entries.push([entry, row, column]);
        }
        Analysis { dissection, fronts }
    }

    /// Factorises a matrix with these values on the diagonal and for the pairs; `None` if it is not positive definite or memory
    /// does not suffice.
    pub fn factorise(&self, diagonal: &[f64], of_pairs: &[f64]) -> Option<Factor<'_>> {
        let root = self.fronts.len() - 1;
        let n_values = self.fronts[root].n_values;
        let mut values = Vec::new();
        values.try_reserve_exact(n_values).ok()?;
        values.par_extend(rayon::iter::repeat_n(0.0, n_values));
        let matrix = Entries { diagonal, of_pairs };
        self.eliminate(root, &matrix, &mut values)?;
        Some(Factor {
            analysis: self,
            values,
        })
    }

    /// Factorises the columns of a node and of all below it; returns what they subtract from the boundary, the lower half.
    fn eliminate(&self, node: usize, matrix: &Entries, values: &mut [f32]) -> Option<Mat<f32>> {
        let (
            Node {
                children, pivots, ..
            },
            front,
        ) = self.at(node);
        let (n, m) = (pivots.len(), front.n_boundary);
        let (below, own) = values.split_at_mut(values.len() - n * (n + m));
        let mut own = MatMut::from_column_major_slice_mut(own, n + m, n);
        let mut update = Mat::<f32>::zeros(m, m);
        if let Some([a, b]) = *children {
            let (near, far) = below.split_at_mut(self.fronts[a].n_values);
            let nodes = [a, b];
            let (a, b) = self.both(
                node,
                || self.eliminate(a, matrix, near),
                || self.eliminate(b, matrix, far),
            );
            for (child, theirs) in nodes.into_iter().zip([a?, b?]) {
                let rows = &self.fronts[child].in_parent;
                add_lower(&theirs, rows, &mut own, &mut update);
            }
        }
        for (k, &unknown) in self.dissection.order[pivots.clone()].iter().enumerate() {
            own[(k, k)] += matrix.diagonal[unknown as usize] as f32;
        }
        for &[entry, row, column] in &front.entries {
            own[(row as usize, column as usize)] += matrix.of_pairs[entry as usize] as f32;
        }
        let (mut corner, mut rows) = own.split_at_row_mut(n);
        let scratch = cholesky_in_place_scratch::<f32>(n, Par::Seq, Default::default());
        cholesky_in_place(
            corner.as_mut(),
            Default::default(),
            Par::Seq,
            MemStack::new(&mut MemBuffer::try_new(scratch).ok()?),
            Default::default(),
        )
        .ok()?;
        if m > 0 {
            let transposed = rows.as_mut().transpose_mut();
            solve_lower_triangular_in_place(corner.as_ref(), transposed, Par::Seq);
            triangular::matmul(
                update.as_mut(),
                BlockStructure::TriangularLower,
                Accum::Add,
                rows.as_ref(),
                BlockStructure::Rectangular,
                rows.as_ref().transpose(),
                BlockStructure::Rectangular,
                -1.0,
                Par::Seq,
            );
        }
        Some(update)
    }

    fn at(&self, node: usize) -> (&Node, &Front) {
        (&self.dissection.nodes[node], &self.fronts[node])
    }

    /// Does what is to be done for both branches below a node, at the same time if they are large.
    fn both<A: Send, B: Send>(
        &self,
        node: usize,
        near: impl FnOnce() -> A + Send,
        far: impl FnOnce() -> B + Send,
    ) -> (A, B) {
        let (Node { pivots, first, .. }, _) = self.at(node);
        both(pivots.start - first > PARALLEL, near, far)
    }
}

/// The rows of a front by their places in the order.
struct Rows<'a> {
    pivots: &'a Range<usize>,
    boundary: &'a [u32],
}

impl Rows<'_> {
    fn row_of(&self, place: u32) -> u32 {
        let row = match self.pivots.contains(&(place as usize)) {
            true => place as usize - self.pivots.start,
            false => {
                let found = self.boundary.binary_search(&place);
                self.pivots.len() + found.expect("the boundary holds all that pivots meet")
            }
        };
        row as u32
    }
}

struct Entries<'a> {
    diagonal: &'a [f64],
    of_pairs: &'a [f64],
}

/// The values of a column of a matrix that is kept column by column.
fn values_of(column: ColRef<'_, f32>) -> &[f32] {
    let column = column.try_as_col_major();
    column.expect("kept column by column").as_slice()
}

/// The same for writing.
fn values_of_mut(column: ColMut<'_, f32>) -> &mut [f32] {
    let column = column.try_as_col_major_mut();
    column.expect("kept column by column").as_slice_mut()
}

/// Adds the lower half of a child's update to the front's own columns and to its update.
fn add_lower(theirs: &Mat<f32>, rows: &[u32], own: &mut MatMut<'_, f32>, update: &mut Mat<f32>) {
    let n = own.ncols();
    for (j, &column) in rows.iter().enumerate() {
        let column = column as usize;
        let from = values_of(theirs.col(j));
        let (to, first) = match column < n {
            true => (own.as_mut().col_mut(column), 0),
            false => (update.col_mut(column - n), n),
        };
        let to = values_of_mut(to);
        for (&row, value) in rows[j..].iter().zip(&from[j..]) {
            to[row as usize - first] += value;
        }
    }
}

impl Factor<'_> {
    /// Solves `A X = B` for several columns at once, which stand one after the other in `columns`. The factor is read once for
    /// all of them, which is most of the cost.
    pub fn solve(&self, mut columns: Vec<f64>) -> Vec<f64> {
        let order = &self.analysis.dissection.order;
        let n = order.len();
        let width = columns.len() / n.max(1);
        // Row by row, in the order of elimination.
        let mut rows = vec![0.0; columns.len()];
        let pairs = rows.par_chunks_mut(width.max(1)).zip(order);
        pairs.for_each(|(row, &unknown)| {
            for (column, value) in row.iter_mut().enumerate() {
                *value = columns[column * n + unknown as usize] as f32;
            }
        });
        let root = self.analysis.fronts.len() - 1;
        self.forward(root, &self.values, &mut rows, width);
        self.backward(root, &self.values, &mut rows, &[], width);
        for (row, &unknown) in rows.chunks(width.max(1)).zip(order) {
            for (column, value) in row.iter().enumerate() {
                columns[column * n + unknown as usize] = f64::from(*value);
            }
        }
        columns
    }

    /// `L_JJ` over `L_IJ` of a node, and the values of both branches below it.
    fn blocks<'a>(&self, node: usize, values: &'a [f32]) -> (MatRef<'a, f32>, [&'a [f32]; 2]) {
        let (
            Node {
                children, pivots, ..
            },
            front,
        ) = self.analysis.at(node);
        let n = pivots.len();
        let height = n + front.n_boundary;
        let (below, own) = values.split_at(values.len() - height * n);
        let n_near = children.map_or(0, |[near, _]| self.analysis.fronts[near].n_values);
        let (near, far) = below.split_at(n_near);
        (MatRef::from_column_major_slice(own, height, n), [near, far])
    }

    /// Parts the rows of a node and all below it into those of both branches and its own.
    fn split<'a>(&self, node: usize, rows: &'a mut [f32], width: usize) -> [&'a mut [f32]; 3] {
        let nodes = &self.analysis.dissection.nodes;
        let Node {
            children,
            pivots,
            first,
        } = &nodes[node];
        let n_near = children.map_or(0, |[near, _]| nodes[near].pivots.end - first);
        let (below, own) = rows.split_at_mut((pivots.start - first) * width);
        let (near, far) = below.split_at_mut(n_near * width);
        [near, far, own]
    }

    /// `L Y = B` for a node and all below it; returns what it adds to the right-hand side of its boundary.
    fn forward(&self, node: usize, values: &[f32], rows: &mut [f32], width: usize) -> Vec<f32> {
        let (at, front) = self.analysis.at(node);
        let (n, m) = (at.pivots.len(), front.n_boundary);
        let (own, below) = self.blocks(node, values);
        let [near, far, pivots] = self.split(node, rows, width);
        let mut added = vec![0.0; m * width];
        if let Some([a, b]) = at.children {
            let (from_near, from_far) = self.analysis.both(
                node,
                || self.forward(a, below[0], near, width),
                || self.forward(b, below[1], far, width),
            );
            for (child, theirs) in [(a, from_near), (b, from_far)] {
                let places = &self.analysis.fronts[child].in_parent;
                for (&row, values) in places.iter().zip(theirs.chunks(width)) {
                    let row = row as usize;
                    let to = match row < n {
                        true => &mut pivots[row * width..(row + 1) * width],
                        false => &mut added[(row - n) * width..(row - n + 1) * width],
                    };
                    to.iter_mut()
                        .zip(values)
                        .for_each(|(to, value)| *to += value);
                }
            }
        }
        let (corner, rows_below) = own.split_at_row(n);
        let mut pivots = MatMut::from_row_major_slice_mut(pivots, n, width);
        solve_lower_triangular_in_place(corner, pivots.as_mut(), Par::Seq);
        matmul(
            MatMut::from_row_major_slice_mut(&mut added, m, width),
            Accum::Add,
            rows_below,
            pivots.as_ref(),
            -1.0,
            Par::Seq,
        );
        added
    }

    /// `Lᵀ X = Y` for a node and all below it, given X on its boundary.
    fn backward(
        &self,
        node: usize,
        values: &[f32],
        rows: &mut [f32],
        boundary: &[f32],
        width: usize,
    ) {
        let (at, front) = self.analysis.at(node);
        let (n, m) = (at.pivots.len(), front.n_boundary);
        let (own, below) = self.blocks(node, values);
        let [near, far, pivots] = self.split(node, rows, width);
        let (corner, rows_below) = own.split_at_row(n);
        let mut x = MatMut::from_row_major_slice_mut(pivots, n, width);
        matmul(
            x.as_mut(),
            Accum::Add,
            rows_below.transpose(),
            MatRef::from_row_major_slice(boundary, m, width),
            -1.0,
            Par::Seq,
        );
        solve_upper_triangular_in_place(corner.transpose(), x, Par::Seq);
        let Some([a, b]) = at.children else { return };
        let theirs = |child: usize| -> Vec<f32> {
            let rows = self.analysis.fronts[child].in_parent.iter();
            rows.flat_map(|&row| {
                let row = row as usize;
                match row < n {
                    true => &pivots[row * width..(row + 1) * width],
                    false => &boundary[(row - n) * width..(row - n + 1) * width],
                }
            })
            .copied()
            .collect()
        };
        let (of_near, of_far) = (theirs(a), theirs(b));
        self.analysis.both(
            node,
            || self.backward(a, below[0], near, &of_near, width),
            || self.backward(b, below[1], far, &of_far, width),
        );
    }

    /// The diagonal of `A⁻¹`. Costs about as much as two factorisations.
    pub fn inverse_diagonal(&self) -> Vec<f64> {
        let mut permuted = vec![0.0; self.analysis.dissection.order.len()];
        let root = self.analysis.fronts.len() - 1;
        self.invert(root, &self.values, &Mat::zeros(0, 0), &mut permuted);
        let mut diagonal = vec![0.0; permuted.len()];
        for (&unknown, value) in self.analysis.dissection.order.iter().zip(permuted) {
            diagonal[unknown as usize] = f64::from(value);
        }
        diagonal
    }

    /// The inverse's diagonal for a node and all below it, given the inverse on its boundary.
    fn invert(&self, node: usize, values: &[f32], boundary: &Mat<f32>, diagonal: &mut [f32]) {
        let (at, front) = self.analysis.at(node);
        let (n, m) = (at.pivots.len(), front.n_boundary);
        let (own, below) = self.blocks(node, values);
        let [near, far, pivots] = self.split(node, diagonal, 1);
        let mut inverse = Mat::<f32>::identity(n, n);
        solve_lower_triangular_in_place(own.subrows(0, n), inverse.as_mut(), Par::Seq);
        let mut known = Mat::<f32>::zeros(n + m, n + m);
        let (own_rows, coupled_rows) = known.as_mut().split_at_row_mut(n);
        let mut corner = own_rows.subcols_mut(0, n);
        let mut coupled = coupled_rows.subcols_mut(0, n);
        let product = |to: MatMut<'_, f32>, accum, a: MatRef<'_, f32>, b: MatRef<'_, f32>, by| {
            matmul(to, accum, a, b, by, Par::Seq);
        };
        let upper = inverse.transpose();
        product(
            corner.as_mut(),
            Accum::Replace,
            upper,
            inverse.as_ref(),
            1.0,
        );
        if m > 0 {
            let mut w = Mat::<f32>::zeros(m, n);
            let rows = own.subrows(n, m);
            product(w.as_mut(), Accum::Replace, rows, inverse.as_ref(), 1.0);
            let known = boundary.as_ref();
            product(coupled.as_mut(), Accum::Replace, known, w.as_ref(), -1.0);
            let coupled = coupled.as_ref();
            product(corner.as_mut(), Accum::Add, w.transpose(), coupled, -1.0);
        }
        for (k, value) in pivots.iter_mut().enumerate() {
            *value = corner[(k, k)];
        }
        let Some([a, b]) = at.children else { return };
        for column in 0..n {
            for row in n..n + m {
                known[(column, row)] = known[(row, column)];
            }
        }
        known.as_mut().submatrix_mut(n, n, m, m).copy_from(boundary);
        let theirs = |child: usize| {
            let rows = &self.analysis.fronts[child].in_parent;
            let mut theirs = Mat::zeros(rows.len(), rows.len());
            for (j, &column) in rows.iter().enumerate() {
                let from = values_of(known.col(column as usize));
                for (to, &row) in values_of_mut(theirs.col_mut(j)).iter_mut().zip(rows) {
                    *to = from[row as usize];
                }
            }
            theirs
        };
        self.analysis.both(
            node,
            || self.invert(a, below[0], &theirs(a), near),
            || self.invert(b, below[1], &theirs(b), far),
        );
    }
}

#[cfg(test)]
mod tests {
    use super::super::dissection::tests::square;
    use super::*;
    use faer::linalg::solvers::DenseSolveCore;

    /// A matrix over a square: a Laplacian with weights, plus a little on the diagonal.
    struct Example {
        places: Vec<Point3<f64>>,
        pairs: Vec<[u32; 2]>,
        diagonal: Vec<f64>,
        of_pairs: Vec<f64>,
    }

    impl Example {
        fn new(side: usize) -> Example {
            let (places, pairs) = square(side);
            let mut diagonal: Vec<f64> = (0..places.len())
                .map(|k| 0.01 + 0.02 * (k % 3) as f64)
                .collect();
            let of_pairs = pairs.iter().enumerate().map(|(k, pair)| {
                let weight = 0.5 + (k as f64 * 0.618_034).fract();
                for &end in pair {
                    diagonal[end as usize] += weight;
                }
                -weight
            });
            let of_pairs = of_pairs.collect();
            Example {
                places,
                pairs,
                diagonal,
                of_pairs,
            }
        }

        fn dense(&self) -> Mat<f64> {
            let n = self.places.len();
            let mut dense = Mat::zeros(n, n);
            for (k, value) in self.diagonal.iter().enumerate() {
                dense[(k, k)] = *value;
            }
            for (&[a, b], value) in self.pairs.iter().zip(&self.of_pairs) {
                dense[(a as usize, b as usize)] = *value;
                dense[(b as usize, a as usize)] = *value;
            }
            dense
        }

        fn analysis(&self) -> Analysis {
            Analysis::new(&self.places, &self.pairs)
        }
    }

    #[test]
    fn solution_and_diagonal_are_those_of_the_dense_inverse() {
        for side in [1, 2, 5, 9, 30] {
            let example = Example::new(side);
            let n = side * side;
            let inverse = example.dense().partial_piv_lu().inverse();
            let analysis = example.analysis();
            let factor = analysis
                .factorise(&example.diagonal, &example.of_pairs)
                .expect("positive definite");
            for (k, value) in factor.inverse_diagonal().iter().enumerate() {
                let relative = (value / inverse[(k, k)] - 1.0).abs();
                assert!(relative < 1e-5, "{side}: entry {k} is off by {relative}");
            }
            let columns: Vec<f64> = (0..3 * n).map(|k| (k as f64 * 0.37).sin()).collect();
            let solved = factor.solve(columns.clone());
            let right = MatRef::from_column_major_slice(&columns, n, 3);
            let expected = &inverse * right;
            for (k, value) in solved.iter().enumerate() {
                let off = (value - expected[(k % n, k / n)]).abs();
                assert!(
                    off < 1e-5 * expected.norm_max(),
                    "{side}: {k} is off by {off}"
                );
            }
        }
    }

    #[test]
    fn the_factor_is_the_same_on_any_number_of_threads() {
        let example = Example::new(100);
        let analysis = example.analysis();
        let run = |n_threads: usize| {
            let pool = rayon::ThreadPoolBuilder::new()
                .num_threads(n_threads)
                .build()
                .expect("threads");
            pool.install(|| {
                let factor = analysis.factorise(&example.diagonal, &example.of_pairs);
                let factor = factor.expect("positive definite");
                let solved = factor.solve(example.diagonal.clone());
                (factor.inverse_diagonal(), factor.values, solved)
            })
        };
        assert!(run(1) == run(3));
    }

    #[test]
    fn a_matrix_that_is_not_positive_definite_has_none() {
        let mut example = Example::new(20);
        example.diagonal[211] = -1.0;
        let analysis = example.analysis();
        assert!(
            analysis
                .factorise(&example.diagonal, &example.of_pairs)
                .is_none()
        );
    }
}
