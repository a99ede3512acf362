//! Frames and what is told of them.

use super::*;

fn conditions() -> Conditions {
    Conditions::new(&FusionParams::default(), &SnapshotParams::default())
}

/// A frame with most of its depth in range.
fn frame(time_secs: f64, outcome: &TrackingOutcome) -> Observed<'_> {
    Observed {
        time_secs,
        outcome: Some(outcome),
        depth: DepthStatistics {
            in_range_share: 0.6,
            ..DepthStatistics::default()
        },
        saturated_share: Some(0.01),
    }
}

fn tracked(x_m: f64, fitness: f64, held_share: f64) -> TrackingOutcome {
    TrackingOutcome::Tracked {
        world_from_camera: Pose::translation(x_m, 0.0, 0.0),
        fit: Some(Fit {
            inlier_share: 0.9,
            rmse_m: 0.001,
            conditioning: 1e-2,
            see_through_share: 0.0,
            held_share,
            fitness,
        }),
    }
}

/// The state after some frames at 30 a second, from `first` on.
fn after(conditions: &mut Conditions, first: usize, outcomes: &[TrackingOutcome]) -> State {
    let mut state = conditions.state;
    for (index, outcome) in outcomes.iter().enumerate() {
        state = conditions.observe(&frame((first + index) as f64 / 30.0, outcome));
    }
    state
}

#[test]
fn a_weak_fit_is_told_at_once_and_other_reasons_when_they_last() {
    let good = tracked(0.0, 0.9, 0.01);
    let flat = tracked(0.0, 0.9, 1e-4);
    let mut at = conditions();
    assert_eq!(after(&mut at, 0, &[good]), State::Tracking);
    assert_eq!(after(&mut at, 1, &[flat; 4]), State::Tracking);
    let told = State::Degraded(Degradation::FlatScene);
    assert_eq!(after(&mut at, 5, &[flat]), told);
    assert_eq!(after(&mut at, 6, &[good; 4]), told, "not yet taken back");
    assert_eq!(after(&mut at, 10, &[good]), State::Tracking);
    let weak = tracked(0.0, 0.1, 0.01);
    let told = State::Degraded(Degradation::FewInliers);
    assert_eq!(after(&mut at, 11, &[weak]), told);
}

#[test]
fn speed_is_told_before_the_loss_that_it_leads_to() {
    let few = TrackingOutcome::Lost(LossReason::FewInliers { inlier_share: 0.1 });
    let mut slow = conditions();
    let steps: Vec<_> = (0..8)
        .map(|k| tracked(0.01 * k as f64, 0.9, 0.01))
        .collect();
    assert_eq!(after(&mut slow, 0, &steps), State::Tracking);
    assert_eq!(after(&mut slow, 8, &[few]), State::Lost(Loss::FewInliers));

    // 5 cm a frame are 1.5 m/s of the 2 m/s that would be believed.
    let mut fast = conditions();
    let steps: Vec<_> = (0..8)
        .map(|k| tracked(0.05 * k as f64, 0.9, 0.01))
        .collect();
    let told = State::Degraded(Degradation::TooFast);
    assert_eq!(after(&mut fast, 0, &steps), told);
    assert_eq!(after(&mut fast, 8, &[few]), State::Lost(Loss::TooFast));
    // The reason stays while the camera wanders about.
    let elsewhere = TrackingOutcome::Lost(LossReason::SeeThrough { share: 0.4 });
    assert_eq!(
        after(&mut fast, 60, &[elsewhere]),
        State::Lost(Loss::TooFast)
    );
    let found = TrackingOutcome::Lost(LossReason::Unconfirmed);
    assert_eq!(after(&mut fast, 61, &[found]), State::Relocalising);
    // Nor has it been found by what was not confirmed.
    assert_eq!(
        after(&mut fast, 61, &[elsewhere]),
        State::Lost(Loss::TooFast)
    );
    assert_eq!(
        after(&mut fast, 62, &[tracked(0.3, 0.9, 0.01)]),
        State::Tracking
    );
}

#[test]
fn every_loss_has_its_reason() {
    let jump = LossReason::Jump {
        rotation_rad: 1.0,
        translation_m: 0.0,
    };
    let few = LossReason::FewInliers { inlier_share: 0.1 };
    let flat = LossReason::FlatScene { conditioning: 0.0 };
    let large = LossReason::LargeResidual { rmse_m: 0.1 };
    let see_through = LossReason::SeeThrough { share: 0.4 };
    for (reason, told) in [
        (jump, State::Lost(Loss::TooFast)),
        (few, State::Lost(Loss::FewInliers)),
        (flat, State::Lost(Loss::FlatScene)),
        (large, State::Lost(Loss::FewInliers)),
        (see_through, State::Lost(Loss::Elsewhere)),
        (LossReason::Elsewhere, State::Lost(Loss::Elsewhere)),
        (LossReason::Unconfirmed, State::Relocalising),
    ] {
        let state = conditions().observe(&frame(0.0, &TrackingOutcome::Lost(reason)));
        assert_eq!(state, told, "{reason:?}");
    }
}

#[test]
fn images_tell_what_is_too_close_too_far_or_covered() {
    let nothing = Observed {
        depth: DepthStatistics::default(),
        ..frame(0.0, &TrackingOutcome::NoDepth)
    };
    let covered = conditions().observe(&nothing);
    assert_eq!(covered, State::Lost(Loss::CoveredLens));
    let glaring = Observed {
        saturated_share: Some(0.5),
        ..nothing
    };
    let close = conditions().observe(&glaring);
    assert_eq!(close, State::Lost(Loss::TooClose));

    let good = tracked(0.0, 0.9, 0.01);
    let told = |depth: DepthStatistics, saturated: f64| {
        let mut at = conditions();
        let observed = Observed {
            depth,
            saturated_share: Some(saturated),
            ..frame(0.0, &good)
        };
        (0..STEADY_FRAMES).map(|_| at.observe(&observed)).last()
    };
    let depth = |in_range_share, near_share, far_share| DepthStatistics {
        in_range_share,
        near_share,
        far_share,
    };
    let degraded = |reason| Some(State::Degraded(reason));
    assert_eq!(
        told(depth(0.3, 0.4, 0.0), 0.0),
        degraded(Degradation::TooClose)
    );
    assert_eq!(
        told(depth(0.05, 0.0, 0.8), 0.0),
        degraded(Degradation::TooFar)
    );
    let overexposed = told(depth(0.9, 0.0, 0.0), 0.3);
    assert_eq!(overexposed, degraded(Degradation::SaturatedInfrared));
    assert_eq!(told(depth(0.3, 0.0, 0.6), 0.1), Some(State::Tracking));
}
