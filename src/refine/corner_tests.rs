//! Interreflection in a corner: two planes at right angles light one another, summed square by square here.

use super::calibration_trial::CalibrationTrial;
use super::gaze::Gaze;
use super::level::coarsest;
use super::optics::Optics;
use super::params::RefineParams;
use super::preparation::{Preparation, first_views, views_of};
use super::scenes::{FULL_SCALE, calibration, image, optics, whole};
use super::self_calibration::Told;
use super::view::{ImageTrust, View, ViewContext};
use crate::geometry::camera::tests::distorted_camera;
use crate::geometry::{Pose, RayGrid, TriMesh, increment_about};
use crate::interreflection::WhiteLevel;
use crate::shading::{Calibration, Gloss};
use crate::snapshot::ShadingSnapshot;
use nalgebra::{Point3, Vector3, Vector6};
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

/// The corner, lit from a camera.
struct Corner<'a> {
    optics: &'a Optics<'a>,
    camera_from_world: Pose,
    albedo: f64,
}

impl Corner<'_> {
    /// Direct light times albedo.
    fn direct(&self, x: f64, y: f64) -> f64 {
        let (point, normal) = at(x, y);
        let (point, normal) = (
            self.camera_from_world * point,
            self.camera_from_world * normal,
        );
        WHITE.0 * self.albedo * self.optics.light.irradiance(&point, &normal)
    }

    /// What the other plane adds.
    fn bounced(&self, x: f64, y: f64) -> f64 {
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
                self.direct(other_x, other_y) * area * cosines / across.norm_squared().powi(2)
            })
            .sum();
        self.albedo / PI * sum
    }

    /// Where the ray of a pixel, in the camera's frame, meets the planes; `None` beyond what there is of them.
    fn met(&self, ray: &Vector3<f64>) -> Option<Point3<f64>> {
        let world_from_camera = self.camera_from_world.inverse();
        let (origin, ray) = (
            world_from_camera.translation.vector,
            world_from_camera * ray,
        );
        [-1.0, 1.0].into_iter().find_map(|side: f64| {
            let t = (EDGE_M - origin.z - side * origin.x) / (ray.z + side * ray.x);
            let point = Point3::from(origin + t * ray);
            let is_there =
                (0.0..=HALF_M[0]).contains(&(side * point.x)) && point.y.abs() <= HALF_M[1];
            is_there.then_some(point)
        })
    }

    fn snapshot(&self) -> ShadingSnapshot {
        let (mut counts, mut depths) = (Vec::new(), Vec::new());
        for ray in self.optics.rays.rays().data() {
            let [x, y] = ray.map(f64::from);
            let Some(point) = self.met(&Vector3::new(x, y, 1.0)) else {
                counts.push(0.0);
                depths.push(0.0);
                continue;
            };
            let linear = self.direct(point.x, point.y) + self.bounced(point.x, point.y);
            let Calibration {
                flat_field, gamma, ..
            } = self.optics.calibration;
            counts.push((FULL_SCALE * (linear * flat_field.factor(x, y)).powf(*gamma)) as f32);
            depths.push((self.camera_from_world * point).z as f32);
        }
        image(
            self.optics,
            &self.camera_from_world.inverse(),
            counts,
            depths,
        )
    }
}

/// The planes in so many squares along y, and half as many along x on either side.
fn mesh(n: usize) -> TriMesh {
    let [half_x, half_y] = HALF_M;
    let step = |k: usize, half: f64| half * (2.0 * k as f64 / n as f64 - 1.0);
    let index = |i: usize, j: usize| (i * (n + 1) + j) as u32;
    let squares = (0..n).flat_map(|i| (0..n).map(move |j| (i, j)));
    TriMesh {
        vertices: (0..=n)
            .flat_map(|i| (0..=n).map(move |j| (i, j)))
            .map(|(i, j)| at(step(i, half_x), step(j, half_y)).0)
            .collect(),
        faces: squares
            .flat_map(|(i, j)| {
                let [a, b] = [index(i, j), index(i, j + 1)];
                let [c, d] = [index(i + 1, j), index(i + 1, j + 1)];
                [[a, b, c], [c, b, d]]
            })
            .collect(),
    }
}

#[test]
fn brightness_in_a_corner_is_predicted_with_the_light_of_the_other_side() {
    let (rays, calibration) = (RayGrid::new(distorted_camera()), calibration());
    let optics = optics(&rays, &calibration);
    let scene = mesh(2);
    let context = ViewContext {
        scene: &scene,
        centre: Point3::new(0.0, 0.0, EDGE_M),
        radius_m: scene.radius_about(&Point3::new(0.0, 0.0, EDGE_M)),
        optics: &optics,
        trust: &ImageTrust::default(),
        flat: &optics.flat_image(),
        patches: &optics.patch_grid(),
    };
    let corner = Corner {
        optics: &optics,
        camera_from_world: Pose::identity(),
        albedo: REFLECTED,
    };
    let mut view = View::new(&corner.snapshot(), &context);
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

/// Images of a corner from eight sides.
fn snapshots(optics: &Optics, albedo: f64) -> Vec<ShadingSnapshot> {
    let centre = Vector3::new(0.0, 0.0, EDGE_M);
    let from_a_side = |k: i32| {
        let (turn, back_m) = (f64::from(k) * PI / 4.0, 0.02 * f64::from(k % 3));
        let tilt = 0.3 * Vector3::new(turn.cos(), turn.sin(), 0.0);
        let by = Vector6::new(tilt.x, tilt.y, tilt.z, 0.0, 0.0, back_m);
        let corner = Corner {
            optics,
            camera_from_world: increment_about(&centre, &by),
            albedo,
        };
        corner.snapshot()
    };
    (0..8).map(from_a_side).collect()
}

/// Parameters of a coarse mesh, which is fast.
fn params() -> RefineParams {
    RefineParams {
        edge_length_m: 0.003,
        ..RefineParams::default()
    }
}

#[test]
fn indirect_light_by_which_images_held_out_differ_more_is_not_taken() {
    let (rays, calibration) = (RayGrid::new(distorted_camera()), calibration());
    let optics = optics(&rays, &calibration);
    let scene = mesh(80);
    let snapshots = snapshots(&optics, REFLECTED);
    let subject = whole(&scene, &snapshots, &optics);
    let params = params();
    let level = coarsest(&scene, &params).expect("a surface");
    let trial = CalibrationTrial {
        subject: &subject,
        params: &params,
        mesh: &level.mesh,
        asked: first_views(snapshots.len()),
    };
    let views = views_of(&subject, &params);
    let strength_of = |views: &[View]| views[0].white.expect("interreflection").strength();
    // By the factor that is right, what is taken for white here is.
    let right = WHITE.strength() / strength_of(&views);
    let taken = |log_indirect: f64| {
        let told = Told {
            log_indirect,
            ..Told::default()
        };
        let judged = trial.judge_indirect(&told, &level, views.clone());
        (strength_of(&judged) / strength_of(&views)).ln()
    };
    for wrong in [4.0 * right, 0.2 * right] {
        assert_eq!(taken(wrong.ln()), 0.0);
    }
    assert!((taken(0.05) - 0.05).abs() < 1e-9);
}

#[test]
fn a_dark_corner_is_not_taken_for_one_of_plaster() {
    let (rays, calibration) = (RayGrid::new(distorted_camera()), calibration());
    let scene = mesh(80);
    // Plaster reflects twice as much as this.
    let whites = |white_level: Option<f64>| {
        let mut calibration = calibration.clone();
        calibration.light.white_level = white_level;
        let optics = optics(&rays, &calibration);
        let snapshots = snapshots(&optics, 0.3);
        let subject = whole(&scene, &snapshots, &optics);
        let params = params();
        let all = first_views(snapshots.len());
        let prepared = Preparation::new(&subject, &params, all).expect("a surface");
        let (state, _) = prepared.base(&subject, all).expect("visible");
        let view = &state.views[0];
        let plausible = view.plausible_white.expect("bright patches");
        (plausible, view.white.expect("interreflection"))
    };
    let (WhiteLevel(plausible), WhiteLevel(found)) = whites(None);
    let off = |white: f64| (white / WHITE.0).ln().abs();
    assert!(off(plausible) > 0.5, "{plausible}");
    assert!(off(found) < 0.5 * off(plausible), "{found} for {plausible}");
    let (_, measured) = whites(Some(WHITE.0));
    assert_eq!(measured, WHITE);
}
