//! Scenes along which geometry alone lets the camera slide, against the simulated camera's truth.

use crate::fusion::tests::small_params;
use crate::fusion::{
    DepthNoise, Fit, Fusion, FusionParams, InfraredOptics, MODEL_LEVEL, PoseCorrection,
    TrackingOutcome,
};
use crate::geometry::{CameraModel, Motion, Pose, increment, motion_between};
use crate::shading::Calibration;
use depth_camera::{DepthCamera, Frame, Sensor};
use nalgebra::{Point3, Vector6};
use simulated::{Infrared, Orbit, Scene, Setup, SimulatedCamera, Trajectory};
use std::time::Duration;

/// A Kinect II led round a target 0.7 m away, 0.7° a frame.
fn camera(scene: Scene, target: Point3<f64>, n_frames: usize) -> SimulatedCamera {
    let reach = 0.35 * n_frames as f64;
    SimulatedCamera::new(Setup {
        trajectory: Trajectory::Orbit(Orbit {
            target,
            distance_m: 0.7,
            azimuth_rad: reach.to_radians(),
            elevation_rad: 55_f64.to_radians(),
            elevation_swing_rad: 4_f64.to_radians(),
            frames_per_swing: n_frames as f64,
            tremor_rad: 0.1_f64.to_radians(),
        }),
        scene,
        sensor: Sensor::Kinect2,
        infrared: Infrared::of_sensor(Sensor::Kinect2),
        n_moving_frames: n_frames,
        shading_frames: Vec::new(),
        reduction: 1,
        seed: 4,
    })
    .expect("full size")
}

/// What became of a path.
struct Walk {
    n_lost: usize,
    /// From the true to the tracked pose of the last frame that was tracked.
    drift: Motion,
    /// The most that a frame was turned from the true one.
    worst_rad: f64,
    fits: Vec<Fit>,
}

/// An empty model for a camera, which may see its infrared images.
fn fusion(camera: &SimulatedCamera, with_infrared: bool) -> Fusion {
    let info = camera.info().clone();
    let model = CameraModel::new(info.intrinsics);
    let calibration = Calibration::shipped(Sensor::Kinect2).expect("shipped");
    let stated = info.light.expect("Kinect II");
    let optics = InfraredOptics {
        light: calibration.light.near_light(stated.position_m),
        full_scale: info.ir_full_scale.expect("Kinect II"),
        calibration,
    };
    let params = FusionParams {
        // The gate for flat scenes is not what is looked at.
        min_conditioning: 0.0,
        ..small_params()
    };
    let fusion = Fusion::new(model, DepthNoise::of_sensor(Sensor::Kinect2), params);
    match with_infrared {
        true => fusion.with_infrared(model, optics),
        false => fusion,
    }
}

/// What becomes of a camera's path by depth alone, and with its infrared images.
fn walks(mut camera: SimulatedCamera) -> [Walk; 2] {
    let frames = std::iter::from_fn(|| camera.grab(Duration::ZERO).expect("no errors"));
    let frames: Vec<Frame> = frames.collect();
    [false, true].map(|with_infrared| walk(&camera, &frames, with_infrared))
}

fn walk(camera: &SimulatedCamera, frames: &[Frame], with_infrared: bool) -> Walk {
    let mut fusion = fusion(camera, with_infrared);
    let first = camera.true_world_from_camera(0).inverse();
    let (mut n_lost, mut fits, mut drift) = (0, Vec::new(), None);
    let mut worst_rad: f64 = 0.0;
    for (index, frame) in frames.iter().enumerate() {
        fusion.see(frame.ir.as_ref().expect("Kinect II"));
        let depth = frame.depth.as_ref().expect("Kinect II");
        match fusion.fuse(depth, frame.device_time_secs) {
            TrackingOutcome::Tracked {
                world_from_camera,
                fit,
            } => {
                let truth = first * camera.true_world_from_camera(index);
                let apart = motion_between(&truth, &world_from_camera);
                worst_rad = worst_rad.max(apart.rotation_rad);
                drift = Some(apart);
                fits.extend(fit);
            }
            _ => n_lost += 1,
        }
    }
    Walk {
        n_lost,
        drift: drift.expect("the first frame is the world"),
        worst_rad,
        fits,
    }
}

#[test]
fn a_printed_wall_is_tracked_by_its_print() {
    let [bare, held] = walks(camera(Scene::printed_wall(), Point3::origin(), 24));
    assert_eq!((held.n_lost, held.fits.len()), (0, 23));
    // The camera goes 17° and 120 mm; depth alone knows nothing of the part along the wall.
    assert!(bare.drift.translation_m > 0.03, "{:?}", bare.drift);
    assert!(held.drift.translation_m < 0.003, "{:?}", held.drift);
    assert!(held.drift.rotation_rad < 0.003, "{:?}", held.drift);
}

#[test]
fn where_the_geometry_holds_the_camera_no_bit_changes() {
    let [bare, held] = walks(SimulatedCamera::kinect2_plaque(16, 3));
    assert_eq!(bare.fits.len(), 15);
    assert!(!bare.fits.iter().any(Fit::is_sliding));
    assert_eq!(bare.fits, held.fits);
    assert_eq!(bare.drift, held.drift);
}

/// Goes 34° round a solid of revolution on a table, which depth alone lets turn under the camera, by `least_rad` on the way, while
/// by its print no frame turns by more than `most_rad`: half as much again as was measured.
fn check_round(scene: Scene, middle_m: f64, least_rad: f64, most_rad: f64) {
    let [bare, held] = walks(camera(scene, Point3::new(0.0, 0.0, middle_m), 48));
    assert_eq!((held.n_lost, held.fits.len()), (0, 47));
    assert!(bare.worst_rad > least_rad, "{}", bare.worst_rad);
    assert!(held.worst_rad < most_rad, "{}", held.worst_rad);
    // Both say so, but for the first frames.
    for walk in [bare, held] {
        let is_sliding = walk.fits.iter().map(Fit::is_sliding);
        assert!(is_sliding.skip(3).all(|is_sliding| is_sliding));
    }
}

#[test]
fn a_printed_ball_on_a_table_is_tracked_by_its_print() {
    check_round(Scene::printed_ball(), 0.05, 0.5, 0.08);
}

#[test]
fn a_printed_cylinder_on_a_table_is_tracked_by_its_print() {
    check_round(Scene::printed_cylinder(), 0.1, 0.2, 0.14);
}

/// A printed wall as the first of two frames showed it, and the second in hand.
fn before_a_wall() -> (Fusion, [f64; 2]) {
    let mut camera = camera(Scene::printed_wall(), Point3::origin(), 24);
    let mut fusion = fusion(&camera, true);
    let times = std::array::from_fn(|_| {
        let frame = camera
            .grab(Duration::ZERO)
            .expect("no errors")
            .expect("more");
        let (depth, ir) = (
            frame.depth.expect("Kinect II"),
            frame.ir.expect("Kinect II"),
        );
        fusion.see(&ir);
        let outcome = fusion.fuse(&depth, frame.device_time_secs);
        assert!(matches!(outcome, TrackingOutcome::Tracked { .. }));
        fusion.see(&ir);
        frame.device_time_secs
    });
    (fusion, times)
}

#[test]
fn the_key_view_moves_with_the_model_as_it_was_moved_at_its_time() {
    let (before, [first_secs, last_secs]) = before_a_wall();
    let motion = increment(&Vector6::new(0.02, -0.01, 0.03, 0.01, 0.02, -0.015));
    let mut after = before.clone();
    let images = after.infrared.as_mut().expect("with infrared");
    images.correct(&PoseCorrection::of_knots(vec![
        (first_secs, motion),
        (last_secs, Pose::identity()),
    ]));
    let compared = |fusion: &Fusion, pose: &Pose| {
        let images = fusion.infrared.as_ref().expect("with infrared");
        let key = images.key.as_ref().expect("the first frame is kept");
        let linear = images.linear().expect("in hand");
        images.equations(key, &linear, fusion.eye.level(MODEL_LEVEL), pose)
    };
    let pose = before.track.world_from_camera;
    let (as_it_was, moved) = (compared(&before, &pose), compared(&after, &(motion * pose)));
    assert!(as_it_was.n_inliers > super::MIN_PIXELS);
    // Points are kept to 0.1 µm.
    assert!(as_it_was.n_inliers.abs_diff(moved.n_inliers) * 100 < as_it_was.n_inliers);
    let ratio = moved.rmse_m() / as_it_was.rmse_m();
    assert!((ratio - 1.0).abs() < 0.01, "{ratio}");
}

#[test]
fn the_key_view_is_forgotten_only_with_the_frame_that_it_is_of() {
    let (mut fusion, [first_secs, _]) = before_a_wall();
    let images = fusion.infrared.as_mut().expect("with infrared");
    images.forget_after(first_secs);
    assert!(images.key.is_some());
    images.forget_after(first_secs - 0.01);
    assert!(images.key.is_none());
}
