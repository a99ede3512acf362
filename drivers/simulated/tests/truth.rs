//! What the simulated sensors deliver, against the truth.

use std::time::Duration;

use depth_camera::{DepthCamera, Frame, Image, Sensor};
use nalgebra::{Isometry3, Point3};
use simulated::{Infrared, Scene, Setup, Shape, SimulatedCamera, Solid, Trajectory};

fn setup(sensor: Sensor, n_moving_frames: usize, reduction: usize) -> Setup {
    Setup {
        scene: Scene::plaque(),
        trajectory: Trajectory::hand_held(Point3::new(0.0, 0.0, 0.11), 48),
        sensor,
        infrared: Infrared::of_sensor(sensor),
        n_moving_frames,
        shading_frames: Vec::new(),
        reduction,
        seed: 20,
    }
}

fn frames(setup: Setup) -> Vec<Frame> {
    let mut camera = SimulatedCamera::new(setup).expect("a set-up that makes sense");
    std::iter::from_fn(|| camera.grab(Duration::ZERO).expect("never fails")).collect()
}

/// The square of `side` pixels about the middle of an image.
fn middle<T: Copy + Into<f64>>(image: &Image<T>, side: usize) -> Vec<f64> {
    let (left, top) = ((image.width() - side) / 2, (image.height() - side) / 2);
    let rows = (top..top + side).flat_map(|v| &image.row(v)[left..left + side]);
    rows.map(|&value| value.into()).collect()
}

fn mean(values: &[f64]) -> f64 {
    values.iter().sum::<f64>() / values.len() as f64
}

fn deviation(values: &[f64]) -> f64 {
    let mean = mean(values);
    let squares = values.iter().map(|value| (value - mean).powi(2));
    (squares.sum::<f64>() / values.len() as f64).sqrt()
}

#[test]
fn depth_is_unbiased_and_as_noisy_as_the_sensor() {
    // Deviation in the middle of the plaque at about 0.6 m: 1.2 mm head-on and 0.5 mm of fixed pattern, more when tilted;
    // and 0.1 px of 72 px disparity.
    for (sensor, sigma_m) in [
        (Sensor::Kinect2, 1.1e-3..1.8e-3),
        (Sensor::Kinect1, 0.6e-3..1.5e-3),
    ] {
        let setup = setup(sensor, 1, 2);
        let truth = SimulatedCamera::new(setup.clone()).unwrap().true_depth(0);
        let depth = frames(setup).remove(0).depth.unwrap();
        let errors = |found: &[f64], truth: &[f64]| -> Vec<f64> {
            let pairs = found.iter().zip(truth).filter(|(found, _)| **found > 0.0);
            pairs.map(|(found, truth)| found - truth).collect()
        };
        let all = errors(
            &middle(&depth, depth.height()),
            &middle(&truth, depth.height()),
        );
        assert!(all.len() > 20_000, "{} pixels", all.len());
        // Thousands of windows of a few millimetres each.
        assert!(mean(&all).abs() < 0.2e-3, "{sensor:?}: {}", mean(&all));
        let plaque = errors(&middle(&depth, 40), &middle(&truth, 40));
        assert!(plaque.len() == 1600);
        assert!(
            sigma_m.contains(&deviation(&plaque)),
            "{sensor:?}: {}",
            deviation(&plaque)
        );
    }
}

#[test]
fn a_white_wall_seen_head_on_darkens_with_the_square_of_the_distance() {
    let half_size = [2.0, 2.0];
    let wall = Solid::new(Shape::Table { half_size }, Isometry3::identity(), 0.75);
    for sensor in [Sensor::Kinect1, Sensor::Kinect2] {
        let linear = |distance_m: f64| {
            let eye = Point3::new(0.0, 0.0, distance_m);
            let setup = Setup {
                scene: Scene::new(vec![wall.clone()], 0),
                trajectory: Trajectory::still(eye, Point3::origin()),
                shading_frames: match sensor {
                    Sensor::Kinect1 => vec![0],
                    Sensor::Kinect2 => Vec::new(),
                },
                ..setup(sensor, 1, 2)
            };
            let camera = SimulatedCamera::new(setup.clone()).unwrap();
            let ir = frames(setup).pop().and_then(|frame| frame.ir).unwrap();
            let full_scale = camera.info().ir_full_scale.unwrap();
            let [x, y, z] = camera.info().light.unwrap().position_m;
            // Cosine over squared distance, for a light beside the camera: height over cubed distance.
            let height_m = distance_m - z;
            let law = height_m / (x * x + y * y + height_m * height_m).powf(1.5);
            (mean(&middle(&ir, 9)) / full_scale).powf(1.0 / camera.gamma()) / law
        };
        let ratio = linear(1.2) / linear(0.6);
        // 81 pixels of 1 % to 2 % noise.
        assert!((ratio - 1.0).abs() < 0.01, "{sensor:?}: {ratio}");
    }
}

/// A white wall 0.6 m in front of a still Kinect II, and the IR image as shares of full scale.
fn wall_image(infrared: Infrared) -> (SimulatedCamera, Image<f64>) {
    let half_size = [2.0, 2.0];
    let wall = Solid::new(Shape::Table { half_size }, Isometry3::identity(), 0.75);
    let setup = Setup {
        scene: Scene::new(vec![wall], 0),
        trajectory: Trajectory::still(Point3::new(0.0, 0.0, 0.6), Point3::origin()),
        infrared,
        ..setup(Sensor::Kinect2, 1, 4)
    };
    let camera = SimulatedCamera::new(setup.clone()).expect("a set-up that makes sense");
    let ir = frames(setup)
        .remove(0)
        .ir
        .expect("every frame of a Kinect II");
    (camera, ir.map(|&counts| f64::from(counts) / 65535.0))
}

#[test]
fn a_wall_shows_the_lens_about_the_camera_and_the_lobe_about_the_light() {
    let infrared = Infrared {
        gamma: 1.0,
        lens_power: 2.0,
        lobe_power: 4.0,
        light_position_m: [0.15, -0.05, 0.01],
        offset_px: [0.0, 0.0],
    };
    let (camera, image) = wall_image(infrared);
    let lens = camera.info().intrinsics;
    let law = |u: f64, v: f64| {
        // Near the principal point the distortion, below 1 %, moves nothing by more than a pixel.
        let (x, y) = ((u - lens.cx) / lens.fx * 0.6, (v - lens.cy) / lens.fy * 0.6);
        let [lx, ly, lz] = infrared.light_position_m;
        let height_m = 0.6 - lz;
        let squared = (x - lx).powi(2) + (y - ly).powi(2) + height_m * height_m;
        let cos_light = height_m / squared.sqrt();
        let cos_axis = 0.6 / (x * x + y * y + 0.36).sqrt();
        cos_light.powi(5) / squared * cos_axis.powi(2)
    };
    let share = |u0: usize, v0: usize| {
        let pixels = (0..64).map(|k| (u0 + k % 8, v0 + k / 8));
        let ratios = pixels.map(|(u, v)| image.at(u, v) / law(u as f64, v as f64));
        ratios.sum::<f64>() / 64.0
    };
    // Noise of 0.7 % over 64 pixels; a lobe about the camera would be off by 20 % from side to side.
    let middle = share(60, 47);
    for (u, v) in [(20, 47), (100, 47), (60, 10), (60, 85)] {
        let ratio = share(u, v) / middle;
        assert!((ratio - 1.0).abs() < 0.02, "{u}, {v}: {ratio}");
    }
}

#[test]
fn the_content_of_the_infrared_image_lies_where_its_offset_says() {
    let infrared = Infrared::of_sensor(Sensor::Kinect2);
    let shifted = Infrared {
        offset_px: [6.0, 3.0],
        ..infrared
    };
    let ((_, here), (_, there)) = (wall_image(infrared), wall_image(shifted));
    let differences = |du: usize, dv: usize| -> Vec<f64> {
        let pixels = (0..60 * 60).map(|k| (20 + k % 60, 20 + k / 60));
        let pairs = pixels.map(|(u, v)| there.at(u + du, v + dv) - here.at(u, v));
        pairs.collect()
    };
    // Noise of both images, 0.75 % of full scale.
    assert!(mean(&differences(6, 3)).abs() < 5e-4);
    assert!(deviation(&differences(6, 3)) < 0.012);
    assert!(deviation(&differences(0, 0)) > 0.015);
}

#[test]
fn two_runs_are_identical_and_two_seeds_are_not() {
    let run = |seed| {
        let setup = Setup {
            seed,
            ..setup(Sensor::Kinect2, 2, 4)
        };
        let images = frames(setup)
            .into_iter()
            .map(|frame| (frame.depth, frame.ir));
        images.collect::<Vec<_>>()
    };
    assert_eq!(run(1), run(1));
    assert_ne!(run(1), run(2));
    assert_ne!(run(1)[0], run(1)[1]);
}

#[test]
fn a_shading_pose_stands_still_under_the_lamp_between_speckled_frames() {
    let setup = Setup {
        shading_frames: vec![2],
        ..setup(Sensor::Kinect1, 4, 2)
    };
    let camera = SimulatedCamera::new(setup.clone()).unwrap();
    let frames = frames(setup);
    assert_eq!(camera.info().n_frames, Some(8));
    let with_ir: Vec<_> = frames.iter().map(|frame| frame.ir.is_some()).collect();
    assert_eq!(with_ir, [false, true, true, true, true, true, true, false]);
    let empty = |frame: &Frame| {
        let depth = frame.depth.as_ref().unwrap();
        depth.data().iter().all(|&metres| metres == 0.0)
    };
    let covered: Vec<_> = frames.iter().map(empty).collect();
    assert_eq!(
        covered,
        [false, false, false, true, true, true, true, false]
    );
    for frame in 3..7 {
        let held = camera.true_world_from_camera(2);
        assert_eq!(camera.true_world_from_camera(frame), held);
    }
    assert_ne!(
        camera.true_world_from_camera(7),
        camera.true_world_from_camera(2)
    );
    let times = frames.windows(2);
    assert!(
        times
            .into_iter()
            .all(|pair| pair[0].device_time_secs < pair[1].device_time_secs)
    );

    // On the plaque: dots and darkness, against an even light.
    let relative = |frame: &Frame| {
        let patch = middle(frame.ir.as_ref().unwrap(), 40);
        deviation(&patch) / mean(&patch)
    };
    assert!(frames[1..3].iter().all(|frame| relative(frame) > 1.0));
    assert!(frames[3..7].iter().all(|frame| relative(frame) < 0.2));
}

#[test]
fn the_hand_moves_as_slowly_as_a_tracker_needs() {
    for n_frames in [12, 48, 250] {
        let path = Trajectory::hand_held(Point3::new(0.0, 0.0, 0.11), n_frames);
        for frame in 1..n_frames {
            let [before, after] = [frame - 1, frame].map(|frame| path.world_from_camera(frame));
            let motion = before.inverse() * after;
            assert!(motion.translation.vector.norm() < 0.035);
            assert!(motion.rotation.angle() < 3.0_f64.to_radians());
        }
    }
}

#[test]
fn a_setup_that_makes_no_sense_is_refused() {
    let faults: [(Setup, &str); 5] = [
        (setup(Sensor::Kinect2, 1, 0), "reduction is 0"),
        (setup(Sensor::Kinect2, 1, 5), "from 1 to 4"),
        (with_shading(Sensor::Kinect2, vec![0]), "empty for kinect2"),
        (with_shading(Sensor::Kinect1, vec![1, 1]), "must increase"),
        (
            with_shading(Sensor::Kinect1, vec![4]),
            "below n_moving_frames, 4",
        ),
    ];
    for (setup, words) in faults {
        let error = SimulatedCamera::new(setup).map(|_| ()).unwrap_err();
        assert!(error.to_string().contains(words), "{error}");
    }
}

fn with_shading(sensor: Sensor, shading_frames: Vec<usize>) -> Setup {
    Setup {
        shading_frames,
        ..setup(sensor, 4, 4)
    }
}
