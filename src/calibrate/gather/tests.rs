//! What sessions are taken for, by simulated cameras.

use super::*;
use depth_camera::{DepthCamera, Sensor};
use nalgebra::{Isometry3, Vector3};
use simulated::{Infrared, Scene, Setup, Shape, SimulatedCamera, Solid, Trajectory};
use std::time::{Duration, Instant};

/// What a Kinect II sees of a scene from one place after the other, on the way to a target.
fn gathered(places: &[(&Scene, Point3<f64>)], target: Point3<f64>) -> Result<Scan, Refusal> {
    let mut gatherer: Option<Gatherer> = None;
    for (moment, (scene, eye)) in places.iter().enumerate() {
        let mut camera = SimulatedCamera::new(Setup {
            scene: (*scene).clone(),
            trajectory: Trajectory::still(*eye, target),
            sensor: Sensor::Kinect2,
            infrared: Infrared::of_sensor(Sensor::Kinect2),
            n_moving_frames: 1,
            shading_frames: Vec::new(),
            reduction: 1,
            seed: moment as u64,
        })
        .unwrap();
        let gatherer = gatherer
            .get_or_insert_with(|| Gatherer::new(camera.info(), FusionParams::default()).unwrap());
        let frame = camera.grab(Duration::ZERO).unwrap().unwrap();
        gatherer.observe(&Frame {
            frame_id: moment as u64,
            device_time_secs: moment as f64 / 30.0,
            ..frame
        });
    }
    gatherer.unwrap().finish("scan", BallRadius::Unknown)
}

/// A plane without end, and one with something on it.
fn bare_and_with(shape: Shape, place: Isometry3<f64>) -> [Scene; 2] {
    let half_size = [2.0, 2.0];
    let plane = Solid::new(Shape::Table { half_size }, Isometry3::identity(), 0.7);
    let thing = Solid::new(shape, place, 0.75);
    [vec![plane.clone()], vec![thing, plane]].map(|solids| Scene::new(solids, 0))
}

#[test]
fn a_ball_on_a_table_that_fills_the_image_is_no_wall_whatever_comes_first() {
    let ball = Shape::Sphere { radius: 0.1 };
    let middle = Point3::new(0.0, 0.0, 0.1);
    let [bare, with_ball] = bare_and_with(ball, Isometry3::translation(0.0, 0.0, 0.1));
    let from = |aside_m: f64| middle + Vector3::new(aside_m, -0.35, 0.55);
    let places = [
        (&bare, from(0.0)),
        (&with_ball, from(0.0)),
        (&with_ball, from(0.01)),
        (&with_ball, from(0.02)),
    ];
    let scan = gathered(&places, middle).unwrap();
    assert!(scan.shares.plane > WALL_SHARE, "{}", scan.shares);
    let Target::Sphere(sphere) = scan.target else {
        panic!("{}", scan.shares);
    };
    assert!((sphere.radius_m - 0.1).abs() < 0.006, "{sphere:?}");
    assert_eq!((scan.images.len(), scan.n_unused), (3, 1));
}

#[test]
fn a_ball_of_five_centimetres_before_a_camera_that_moves_is_no_wall() {
    let ball = Shape::Sphere { radius: 0.025 };
    let middle = Point3::new(0.0, 0.0, 0.025);
    let [_, with_ball] = bare_and_with(ball, Isometry3::translation(0.0, 0.0, 0.025));
    // 10 cm from frame to frame.
    let from = |aside_m: f64| middle + Vector3::new(aside_m, -0.35, 0.5);
    let places = [-0.15, -0.05, 0.05, 0.15].map(|aside_m| (&with_ball, from(aside_m)));
    let target = Point3::new(0.05, 0.0, 0.0);
    let scan = gathered(&places, target).unwrap();
    assert!(scan.shares.plane > WALL_SHARE, "{}", scan.shares);
    let Target::Sphere(sphere) = scan.target else {
        panic!("{}", scan.shares);
    };
    assert!((sphere.radius_m - 0.025).abs() < 0.003, "{sphere:?}");
    assert_eq!((scan.images.len(), scan.n_unused), (4, 0));
    for (image, (_, eye)) in scan.images.iter().zip(places) {
        let Place::Sphere(centre) = image.place else {
            panic!("{:?}", image.place);
        };
        // As far away as it is.
        let off_m = centre.coords.norm() - (middle - eye).norm();
        assert!(off_m.abs() < 0.004, "{off_m} m off");
    }
}

#[test]
fn a_wall_with_something_before_it_is_a_wall() {
    let box_shape = Shape::RoundedBox {
        half_size: [0.06, 0.06, 0.06],
        radius: 0.004,
    };
    let [_, with_box] = bare_and_with(box_shape, Isometry3::translation(0.2, 0.1, 0.06));
    let places = [0.8, 0.9].map(|z| (&with_box, Point3::new(0.0, -0.05, z)));
    let scan = gathered(&places, Point3::origin()).unwrap();
    assert_eq!(scan.target, Target::Wall, "{}", scan.shares);
    assert_eq!((scan.images.len(), scan.n_unused), (2, 0));
}

#[test]
fn a_kinect1_that_moves_before_a_wall_under_the_lamp_is_refused() {
    let info = SimulatedCamera::kinect1_plaque(1, 0).info().clone();
    let (width, height) = (info.intrinsics.width, info.intrinsics.height);
    let frame = |frame_id: u64, device_time_secs: f64, depth_m: f32, counts: Option<u16>| Frame {
        frame_id,
        device_time_secs,
        host_time: Instant::now(),
        depth: Some(Image::filled(width, height, depth_m)),
        ir: counts.map(|counts| Image::filled(width, height, counts)),
    };
    // Straight before the wall at 1 m, under the lamp, and what is seen afterwards.
    let scan = |after_secs: f64, after_m: f32| {
        let mut gatherer = Gatherer::new(&info, FusionParams::default()).unwrap();
        gatherer.observe(&frame(0, 0.0, 1.0, None));
        gatherer.observe(&frame(1, 0.5, 0.0, Some(300)));
        gatherer.observe(&frame(2, 0.6, 0.0, Some(300)));
        gatherer.observe(&frame(3, after_secs, after_m, None));
        gatherer.finish("wall", BallRadius::Unknown)
    };
    let still = scan(1.0, 1.0).unwrap();
    assert_eq!((still.target, still.images.len()), (Target::Wall, 1));
    assert!(scan(1.0, 1.005).is_ok());
    let Err(Refusal::NoImages {
        n_unused, reasons, ..
    }) = scan(1.0, 1.02)
    else {
        panic!("not refused for want of images");
    };
    assert_eq!(n_unused, 2);
    let moved = "2 times: not held still: 0.00° and 20.0 mm from before to after";
    assert_eq!(reasons, moved);
    // On the way to the next place: it is too late to tell.
    assert_eq!(scan(2.0, 1.2).unwrap().images.len(), 1);
}

#[test]
fn an_image_without_the_ball_is_none_of_the_ball() {
    let info = SimulatedCamera::kinect2_plaque(1, 0).info().clone();
    let rays = RayGrid::new(CameraModel::new(info.intrinsics));
    let noise = DepthNoise::of_sensor(info.sensor);
    let (width, height) = (info.intrinsics.width, info.intrinsics.height);
    let is_used = |x: f64, z: f64| {
        let snapshot = ShadingSnapshot {
            frame_id: 0,
            device_time_secs: 0.0,
            n_exposures: 1,
            ir_counts: Image::filled(width, height, 1000.0),
            unlit_counts: None,
            depth_m: Image::filled(width, height, 1.0),
            world_from_camera: Pose::identity(),
            moved: None,
        };
        let sphere = FoundSphere {
            centre_world: Point3::new(x, 0.0, z),
            radius_m: 0.1,
            radius_sigma_m: 0.001,
            coverage: 1.0,
        };
        placed(snapshot, Shown::Fused(sphere), &rays, &noise).is_some()
    };
    assert!(is_used(0.0, 0.6));
    assert!(!is_used(0.9, 0.6), "beside the picture");
    assert!(!is_used(0.0, -0.6), "behind the camera");
}
