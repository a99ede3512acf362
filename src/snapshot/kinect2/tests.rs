//! Tilted planes in closed form, and a simulated scan.

use super::*;
use crate::fusion::{DepthNoise, Fusion, FusionParams, LossReason, TrackingOutcome};
use crate::geometry::{CameraModel, increment};
use crate::snapshot::information::ATTENTION_REACH_RAD;
use crate::snapshot::scenes::{self, Plane};
use crate::snapshot::{SnapshotParams, SnapshotSelector};
use depth_camera::{DepthCamera, Sensor};
use nalgebra::{UnitQuaternion, Vector3, Vector6};
use simulated::{Infrared, Scene, Setup, SimulatedCamera, Trajectory};
use std::time::Duration;

/// Shows a selector an image of a plane, as bright all over, from a pose.
fn observe(
    selector: &mut SnapshotSelector,
    plane: &Plane,
    (frame_id, time): (u64, f64),
    pose: &Pose,
    counts: u16,
) {
    let (snapshot, model) = scenes::view_of_plane(plane, pose);
    let ir = snapshot.ir_counts.map(|_| counts);
    let frame = scenes::frame(frame_id, time, Some(snapshot.depth_m), Some(ir));
    selector.observe(&TrackedFrame {
        frame: &frame,
        outcome: &scenes::tracked(*pose),
        model: Some(&model),
    });
}

/// What becomes of the second of two frames of a tilted plane, 33 ms apart, when the camera moves by `step`.
fn second_frame(step: &Pose, counts: u16) -> Option<RejectReason> {
    let info = scenes::camera_info(Sensor::Kinect2);
    let params = SnapshotParams {
        // The image is a quarter of the sensor's.
        max_image_speed_px_per_s: 150.0 / 4.0,
        ..SnapshotParams::default()
    };
    let mut selector = SnapshotSelector::new(&info, params).unwrap();
    let plane = Plane::tilted(0.6, 0.0);
    observe(&mut selector, &plane, (0, 0.0), &Pose::identity(), 20_000);
    observe(&mut selector, &plane, (1, 1.0 / 30.0), step, counts);
    let selection = selector.finish();
    assert_eq!(selection.accepted.len() + selection.rejected.len(), 2);
    selection.rejected.first().map(|r| r.reason)
}

fn turn_about(centre: Vector3<f64>, degrees: f64) -> Pose {
    let turn = UnitQuaternion::from_scaled_axis(Vector3::y() * degrees.to_radians());
    nalgebra::Isometry3::rotation_wrt_point(turn, centre.into())
}

#[test]
fn a_pan_blurs_and_a_walk_round_the_object_does_not() {
    let walk = turn_about(Vector3::new(0.0, 0.0, 0.6), 1.5);
    assert_eq!(second_frame(&walk, 20_000), None);
    let slower_pan = turn_about(Vector3::zeros(), 1.5);
    assert_eq!(second_frame(&slower_pan, 20_000), None, "blurred, but used");
    let pan = turn_about(Vector3::zeros(), 2.0);
    let reason = second_frame(&pan, 20_000).unwrap();
    // 2° in 1/30 s: 1.047 rad/s, with 91.4 px a radian.
    let RejectReason::TooFast {
        rotation_rad_per_s,
        speed_m_per_s,
        ..
    } = reason
    else {
        panic!("{reason}");
    };
    assert!((rotation_rad_per_s - 1.047).abs() < 0.001 && speed_m_per_s < 1e-9);
}

#[test]
fn fast_and_saturated_frames_are_refused() {
    let jump = increment(&Vector6::new(0.0, 0.0, 0.0, 0.0, 0.0, 0.08));
    assert!(matches!(
        second_frame(&jump, 20_000),
        Some(RejectReason::TooFast { speed_m_per_s, .. }) if (speed_m_per_s - 2.4).abs() < 1e-9
    ));
    assert_eq!(
        second_frame(&Pose::identity(), 65_535),
        Some(RejectReason::Saturated { share: 1.0 })
    );
    assert_eq!(
        second_frame(&Pose::identity(), 100),
        Some(RejectReason::NoInformation)
    );
}

#[test]
fn a_fast_image_is_used_until_a_slow_one_tells_the_same() {
    let info = scenes::camera_info(Sensor::Kinect2);
    let params = SnapshotParams {
        max_snapshots: 2,
        ..SnapshotParams::default()
    };
    let mut selector = SnapshotSelector::new(&info, params).unwrap();
    let plane = Plane::tilted(0.6, 0.3);
    let mut chosen_after = |frame_id: u64, time: f64, pose: Pose, is_requested: bool| {
        if is_requested {
            selector.request();
        }
        observe(&mut selector, &plane, (frame_id, time), &pose, 20_000);
        let chosen = selector.selection().accepted;
        let chosen = chosen.iter().map(|s| s.frame_id);
        (chosen.collect::<Vec<u64>>(), selector.is_requested())
    };
    let (still, beside) = (
        Pose::identity(),
        turn_about(Vector3::new(0.0, 0.0, 0.6), 4.0),
    );
    assert_eq!(chosen_after(0, 0.0, still, false), (vec![0], false));
    // 4° at 0.6 m in 1/30 s: 1.26 m/s. What is asked for is a slow one.
    let soon = 1.0 / 30.0;
    assert_eq!(chosen_after(1, soon, beside, true), (vec![0, 1], true));
    assert_eq!(chosen_after(2, 1.0, beside, true), (vec![0, 2], false));
}

#[test]
fn the_image_in_which_a_lost_camera_is_found_is_not_taken_for_a_sharp_one() {
    let info = scenes::camera_info(Sensor::Kinect2);
    let mut selector = SnapshotSelector::new(&info, SnapshotParams::default()).unwrap();
    let plane = Plane::tilted(0.6, 0.3);
    let here = Pose::identity();
    observe(&mut selector, &plane, (0, 0.0), &here, 20_000);
    let (snapshot, model) = scenes::view_of_plane(&plane, &here);
    let few = LossReason::FewInliers { inlier_share: 0.1 };
    for (frame_id, outcome) in [
        (1, TrackingOutcome::Lost(few)),
        (4, TrackingOutcome::NoDepth),
    ] {
        let at = |frames: u64| (frame_id + frames, 0.5 * (frame_id + frames) as f64);
        selector.observe(&TrackedFrame {
            frame: &scenes::frame(frame_id, at(0).1, Some(snapshot.depth_m.clone()), None),
            outcome: &outcome,
            model: Some(&model),
        });
        selector.request();
        observe(&mut selector, &plane, at(1), &here, 20_000);
        assert!(selector.is_requested(), "how fast it moved is not known");
        observe(&mut selector, &plane, at(2), &here, 20_000);
        assert!(!selector.is_requested());
    }
}

#[test]
fn a_scan_of_a_plaque_gives_views_from_both_sides() {
    let scene = Scene::plaque();
    let (low, high) = scene.object_bounds();
    let setup = Setup {
        scene,
        trajectory: Trajectory::hand_held(nalgebra::center(&low, &high), 60),
        sensor: Sensor::Kinect2,
        infrared: Infrared::of_sensor(Sensor::Kinect2),
        n_moving_frames: 60,
        shading_frames: Vec::new(),
        reduction: 4,
        seed: 5,
    };
    let mut camera = SimulatedCamera::new(setup).unwrap();
    let params = SnapshotParams {
        max_snapshots: 6,
        ..SnapshotParams::default()
    };
    let mut selector = SnapshotSelector::new(camera.info(), params).unwrap();
    let lens = CameraModel::new(camera.info().intrinsics);
    let fusion_params = FusionParams {
        voxel_size_m: 0.004,
        ..FusionParams::default()
    };
    let noise = DepthNoise::of_sensor(Sensor::Kinect2);
    let mut fusion = Fusion::new(lens, noise, fusion_params);
    while let Some(frame) = camera.grab(Duration::ZERO).unwrap() {
        let pose = camera.true_world_from_camera(frame.frame_id as usize);
        let depth = frame.depth.as_ref().unwrap();
        let outcome = fusion.fuse_at(depth, frame.device_time_secs, &pose);
        selector.observe(&TrackedFrame {
            frame: &frame,
            outcome: &outcome,
            model: fusion.model_near_axis(ATTENTION_REACH_RAD),
        });
    }
    assert_eq!(selector.n_accepted(), 6);
    let selection = selector.finish();
    assert_eq!(selection.accepted.len() + selection.rejected.len(), 60);
    let azimuths: Vec<f64> = selection
        .accepted
        .iter()
        .map(|s| {
            s.world_from_camera
                .translation
                .x
                .atan2(-s.world_from_camera.translation.y)
        })
        .map(f64::to_degrees)
        .collect();
    assert!(selection.accepted.is_sorted_by_key(|s| s.frame_id));
    // The swing reaches 42° to either side; a choice of tilts goes near both ends.
    assert!(azimuths.iter().any(|a| *a < -20.0), "{azimuths:?}");
    assert!(azimuths.iter().any(|a| *a > 20.0), "{azimuths:?}");
}

#[test]
fn a_frame_that_makes_another_one_room_is_a_candidate_though_there_are_no_more_than_before() {
    let info = scenes::camera_info(Sensor::Kinect2);
    let params = SnapshotParams {
        max_snapshots: 2,
        ..SnapshotParams::default()
    };
    let mut selector = SnapshotSelector::new(&info, params).unwrap();
    let other_side = turn_about(Vector3::new(0.0, 0.0, 0.6), -20.0);
    let mut held = Vec::new();
    for frame_id in 0..6 {
        let pose = match frame_id {
            5 => other_side,
            _ => Pose::identity(),
        };
        let plane = Plane::tilted(0.6, 0.0);
        let at = (frame_id, frame_id as f64);
        observe(&mut selector, &plane, at, &pose, 20_000);
        held.push((selector.holds(frame_id), selector.n_accepted()));
    }
    // Twice as many as are chosen find room, and the fifth tells what those before it do.
    let full = (true, 2);
    assert_eq!(held, [(true, 1), full, full, full, (false, 2), full]);
    let accepted = selector.finish().accepted;
    assert!(accepted.iter().any(|s| s.frame_id == 5));
}

#[test]
fn an_image_that_is_asked_for_waits_for_a_good_frame() {
    let info = scenes::camera_info(Sensor::Kinect2);
    let params = SnapshotParams {
        max_snapshots: 1,
        ..SnapshotParams::default()
    };
    let mut selector = SnapshotSelector::new(&info, params).unwrap();
    let observe = |selector: &mut SnapshotSelector, frame_id: u64, counts: u16| {
        let at = (frame_id, frame_id as f64);
        let plane = Plane::tilted(0.6, 0.0);
        observe(selector, &plane, at, &Pose::identity(), counts);
    };
    observe(&mut selector, 0, 20_000);
    selector.request();
    // Saturated: the gates of quality hold for what is asked for too.
    observe(&mut selector, 1, 65_535);
    assert!(selector.is_requested());
    let last = selector.rejected().newest().last().map(|r| r.reason.code());
    assert_eq!(last, Some("saturated"));
    observe(&mut selector, 2, 20_000);
    assert!(!selector.is_requested());
    // It tells no more than the first one, which would win otherwise.
    observe(&mut selector, 3, 20_000);
    let chosen: Vec<u64> = selector
        .selection()
        .accepted
        .iter()
        .map(|s| s.frame_id)
        .collect();
    assert_eq!(chosen, [2]);
    selector.forget_after(1.5);
    let chosen = selector.finish().accepted;
    assert_eq!(chosen[0].frame_id, 0);
}
