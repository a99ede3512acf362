//! Loops over frames of the simulated camera, whose poses are known.

use super::super::tests::{frames as simulated_frames, small_params};
use super::super::{
    DepthNoise, FusionParams, Improvement, eye::Eye, keyframes::Keyframes,
    marching_cubes::marching_cubes, track::Track,
};
use super::*;
use crate::geometry::{increment, motion_between};
use depth_camera::Sensor;
use std::sync::atomic::{AtomicUsize, Ordering};

/// A swing whose poses drift evenly, by `drift` from frame to frame.
fn drifted(n_frames: usize, drift: &Vector6<f64>) -> (Keyframes, Vec<Pose>, Eye) {
    displaced(n_frames, |index| (drift * index as f64, 0))
}

/// A swing whose frames are moved, and in stretches of tracking, by what is said of each.
fn displaced(
    n_frames: usize,
    displacement: impl Fn(usize) -> (Vector6<f64>, usize),
) -> (Keyframes, Vec<Pose>, Eye) {
    let (frames, truth, camera) = simulated_frames(n_frames);
    let noise = DepthNoise::of_sensor(Sensor::Kinect2);
    let mut eye = Eye::new(&camera, noise, small_params().depth_range());
    let mut keyframes = Keyframes::new(usize::MAX);
    for (index, (frame, pose)) in frames.iter().zip(&truth).enumerate() {
        let depth = frame.depth.as_ref().expect("Kinect II");
        let (off, stretch) = displacement(index);
        assert!(eye.take(depth));
        let track = Track::at(increment(&off) * pose, frame.device_time_secs);
        keyframes.offer(&eye, &track, None, stretch);
    }
    (keyframes, truth, eye)
}

fn closed(keyframes: &Keyframes, eye: &Eye, params: &FusionParams) -> Option<ClosedLoops> {
    closed_while(keyframes, eye, params, &|_| true)
}

fn closed_while(
    keyframes: &Keyframes,
    eye: &Eye,
    params: &FusionParams,
    goes_on: &GoesOn,
) -> Option<ClosedLoops> {
    let nothing_moved = PoseCorrection::default();
    let mut live = FusedVolume::untouched(params.empty_volume());
    let frames = keyframes.frames();
    live.fuse_again(frames, &nothing_moved, eye, &|| true);
    find(frames, eye, params, goes_on)?.judged(&live.volume)
}

/// Fragments so short that a swing of few frames has several.
fn short_fragments() -> FusionParams {
    FusionParams {
        loop_closing: LoopClosingParams {
            fragment_frames: 3,
            ..LoopClosingParams::default()
        },
        ..small_params()
    }
}

#[test]
fn drift_is_taken_back_alike_on_any_number_of_threads() {
    let drift = Vector6::new(0.0004, 0.0003, 0.0, 0.0006, 0.0, 0.0004);
    let (keyframes, truth, eye) = drifted(18, &drift);
    let run = |n_threads: usize| {
        let pool = rayon::ThreadPoolBuilder::new()
            .num_threads(n_threads)
            .build()
            .expect("threads");
        pool.install(|| closed(&keyframes, &eye, &short_fragments()).expect("a better fit"))
    };
    let (one, two) = (run(1), run(2));
    assert_eq!(one.closure.correction, two.closure.correction);
    assert!(one.closure.misfit_after_m < one.closure.misfit_before_m);
    let frame = &keyframes.frames()[17];
    let before = motion_between(&truth[17], &frame.world_from_camera);
    let correction = &one.closure.correction;
    let after = correction.apply(frame.time_secs, &frame.world_from_camera);
    let after = motion_between(&truth[17], &after);
    // Drift of 12 mm and 8.5 mrad; half a voxel of 4 mm may be left, as in tracking.
    assert!(before.translation_m > 0.010 && before.rotation_rad > 0.008);
    assert!(after.translation_m < 0.002, "{after:?}");
    assert!(after.rotation_rad < 0.004, "{after:?}");
    let first = motion_between(&correction.at(frame.time_secs - 1e3), &Pose::identity());
    assert!(first.translation_m < 1e-12 && first.rotation_rad < 1e-7);
}

#[test]
fn drift_along_the_view_is_found_as_far_as_alignment_reaches() {
    // A camera that was lost, and found 30 mm behind where it was: more than surfaces may lie apart that are the same with these voxels.
    let behind = Vector6::new(0.0, 0.0, 0.0, 0.0, 0.0, 0.03);
    let (keyframes, truth, eye) = displaced(18, |index| match index {
        0..9 => (Vector6::zeros(), 0),
        _ => (behind, 1),
    });
    let params = FusionParams {
        voxel_size_m: 0.002,
        ..short_fragments()
    };
    assert!(icp::BEHIND_VOXELS * (params.voxel_size_m as f32) < 0.025);
    let closed = closed(&keyframes, &eye, &params).expect("a better fit");
    let frames = keyframes.frames();
    let apart = |moved: &dyn Fn(&Keyframe) -> Pose| {
        let tracked = moved(&frames[0]).inverse() * moved(&frames[17]);
        let true_motion = truth[0].inverse() * truth[17];
        motion_between(&true_motion, &tracked).translation_m
    };
    let before_m = apart(&|frame| frame.world_from_camera);
    let correction = &closed.closure.correction;
    let after_m = apart(&|frame| correction.apply(frame.time_secs, &frame.world_from_camera));
    assert!(
        before_m > 0.025 && after_m < 0.004,
        "{before_m} m, {after_m} m"
    );
}

#[test]
fn a_scan_that_never_comes_back_is_left_alone() {
    let (keyframes, _, eye) = drifted(6, &Vector6::zeros());
    assert!(closed(&keyframes, &eye, &short_fragments()).is_none());
}

#[test]
fn closing_loops_ends_wherever_it_is_told_to() {
    let drift = Vector6::new(0.0004, 0.0003, 0.0, 0.0006, 0.0, 0.0004);
    let (keyframes, _, eye) = drifted(18, &drift);
    let n_asked = AtomicUsize::new(0);
    let count = |told: Improvement| {
        assert!(told.n_done < told.n_in_all, "{told:?}");
        n_asked.fetch_add(1, Ordering::Relaxed);
        true
    };
    let params = short_fragments();
    assert!(closed_while(&keyframes, &eye, &params, &count).is_some());
    let n_all = n_asked.into_inner();
    // Once a fragment, a pair, and a frame at least.
    assert!(n_all > 6 + 15 + 18, "{n_all}");
    for n in [0, 3, 10, n_all / 2, n_all - 10, n_all - 1] {
        let left = AtomicUsize::new(n);
        let ends = |_| {
            let taken = |left: usize| left.checked_sub(1);
            left.fetch_update(Ordering::Relaxed, Ordering::Relaxed, taken)
                .is_ok()
        };
        let closed = closed_while(&keyframes, &eye, &params, &ends);
        assert!(closed.is_none(), "after {n} of {n_all}");
    }
}

#[test]
fn chosen_targets_are_spread_and_end_with_the_nearest() {
    let targets: Vec<usize> = (0..20).collect();
    assert_eq!(evenly(&targets, 4), [4, 9, 14, 19]);
    assert_eq!(evenly(&targets[..3], 4), [0, 1, 2]);
    assert!(evenly(&[], 4).is_empty());
}

#[test]
fn frames_that_memory_has_no_room_for_are_not_missing_from_the_surface() {
    const N_FRAMES: usize = 16;
    // A camera that rests at four places.
    let (frames, truth, camera) = simulated_frames(4);
    let noise = DepthNoise::of_sensor(Sensor::Kinect2);
    let params = small_params();
    let mut eye = Eye::new(&camera, noise, params.depth_range());
    let mut kept = |max_bytes: usize| {
        let mut keyframes = Keyframes::new(max_bytes);
        for index in 0..N_FRAMES {
            let (frame, pose) = (&frames[index / 4], truth[index / 4]);
            assert!(eye.take(frame.depth.as_ref().expect("Kinect II")));
            keyframes.offer(&eye, &Track::at(pose, index as f64 / 30.0), None, 0);
        }
        keyframes.frames().to_vec()
    };
    let all = kept(usize::MAX);
    let sizes = all.iter().map(|frame| frame.depth.memory_bytes());
    let most_bytes = sizes.max().expect("frames");
    let (half, quarter) = (kept(8 * most_bytes), kept(4 * most_bytes));
    assert_eq!((half.len(), quarter.len()), (N_FRAMES / 2, N_FRAMES / 4));
    let area_m2 = |frames: &[Keyframe]| {
        // Four frames weigh less than this where each is fused as one.
        let min_weight = 4.0;
        let mut fused = FusedVolume::untouched(params.empty_volume());
        fused.fuse_again(frames, &PoseCorrection::default(), &eye, &|| true);
        marching_cubes(eye.arch, &fused.volume, min_weight).area_m2()
    };
    let whole_m2 = area_m2(&all);
    assert!(whole_m2 > 0.01, "{whole_m2}");
    for frames in [half, quarter] {
        let share = area_m2(&frames) / whole_m2;
        assert!(
            (share - 1.0).abs() < 0.03,
            "{} frames: {share}",
            frames.len()
        );
    }
}
