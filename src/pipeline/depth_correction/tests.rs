//! Scans of the simulated Kinect II, fused again at their end.

use super::*;
use crate::geometry::motion_between;
use depth_camera::DepthCamera;
use simulated::SimulatedCamera;
use std::time::Duration;

const N_FRAMES: usize = 3;

/// A short scan, fused by `fuse` as corrected while it went on.
fn scanned(
    fuse: impl Fn(&mut Fusion, &Image<f32>, f64, &Pose) -> TrackingOutcome,
) -> (DepthCorrection, Fusion) {
    let mut camera = SimulatedCamera::kinect2_plaque(N_FRAMES, 7);
    let info = camera.info().clone();
    let calibration = Calibration::shipped_for(&info).expect("shipped");
    let params = FusionParams {
        voxel_size_m: 0.004,
        ..FusionParams::default()
    };
    let mut correction = DepthCorrection::new(&info, &calibration, true, &params);
    let noise = DepthNoise::of_sensor(info.sensor);
    let mut fusion = Fusion::new(CameraModel::new(info.intrinsics), noise, params);
    let first = camera.true_world_from_camera(0).inverse();
    for index in 0..N_FRAMES {
        let frame = camera.grab(Duration::from_secs(10));
        let frame = frame.expect("it is simulated").expect("not the end");
        let corrected = correction.correct(&frame).expect("it shows light");
        let depth = corrected.depth.as_ref().expect("a Kinect II");
        let pose = first * camera.true_world_from_camera(index);
        let outcome = fuse(&mut fusion, depth, frame.device_time_secs, &pose);
        assert!(
            matches!(outcome, TrackingOutcome::Tracked { .. }),
            "{outcome:?}"
        );
    }
    (correction, fusion)
}

#[test]
fn a_tracked_scan_is_fused_again_on_its_model_with_every_frame_where_it_was() {
    let (correction, tracked) = scanned(|fusion, depth, time, _| fusion.fuse(depth, time));
    let revised = correction
        .revise(&tracked, &|_| true)
        .expect("light comes over the table");
    assert_eq!(revised.fusion.n_fused(), N_FRAMES);
    let pairs = revised.fusion.keyframes().iter().zip(tracked.keyframes());
    for (after, before) in pairs {
        assert_eq!(after.time_secs, before.time_secs);
        let moved = revised
            .correction
            .apply(before.time_secs, &before.world_from_camera);
        let apart = motion_between(&moved, &after.world_from_camera);
        assert!(
            apart.translation_m < 1e-9 && apart.rotation_rad < 1e-7,
            "{apart:?}"
        );
        let motion = motion_between(&before.world_from_camera, &after.world_from_camera);
        assert!(
            motion.translation_m < 0.01 && motion.rotation_rad < 0.02,
            "{motion:?}"
        );
    }
    assert!(correction.revise(&tracked, &|_| false).is_none());
}

#[test]
fn a_scan_at_given_poses_is_fused_again_and_every_frame_stays_where_it_was_given() {
    let (correction, given) = scanned(Fusion::fuse_at);
    let revised = correction
        .revise(&given, &|_| true)
        .expect("light comes over the table");
    assert_eq!(revised.fusion.n_fused(), N_FRAMES);
    let pairs = revised.fusion.keyframes().iter().zip(given.keyframes());
    for (after, before) in pairs {
        let (time_secs, pose) = (before.time_secs, &before.world_from_camera);
        let moved = revised.correction.apply(time_secs, pose);
        for pose_after in [&after.world_from_camera, &moved] {
            let apart = motion_between(pose_after, pose);
            assert!(apart.translation_m < 1e-9 && apart.rotation_rad < 1e-7);
        }
        assert_ne!(after.depth_m().data(), before.depth_m().data());
    }
    let mut fusion = revised.fusion;
    assert!(fusion.close_loops(&|_| true).is_none());
}
