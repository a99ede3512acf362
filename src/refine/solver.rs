//! Levenberg–Marquardt on the robust energy.

use super::energy::Problem;
use super::evaluation::Evaluation;
use super::pattern::{Pattern, Step};
use super::surface::Surface;
use super::tint::Tint;
use crate::geometry::area_vector;
use rayon::prelude::*;
use serde::Serialize;

/// How a solve ended.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum RefineStatus {
    /// The energy stopped falling.
    Converged,
    /// All iterations were used.
    IterationLimit,
    /// No damping gave a lower energy.
    Stalled,
    /// The caller asked to stop.
    Cancelled,
    /// The normal equations could not be factorised.
    Singular,
}

impl RefineStatus {
    /// Whether no further round makes sense.
    pub fn is_final(self) -> bool {
        matches!(self, RefineStatus::Cancelled | RefineStatus::Singular)
    }
}

/// One accepted step.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Iteration {
    /// Outer round, from 0.
    pub round: usize,
    /// Robust energy before the step.
    pub energy_before: f64,
    /// Robust energy after it.
    pub energy_after: f64,
    /// Levenberg–Marquardt damping of the accepted step.
    pub damping: f64,
    /// Largest displacement of a vertex in the step, metres.
    pub max_step_m: f64,
}

/// No logarithm of an albedo changes by more than this in one step.
const MAX_ALBEDO_STEP: f64 = 0.1;

/// Bounds of one inner solve.
#[derive(Clone, Copy, Debug)]
pub struct SolverParams {
    /// Accepted steps at most.
    pub max_steps: usize,
    /// The solve has converged when a step lowers the energy by less than this share.
    pub min_decrease: f64,
    /// No vertex moves farther than this in one step, metres.
    pub max_step_m: f64,
}

/// Where the energy was lowered to.
pub struct Minimum {
    /// Why it ended.
    pub status: RefineStatus,
    /// Tint of each site, as [`Evaluation::tints`].
    pub tints: Vec<Option<Tint>>,
}

/// What is minimised, and how.
pub struct Solver<'a> {
    /// The energy.
    pub problem: &'a Problem<'a>,
    /// The pattern of its normal equations.
    pub pattern: &'a Pattern,
    /// Bounds.
    pub params: SolverParams,
}

/// A surface and albedos that a step leads to.
struct Trial {
    surface: Surface,
    albedos: Vec<f64>,
    evaluation: Evaluation,
    max_step_m: f64,
    /// Of its step.
    damping: f64,
}

impl Solver<'_> {
    /// Lowers the energy by the surface and the groups' albedos together; it never rises. Brightness tells a darker material from
    /// a steeper slope by the slopes that depth holds, which neither finds with the other one fixed.
    pub fn minimise(
        &self,
        surface: &mut Surface,
        albedos: &mut Vec<f64>,
        mut accepted: impl FnMut(Iteration) -> bool,
    ) -> Minimum {
        let mut now = self.problem.evaluate(surface, albedos);
        let mut damping = 1e-4;
        let mut status = RefineStatus::IterationLimit;
        for _ in 0..self.params.max_steps {
            let next = match self.descend(surface, albedos, &now, damping) {
                Ok(next) => next,
                Err(ended) => {
                    status = ended;
                    break;
                }
            };
            let iteration = Iteration {
                round: 0,
                energy_before: now.energy,
                energy_after: next.evaluation.energy,
                damping: next.damping,
                max_step_m: next.max_step_m,
            };
            (*surface, *albedos) = (next.surface, next.albedos);
            now = next.evaluation;
            damping = (next.damping * 0.1).max(1e-8);
            if !accepted(iteration) {
                status = RefineStatus::Cancelled;
                break;
            }
            let decrease = (iteration.energy_before - now.energy) / iteration.energy_before;
            if decrease < self.params.min_decrease {
                status = RefineStatus::Converged;
                break;
            }
        }
        Minimum {
            status,
            tints: now.tints,
        }
    }

    /// A step that lowers the energy, damped at least so much and as far as it must be; how it ends where there is none.
    fn descend(
        &self,
        surface: &Surface,
        albedos: &[f64],
        now: &Evaluation,
        mut damping: f64,
    ) -> Result<Trial, RefineStatus> {
        const MAX_DAMPING: f64 = 1e6;
        let Solver {
            problem, pattern, ..
        } = self;
        let matrix = problem.linearise(surface, albedos, &now.tints, pattern.couplings());
        loop {
            let ended = match pattern.solve(problem, &matrix, damping) {
                Some(step) => {
                    let trial = self.take(surface, albedos, step, damping);
                    if trial.evaluation.energy < now.energy {
                        return Ok(trial);
                    }
                    RefineStatus::Stalled
                }
                None => RefineStatus::Singular,
            };
            damping *= 10.0;
            if damping > MAX_DAMPING {
                return Err(ended);
            }
        }
    }

    /// Takes a step, held within its bounds.
    fn take(&self, surface: &Surface, albedos: &[f64], step: Step, damping: f64) -> Trial {
        let Step {
            mut displacement,
            log_albedo,
        } = step;
        let bound = self.params.max_step_m;
        for value in &mut displacement {
            *value = value.clamp(-bound, bound);
        }
        hold_back_flips(surface, &mut displacement);
        let surface = surface.displaced(&displacement);
        let change = |by: &f64| by.clamp(-MAX_ALBEDO_STEP, MAX_ALBEDO_STEP).exp();
        let pairs = albedos.iter().zip(&log_albedo);
        let albedos: Vec<f64> = pairs.map(|(albedo, by)| albedo * change(by)).collect();
        Trial {
            evaluation: self.problem.evaluate(&surface, &albedos),
            max_step_m: displacement
                .iter()
                .fold(0.0, |max: f64, step| max.max(step.abs())),
            surface,
            albedos,
            damping,
        }
    }
}

/// Shortens the step at the corners of faces that it would turn by more than 60°, until none is left.
fn hold_back_flips(surface: &Surface, step: &mut [f64]) {
    const MIN_COSINE: f64 = 0.5;
    const HALVINGS: usize = 8;
    let Surface {
        mesh, directions, ..
    } = surface;
    let is_turned = |face: &[u32; 3], step: &[f64]| {
        let moved = |vertex: u32| {
            let vertex = vertex as usize;
            mesh.vertices[vertex] + directions[vertex] * step[vertex]
        };
        let old = area_vector(face.map(|vertex| mesh.vertices[vertex as usize]));
        let new = area_vector(face.map(moved));
        new.dot(&old) < MIN_COSINE * new.norm() * old.norm()
    };
    // Only a face with a corner whose step has changed can have turned.
    let mut has_changed = vec![true; step.len()];
    for _ in 0..HALVINGS {
        let faces = mesh.faces.par_iter();
        let suspects = faces.filter(|face| face.iter().any(|&vertex| has_changed[vertex as usize]));
        let turned: Vec<&[u32; 3]> = suspects.filter(|face| is_turned(face, step)).collect();
        if turned.is_empty() {
            break;
        }
        has_changed.fill(false);
        for &vertex in turned.into_iter().flatten() {
            has_changed[vertex as usize] = true;
        }
        // Once each, however many of its faces turn.
        for (step, has_changed) in step.iter_mut().zip(&has_changed) {
            if *has_changed {
                *step *= 0.5;
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::TriMesh;
    use nalgebra::Point3;

    const SIDE: usize = 7;

    /// A square of 7 × 7 vertices, 1 mm apart.
    fn square() -> Surface {
        let at = |vertex: usize| Point3::new((vertex % SIDE) as f64, (vertex / SIDE) as f64, 0.0);
        let cells = (0..SIDE * (SIDE - 1)).filter(|vertex| vertex % SIDE + 1 < SIDE);
        let faces = cells.flat_map(|vertex| {
            let [a, b] = [vertex, vertex + 1].map(|corner| corner as u32);
            let [c, d] = [a, b].map(|corner| corner + SIDE as u32);
            [[a, b, c], [c, b, d]]
        });
        Surface::of_base(&TriMesh {
            vertices: (0..SIDE * SIDE).map(|vertex| at(vertex) * 1e-3).collect(),
            faces: faces.collect(),
        })
    }

    /// The farthest that a face turns, radians.
    fn farthest_turn(surface: &Surface, step_m: &[f64]) -> f64 {
        let moved = surface.displaced(step_m).mesh;
        let turn = |face| {
            moved
                .face_normal(face)
                .angle(&surface.mesh.face_normal(face))
        };
        (0..moved.faces.len()).map(turn).fold(0.0, f64::max)
    }

    #[test]
    fn a_step_that_would_turn_faces_over_is_shortened_at_their_corners_alone() {
        let surface = square();
        let (corner, middle) = (0, SIDE * SIDE / 2);
        let mut step = vec![0.0; SIDE * SIDE];
        (step[corner], step[middle]) = (4e-4, 5e-3);
        assert!(farthest_turn(&surface, &step) > 80_f64.to_radians());
        hold_back_flips(&surface, &mut step);
        assert!(farthest_turn(&surface, &step) <= 60_f64.to_radians());
        // 60° are 1.22 mm of the middle: the first half of a half of 5 mm below that is taken.
        assert_eq!((step[corner], step[middle]), (4e-4, 5e-3 / 8.0));
        let held = step.clone();
        hold_back_flips(&surface, &mut step);
        assert_eq!(step, held, "nothing is left to hold back");
    }
}
