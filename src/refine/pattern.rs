//! One step: the sparse normal equations, whose pattern is analysed once a mesh, and their solution.

use super::cholesky::{Analysis, Factor};
use super::couplings::Couplings;
use super::energy::{GroupTerms, NormalMatrix, Problem};
use nalgebra::{Cholesky, DMatrix, DVector, Dyn, Point3};
use serde::Serialize;

/// The sparsity pattern of a mesh's normal matrix, analysed once.
pub struct Pattern {
    couplings: Couplings,
    analysis: Analysis,
}

impl Pattern {
    /// Analyses the pattern of vertices at these places, metres.
    pub fn new(vertices: &[Point3<f64>], couplings: Couplings) -> Pattern {
        Pattern {
            analysis: Analysis::new(vertices, &couplings.pairs),
            couplings,
        }
    }

    /// Analyses the pattern of a mesh whose vertices began at those of this one's or, with two of them for parents, between these.
    pub fn finer(
        &self,
        parents: &[[u32; 2]],
        vertices: &[Point3<f64>],
        couplings: Couplings,
    ) -> Pattern {
        Pattern {
            analysis: self.analysis.finer(parents, vertices, &couplings.pairs),
            couplings,
        }
    }

    /// Which displacements meet.
    pub fn couplings(&self) -> &Couplings {
        &self.couplings
    }

    /// The diagonal of H⁻¹; `None` where H is not positive definite, rounding allowed for, or memory does not suffice.
    pub fn inverse_diagonal(&self, matrix: &NormalMatrix) -> Option<Vec<f64>> {
        let NormalMatrix {
            diagonal,
            off_diagonal,
            ..
        } = matrix;
        /// Some ten times what single precision resolves: rounding alone makes no matrix indefinite then.
        const RIDGE: f64 = 1e-6;
        let factor = self.analysis.factorise(diagonal, off_diagonal);
        let factor = factor.or_else(|| {
            let ridged: Vec<f64> = diagonal.iter().map(|d| d * (1.0 + RIDGE)).collect();
            self.analysis.factorise(&ridged, off_diagonal)
        });
        Some(factor?.inverse_diagonal())
    }

    /// Solves `(H + damping · diag H) x = −gradient` for displacements and the groups' albedos together: these are few, and
    /// taken out by their Schur complement. `None` where H is not positive definite.
    ///
    /// By conjugate gradients (Hestenes and Stiefel 1952) in the metric of a factor that is not the matrix: one in single precision,
    /// for sites at vertices of an upper bound of their data term.
    pub fn solve(&self, problem: &Problem, matrix: &NormalMatrix, damping: f64) -> Option<Step> {
        let (bound, first) = Bordered::new(&self.analysis, matrix, damping)?;
        let times = |x: &Step| {
            let mut product = match &matrix.at_vertices {
                Some(system) => {
                    let (x, corners) = (&x.displacement, &self.couplings.corners);
                    let of_priors = || problem.prior_times(x);
                    let (prior, data) = rayon::join(of_priors, || system.times(corners, x));
                    prior.iter().zip(&data).map(|(a, b)| a + b).collect()
                }
                None => matrix.times(&self.couplings.pairs, &x.displacement),
            };
            let pairs = matrix.diagonal.iter().zip(&x.displacement);
            for (product, (diagonal, x)) in product.iter_mut().zip(pairs) {
                *product += damping * diagonal * x;
            }
            bound.with_albedos(x, product)
        };
        let (mut residual, mut direction) = (matrix.descent(), first);
        let mut solution = residual.zeros();
        let mut descent = residual.dot(&direction);
        for iteration in 1.. {
            let product = times(&direction);
            let length = descent / direction.dot(&product);
            solution.add(length, &direction);
            if iteration == CONJUGATE_GRADIENTS {
                break;
            }
            residual.add(-length, &product);
            let next = bound.solve(residual.clone());
            let next_descent = residual.dot(&next);
            let turned = direction;
            direction = next;
            direction.add(next_descent / descent, &turned);
            descent = next_descent;
        }
        solution.is_finite().then_some(solution)
    }
}

/// A factor of the displacements' matrix, and the Schur complement of the groups' albedos beside it.
struct Bordered<'a> {
    factor: Factor<'a>,
    groups: &'a [GroupTerms],
    /// Diagonal of each group.
    own: Vec<f64>,
    /// The displacements' inverse times the coupling of each group.
    by_group: Vec<f64>,
    complement: Cholesky<f64, Dyn>,
}

impl<'a> Bordered<'a> {
    /// Factorises a damped matrix and solves for its descent; `None` where it is not positive definite.
    fn new(analysis: &'a Analysis, matrix: &'a NormalMatrix, damping: f64) -> Option<(Self, Step)> {
        let damped = matrix.diagonal.iter().map(|value| value * (1.0 + damping));
        let damped: Vec<f64> = damped.collect();
        let factor = analysis.factorise(&damped, &matrix.off_diagonal)?;
        let (n, groups) = (matrix.gradient.len(), &matrix.groups[..]);
        let descent = matrix.descent();
        let mut columns = descent.displacement;
        for group in groups {
            columns.extend_from_slice(&group.coupling);
        }
        let mut alone = factor.solve(columns);
        let by_group = alone.split_off(n);
        let own = groups
            .iter()
            .map(|group| group.diagonal * (1.0 + damping) + NO_EVIDENCE);
        let own: Vec<f64> = own.collect();
        let complement = DMatrix::from_fn(groups.len(), groups.len(), |k, l| {
            let own = if k == l { own[k] } else { 0.0 };
            own - dot(&groups[k].coupling, &by_group[l * n..(l + 1) * n])
        });
        let bordered = Bordered {
            factor,
            groups,
            own,
            by_group,
            complement: complement.cholesky()?,
        };
        let step = bordered.border(alone, &descent.log_albedo);
        Some((bordered, step))
    }

    fn solve(&self, right: Step) -> Step {
        self.border(self.factor.solve(right.displacement), &right.log_albedo)
    }

    /// The solution for displacements and albedos, from that for displacements alone and the albedos' right side.
    fn border(&self, mut alone: Vec<f64>, right: &[f64]) -> Step {
        let pairs = self.groups.iter().zip(right);
        let right = pairs.map(|(group, right)| right - dot(&group.coupling, &alone));
        let right = DVector::from_iterator(self.groups.len(), right);
        let log_albedo = self.complement.solve(&right);
        for (by_group, albedo) in self.by_group.chunks(alone.len()).zip(&log_albedo) {
            for (x, by_albedo) in alone.iter_mut().zip(by_group) {
                *x -= albedo * by_albedo;
            }
        }
        Step {
            displacement: alone,
            log_albedo: log_albedo.as_slice().to_vec(),
        }
    }

    /// The product of the whole matrix with `x`, from that of the displacements' alone.
    fn with_albedos(&self, x: &Step, mut displacement: Vec<f64>) -> Step {
        for (group, albedo) in self.groups.iter().zip(&x.log_albedo) {
            for (product, coupling) in displacement.iter_mut().zip(&group.coupling) {
                *product += coupling * albedo;
            }
        }
        let of_group = |((group, own), albedo): ((&GroupTerms, &f64), &f64)| {
            dot(&group.coupling, &x.displacement) + own * albedo
        };
        let groups = self.groups.iter().zip(&self.own).zip(&x.log_albedo);
        Step {
            displacement,
            log_albedo: groups.map(of_group).collect(),
        }
    }
}

impl NormalMatrix {
    /// The product of the displacements' matrix with `x`.
    fn times(&self, pairs: &[[u32; 2]], x: &[f64]) -> Vec<f64> {
        let own = self.diagonal.iter().zip(x);
        let mut product: Vec<f64> = own.map(|(diagonal, x)| diagonal * x).collect();
        for (&[a, b], value) in pairs.iter().zip(&self.off_diagonal) {
            let (a, b) = (a as usize, b as usize);
            product[a] += value * x[b];
            product[b] += value * x[a];
        }
        product
    }

    /// The negative gradient.
    fn descent(&self) -> Step {
        Step {
            displacement: self.gradient.iter().map(|slope| -slope).collect(),
            log_albedo: self.groups.iter().map(|group| -group.gradient).collect(),
        }
    }
}

/// Where the energy's quadratic model has its minimum.
#[derive(Clone, Debug, Serialize)]
pub struct Step {
    /// Of each vertex along its direction, metres.
    pub displacement: Vec<f64>,
    /// Change of the logarithm of each group's albedo.
    pub log_albedo: Vec<f64>,
}

impl Step {
    fn zeros(&self) -> Step {
        Step {
            displacement: vec![0.0; self.displacement.len()],
            log_albedo: vec![0.0; self.log_albedo.len()],
        }
    }

    fn dot(&self, other: &Step) -> f64 {
        dot(&self.displacement, &other.displacement) + dot(&self.log_albedo, &other.log_albedo)
    }

    fn add(&mut self, factor: f64, other: &Step) {
        let all = self.displacement.iter_mut().chain(&mut self.log_albedo);
        let others = other.displacement.iter().chain(&other.log_albedo);
        all.zip(others).for_each(|(x, other)| *x += factor * other);
    }

    fn is_finite(&self) -> bool {
        let mut all = self.displacement.iter().chain(&self.log_albedo);
        all.all(|value| value.is_finite())
    }
}

/// Conjugate gradients a step. The bound alone leaves the wedges of a Kinect II's plate at 5.23° where three reach 4.93° and six 4.97°.
const CONJUGATE_GRADIENTS: usize = 3;
/// Keeps the system of the albedos solvable where nobody sees a group: next to nothing beside one pixel.
const NO_EVIDENCE: f64 = 1e-3;

fn dot(a: &[f64], b: &[f64]) -> f64 {
    a.iter().zip(b).map(|(a, b)| a * b).sum()
}

#[cfg(test)]
mod tests {
    use super::super::RefineParams;
    use super::super::scenes::{ALBEDO, RippledPlane, with_problem};
    use super::super::sites::SiteKind;
    use super::*;

    /// The whole damped system, albedos last, and its right side.
    fn dense(
        matrix: &NormalMatrix,
        pairs: &[[u32; 2]],
        damping: f64,
    ) -> (DMatrix<f64>, DVector<f64>) {
        let n = matrix.diagonal.len();
        let size = n + matrix.groups.len();
        let mut all = DMatrix::zeros(size, size);
        let mut right = DVector::zeros(size);
        for (k, (value, slope)) in matrix.diagonal.iter().zip(&matrix.gradient).enumerate() {
            all[(k, k)] = value * (1.0 + damping);
            right[k] = -slope;
        }
        for (&[a, b], &value) in pairs.iter().zip(&matrix.off_diagonal) {
            all[(a as usize, b as usize)] = value;
            all[(b as usize, a as usize)] = value;
        }
        for (k, group) in (n..).zip(&matrix.groups) {
            all[(k, k)] = group.diagonal * (1.0 + damping) + NO_EVIDENCE;
            right[k] = -group.gradient;
            for (vertex, &value) in group.coupling.iter().enumerate() {
                all[(k, vertex)] = value;
                all[(vertex, k)] = value;
            }
        }
        (all, right)
    }

    #[test]
    fn what_single_precision_leaves_of_a_step_is_taken_out() {
        let hidden = RippledPlane {
            amplitude_m: 0.0003,
        };
        let params = RefineParams {
            edge_length_m: 0.004,
            sites: SiteKind::Face,
            ..RefineParams::default()
        };
        let plane = RippledPlane { amplitude_m: 0.0 }.mesh(params.edge_length_m);
        with_problem(&hidden, plane, &params, |problem, surface, pattern| {
            let albedos = [1.1 * ALBEDO];
            let tints = problem.evaluate(&surface, &albedos).tints;
            let matrix = problem.linearise(&surface, &albedos, &tints, pattern.couplings());
            for damping in [1e-8, 1e-3] {
                let (all, right) = dense(&matrix, &pattern.couplings().pairs, damping);
                let expected = all.cholesky().expect("positive definite").solve(&right);
                let step = pattern.solve(problem, &matrix, damping);
                let Step {
                    displacement,
                    log_albedo,
                } = step.expect("positive definite");
                let n = displacement.len();
                let largest = expected.rows(0, n).amax();
                assert!(largest > 1e-4, "{largest}");
                for (x, expected) in displacement.iter().zip(&expected) {
                    assert!((x - expected).abs() < 1e-9 * largest, "{x} for {expected}");
                }
                assert!((log_albedo[0] / expected[n] - 1.0).abs() < 1e-9);
            }
        });
    }
}
