//! Scans of the simulated Kinect II, fused again at their end.

use super::lens::Lens;
use super::predictions::nanos;
use super::ray_order::RayOrder;
use super::*;
use crate::{
    fusion::{DepthNoise, TrackingOutcome, Work},
    geometry::{CellGrid, increment, motion_between},
};
use depth_camera::DepthCamera;
use nalgebra::{Translation3, Vector3, Vector6};
use simulated::SimulatedCamera;
use std::time::Duration;

const N_FRAMES: usize = 3;

/// A short scan, fused by `fuse` as corrected while it went on.
fn scanned(
    fuse: impl Fn(&mut Fusion, &Image<f32>, f64, &Pose) -> TrackingOutcome,
) -> (DepthCorrection, Fusion) {
    scanned_with(&calibration(1.0), fuse)
}

/// The shipped calibration with another gamma, as a share of the right one.
fn calibration(gamma_share: f64) -> Calibration {
    let info = SimulatedCamera::kinect2_plaque(1, 7).info().clone();
    let shipped = Calibration::shipped_for(&info).expect("shipped");
    Calibration {
        gamma: gamma_share * shipped.gamma,
        ..shipped
    }
}

/// The same, corrected by a calibration.
fn scanned_with(
    calibration: &Calibration,
    fuse: impl Fn(&mut Fusion, &Image<f32>, f64, &Pose) -> TrackingOutcome,
) -> (DepthCorrection, Fusion) {
    scanned_as(&rendered(N_FRAMES), calibration, Frame::clone, fuse)
}

/// So many frames of the camera.
fn rendered(n_frames: usize) -> Vec<Frame> {
    let mut camera = SimulatedCamera::kinect2_plaque(n_frames, 7);
    let grab = |_| {
        let frame = camera.grab(Duration::from_secs(10));
        frame.expect("it is simulated").expect("not the end")
    };
    (0..n_frames).map(grab).collect()
}

/// The same of these frames, as a sensor delivers them that has another error of its own.
fn scanned_as(
    frames: &[Frame],
    calibration: &Calibration,
    deliver: impl Fn(&Frame) -> Frame,
    fuse: impl Fn(&mut Fusion, &Image<f32>, f64, &Pose) -> TrackingOutcome,
) -> (DepthCorrection, Fusion) {
    scanned_by(FusionParams::default(), frames, calibration, deliver, fuse)
}

/// The same, by other parameters than the default.
fn scanned_by(
    params: FusionParams,
    frames: &[Frame],
    calibration: &Calibration,
    deliver: impl Fn(&Frame) -> Frame,
    fuse: impl Fn(&mut Fusion, &Image<f32>, f64, &Pose) -> TrackingOutcome,
) -> (DepthCorrection, Fusion) {
    let camera = SimulatedCamera::kinect2_plaque(frames.len(), 7);
    let info = camera.info().clone();
    let params = FusionParams {
        voxel_size_m: 0.004,
        ..params
    };
    let mut correction = DepthCorrection::new(&info, calibration, true, &params);
    let noise = DepthNoise::of_sensor(info.sensor);
    let mut fusion = Fusion::new(CameraModel::new(info.intrinsics), noise, params);
    let first = camera.true_world_from_camera(0).inverse();
    for (index, frame) in frames.iter().enumerate() {
        let frame = deliver(frame);
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
    let (mut correction, tracked) = scanned(|fusion, depth, time, _| fusion.fuse(depth, time));
    for max_sought_by in [N_FRAMES, N_FRAMES - 1] {
        correction.max_sought_by = max_sought_by;
        is_fused_again_where_it_was(&correction, &tracked);
    }
    assert!(correction.revise(&tracked, &|_| false).is_none());
}

fn is_fused_again_where_it_was(correction: &DepthCorrection, tracked: &Fusion) {
    let revised = correction
        .revise(tracked, &|_| true)
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

#[test]
fn a_scan_is_revised_by_the_calibration_that_was_found_since() {
    /// Mean difference of the revised depth from that of another scan, metres.
    fn apart(one: &Revised, other: &Revised) -> f64 {
        let frames = one.fusion.keyframes().iter();
        let pairs = frames.zip(other.fusion.keyframes());
        let (mut sum, mut n) = (0.0, 0.0);
        for (one, other) in pairs {
            let (one, other) = (one.depth_m(), other.depth_m());
            for (a, b) in one.data().iter().zip(other.data()) {
                if *a > 0.0 && *b > 0.0 {
                    sum += f64::from((a - b).abs());
                    n += 1.0;
                }
            }
        }
        sum / n
    }
    let revised = |correction: &DepthCorrection, fusion: &Fusion| {
        let revised = correction.revise(fusion, &|_| true);
        revised.expect("light comes over the table")
    };
    // By one white level: the sensor has no multipath, and each round of each scan would tell another.
    let measured = |gamma_share: f64| {
        let mut calibration = calibration(gamma_share);
        calibration.light.white_level = Some(0.3);
        calibration
    };
    let (correction, fusion) = scanned_with(&measured(1.0), Fusion::fuse_at);
    let right = revised(&correction, &fusion);
    let (mut correction, fusion) = scanned_with(&measured(1.6), Fusion::fuse_at);
    let wrong = revised(&correction, &fusion);
    correction.recalibrate(&measured(1.0));
    let recalibrated = revised(&correction, &fusion);
    let (before, after) = (apart(&wrong, &right), apart(&recalibrated, &right));
    assert!(after < 0.3 * before, "{before} m, {after} m");
}

#[test]
fn multipath_is_taken_once_off_a_frame_without_an_infrared_image() {
    let (mut correction, fusion) = scanned(|fusion, depth, time, _| fusion.fuse(depth, time));
    let mut camera = SimulatedCamera::kinect2_plaque(N_FRAMES, 7);
    let seen = camera.grab(Duration::from_secs(10));
    let seen = seen.expect("it is simulated").expect("not the end");
    let seen_m = seen.depth.expect("a Kinect II");
    let frame = &fusion.keyframes()[0];
    let (time_secs, pose) = (frame.time_secs, frame.world_from_camera);
    let known = Known {
        white: correction.live,
        ..Known::default()
    };
    let anew = |correction: &DepthCorrection, depth_m: &Image<f32>| {
        let depth = (depth_m, correction.corrected_by(time_secs));
        correction.anew(depth, time_secs, &pose, &fusion, &known)
    };
    let of_corrected = anew(&correction, &frame.depth_m());
    correction.predictions.0.remove(&nanos(time_secs));
    let of_seen = anew(&correction, &seen_m);
    let mean = |a: &Image<f32>, b: &Image<f32>| {
        let pixels = a.data().iter().zip(b.data());
        let both = pixels.filter(|(a, b)| **a > 0.0 && **b > 0.0);
        let apart: Vec<f64> = both.map(|(a, b)| f64::from(a - b)).collect();
        apart.iter().sum::<f64>() / apart.len() as f64
    };
    let taken_m = mean(&seen_m, &of_corrected);
    assert!(taken_m > 0.0003, "{taken_m}");
    let apart_m = mean(&of_seen, &of_corrected);
    assert!(apart_m.abs() < 0.15 * taken_m, "{apart_m} of {taken_m}");
}

#[test]
fn a_scan_has_the_white_level_of_the_first_frame_that_is_fused() {
    let (mut correction, fusion) = scanned(|fusion, depth, time, _| fusion.fuse(depth, time));
    correction.thin_out(&fusion);
    assert!(correction.live.is_some() && !correction.predictions.0.is_empty());
    let camera = CameraModel::new(correction.info.intrinsics);
    let noise = DepthNoise::of_sensor(Sensor::Kinect2);
    let nothing = Fusion::new(camera, noise, FusionParams::default());
    correction.thin_out(&nothing);
    assert!(correction.live.is_none() && correction.predictions.0.is_empty());

    let mut measured = calibration(1.0);
    measured.light.white_level = Some(0.2);
    let (mut correction, _) =
        scanned_with(&measured, |fusion, depth, time, _| fusion.fuse(depth, time));
    correction.thin_out(&nothing);
    assert_eq!(correction.live.map(|white| white.0), Some(0.2));
}

/// A wiggle of 4 mm, as a table over the ranges of the scan and as a sensor has it.
fn wiggle() -> RangeError {
    let points = (20..200).map(|k| 0.01 * f64::from(k));
    RangeError::through(points.map(|r| [r, 0.004 * (20.0 * r).sin()]).collect())
}

/// A frame of a sensor with that wiggle.
fn wiggling(frame: &Frame) -> Frame {
    let points = (20..200).map(|k| 0.01 * f64::from(k));
    let shorter = RangeError::through(points.map(|r| [r, -wiggle().at_m(r)]).collect());
    let rays = RayGrid::new(CameraModel::new(
        SimulatedCamera::kinect2_plaque(1, 7).info().intrinsics,
    ));
    let depth = shorter.corrected(frame.depth.as_ref().expect("a Kinect II"), &rays);
    with_depth(frame, depth)
}

/// Root mean square of how far patches of fused frames lie from what the camera saw, metres, but for a constant and a share of depth.
fn off_m(fusion: &Fusion, truths: &[Image<f32>]) -> f64 {
    let cells = CellGrid::new(truths[0].width(), truths[0].height(), 32);
    let mut apart = Vec::new();
    for (frame, truth) in fusion.keyframes().iter().zip(truths) {
        let seen = frame.depth_m();
        for cell in 0..cells.n_cells() {
            let pixels = cells.square(cell, 1).pixels();
            let both = pixels.map(|(u, v)| (*seen.at(u, v), *truth.at(u, v)));
            let both = both.filter(|(a, b)| *a > 0.0 && *b > 0.0 && (a - b).abs() < 0.02);
            let off: Vec<f64> = both.map(|(a, b)| f64::from(a - b)).collect();
            if off.len() > 200 {
                let far = f64::from(*truth.at(cells.middle(cell).0, cells.middle(cell).1));
                apart.push((far, off.iter().sum::<f64>() / off.len() as f64));
            }
        }
    }
    let n = apart.len() as f64;
    let mean = |value: &dyn Fn(&(f64, f64)) -> f64| apart.iter().map(value).sum::<f64>() / n;
    let (far, off) = (mean(&|(far, _)| *far), mean(&|(_, off)| *off));
    let slope = mean(&|(z, x)| (z - far) * (x - off)) / mean(&|(z, _)| (z - far).powi(2));
    mean(&|(z, x)| (x - off - slope * (z - far)).powi(2)).sqrt()
}

#[test]
fn a_wiggle_is_told_by_the_views_of_a_scan_and_taken_off() {
    const N_VIEWS: usize = 16;
    let frames = rendered(N_VIEWS);
    let camera = SimulatedCamera::kinect2_plaque(N_VIEWS, 7);
    let truths: Vec<Image<f32>> = (0..N_VIEWS).map(|k| camera.true_depth(k)).collect();
    let track =
        |fusion: &mut Fusion, depth: &Image<f32>, time: f64, _: &Pose| fusion.fuse(depth, time);
    let revised = |correction: &DepthCorrection, fusion: &Fusion| {
        let revised = correction.revise(fusion, &|_| true);
        revised.expect("light comes over the table")
    };
    let (correction, fusion) = scanned_as(&frames, &calibration(1.0), Frame::clone, track);
    let without = revised(&correction, &fusion);
    assert_eq!(without.range_error(), None);

    let (correction, fusion) = scanned_as(&frames, &calibration(1.0), wiggling, track);
    let before = off_m(&fusion, &truths);
    let told = revised(&correction, &fusion);
    assert!(
        told.range_error()
            .is_some_and(|error| error.largest_m() > 0.002)
    );
    assert_eq!(told.constant_m(), 0.0, "a wiggle passed for it");
    let said = told.put_right();
    assert!(
        matches!(&said[..], [one] if one.starts_with("depth was up to ") && one.contains(" mm too long or short by turns from 0.")),
        "{said:?}"
    );
    assert!(without.put_right().is_empty());
    let after = off_m(&told.fusion, &truths);
    let best = off_m(&without.fusion, &truths);
    assert!(
        after - best < 0.5 * (before - best),
        "{before} m, {after} m, {best} m"
    );

    let mut known = calibration(1.0);
    known.range_error_m = Some(wiggle());
    let (correction, fusion) = scanned_as(&frames, &known, wiggling, track);
    let live = off_m(&fusion, &truths);
    assert!(
        live - best < 0.3 * (before - best),
        "{before} m, {live} m, {best} m"
    );
    // The scan shows no more of it, and what is known of it stays.
    let measured = correction.measure(&fusion, &|_| true);
    assert_eq!(measured.range_error, Some(wiggle()));

    let none = RangeError::through(vec![[0.5, 0.0], [1.0, 0.0]]);
    known.range_error_m = Some(none.clone());
    let (correction, fusion) = scanned_as(&frames, &known, wiggling, track);
    let told_beside = correction.measure(&fusion, &|_| true).range_error;
    assert!(told_beside.is_some_and(|error| error.largest_m() > 0.002));
    // What is told to end at once has nothing to tell.
    let told_to_end = correction.measure(&fusion, &|_| false);
    assert_eq!(told_to_end.range_error, Some(none));
}

#[test]
fn a_constant_of_the_range_is_told_by_the_views_of_a_scan_and_taken_off() {
    const CONSTANT_M: f64 = 0.02;
    let frames = rendered(16);
    let truths: Vec<Image<f32>> = {
        let camera = SimulatedCamera::kinect2_plaque(frames.len(), 7);
        (0..frames.len()).map(|k| camera.true_depth(k)).collect()
    };
    let longer = RangeError::constant(-CONSTANT_M);
    let deliver = |frame: &Frame| {
        let rays = RayGrid::new(CameraModel::new(
            SimulatedCamera::kinect2_plaque(1, 7).info().intrinsics,
        ));
        let depth = longer.corrected(frame.depth.as_ref().expect("a Kinect II"), &rays);
        with_depth(frame, depth)
    };
    let track =
        |fusion: &mut Fusion, depth: &Image<f32>, time: f64, _: &Pose| fusion.fuse(depth, time);
    let (mut correction, fusion) = scanned_as(&frames, &calibration(1.0), deliver, track);
    let revised = correction.revise(&fusion, &|_| true).expect("it is wrong");
    assert_eq!(revised.wrong_rays(), None);
    let said = revised.put_right();
    assert!(
        matches!(&said[..], [one] if one.starts_with("depth was ") && one.contains(" mm too long at all distances")),
        "{said:?}"
    );
    let told = revised.range_error().expect("a constant");
    assert!(
        (told.at_m(0.8) - CONSTANT_M).abs() < 0.007,
        "{} m",
        told.at_m(0.8)
    );
    // How far depth lies from what was seen, in the mean.
    let off_m = |fusion: &Fusion| {
        let pairs = fusion.keyframes().iter().zip(&truths);
        let mut off = Vec::new();
        for (frame, truth) in pairs {
            let seen = frame.depth_m();
            let pixels = seen.data().iter().zip(truth.data());
            let both = pixels.filter(|(a, b)| **a > 0.0 && **b > 0.0);
            off.extend(both.map(|(a, b)| f64::from(a - b)));
        }
        off.iter().sum::<f64>() / off.len() as f64
    };
    let (before, after) = (off_m(&fusion), off_m(&revised.fusion));
    assert!(
        before > 0.015 && after.abs() < 0.007,
        "{before} m, {after} m"
    );
    correction.fusion.range_error = false;
    let not_asked = correction.revise(&fusion, &|_| true);
    let not_asked = not_asked.expect("light comes over the table");
    assert_eq!(not_asked.range_error(), None);
    correction.fusion.range_error = true;
    // A device of which something is known has that beside it.
    correction.range = Some(RangeError::through(vec![[0.5, 0.001], [1.0, 0.002]]));
    let measured = correction.measure(&fusion, &|_| true);
    assert!((measured.constant_m - CONSTANT_M).abs() < 0.007);
    let both = measured.range_error.expect("both");
    for (range_m, known_m) in [(0.36, 0.001), (0.5, 0.001), (3.0, 0.002)] {
        let off_m = both.at_m(range_m) - known_m - measured.constant_m;
        assert!(off_m.abs() < 1e-9, "{off_m} m at {range_m} m");
    }
}

#[test]
fn a_model_from_which_its_frames_lie_farther_does_not_take_the_place_of_one() {
    let (correction, good) = scanned(Fusion::fuse_at);
    let (_, bad) = scanned(|fusion, depth, time, pose| {
        // Two thirds of the band to and fro, one frame after the other.
        let off_m = [-0.013, 0.013][fusion.n_fused() % 2];
        let along = pose.rotation * Vector3::z() * off_m;
        let off = Translation3::from(along) * pose;
        fusion.fuse_at(depth, time, &off)
    });
    let lies_as_close = |before, after| correction.lies_as_close(before, after, &Known::default());
    assert!(lies_as_close(&bad, &good) && lies_as_close(&good, &good));
    assert!(!lies_as_close(&good, &bad));
}

/// A frame whose decoder took the rays of the image upside down.
fn bent(frame: &Frame) -> Frame {
    let rays = RayGrid::new(CameraModel::new(
        SimulatedCamera::kinect2_plaque(1, 7).info().intrinsics,
    ));
    let bending = RayOrder::upside_down(&rays).undone();
    let depth = frame.depth.as_ref().expect("a Kinect II");
    with_depth(frame, bending.righted(depth))
}

#[test]
fn rays_that_were_upside_down_are_told_by_views_at_given_poses_and_put_right() {
    let frames = rendered(16);
    let camera = SimulatedCamera::kinect2_plaque(frames.len(), 7);
    let truths: Vec<Image<f32>> = (0..frames.len()).map(|k| camera.true_depth(k)).collect();
    let revised = |deliver: fn(&Frame) -> Frame| {
        let (correction, fusion) = scanned_as(&frames, &calibration(1.0), deliver, Fusion::fuse_at);
        let revised = correction.revise(&fusion, &|_| true);
        (fusion, revised.expect("light comes over the table"))
    };
    let (_, right) = revised(Frame::clone);
    assert_eq!((right.wrong_rays(), right.constant_m()), (None, 0.0));
    let (fusion, righted) = revised(bent);
    assert_eq!(righted.wrong_rays(), Some(WrongRays::UpsideDown));
    assert_eq!(righted.put_right(), [WrongRays::UpsideDown.to_string()]);
    assert_eq!(righted.constant_m(), 0.0);
    let before = off_m(&fusion, &truths);
    let (after, best) = (
        off_m(&righted.fusion, &truths),
        off_m(&right.fusion, &truths),
    );
    assert!(
        after - best < 0.2 * (before - best),
        "{before} m, {after} m, {best} m"
    );

    let info = camera.info();
    let params = FusionParams {
        rays_upside_down: true,
        ..FusionParams::default()
    };
    let (correction, fusion) = scanned_by(
        params.clone(),
        &frames,
        &calibration(1.0),
        Frame::clone,
        Fusion::fuse_at,
    );
    let revised = correction.revise(&fusion, &|_| true);
    let wrong = revised.and_then(|revised| revised.wrong_rays());
    assert_eq!(wrong, Some(WrongRays::PutRightInVain));
    let mut knowing = DepthCorrection::new(info, &calibration(1.0), false, &params);
    let frame = knowing.correct(&bent(&frames[0])).expect("it was bent");
    let (straight, seen) = (frame.depth.as_ref(), frames[0].depth.as_ref());
    let (straight, seen) = (straight.expect("a Kinect II"), seen.expect("a Kinect II"));
    for (a, b) in straight.data().iter().zip(seen.data()) {
        assert!((a - b).abs() < 1e-6, "{a} m for {b} m");
    }
}

#[test]
fn a_lens_that_is_not_what_it_is_said_to_be_is_told_by_a_scan_and_put_right() {
    let rays = wavy_wall::rays();
    let truth = rays.camera().intrinsics();
    let said = rays.camera().with_longer_focus([-0.02; 2]);
    let info = CameraInfo {
        intrinsics: *said.intrinsics(),
        ..SimulatedCamera::kinect1_plaque(1, 7).info().clone()
    };
    let params = FusionParams {
        voxel_size_m: 0.004,
        ..FusionParams::default()
    };
    let not_asked = FusionParams {
        focal_length: false,
        ..params.clone()
    };
    let calibration = Calibration::shipped_for(&info).expect("shipped");
    let correction = DepthCorrection::new(&info, &calibration, false, &params);
    let mut fusion = Fusion::new(said, DepthNoise::of_sensor(info.sensor), params);
    // Once round in front of the wall, turned to where it was begun.
    for k in 0..42 {
        let (y, x) = (0.15 * f64::from(k)).sin_cos();
        let turn = increment(&Vector6::new(0.25 * y, -0.25 * x, 0.1 * x, 0.0, 0.0, 0.0));
        let pose = Translation3::new(0.3 * x, 0.3 * y, -0.1 * x) * turn;
        let outcome = fusion.fuse(&wavy_wall::seen(&rays, &pose), f64::from(k) / 30.0);
        assert!(
            matches!(outcome, TrackingOutcome::Tracked { .. }),
            "{k}: {outcome:?}"
        );
    }
    let revised = correction.revise(&fusion, &|_| true).expect("another lens");
    let found = revised.intrinsics().expect("another lens");
    for off in [found.fx / truth.fx - 1.0, found.fy / truth.fy - 1.0] {
        assert!(off.abs() < 0.008, "{found:?}: {off}");
    }
    // One that lies the other way is left, whoever tells of it.
    let fused_by = |known| {
        let (frames, work) = (fusion.keyframes(), Work::CorrectDepth(1));
        correction.fuse_again(frames, &fusion, None, known, work, &|_| true)
    };
    for (longer, is_taken) in [(0.02, true), (-0.02, false)] {
        let lens = Lens::new(said.intrinsics(), [longer; 2]);
        let without = (&fusion, &Known::default());
        let revised = correction.by_closer_lens(without, lens.clone(), 1.0, fused_by);
        assert_eq!(revised.is_some(), is_taken, "{longer}");
        // What a scan that is stopped would be by it is not known.
        let stopped = correction.by_closer_lens(without, lens, 1.0, |_| None);
        assert!(stopped.is_none());
    }
    let correction = DepthCorrection::new(&info, &calibration, false, &not_asked);
    let stays = correction.revise(&fusion, &|_| true);
    assert!(stays.is_none_or(|revised| revised.intrinsics().is_none()));
    let sentences = revised.put_right();
    assert!(
        sentences
            .iter()
            .any(|s| s.contains("% longer") && s.contains(&format!("{:.1}", said.intrinsics().fx))),
        "{sentences:?}"
    );
}
