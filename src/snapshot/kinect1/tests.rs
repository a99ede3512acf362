//! Sequences of tiny images with closed-form answers, and a simulated scan.

use super::*;
use crate::fusion::LossReason;
use crate::geometry::increment;
use crate::snapshot::{PartOfModel, SnapshotSelection, SnapshotSelector, scenes};
use depth_camera::{DepthCamera, Sensor};
use nalgebra::Vector6;
use simulated::{Infrared, Scene, Setup, SimulatedCamera, Trajectory};
use std::time::Duration;

/// What the sensor shows next.
#[derive(Clone, Copy)]
enum Shows {
    /// Depth, tracked at this x of the camera, metres.
    Depth(f64),
    /// Depth in this share of the rows, tracked where the camera began.
    Partly(f64),
    /// Depth that the tracker does not find in the model.
    Strange,
    /// The lamp at this brightness.
    Lamp(u16),
    /// Speckle without depth: out of range.
    Speckle,
    /// Nothing: covered, and the lamp is out.
    Nothing,
}

fn observe(selector: &mut SnapshotSelector, frame_id: u64, shows: Shows) {
    let info = scenes::camera_info(Sensor::Kinect1);
    let (width, height) = (info.intrinsics.width, info.intrinsics.height);
    let depth_share = match shows {
        Shows::Depth(_) | Shows::Strange => 1.0,
        Shows::Partly(share) => share,
        _ => 0.0,
    };
    let ir = match shows {
        Shows::Depth(_) | Shows::Partly(_) | Shows::Strange => None,
        Shows::Lamp(counts) => Some(Image::filled(width, height, counts)),
        Shows::Speckle => {
            let dots = (0..width * height).map(|pixel| if pixel % 5 == 0 { 700 } else { 20 });
            Some(Image::from_vec(width, height, dots.collect()))
        }
        Shows::Nothing => Some(Image::filled(width, height, 3)),
    };
    let outcome = match shows {
        Shows::Depth(x) => scenes::tracked(increment(&Vector6::new(0.0, 0.0, 0.0, x, 0.0, 0.0))),
        Shows::Partly(_) => scenes::tracked(Pose::identity()),
        Shows::Strange => TrackingOutcome::Lost(LossReason::FewInliers { inlier_share: 0.1 }),
        _ => TrackingOutcome::NoDepth,
    };
    let n_measured = (depth_share * height as f64) as usize * width;
    let depth = (0..width * height).map(|pixel| if pixel < n_measured { 0.6 } else { 0.0 });
    let depth = Image::from_vec(width, height, depth.collect());
    let frame = scenes::frame(frame_id, frame_id as f64 / 30.0, Some(depth), ir);
    selector.observe(&scenes::without_model(&frame, &outcome));
}

/// The selection from a sequence; frames are numbered from 0.
fn select(sequence: &[Shows]) -> SnapshotSelection {
    let info = scenes::camera_info(Sensor::Kinect1);
    let mut selector = SnapshotSelector::new(&info, SnapshotParams::default()).unwrap();
    for (shows, frame_id) in sequence.iter().zip(0..) {
        observe(&mut selector, frame_id, *shows);
    }
    selector.finish()
}

fn reasons(selection: &SnapshotSelection) -> Vec<(u64, String)> {
    let rejected = selection.rejected.iter();
    rejected
        .map(|r| (r.frame_id, r.reason.to_string()))
        .collect()
}

#[test]
fn a_still_group_becomes_one_image_at_the_pose_between() {
    use Shows::*;
    let sequence = [
        Depth(0.0),
        Nothing,
        Lamp(300),
        Lamp(330),
        Lamp(300),
        Depth(0.002),
    ];
    let selection = select(&sequence);
    assert_eq!(selection.accepted.len(), 1);
    let snapshot = &selection.accepted[0];
    assert_eq!((snapshot.frame_id, snapshot.n_exposures), (2, 3));
    assert!((snapshot.world_from_camera.translation.x - 0.001).abs() < 1e-12);
    // The lamp's mean brightness.
    assert!((snapshot.ir_counts.at(9, 9) - 310.0).abs() < 0.01);
    assert_eq!(*snapshot.depth_m.at(9, 9), 0.6);
    let dark = (1, "only 0.0 % of the image is lit".to_owned());
    assert_eq!(reasons(&selection), [dark]);
}

#[test]
fn images_from_before_the_lamp_was_lit_are_the_ambient_light_of_their_pose_alone() {
    use Shows::*;
    let dark_room = [Depth(0.0), Nothing, Nothing, Lamp(300), Lamp(300)];
    let lit_room = [
        Depth(0.0),
        Lamp(60),
        Lamp(60),
        Lamp(60),
        Lamp(300),
        Lamp(300),
    ];
    let no_pause = [Depth(0.0), Lamp(300), Lamp(300), Depth(0.0)];
    let selection = select(&[&dark_room[..], &lit_room, &no_pause].concat());
    let unlit = selection.accepted.iter().map(|snapshot| {
        let counts = snapshot.unlit_counts.as_ref();
        (snapshot.n_exposures, counts.map(|counts| *counts.at(9, 9)))
    });
    let unlit: Vec<_> = unlit.collect();
    let is_near =
        |found: Option<f32>, counts: f32| found.is_some_and(|found| (found - counts).abs() < 1e-3);
    assert_eq!(unlit.len(), 3);
    assert!(unlit.iter().all(|(n_exposures, _)| *n_exposures == 2));
    assert!(
        is_near(unlit[0].1, 3.0) && is_near(unlit[1].1, 60.0),
        "{unlit:?}"
    );
    assert_eq!(unlit[2].1, None);
    let told = "without the lamp, 20.0 % as bright as with it".to_owned();
    assert_eq!(
        reasons(&selection)[2..],
        [(6, told.clone()), (7, told.clone()), (8, told)]
    );
}

#[test]
fn poses_without_the_lamp_are_no_shading_images_however_late_that_is_known() {
    use Shows::*;
    let pose = |counts| [Depth(0.0), Lamp(counts), Lamp(counts)];
    // A lit room, as long as nobody knows the lamp; under the lamp; something darker; the room again.
    let poses = [pose(60), pose(400), pose(120), pose(60), [Depth(0.0); 3]];
    let selection = select(&poses.concat());
    let accepted = selection.accepted.iter().map(|s| s.frame_id);
    assert_eq!(accepted.collect::<Vec<_>>(), [4, 7]);
    let told = "without the lamp, 15.0 % as bright as with it".to_owned();
    assert_eq!(
        reasons(&selection),
        [(1, told.clone()), (10, told.clone()), (11, told)]
    );
    assert_eq!(
        selection.reasons(),
        ["3 times: without the lamp, 15.0 % as bright as with it"]
    );
}

#[test]
fn a_request_that_a_pose_without_the_lamp_met_stands_until_a_lit_one_comes() {
    use Shows::*;
    let info = scenes::camera_info(Sensor::Kinect1);
    let params = SnapshotParams {
        max_snapshots: 1,
        ..SnapshotParams::default()
    };
    let mut selector = SnapshotSelector::new(&info, params).unwrap();
    let mut frame_id = 0;
    let mut expose = |selector: &mut SnapshotSelector, counts| {
        for shows in [Depth(0.0), Lamp(counts), Lamp(counts), Depth(0.0)] {
            observe(selector, frame_id, shows);
            frame_id += 1;
        }
    };
    selector.request();
    // A lit room, while nobody knows the lamp; something brighter, which it may be; and the lamp.
    expose(&mut selector, 60);
    assert_eq!((selector.is_requested(), selector.n_revoked()), (false, 0));
    expose(&mut selector, 120);
    expose(&mut selector, 400);
    // One came for one: it is not the number that tells of it.
    assert_eq!((selector.is_requested(), selector.n_revoked()), (false, 1));
    // Two tell the same, and the one that was asked for is chosen.
    let selection = selector.finish();
    let accepted = selection.accepted.iter().map(|s| s.frame_id);
    assert_eq!(accepted.collect::<Vec<_>>(), [9]);
}

/// Where depth was measured in the shading images, as a share of the image, with their first frames.
fn measured(selection: &SnapshotSelection) -> Vec<(u64, f64)> {
    let accepted = selection.accepted.iter();
    let measured = accepted.map(|s| {
        let n_measured = s.depth_m.data().iter().filter(|z| **z > 0.0).count();
        (
            s.frame_id,
            n_measured as f64 / s.depth_m.data().len() as f64,
        )
    });
    measured.collect()
}

#[test]
fn what_a_shutter_leaves_of_the_depth_on_its_way_is_no_shading_image_s_depth() {
    use Shows::*;
    let whole = [Depth(0.0), Lamp(300), Lamp(300), Depth(0.0)];
    // Half and half again, down to what tracking takes.
    let shutter = [
        Depth(0.0),
        Partly(0.6),
        Partly(0.35),
        Partly(0.05),
        Partly(0.02),
        Lamp(300),
        Lamp(300),
        Partly(0.02),
        Depth(0.0),
    ];
    let selection = select(&[&whole[..], &shutter, &whole].concat());
    let found = measured(&selection);
    let ids: Vec<_> = found.iter().map(|(frame_id, _)| *frame_id).collect();
    assert_eq!(ids, [1, 9, 14]);
    assert!(found.iter().all(|(_, share)| *share > 0.5), "{found:?}");
    assert!(reasons(&selection).is_empty());
}

#[test]
fn a_pose_that_sees_little_depth_is_no_brighter_for_it() {
    use Shows::*;
    let pose = |seen| [seen, Lamp(300), Lamp(300), seen];
    // For longer than a second there is no more depth than that.
    let little = [&[Partly(0.1); 40][..], &pose(Partly(0.1))].concat();
    let selection = select(&[&pose(Depth(0.0))[..], &little, &pose(Depth(0.0))].concat());
    let found = measured(&selection);
    let ids: Vec<_> = found.iter().map(|(frame_id, _)| *frame_id).collect();
    assert_eq!(ids, [1, 45, 49]);
    assert!(found[1].1 < 0.11, "{found:?}");
    assert!(reasons(&selection).is_empty());
}

#[test]
fn what_is_forgotten_tells_nothing_of_the_lamp() {
    use Shows::*;
    let info = scenes::camera_info(Sensor::Kinect1);
    for (forget_after, n_accepted) in [(f64::INFINITY, 2), (0.15, 2), (f64::NEG_INFINITY, 1)] {
        let mut selector = SnapshotSelector::new(&info, SnapshotParams::default()).unwrap();
        let frames = [120, 400].map(|counts| [Depth(0.0), Lamp(counts), Lamp(counts), Depth(0.0)]);
        for (frame_id, shows) in frames.concat().into_iter().enumerate() {
            observe(&mut selector, frame_id as u64, shows);
        }
        selector.forget_after(forget_after);
        for (frame_id, shows) in (8..).zip([Depth(0.0), Lamp(60), Lamp(60), Depth(0.0)]) {
            observe(&mut selector, frame_id, shows);
        }
        assert_eq!(
            selector.finish().accepted.len(),
            n_accepted,
            "{forget_after}"
        );
    }
}

#[test]
fn a_group_during_which_the_camera_moved_is_refused_with_figures() {
    use Shows::*;
    let info = scenes::camera_info(Sensor::Kinect1);
    let params = SnapshotParams {
        held_pose: HeldPose::Between,
        ..SnapshotParams::default()
    };
    let mut selector = SnapshotSelector::new(&info, params).unwrap();
    let frames = [Depth(0.0), Lamp(300), Lamp(300), Depth(0.004)];
    for (frame_id, shows) in frames.into_iter().enumerate() {
        observe(&mut selector, frame_id as u64, shows);
    }
    let selection = selector.finish();
    assert!(selection.accepted.is_empty());
    let told = "not held still: 0.00° and 4.0 mm from before to after".to_owned();
    assert_eq!(reasons(&selection), [(1, told.clone()), (2, told)]);
}

#[test]
fn the_pose_before_may_be_trusted_for_a_second() {
    use Shows::*;
    let info = scenes::camera_info(Sensor::Kinect1);
    let params = SnapshotParams::default();
    for (first_exposure, n_accepted) in [(30, 1), (31, 0)] {
        let mut selector = SnapshotSelector::new(&info, params.clone()).unwrap();
        let frames = [
            (0, Depth(0.01)),
            (first_exposure, Lamp(300)),
            (first_exposure + 1, Lamp(300)),
            (first_exposure + 20, Depth(0.05)),
        ];
        for (frame_id, shows) in frames {
            observe(&mut selector, frame_id, shows);
        }
        let selection = selector.finish();
        assert_eq!(selection.accepted.len(), n_accepted);
        for snapshot in selection.accepted {
            assert_eq!(snapshot.world_from_camera.translation.x, 0.01);
            let moved_m = snapshot.moved.map(|moved| moved.translation.x);
            assert!((moved_m.unwrap() - 0.04).abs() < 1e-12, "{moved_m:?}");
        }
    }
}

#[test]
fn a_hand_that_was_still_or_was_found_elsewhere_went_no_way() {
    use Shows::*;
    for after in [0.002, 0.08] {
        let selection = select(&[Depth(0.0), Lamp(300), Lamp(300), Depth(after)]);
        assert_eq!(selection.accepted.len(), 1);
        assert_eq!(selection.accepted[0].moved, None, "{after} m");
    }
}

#[test]
fn a_pose_that_comes_soon_after_the_exposures_tells_whether_the_camera_was_still() {
    use Shows::*;
    let info = scenes::camera_info(Sensor::Kinect1);
    let params = SnapshotParams {
        held_pose: HeldPose::BetweenUnlessLate,
        ..SnapshotParams::default()
    };
    // The exposures end with frame 2, a second is 30 frames.
    for (after, x, n_accepted) in [(31, 0.05, 0), (31, 0.002, 1), (34, 0.05, 1)] {
        let mut selector = SnapshotSelector::new(&info, params.clone()).unwrap();
        for (frame_id, shows) in [
            (0, Depth(0.0)),
            (1, Lamp(300)),
            (2, Lamp(300)),
            (after, Depth(x)),
        ] {
            observe(&mut selector, frame_id, shows);
        }
        assert_eq!(selector.finish().accepted.len(), n_accepted, "{after} {x}");
    }
}

#[test]
fn groups_without_a_pose_on_both_sides_are_refused() {
    use Shows::*;
    let lost_after = select(&[Depth(0.0), Lamp(300), Lamp(300), Strange, Depth(0.0)]);
    assert!(lost_after.accepted.is_empty());
    let lost = lost_after.rejected.iter();
    assert!(lost.clone().count() == 2 && lost.clone().all(|r| r.reason == RejectReason::LostAfter));

    let lost_before = select(&[Depth(0.0), Strange, Lamp(300), Lamp(300), Depth(0.0)]);
    assert!(lost_before.accepted.is_empty());
    assert!(
        lost_before
            .rejected
            .iter()
            .all(|r| r.reason == RejectReason::NotTracked)
    );

    let unfinished = select(&[Depth(0.0), Lamp(300), Lamp(300)]);
    assert!(unfinished.accepted.is_empty());
    assert!(
        unfinished
            .rejected
            .iter()
            .all(|r| r.reason == RejectReason::Unfinished)
    );
}

#[test]
fn speckle_and_single_exposures_are_never_taken() {
    use Shows::*;
    let selection = select(&[Depth(0.0), Speckle, Lamp(300), Speckle, Depth(0.0)]);
    assert!(selection.accepted.is_empty());
    let kinds: Vec<_> = selection.rejected.iter().map(|r| r.reason).collect();
    assert!(matches!(
        kinds[..],
        [
            RejectReason::Speckle { .. },
            RejectReason::FewExposures { n_exposures: 1 },
            RejectReason::Speckle { .. }
        ]
    ));
}

#[test]
fn exposures_and_groups_beyond_the_limits_do_not_pile_up() {
    let info = scenes::camera_info(Sensor::Kinect1);
    let params = SnapshotParams {
        max_snapshots: 2,
        max_exposures: 3,
        ..SnapshotParams::default()
    };
    let mut selector = SnapshotSelector::new(&info, params).unwrap();
    for group in 0..6 {
        observe(&mut selector, group * 10, Shows::Depth(0.0));
        for exposure in 1..6 {
            observe(&mut selector, group * 10 + exposure, Shows::Lamp(300));
        }
    }
    observe(&mut selector, 60, Shows::Depth(0.0));
    assert_eq!(selector.n_accepted(), 2);
    let selection = selector.finish();
    // Without a model all groups tell the same: the first ones stay.
    let ids: Vec<_> = selection.accepted.iter().map(|s| s.frame_id).collect();
    assert_eq!(ids, [1, 11]);
    assert!(selection.accepted.iter().all(|s| s.n_exposures == 3));
    let surplus = selection
        .rejected
        .iter()
        .filter(|r| r.reason == RejectReason::Surplus);
    assert_eq!(surplus.count(), 12);
}

#[test]
fn the_model_is_needed_from_the_first_exposure_to_the_frame_after() {
    use Shows::*;
    let info = scenes::camera_info(Sensor::Kinect1);
    let mut selector = SnapshotSelector::new(&info, SnapshotParams::default()).unwrap();
    let next = scenes::frame(0, 0.0, None, None);
    let sequence = [Depth(0.0), Lamp(300), Lamp(300), Depth(0.0), Depth(0.0)];
    let needed = sequence.iter().zip(0..).map(|(shows, frame_id)| {
        let looks_at = selector.looks_at(&next);
        observe(&mut selector, frame_id, *shows);
        looks_at
    });
    let needed: Vec<PartOfModel> = needed.collect();
    let [nothing, all] = [PartOfModel::Nothing, PartOfModel::All];
    assert_eq!(needed, [nothing, nothing, all, all, nothing]);
}

#[test]
fn a_simulated_scan_gives_an_image_at_each_shading_pose() {
    let scene = Scene::plaque();
    let (low, high) = scene.object_bounds();
    let setup = Setup {
        scene,
        trajectory: Trajectory::hand_held(nalgebra::center(&low, &high), 24),
        sensor: Sensor::Kinect1,
        infrared: Infrared::of_sensor(Sensor::Kinect1),
        n_moving_frames: 24,
        shading_frames: vec![6, 16],
        reduction: 4,
        seed: 9,
    };
    let mut camera = SimulatedCamera::new(setup).unwrap();
    // The simulated hand has moved on when depth comes back.
    let mut selector = SnapshotSelector::new(camera.info(), SnapshotParams::default()).unwrap();
    while let Some(frame) = camera.grab(Duration::ZERO).unwrap() {
        let pose = camera.true_world_from_camera(frame.frame_id as usize);
        let outcome = match frame.depth_share() > 0.1 {
            true => scenes::tracked(pose),
            false => TrackingOutcome::NoDepth,
        };
        selector.observe(&scenes::without_model(&frame, &outcome));
    }
    let selection = selector.finish();
    let found: Vec<_> = selection
        .accepted
        .iter()
        .map(|s| (s.frame_id, s.n_exposures))
        .collect();
    let held = camera.true_world_from_camera(6);
    assert_eq!(selection.accepted[0].world_from_camera, held);
    // Moving frames 0 to 6, four exposures, moving frames 7 to 16, four exposures.
    assert_eq!(found, [(7, 4), (21, 4)]);
    assert_eq!(selection.rejected.len(), 4);
    assert!(
        selection
            .rejected
            .iter()
            .all(|r| matches!(r.reason, RejectReason::Speckle { .. }))
    );
}

#[test]
fn the_operator_is_led_through_the_sequence() {
    use crate::snapshot::SequenceStep::*;
    let info = scenes::camera_info(Sensor::Kinect1);
    let mut selector = SnapshotSelector::new(&info, SnapshotParams::default()).unwrap();
    let mut frame_id = 0;
    let mut step_after = |n: u64, shows: fn(u64) -> Shows| {
        for _ in 0..n {
            observe(&mut selector, frame_id, shows(frame_id));
            frame_id += 1;
        }
        let guidance = selector.guidance().expect("a Kinect I");
        (guidance.step, guidance.speckle < guidance.speckle_limit)
    };
    // 1 cm a frame, then still: frames are 1/30 s apart.
    assert_eq!(
        step_after(5, |frame| Shows::Depth(0.01 * frame as f64)).0,
        Track
    );
    assert_eq!(step_after(10, |_| Shows::Depth(0.04)).0, HoldStill);
    assert_eq!(step_after(25, |_| Shows::Depth(0.04)).0, CoverProjector);
    // Depth is gone and the speckle is not: covered badly, or out of range.
    assert_eq!(step_after(1, |_| Shows::Speckle), (CoverProjector, false));
    assert_eq!(step_after(2, |_| Shows::Nothing), (LampOn, true));
    assert_eq!(step_after(1, |_| Shows::Lamp(400)).0, LampOn);
    assert_eq!(step_after(1, |_| Shows::Lamp(400)).0, Uncover);
    assert_eq!(step_after(1, |_| Shows::Depth(0.04)).0, CoverProjector);
    // The next pose is in a lit room; how bright the lamp is is known by now.
    assert_eq!(step_after(5, |_| Shows::Lamp(60)).0, LampOn);
    assert_eq!(step_after(1, |_| Shows::Lamp(220)).0, LampOn);
    assert_eq!(step_after(1, |_| Shows::Lamp(220)).0, Uncover);
    assert_eq!(step_after(1, |_| Shows::Depth(0.04)).0, CoverProjector);
    assert_eq!(step_after(1, |_| Shows::Strange).0, Track);
}
