use super::bounce::bounces;
use super::*;
use crate::fusion::{DepthNoise, Fusion, FusionParams};
use crate::geometry::Pose;
use crate::geometry::camera::tests::distorted_camera;
use crate::interreflection::{Lit, Sources};
use depth_camera::Light;
use nalgebra::UnitQuaternion;
use std::time::Instant;

fn lit(point: [f32; 3], normal: [f32; 3], area_m2: f32, radiance: f32, direct: f32) -> Lit {
    Lit {
        point,
        normal,
        area_m2,
        radiance,
        direct,
        light_m: point.iter().map(|x| x * x).sum::<f32>().sqrt(),
    }
}

#[test]
fn a_patch_receives_what_the_form_factor_of_another_says() {
    // Two squares of a right-angled corner, 0.1 m from its edge, seen from the corner's diagonal.
    let receiver = lit([0.0, 0.0, 1.0], [1.0, 0.0, 0.0], 0.0, 0.0, 0.4);
    let source = lit([0.1, 0.0, 1.1], [0.0, 0.0, -1.0], 0.003, 0.5, 0.4);
    let Some(bounce) = bounces(&[Some(receiver)], &Sources::new([source].iter()))[0] else {
        panic!("it receives light");
    };
    // L cosθ cosθ' dA/r² over the direct light; both angles are 45° and r² is 0.02.
    let share = 0.5 * 0.5 * 0.003 / 0.02 / 0.4;
    assert!(
        (bounce.share / share - 1.0).abs() < 1e-5,
        "{}",
        bounce.share
    );
    let longer = source.light_m + 0.02f32.sqrt() - receiver.light_m;
    assert!((bounce.range_m / (0.5 * longer * share) - 1.0).abs() < 1e-5);
}

#[test]
fn patches_that_face_away_send_nothing() {
    let receiver = lit([0.0, 0.0, 1.0], [0.0, 0.0, -1.0], 0.0, 0.0, 1.0);
    let behind = lit([0.1, 0.0, 1.2], [0.0, 0.0, -1.0], 0.01, 1.0, 1.0);
    let turned = lit([0.1, 0.0, 0.8], [0.0, 0.0, -1.0], 0.01, 1.0, 1.0);
    assert_eq!(
        bounces(&[Some(receiver)], &Sources::new([behind, turned].iter()))[0],
        Some(Default::default())
    );
}

fn unit(vector: Vector3<f64>) -> Vector3<f64> {
    vector.try_normalize(0.0).expect("not zero")
}

/// A white ball of 0.1 m on a table, seen by a Kinect II that sees no multipath.
struct Scene {
    info: CameraInfo,
    calibration: Calibration,
}

const RADIUS_M: f64 = 0.1;
const ALBEDO: f64 = 0.6;
const WHITE: WhiteLevel = WhiteLevel(0.3);

impl Scene {
    fn new() -> Self {
        let info = CameraInfo {
            sensor: Sensor::Kinect2,
            serial: "ball".to_owned(),
            driver: None,
            intrinsics: *distorted_camera().intrinsics(),
            ir_full_scale: Some(65535.0),
            ir_gain: None,
            light: Some(Light {
                position_m: [0.05, 0.0, 0.0],
                kind: LightKind::Emitter,
            }),
            n_frames: None,
        };
        let calibration = Calibration::shipped(Sensor::Kinect2).expect("shipped");
        Scene { info, calibration }
    }

    /// Cameras round the ball, 35° above the table, 0.6 m away; the world's origin is the ball's foot, z is up.
    fn poses() -> Vec<Pose> {
        (0..10)
            .map(|k| {
                let turn = UnitQuaternion::from_axis_angle(&Vector3::z_axis(), 0.15 * f64::from(k));
                let eye = turn * Vector3::new(0.5, 0.0, 0.1 + 0.035 * f64::from(k));
                let forward = unit(Vector3::new(0.0, 0.0, 0.06) - eye);
                let right = unit(forward.cross(&Vector3::z()));
                let axes =
                    nalgebra::Matrix3::from_columns(&[right, forward.cross(&right), forward]);
                let rotation = nalgebra::Rotation3::from_matrix_unchecked(axes);
                Pose::from_parts(eye.into(), UnitQuaternion::from_rotation_matrix(&rotation))
            })
            .collect()
    }

    fn frame(&self, world_from_camera: &Pose) -> Frame {
        let rays = RayGrid::new(distorted_camera());
        let light = self
            .calibration
            .light
            .near_light(self.info.light.expect("given").position_m);
        let (mut depth, mut ir) = (Vec::new(), Vec::new());
        for &[x, y] in rays.rays().data() {
            let ray = Vector3::new(f64::from(x), f64::from(y), 1.0);
            let direction = world_from_camera.rotation * ray;
            let seen = hit(&world_from_camera.translation.vector, &direction);
            let Some((z, normal)) = seen.filter(|(z, _)| *z < 1.5) else {
                depth.push(0.0);
                ir.push(0);
                continue;
            };
            let point = Point3::from(ray * z);
            let normal = world_from_camera.rotation.inverse() * normal;
            let lit = WHITE.0 * ALBEDO * light.irradiance(&point, &normal).max(0.0);
            let lit = lit * self.calibration.flat_field.factor(ray.x, ray.y);
            depth.push(z as f32);
            ir.push((65535.0 * lit.min(1.0).powf(self.calibration.gamma)) as u16);
        }
        Frame {
            frame_id: 0,
            device_time_secs: 0.0,
            host_time: Instant::now(),
            depth: Some(Image::from_vec(512, 424, depth)),
            ir: Some(Image::from_vec(512, 424, ir)),
        }
    }
}

/// Normals of the ball and the table near points of the camera frame.
fn true_normals(world_from_camera: &Pose) -> impl Fn(&Point3<f64>) -> Option<Vector3<f64>> + Sync {
    let pose = *world_from_camera;
    move |point| {
        let ball = pose * point - Point3::new(0.0, 0.0, RADIUS_M);
        let normal = if ball.norm() < 1.05 * RADIUS_M {
            unit(ball)
        } else {
            Vector3::z()
        };
        Some(pose.rotation.inverse() * normal)
    }
}

/// Depth and normal of the ball or the table along a ray.
fn hit(eye: &Vector3<f64>, direction: &Vector3<f64>) -> Option<(f64, Vector3<f64>)> {
    let centre = Vector3::new(0.0, 0.0, RADIUS_M);
    let (a, b) = (direction.norm_squared(), direction.dot(&(eye - centre)));
    let root = b * b - a * ((eye - centre).norm_squared() - RADIUS_M * RADIUS_M);
    if root > 0.0 {
        let z = (-b - root.sqrt()) / a;
        return Some((z, (eye + direction * z - centre) / RADIUS_M));
    }
    let z = -eye.z / direction.z;
    (z > 0.0).then_some((z, Vector3::z()))
}

#[test]
fn the_foot_of_a_ball_looks_farther_away_than_its_top_and_correction_undoes_itself() {
    let scene = Scene::new();
    let multipath = Multipath::new(&scene.info, &scene.calibration).expect("time of flight");
    let frame = scene.frame(&Scene::poses()[5]);
    let prediction = multipath.predict(&frame).expect("much is seen");
    // The ball's own albedo is the brightest there is.
    assert!(
        (prediction.plausible_white.0 / WHITE.0 - 1.0).abs() < 0.1,
        "{prediction:?}"
    );
    let depth = frame.depth.as_ref().expect("given");
    let longer = multipath.corrected(depth, &prediction.bias, Some(WHITE), None);
    let bias_at = |world: Vector3<f64>| {
        let point = Scene::poses()[5].inverse() * Point3::from(world);
        let pixel = distorted_camera().project(&point).expect("in the image");
        let (u, v) = (pixel.x.round() as usize, pixel.y.round() as usize);
        longer.at(u, v) - depth.at(u, v)
    };
    let towards = Scene::poses()[5].translation.vector.xy();
    let towards = towards * (0.1 / towards.norm());
    let (top, side) = (
        bias_at(Vector3::new(0.0, 0.0, 0.199)),
        bias_at(Vector3::new(0.9 * towards.x, 0.9 * towards.y, 0.055)),
    );
    assert!(top < 1e-3 && side > 3e-3, "top {top}, side {side}");
    let again = multipath.corrected(&longer, &prediction.bias, None, Some(WHITE));
    for (a, b) in again.data().iter().zip(depth.data()) {
        assert!((a - b).abs() < 1e-6);
    }
}

#[test]
fn on_a_known_surface_the_slanting_side_of_a_ball_is_predicted_as_by_dense_patches() {
    let scene = Scene::new();
    let multipath = Multipath::new(&scene.info, &scene.calibration).expect("time of flight");
    let pose = Scene::poses()[5];
    let (eye, to_camera) = (pose.translation.vector, pose.inverse());
    let frame = scene.frame(&pose);
    let depth = frame.depth.as_ref().expect("given");
    let prediction = multipath.predict(&frame).expect("much is seen");
    let lit = |world: Vector3<f64>, normal: Vector3<f64>, area_m2: f64| {
        let (point, normal) = (to_camera * Point3::from(world), to_camera * normal);
        let patch = multipath.grid.lit(&point, &normal, area_m2, 0.0)?;
        let radiance = WHITE.0 as f32 * ALBEDO as f32 * patch.direct;
        Some(Lit { radiance, ..patch })
    };
    // The table in squares of a centimetre, where the ball does not stand before it.
    let steps = || (-70..70).map(|k| 0.01 * (f64::from(k) + 0.5));
    let squares = steps().flat_map(|x| steps().map(move |y| Vector3::new(x, y, 0.0)));
    let is_seen =
        |square: &Vector3<f64>| hit(&eye, &(square - eye)).is_some_and(|(reach, _)| reach > 0.999);
    let table = squares.filter(is_seen);
    let table: Vec<Lit> = table
        .filter_map(|square| lit(square, Vector3::z(), 1e-4))
        .collect();
    let dense = Sources::new(table.iter());

    let on_model = multipath.predict_on(depth, &prediction, true, true_normals(&pose));
    let rays = RayGrid::new(distorted_camera());
    let longer = [&prediction.bias, &on_model]
        .map(|bias| multipath.corrected(depth, bias, Some(WHITE), None));
    let mut errors = [Vec::new(), Vec::new()];
    for (u, v) in (100..324)
        .step_by(3)
        .flat_map(|v| (100..412).step_by(3).map(move |u| (u, v)))
    {
        let ray: Vector3<f64> = rays.direction(u, v).cast();
        let Some((z, normal)) = hit(&eye, &(pose * ray)) else {
            continue;
        };
        let point = eye + (pose * ray) * z;
        let cosine = normal.dot(&unit(eye - point));
        if point.z < 0.02 || !(0.25..0.6).contains(&cosine) {
            continue;
        }
        let receiver = lit(point, normal, 0.0).expect("before the light");
        let expected = bounces(&[Some(receiver)], &dense)[0]
            .expect("lit")
            .bias_m(Some(WHITE));
        if expected < 2e-3 {
            continue;
        }
        for (errors, longer) in errors.iter_mut().zip(&longer) {
            let found = (longer.at(u, v) - depth.at(u, v)) * ray.norm() as f32;
            errors.push((found / expected - 1.0).abs());
        }
    }
    let [by_patches, on_model] = errors.map(|mut errors| {
        assert!(errors.len() > 100, "{}", errors.len());
        errors.sort_by(f32::total_cmp);
        errors[errors.len() / 2]
    });
    assert!(
        on_model < 0.1 && by_patches > 2.0 * on_model,
        "on the model {on_model}, by patches {by_patches}"
    );
}

#[test]
fn a_place_that_is_darker_than_the_model_makes_it_has_more_bias_if_its_own_image_says_so() {
    let scene = Scene::new();
    let multipath = Multipath::new(&scene.info, &scene.calibration).expect("time of flight");
    let pose = Scene::poses()[5];
    let mut frame = scene.frame(&pose);
    let ir = frame.ir.as_mut().expect("given");
    // One place, on the ball's front.
    let (u, v, dimmed) = (256, 216, 0.8f64);
    let counts = (0..424usize).flat_map(|y| (0..512usize).map(move |x| (x, y)));
    let counts = counts.map(|(x, y)| {
        let is_dimmed = (u..u + 4).contains(&x) && (v..v + 4).contains(&y);
        let factor = if is_dimmed { dimmed } else { 1.0 };
        (f64::from(*ir.at(x, y)) * factor.powf(scene.calibration.gamma)) as u16
    });
    *ir = Image::from_vec(512, 424, counts.collect());
    let depth = frame.depth.as_ref().expect("given");
    let prediction = multipath.predict(&frame).expect("much is seen");
    let normal_at = true_normals(&pose);
    let bias = |is_its_own| multipath.predict_on(depth, &prediction, is_its_own, &normal_at);
    let cell = bias(true).cells().cell_of((u, v)).expect("on the image");
    let [own, other] = [true, false].map(|is_its_own| {
        let bias = bias(is_its_own);
        bias.measured(cell).expect("on the ball").range_m
    });
    // Of 25 places one is darker, which dims what they are compared with.
    let expected = (24.0 + dimmed) / 25.0 / dimmed;
    assert!(
        (f64::from(own / other) / expected - 1.0).abs() < 0.02,
        "{own}, {other}"
    );
}

#[test]
fn views_of_a_biased_scan_tell_that_there_is_multipath_and_corrected_ones_that_there_is_none() {
    let scene = Scene::new();
    let multipath = Multipath::new(&scene.info, &scene.calibration).expect("time of flight");
    let params = FusionParams {
        voxel_size_m: 0.004,
        min_surface_weight: 0.0,
        ..FusionParams::default()
    };
    let noise = DepthNoise::of_sensor(Sensor::Kinect2);
    let poses = Scene::poses();
    let seen: Vec<_> = poses
        .iter()
        .map(|pose| {
            let frame = scene.frame(pose);
            let bias = multipath.predict(&frame).expect("much is seen").bias;
            let depth = frame.depth.expect("given");
            (multipath.corrected(&depth, &bias, Some(WHITE), None), bias)
        })
        .collect();
    let slope = |white: Option<WhiteLevel>| {
        let mut fusion = Fusion::new(distorted_camera(), noise, params.clone());
        let depths: Vec<Image<f32>> = seen
            .iter()
            .map(|(depth, bias)| multipath.corrected(depth, bias, None, white))
            .collect();
        for (index, (depth, pose)) in depths.iter().zip(&poses).enumerate() {
            fusion.fuse_at(depth, index as f64, pose);
        }
        let views: Vec<Seen> = depths
            .iter()
            .zip(&poses)
            .zip(&seen)
            .map(|((depth_m, world_from_camera), (_, bias))| Seen {
                depth_m,
                world_from_camera,
                bias,
            })
            .collect();
        let evidence = multipath.evidence(&views, white, |point| fusion.signed_distance(point));
        evidence.expect("views overlap").slope
    };
    let truth = strength(Some(WHITE));
    let (without, right, twice) = (
        slope(None),
        slope(Some(WHITE)),
        slope(Some(WhiteLevel(0.15))),
    );
    assert!(without > 0.3 * truth, "{without} of {truth}");
    assert!(right.abs() < 0.1 * truth, "{right} of {truth}");
    assert!(twice < -0.3 * truth, "{twice} of {truth}");
}

#[test]
fn only_time_of_flight_with_its_own_light_has_multipath() {
    let scene = Scene::new();
    let other = CameraInfo {
        sensor: Sensor::Kinect1,
        ..scene.info.clone()
    };
    assert!(Multipath::new(&other, &scene.calibration).is_none());
    let dark = CameraInfo {
        light: None,
        ..scene.info.clone()
    };
    assert!(Multipath::new(&dark, &scene.calibration).is_none());
}

#[test]
fn a_prediction_by_a_wrong_response_becomes_that_of_the_right_one() {
    let scene = Scene::new();
    let wrong = Calibration {
        gamma: 1.3 * scene.calibration.gamma,
        ..scene.calibration.clone()
    };
    let frame = scene.frame(&Scene::poses()[0]);
    let by = |calibration| Multipath::new(&scene.info, calibration).expect("time of flight");
    let (wrong, right) = (by(&wrong), by(&scene.calibration));
    let expected = right.predict(&frame).expect("it shows light");
    let mut prediction = wrong.predict(&frame).expect("it shows light");
    wrong.recalibrate(&mut prediction, &right);
    let (found, right_ones) = (&prediction.radiances, &expected.radiances);
    for (found, expected) in [
        (&found.patches, &right_ones.patches),
        (&found.places, &right_ones.places),
    ] {
        assert_eq!(found.len(), expected.len());
        let pairs = found.iter().zip(expected);
        let bright = pairs.filter(|(_, expected)| **expected > 0.02);
        let mut errors: Vec<f64> = bright
            .map(|(a, b)| f64::from((a / b - 1.0).abs()))
            .collect();
        assert!(errors.len() > 100);
        // What holds a border of the ball is off by more.
        assert!(crate::robust::median(&mut errors) < Some(1e-3));
    }
    let depth = frame.depth.as_ref().expect("given");
    let WhiteLevel(white) = right.plausible_white(depth, &prediction).expect("seen");
    assert!((white / expected.plausible_white.0 - 1.0).abs() < 0.01);
}
