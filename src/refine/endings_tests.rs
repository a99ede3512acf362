//! How a refinement ends: as asked, where nothing more is gained, and where the equations say nothing.

use super::energy::Problem;
use super::priors::PriorWeights;
use super::scenes::{ALBEDO, RippledPlane, calibration, optics, poses, rays, whole, with_problem};
use super::solver::{Iteration, Minimum, Solver, SolverParams};
use super::{RefineParams, RefineStatus, Refinement, refine};
use crate::robust::Tukey;

const FLAT: RippledPlane = RippledPlane { amplitude_m: 0.0 };
/// As steep as 32°, which takes turns.
const RIPPLED: RippledPlane = RippledPlane {
    amplitude_m: 0.0012,
};
const EDGE_M: f64 = 0.0015;

fn params() -> RefineParams {
    RefineParams {
        edge_length_m: EDGE_M,
        // Its images are of points.
        integrate_pixels: false,
        ..RefineParams::default()
    }
}

/// The flat plane refined by images of the rippled one until `accepted` says no.
fn refined(accepted: impl FnMut(&Iteration) -> bool) -> Refinement {
    let (rays, calibration) = (rays(), calibration());
    let optics = optics(&rays, &calibration);
    let base = FLAT.mesh(EDGE_M);
    let poses = poses(0.5);
    let snapshots: Vec<_> = poses.iter().map(|p| RIPPLED.snapshot(&optics, p)).collect();
    let subject = whole(&base, &snapshots, &optics);
    refine(&subject, &params(), accepted).expect("everything is visible")
}

#[test]
fn cancelling_keeps_what_was_reached() {
    let cancelled = refined(|_| false);
    assert_eq!(cancelled.status, RefineStatus::Cancelled);
    assert_eq!(cancelled.iterations.len(), 1);
}

#[test]
fn cancelling_in_a_later_turn_of_a_round_ends_all_of_it() {
    let whole = refined(|_| true);
    assert!(!whole.status.is_final());
    // A turn begins with another energy than the one before it ended with.
    let of_later_turn = whole.iterations.windows(2).position(|steps| {
        steps[1].round == steps[0].round && steps[1].energy_before != steps[0].energy_after
    });
    let n_before = of_later_turn.expect("a round of more than one turn") + 1;
    let mut n_steps = 0;
    let cancelled = refined(|_| {
        n_steps += 1;
        n_steps <= n_before
    });
    assert_eq!(cancelled.status, RefineStatus::Cancelled);
    assert_eq!(cancelled.iterations, whole.iterations[..=n_before]);
}

/// A solve goes on as long as its energy falls.
const ENDLESS: SolverParams = SolverParams {
    max_steps: 1000,
    min_decrease: 0.0,
    max_step_m: 0.001,
};

/// How a solve for the rippled plane ends, and its steps, by what `change` makes of the problem.
fn ending(change: impl FnOnce(Problem) -> Problem) -> (RefineStatus, Vec<Iteration>) {
    let mut steps = Vec::new();
    let ended = with_problem(
        &RIPPLED,
        FLAT.mesh(EDGE_M),
        &params(),
        |p, mut surface, pattern| {
            let problem = change(Problem { ..*p });
            let solver = Solver {
                problem: &problem,
                pattern,
                params: ENDLESS,
            };
            let Minimum { status, .. } = solver.minimise(&mut surface, &mut vec![ALBEDO], |step| {
                steps.push(step);
                true
            });
            status
        },
    );
    (ended, steps)
}

#[test]
fn a_solve_that_no_damping_takes_farther_stalls_at_its_lowest_energy() {
    let (status, steps) = ending(|problem| problem);
    assert_eq!(status, RefineStatus::Stalled);
    assert!(
        steps
            .iter()
            .all(|step| step.energy_after < step.energy_before)
    );
    let [first, .., last] = &steps[..] else {
        panic!("{} steps", steps.len())
    };
    assert!(last.energy_after < 0.5 * first.energy_before);
}

#[test]
fn equations_that_hold_nothing_are_singular() {
    // Every residual is an outlier, and no prior holds the surface.
    let (status, steps) = ending(|problem| Problem {
        loss: Tukey {
            scale: 1e-9,
            cutoff: Tukey::EFFICIENT_CUTOFF,
        },
        priors: PriorWeights {
            anchor: 0.0,
            rest: 0.0,
            smoothness: 0.0,
        },
        ..problem
    });
    assert_eq!(status, RefineStatus::Singular);
    assert!(status.is_final() && steps.is_empty());
}
