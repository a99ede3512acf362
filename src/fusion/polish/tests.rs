//! Poses that err, against the simulated camera's truth.

use crate::fusion::tests::{frames, small_params};
use crate::fusion::{DepthNoise, Fusion, FusionParams, Keyframe, TrackingOutcome};
use crate::geometry::{Motion, Pose, increment, motion_between};
use depth_camera::Sensor;
use nalgebra::Vector6;

/// An error of 5 mrad and 4 mm in a direction of its own for each frame, none for the first, which is the world.
fn perturbed(truth: &[Pose]) -> Vec<Pose> {
    let mut random = fastrand::Rng::with_seed(7);
    let mut unit = || {
        let direction = nalgebra::Vector3::from_fn(|_, _| random.f64() - 0.5);
        direction.try_normalize(0.0).expect("not zero")
    };
    let astray = |(frame, pose): (usize, &Pose)| {
        let (turn, shift) = (0.005 * unit(), 0.004 * unit());
        let mut error = Vector6::zeros();
        if frame > 0 {
            error.fixed_rows_mut::<3>(0).copy_from(&turn);
            error.fixed_rows_mut::<3>(3).copy_from(&shift);
        }
        // About the camera itself, so that the error is what it is said to be.
        pose * increment(&error)
    };
    truth.iter().enumerate().map(astray).collect()
}

fn fusion(camera: crate::geometry::CameraModel) -> Fusion {
    let params = FusionParams {
        max_rotation_rad_per_s: 100.0,
        ..small_params()
    };
    Fusion::new(camera, DepthNoise::of_sensor(Sensor::Kinect2), params)
}

fn rms(motions: impl Iterator<Item = Motion>) -> (f64, f64) {
    let (mut rotation, mut translation, mut n) = (0.0, 0.0, 0);
    for motion in motions {
        rotation += motion.rotation_rad.powi(2);
        translation += motion.translation_m.powi(2);
        n += 1;
    }
    let mean = |sum: f64| (sum / f64::from(n)).sqrt();
    (mean(rotation), mean(translation))
}

#[test]
fn poses_that_err_are_put_right() {
    let (frames, truth, camera) = frames(12);
    let given = perturbed(&truth);
    let mut fusion = fusion(camera);
    let polished: Vec<Pose> = frames
        .iter()
        .zip(&given)
        .map(|(frame, pose)| {
            let depth = frame.depth.as_ref().expect("Kinect II");
            match fusion.fuse_near(depth, frame.device_time_secs, pose) {
                TrackingOutcome::Tracked {
                    world_from_camera, ..
                } => world_from_camera,
                other => panic!("{other:?}"),
            }
        })
        .collect();
    let off = |poses: &[Pose]| {
        rms(poses
            .iter()
            .zip(&truth)
            .skip(1)
            .map(|(pose, truth)| motion_between(truth, pose)))
    };
    let (before, after) = (off(&given), off(&polished));
    assert_eq!(fusion.n_unpolished(), 0);
    assert!((before.0 - 0.005).abs() < 1e-4 && (before.1 - 0.004).abs() < 1e-4);
    // What tracking itself is off.
    assert!(after.0 < 0.75 * before.0, "{before:?} {after:?}");
    assert!(after.1 < 0.45 * before.1, "{before:?} {after:?}");
}

#[test]
fn beyond_the_bound_the_given_pose_stands_and_is_counted() {
    let (frames, truth, camera) = frames(4);
    let mut fusion = fusion(camera);
    for (frame, pose) in frames.iter().zip(&truth).take(3) {
        let depth = frame.depth.as_ref().expect("Kinect II");
        fusion.fuse_near(depth, frame.device_time_secs, pose);
    }
    assert_eq!(fusion.n_unpolished(), 0);
    // 25 mm lie within the reach of the alignment, and beyond the 15 mm that are believed.
    let astray = truth[3] * increment(&Vector6::new(0.0, 0.0, 0.0, 0.0, 0.0, 0.025));
    let depth = frames[3].depth.as_ref().expect("Kinect II");
    let outcome = fusion.fuse_near(depth, frames[3].device_time_secs, &astray);
    let as_given = TrackingOutcome::Tracked {
        world_from_camera: astray,
        fit: None,
    };
    assert_eq!(outcome, as_given);
    assert_eq!((fusion.n_unpolished(), fusion.n_fused()), (1, 4));
}

#[test]
fn a_frame_that_is_fused_anew_is_held_by_the_pose_that_was_given() {
    let (frames, truth, camera) = frames(4);
    let mut before = fusion(camera);
    // Beyond the 15 mm that are believed.
    let astray = truth[3] * increment(&Vector6::new(0.0, 0.0, 0.0, 0.0, 0.0, 0.025));
    for (frame, pose) in frames.iter().zip(truth[..3].iter().chain([&astray])) {
        let depth = frame.depth.as_ref().expect("Kinect II");
        before.fuse_near(depth, frame.device_time_secs, pose);
    }
    let mut anew = fusion(camera);
    for (frame, pose) in before.keyframes().iter().zip(&truth) {
        let outcome = anew.fuse_anew(&frame.depth_m(), frame, pose, None);
        assert!(matches!(outcome, TrackingOutcome::Tracked { .. }));
    }
    let last = &anew.keyframes()[3];
    assert_eq!((last.world_from_camera, last.given), (astray, Some(astray)));
    assert_eq!(anew.n_unpolished(), 1);
    assert!(anew.is_at_given_poses());
}

#[test]
fn frames_that_are_fused_anew_are_kept_as_tracked_ones_are() {
    let (frames, truth, camera) = frames(6);
    let mut tracked = fusion(camera);
    for frame in &frames {
        let depth = frame.depth.as_ref().expect("Kinect II");
        tracked.fuse(depth, frame.device_time_secs);
    }
    let mut anew = fusion(camera);
    let mut poses = Vec::new();
    for (frame, given) in tracked.keyframes().iter().zip(perturbed(&truth)) {
        match anew.fuse_anew(&frame.depth_m(), frame, &given, None) {
            TrackingOutcome::Tracked {
                world_from_camera, ..
            } => poses.push(world_from_camera),
            other => panic!("{other:?}"),
        }
    }
    let kept = |fusion: &Fusion| -> Vec<(f64, usize)> {
        let frames = fusion.keyframes().iter();
        frames
            .map(|frame| (frame.time_secs, frame.stretch))
            .collect()
    };
    assert_eq!(kept(&anew), kept(&tracked));
    assert_eq!(kept(&anew).len(), 6);
    for (frame, pose) in anew.keyframes().iter().zip(&poses) {
        assert_eq!(&frame.world_from_camera, pose);
    }
    // Nobody gave these poses.
    assert_eq!(anew.n_unpolished(), 0);
}

#[test]
fn a_frame_that_is_fused_anew_counts_for_those_that_it_stands_for() {
    let (frames, truth, camera) = frames(2);
    let mut before = fusion(camera);
    for (frame, pose) in frames.iter().zip(&truth) {
        let depth = frame.depth.as_ref().expect("Kinect II");
        before.fuse_at(depth, frame.device_time_secs, pose);
    }
    assert!(before.mesh().faces.is_empty(), "two frames are too few");
    let (mut near, mut there) = (fusion(camera), fusion(camera));
    for (frame, pose) in before.keyframes().iter().zip(&truth) {
        assert_eq!(frame.n_frames, 1);
        let frame = Keyframe {
            n_frames: 3,
            ..frame.clone()
        };
        near.fuse_anew(&frame.depth_m(), &frame, pose, None);
        there.fuse_anew_at(&frame.depth_m(), &frame, pose);
    }
    for anew in [near, there] {
        assert!(!anew.mesh().faces.is_empty());
        assert_eq!(anew.keyframes().len(), 2);
        assert!(anew.keyframes().iter().all(|frame| frame.n_frames == 3));
    }
}
