//! Pose graph optimisation (Grisetti et al. 2010): poses that agree best with measured relative poses.
//!
//! Levenberg–Marquardt with left increments, the normal equations factorised by sparse Cholesky; edges that may be wrong are
//! weighed down by Cauchy's kernel. The first pose is held.

use crate::geometry::{Pose, increment, increment_of};
use faer::Side;
use faer::linalg::solvers::Solve;
use faer::sparse::{SparseColMat, Triplet};
use nalgebra::{Matrix3, Matrix6, Vector3, Vector6};

/// A measured relative pose.
#[derive(Clone, Debug)]
pub struct Edge {
    /// The pose that was aligned.
    pub from: usize,
    /// The pose that it was aligned to.
    pub to: usize,
    /// Where `from` stands in the frame of `to`.
    pub to_from_from: Pose,
    /// Information of a left increment of `to_from_from`.
    pub information: Matrix6<f64>,
    /// Where Cauchy's kernel begins to doubt the edge, in sigmas; infinite for an edge that is beyond doubt.
    pub kernel_sigmas: f64,
}

/// Steps at most.
const MAX_STEPS: usize = 50;
/// The energy has settled when a step lowers it by less than this share.
const MIN_DECREASE: f64 = 1e-9;

/// Moves the poses (world from node) to where the edges' energy is least; the energy never rises.
pub fn optimise(nodes: &mut [Pose], edges: &[Edge]) {
    let mut damping = 1e-6;
    let mut energy = total_energy(nodes, edges);
    for _ in 0..MAX_STEPS {
        let Some(step) = solve(nodes, edges, damping) else {
            return;
        };
        let moved: Vec<Pose> = nodes
            .iter()
            .zip(&step)
            .map(|(pose, step)| increment(step) * pose)
            .collect();
        let moved_energy = total_energy(&moved, edges);
        if moved_energy >= energy {
            damping *= 10.0;
            if damping > 1e6 {
                return;
            }
            continue;
        }
        nodes.copy_from_slice(&moved);
        let decrease = 1.0 - moved_energy / energy;
        energy = moved_energy;
        damping = (damping * 0.1).max(1e-12);
        if decrease < MIN_DECREASE {
            return;
        }
    }
}

/// Half the sum of the edges' robust squares.
fn total_energy(nodes: &[Pose], edges: &[Edge]) -> f64 {
    edges.iter().map(|edge| edge.energy(nodes)).sum()
}

impl Edge {
    /// The increment of `to_from_from` that the nodes' poses amount to.
    fn residual(&self, nodes: &[Pose]) -> Vector6<f64> {
        increment_of(&(nodes[self.to].inverse() * nodes[self.from] * self.to_from_from.inverse()))
    }

    /// Square of the residual in sigmas.
    pub fn square(&self, nodes: &[Pose]) -> f64 {
        let residual = self.residual(nodes);
        residual.dot(&(self.information * residual))
    }

    fn energy(&self, nodes: &[Pose]) -> f64 {
        let square = self.square(nodes);
        if self.kernel_sigmas.is_infinite() {
            return 0.5 * square;
        }
        let scale = self.kernel_sigmas * self.kernel_sigmas;
        0.5 * scale * (square / scale).ln_1p()
    }

    /// What Cauchy's kernel leaves of the edge, 0 to 1.
    pub fn trust(&self, nodes: &[Pose]) -> f64 {
        let scale = self.kernel_sigmas * self.kernel_sigmas;
        1.0 / (1.0 + self.square(nodes) / scale)
    }

    /// Derivative of the residual by a left increment of the pose `from`; by one of `to` it is the negative.
    fn jacobian(&self, nodes: &[Pose], residual: &Vector6<f64>) -> Matrix6<f64> {
        let to = &nodes[self.to];
        let to_from_world = to.rotation.inverse().to_rotation_matrix().into_inner();
        let [turn, shift] = [residual.fixed_rows::<3>(0), residual.fixed_rows::<3>(3)];
        // The increment seen from `to`, at the place of the error: c_r = Rᵀa_r, c_t = Rᵀ(a_t − t × a_r).
        let moves_turn = -to_from_world * to.translation.vector.cross_matrix();
        let by_turn = inverse_left_jacobian(&turn.into_owned());
        let mut jacobian = Matrix6::zeros();
        jacobian
            .fixed_view_mut::<3, 3>(0, 0)
            .copy_from(&(by_turn * to_from_world));
        jacobian
            .fixed_view_mut::<3, 3>(3, 0)
            .copy_from(&(moves_turn - shift.into_owned().cross_matrix() * to_from_world));
        jacobian
            .fixed_view_mut::<3, 3>(3, 3)
            .copy_from(&to_from_world);
        jacobian
    }
}

/// Derivative of log(exp(a) exp(turn)) by a at 0.
fn inverse_left_jacobian(turn: &Vector3<f64>) -> Matrix3<f64> {
    let angle = turn.norm();
    let cross = turn.cross_matrix();
    let second = if angle < 1e-4 {
        1.0 / 12.0
    } else {
        1.0 / (angle * angle) - (1.0 + angle.cos()) / (2.0 * angle * angle.sin())
    };
    Matrix3::identity() - cross * 0.5 + cross * cross * second
}

/// The damped Gauss–Newton step of every pose; `None` where the equations cannot be factorised.
fn solve(nodes: &[Pose], edges: &[Edge], damping: f64) -> Option<Vec<Vector6<f64>>> {
    let n_nodes = nodes.len();
    let mut diagonal = vec![Matrix6::<f64>::zeros(); n_nodes];
    let mut gradient = vec![Vector6::<f64>::zeros(); n_nodes];
    let mut triplets = Vec::new();
    for edge in edges {
        let residual = edge.residual(nodes);
        let jacobian = edge.jacobian(nodes, &residual);
        let information = edge.information * edge.trust(nodes);
        let hessian = jacobian.transpose() * information * jacobian;
        let slope = jacobian.transpose() * (information * residual);
        diagonal[edge.from] += hessian;
        diagonal[edge.to] += hessian;
        gradient[edge.from] += slope;
        gradient[edge.to] -= slope;
        push_block(
            &mut triplets,
            edge.from.max(edge.to),
            edge.from.min(edge.to),
            &-hessian,
        );
    }
    for (node, block) in diagonal.iter_mut().enumerate() {
        for axis in 0..6 {
            block[(axis, axis)] *= 1.0 + damping;
        }
        push_block(&mut triplets, node, node, block);
    }
    let n_unknowns = 6 * n_nodes.checked_sub(1)?;
    let lower = SparseColMat::try_new_from_triplets(n_unknowns, n_unknowns, &triplets).ok()?;
    let factor = lower.sp_cholesky(Side::Lower).ok()?;
    let mut x = faer::Mat::from_fn(n_unknowns, 1, |row, _| -gradient[row / 6 + 1][row % 6]);
    factor.solve_in_place(&mut x);
    let mut step = vec![Vector6::zeros(); n_nodes];
    for row in 0..n_unknowns {
        step[row / 6 + 1][row % 6] = x[(row, 0)];
    }
    step.iter()
        .all(|step| step.iter().all(|value| value.is_finite()))
        .then_some(step)
}

/// Adds a block of the lower triangle; the first pose, which is held, has no rows and no columns.
fn push_block(
    triplets: &mut Vec<Triplet<usize, usize, f64>>,
    row_node: usize,
    column_node: usize,
    block: &Matrix6<f64>,
) {
    if row_node == 0 || column_node == 0 {
        return;
    }
    for column in 0..6 {
        let first_row = if row_node == column_node { column } else { 0 };
        for row in first_row..6 {
            triplets.push(Triplet::new(
                6 * (row_node - 1) + row,
                6 * (column_node - 1) + column,
                block[(row, column)],
            ));
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::motion_between;
    use std::f64::consts::TAU;

    fn edge(from: usize, to: usize, to_from_from: Pose) -> Edge {
        Edge {
            from,
            to,
            to_from_from,
            information: Matrix6::identity() * 1e4,
            kernel_sigmas: f64::INFINITY,
        }
    }

    /// Cameras on a circle of 0.6 m, looking inwards.
    fn ring(n_nodes: usize) -> Vec<Pose> {
        (0..n_nodes)
            .map(|node| {
                let angle = TAU * node as f64 / n_nodes as f64;
                let turn = increment(&Vector6::new(0.0, angle, 0.0, 0.0, 0.0, 0.6));
                turn * increment(&Vector6::new(0.0, 0.0, 0.0, 0.0, 0.0, -0.6))
            })
            .collect()
    }

    /// The poses that one gets by adding up relative poses of which each is off by the same small motion.
    fn drifted(truth: &[Pose], error: &Pose) -> (Vec<Pose>, Vec<Edge>) {
        let mut nodes = vec![truth[0]];
        let mut edges = Vec::new();
        for node in 1..truth.len() {
            let relative = error * truth[node - 1].inverse() * truth[node];
            nodes.push(nodes[node - 1] * relative);
            edges.push(edge(node, node - 1, relative));
        }
        (nodes, edges)
    }

    fn largest_error_m(nodes: &[Pose], truth: &[Pose]) -> f64 {
        nodes
            .iter()
            .zip(truth)
            .map(|(a, b)| motion_between(a, b).translation_m)
            .fold(0.0, f64::max)
    }

    #[test]
    fn jacobians_match_central_differences() {
        let nodes = [
            increment(&Vector6::new(0.3, -0.2, 0.5, 0.1, 0.7, -0.4)),
            increment(&Vector6::new(-0.6, 0.1, 0.2, -0.5, 0.2, 0.9)),
        ];
        let edge = edge(
            0,
            1,
            increment(&Vector6::new(0.5, 0.3, 0.2, 0.3, 0.1, -1.0)),
        );
        let jacobian = edge.jacobian(&nodes, &edge.residual(&nodes));
        for axis in 0..6 {
            let mut step = Vector6::zeros();
            step[axis] = 1e-6;
            let by = |node: usize| {
                let residual = |step: &Vector6<f64>| {
                    let mut moved = nodes;
                    moved[node] = increment(step) * moved[node];
                    edge.residual(&moved)
                };
                (residual(&step) - residual(&-step)) / 2e-6
            };
            assert!((by(0) - jacobian.column(axis)).norm() < 1e-8);
            assert!((by(1) + jacobian.column(axis)).norm() < 1e-8);
        }
    }

    #[test]
    fn a_drift_round_a_ring_is_taken_back() {
        let truth = ring(24);
        let error = increment(&Vector6::new(
            0.0004, 0.001, -0.0003, 0.0005, 0.0002, 0.0004,
        ));
        let (mut nodes, mut edges) = drifted(&truth, &error);
        let before = largest_error_m(&nodes, &truth);
        edges.push(edge(23, 0, truth[0].inverse() * truth[23]));
        optimise(&mut nodes, &edges);
        let after = largest_error_m(&nodes, &truth);
        // One loop spreads its gap evenly; the drift's own course round the ring is not known to it.
        assert!(before > 0.015 && after < 0.4 * before, "{before} {after}");
    }

    #[test]
    fn without_a_loop_nothing_moves() {
        let truth = ring(24);
        let error = increment(&Vector6::new(0.001, 0.001, 0.0, 0.0, 0.001, 0.0));
        let (mut nodes, edges) = drifted(&truth, &error);
        let before = nodes.clone();
        optimise(&mut nodes, &edges);
        assert!(largest_error_m(&nodes, &before) < 1e-12);
    }

    #[test]
    fn a_false_loop_is_not_believed() {
        let truth = ring(24);
        let (mut nodes, mut edges) = drifted(&truth, &Pose::identity());
        let mut false_loop = edge(12, 0, Pose::translation(0.1, 0.0, 0.0));
        false_loop.kernel_sigmas = 1.0;
        edges.push(false_loop);
        let mut true_loop = edge(23, 0, truth[0].inverse() * truth[23]);
        true_loop.kernel_sigmas = 1.0;
        edges.push(true_loop);
        optimise(&mut nodes, &edges);
        assert!(largest_error_m(&nodes, &truth) < 0.001);
    }
}
