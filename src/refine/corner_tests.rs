//! Interreflection in a corner: two planes at right angles light one another, summed square by square here.

use super::gaze::Gaze;
use super::optics::Optics;
use super::rounds::radius_about;
use super::scenes::{FULL_SCALE, calibration, optics};
use super::view::{ImageTrust, View, ViewContext};
use crate::geometry::camera::tests::distorted_camera;
use crate::geometry::{Pose, RayGrid, TriMesh};
use crate::interreflection::WhiteLevel;
use crate::shading::Gloss;
use crate::snapshot::ShadingSnapshot;
use depth_camera::Image;
use nalgebra::{Point3, Vector3};
use std::f64::consts::{FRAC_1_SQRT_2, PI};

/// Distance of the corner's edge, metres; it runs along y, and the planes come towards the camera on either side.
const EDGE_M: f64 = 0.7;
/// Half of what there is of the planes along x and y, metres: all of it is in the image, and too little to be a table that goes
/// on beyond it.
const HALF_M: [f64; 2] = [0.12, 0.11];
const WHITE: WhiteLevel = WhiteLevel(0.3);
/// True albedo of both planes.
const REFLECTED: f64 = 0.6;

fn at(x: f64, y: f64) -> (Point3<f64>, Vector3<f64>) {
    let normal = Vector3::new(-x.signum(), 0.0, -1.0) * FRAC_1_SQRT_2;
    (Point3::new(x, y, EDGE_M - x.abs()), normal)
}

/// Direct light times albedo.
fn direct(optics: &Optics, x: f64, y: f64) -> f64 {
    let (point, normal) = at(x, y);
    WHITE.0 * REFLECTED * optics.light.irradiance(&point, &normal)
}

/// What the other plane adds.
fn bounced(optics: &Optics, x: f64, y: f64) -> f64 {
    let (point, normal) = at(x, y);
    let (n, [half_x, half_y]) = (30, HALF_M);
    let (step_x, step_y) = (half_x / f64::from(n), 2.0 * half_y / f64::from(n));
    let area = step_x / FRAC_1_SQRT_2 * step_y;
    let squares = (0..n).flat_map(|i| (0..n).map(move |j| (i, j)));
    let sum: f64 = squares
        .map(|(i, j)| {
            let other_x = -x.signum() * (f64::from(i) + 0.5) * step_x;
            let other_y = (f64::from(j) + 0.5) * step_y - half_y;
            let (other, other_normal) = at(other_x, other_y);
            let across = other - point;
            let cosines = normal.dot(&across) * -other_normal.dot(&across);
            direct(optics, other_x, other_y) * area * cosines / across.norm_squared().powi(2)
        })
        .sum();
    REFLECTED / PI * sum
}

fn snapshot(optics: &Optics) -> ShadingSnapshot {
    let camera = optics.rays.camera().intrinsics();
    let (mut counts, mut depths) = (Vec::new(), Vec::new());
    for ray in optics.rays.rays().data() {
        let [x, y] = ray.map(f64::from);
        let depth = EDGE_M / (1.0 + x.abs());
        let (x_m, y_m) = (x * depth, y * depth);
        if x_m.abs() > HALF_M[0] || y_m.abs() > HALF_M[1] {
            counts.push(0.0);
            depths.push(0.0);
            continue;
        }
        let linear = direct(optics, x_m, y_m) + bounced(optics, x_m, y_m);
        let flat = optics.calibration.flat_field.factor(x, y);
        counts.push((FULL_SCALE * (linear * flat).powf(optics.calibration.gamma)) as f32);
        depths.push(depth as f32);
    }
    ShadingSnapshot {
        frame_id: 0,
        device_time_secs: 0.0,
        n_exposures: 1,
        ir_counts: Image::from_vec(camera.width, camera.height, counts),
        unlit_counts: None,
        depth_m: Image::from_vec(camera.width, camera.height, depths),
        world_from_camera: Pose::identity(),
    }
}

fn mesh() -> TriMesh {
    let [x, y] = HALF_M;
    let corners = [(-x, -y), (-x, y), (0.0, -y), (0.0, y), (x, -y), (x, y)];
    TriMesh {
        vertices: corners.iter().map(|&(x, y)| at(x, y).0).collect(),
        faces: vec![[0, 1, 2], [2, 1, 3], [2, 3, 4], [4, 3, 5]],
    }
}

#[test]
fn brightness_in_a_corner_is_predicted_with_the_light_of_the_other_side() {
    let (rays, calibration) = (RayGrid::new(distorted_camera()), calibration());
    let optics = optics(&rays, &calibration);
    let scene = mesh();
    let context = ViewContext {
        scene: &scene,
        centre: Point3::new(0.0, 0.0, EDGE_M),
        radius_m: radius_about(&scene, &Point3::new(0.0, 0.0, EDGE_M)),
        optics: &optics,
        trust: &ImageTrust::default(),
        flat: &optics.flat_image(),
        patches: &optics.patch_grid(),
    };
    let mut view = View::new(&snapshot(&optics), &context);
    let error = |view: &View, x: f64| {
        let (point, normal) = at(x, 0.01);
        let mut seen = None;
        Gaze::new(view).each(std::iter::once(&point), |_, look| {
            seen = view.sample(look, &normal, &Gloss::default())
        });
        let sample = seen.expect("is seen");
        WHITE.0 * REFLECTED * sample.unit_prediction / sample.look.observed - 1.0
    };
    for x in [-0.08, -0.04, 0.02, 0.06] {
        view.white = None;
        let alone = error(&view, x);
        view.white = Some(WHITE);
        let with = error(&view, x);
        assert!(
            alone < -0.06,
            "{x} m from the edge: {alone} of the light is missing"
        );
        // Patches are coarse beside the edge, and as bright as they are seen, which holds the second bounce too.
        assert!(
            with.abs() < 0.4 * alone.abs(),
            "{x} m from the edge: {with} of the light is wrong, {alone} without"
        );
    }
}
