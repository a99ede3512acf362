use super::super::scenes::{RippledPlane, calibration, optics, poses, rays, views};
use super::*;
use crate::geometry::Pose;
use crate::geometry::lanes::arch_levels;
use nalgebra::Isometry3;

const RIPPLED: RippledPlane = RippledPlane {
    amplitude_m: 0.0003,
};

/// Points of the plane and beside it, with its normal.
fn points() -> (Lanes3, Lanes3) {
    let (mut points, mut normals) = ([[0.0; LANES]; 3], [[0.0; LANES]; 3]);
    for lane in 0..LANES {
        let x = 0.007 * lane as f64 - 0.05;
        let point = Vector3::new(x, 0.4 * x, 0.6);
        set_lane(&mut points, lane, &point);
        set_lane(&mut normals, lane, &RIPPLED.normal(point.x, point.y));
    }
    (points, normals)
}

/// The same, some of it glossy.
fn surfels() -> Surfels {
    let (points, normals) = points();
    let gloss = |lane: usize| Gloss {
        strength: 0.1 * (lane % 3) as f64,
        power: 20.0,
    };
    Surfels {
        points,
        normals,
        gloss: Some(std::array::from_fn(gloss)),
    }
}

fn view_of(pose: Pose) -> View {
    let (rays, calibration) = (rays(), calibration());
    let optics = optics(&rays, &calibration);
    views(&RIPPLED, &RIPPLED.mesh(0.002), &optics, &[pose]).remove(0)
}

#[test]
fn what_is_shown_is_where_it_projects_and_lit_as_the_light_does() {
    let view = view_of(poses(0.4)[1]);
    let (points, _) = points();
    let looks = Gaze::new(&view).looks(&points);
    let mut n_shown = 0;
    let all = points[0].iter().zip(&points[1]).zip(&points[2]);
    for (lane, ((&x, &y), &z)) in all.enumerate() {
        let point = Point3::from([x, y, z].map(f64::from));
        let at_camera = view.camera_from_world * point;
        let pixel = view.camera().project(&at_camera).expect("in front");
        let Some(look) = looks.get(lane) else {
            assert!(!view.camera().contains(&pixel, 0.0));
            continue;
        };
        assert!((look.pixel - pixel).norm() < 1e-4);
        assert!((look.point_camera - at_camera).norm() < 1e-6);
        let direct = view.light().incident(&at_camera);
        assert!((look.direct - direct).norm() < 1e-5 * direct.norm());
        if let Some((observed, gradient, noise)) = view.linear().sample(pixel.x, pixel.y) {
            n_shown += 1;
            assert!((look.observed - observed).abs() < 1e-5);
            assert!((look.gradient[0] - gradient[0]).abs() < 1e-5);
            assert!(look.sigma >= noise);
        } else {
            assert!(look.observed.is_nan());
        }
    }
    assert!(n_shown > 8, "{n_shown}");
}

#[test]
fn slopes_are_what_points_show_that_have_moved() {
    let view = view_of(poses(0.4)[1]);
    let gaze = Gaze::new(&view);
    let (points, normals) = points();
    let slopes = gaze.weighed(&surfels(), Some(&normals), None).slopes;
    let moved = |by_m: f32| {
        let axes = points.iter().zip(&normals);
        let axes = axes.map(|(p, n)| std::array::from_fn(|lane| p[lane] + by_m * n[lane]));
        let axes: Vec<Lane> = axes.collect();
        gaze.looks(&[axes[0], axes[1], axes[2]])
    };
    // So near that the same four pixels are looked at, and far enough for single precision.
    let (image_m, light_m) = (1e-4, 1e-3);
    let [looks, near, far] = [0.0, image_m, light_m].map(moved);
    let back = [-image_m, -light_m].map(moved);
    let mut n_compared = 0;
    let slopes = slopes.image.iter().zip(&slopes.light).enumerate();
    for (lane, (&of_image, &of_light)) in slopes {
        let shown = [&looks, &near, &far, &back[0], &back[1]].map(|looks| looks.get(lane));
        let [
            Some(look),
            Some(near),
            Some(far),
            Some(near_back),
            Some(far_back),
        ] = shown
        else {
            continue;
        };
        if look.observed.is_nan() || near.observed.is_nan() || near_back.observed.is_nan() {
            continue;
        }
        let n = Vector3::from(normals.map(|axis| f64::from(axis[lane])));
        let n = view.camera_from_world * n;
        let across = |ahead: f64, back: f64, by_m: f32| (ahead - back) / (2.0 * f64::from(by_m));
        let image = across(near.observed, near_back.observed, image_m) / look.sigma;
        let light = across(n.dot(&far.direct), n.dot(&far_back.direct), light_m);
        let light = light * look.gain / look.sigma;
        let [of_image, of_light] = [of_image, of_light].map(f64::from);
        assert!((of_light / light - 1.0).abs() < 0.01, "{of_light} {light}");
        let is_same_cell = near.pixel.map(f64::floor) == near_back.pixel.map(f64::floor);
        if is_same_cell && image.abs() > 1.0 {
            n_compared += 1;
            assert!((of_image / image - 1.0).abs() < 0.02, "{of_image} {image}");
        }
    }
    assert!(n_compared > 5, "{n_compared}");
}

#[test]
fn what_lies_behind_faces_away_or_grazes_is_not_seen() {
    let view = view_of(Isometry3::identity());
    let gaze = Gaze::new(&view);
    let ((points, normals), middle) = (points(), LANES / 2 - 1);
    assert!(gaze.sees(&points, &normals)[middle]);
    let moved = |by: f32| [points[0], points[1], points[2].map(|z| z + by)];
    assert!(gaze.sees(&moved(0.002), &normals)[middle]);
    assert!(!gaze.sees(&moved(0.006), &normals)[middle], "is hidden");
    let turned = normals.map(|axis| axis.map(|x| -x));
    assert_eq!(gaze.sees(&points, &turned), [false; LANES]);
    let slanting = |x: f32, cosine: f32| [[x; LANES], [0.0; LANES], [-cosine; LANES]];
    let is_seen = |x: f32, cosine: f32| gaze.sees(&points, &slanting(x, cosine))[middle];
    assert!(is_seen(1.0, 0.21) && !is_seen(1.0, 0.15), "grazes");
    // The light is aside.
    assert!(
        is_seen(-1.0, 0.3) && !is_seen(-1.0, 0.21),
        "grazes the light's way"
    );
}

#[test]
fn every_instruction_set_gives_the_same_bits() {
    let view = view_of(poses(0.4)[2]);
    let (points, normals) = points();
    let of_arch = |arch| {
        let gaze = Gaze {
            arch,
            ..Gaze::new(&view)
        };
        let weighed = gaze.weighed(&surfels(), Some(&normals), None);
        let Slopes { image, light } = weighed.slopes;
        let mut lanes = vec![weighed.observed, weighed.pixels_per_m2, image, light];
        lanes.extend(weighed.light);
        let bits: Vec<_> = lanes.iter().map(|lane| lane.map(f32::to_bits)).collect();
        (gaze.sees(&points, &normals), bits)
    };
    let levels = arch_levels();
    for &arch in &levels {
        assert_eq!(of_arch(arch), of_arch(levels[0]));
    }
}
