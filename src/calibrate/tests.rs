//! The estimator on closed forms: a wall at several distances and a sphere without surroundings, of a sensor whose
//! response, lens, lobe and light are known.

use super::gather::{Ambient, Place};
use super::model::{Row, cap_row, intensity_row, limb_row, meet_sphere};
use super::samples::{Cap, LimbPoint, Place as SamplePlace, Sample};
use super::*;
use crate::geometry::{CameraModel, Plane};
use crate::shading::{FlatField, NearLight};
use depth_camera::{Image, Intrinsics};
use nalgebra::{DVector, Point3, Vector3};
use std::cell::Cell;

const FULL_SCALE: f64 = 65_535.0;
const RADIUS_M: f64 = 0.1;

/// The truth about a sensor.
struct Truth {
    gamma: f64,
    lens_power: f64,
    light: NearLight,
    albedo: f64,
}

const TRUTH: Truth = Truth {
    gamma: 0.74,
    lens_power: 2.2,
    light: NearLight {
        position: Point3::new(-0.06, 0.03, 0.01),
        lobe_power: 1.3,
    },
    albedo: 0.14,
};

fn rays() -> RayGrid {
    RayGrid::new(CameraModel::new(Intrinsics {
        width: 240,
        height: 200,
        fx: 180.0,
        fy: 180.0,
        cx: 118.0,
        cy: 101.0,
        k1: 0.03,
        k2: -0.05,
        p1: 0.0,
        p2: 0.0,
        k3: 0.0,
    }))
}

fn sensor(rays: &RayGrid) -> Sensor<'_> {
    Sensor {
        kind: depth_camera::Sensor::Kinect2,
        rays,
        full_scale: FULL_SCALE,
        noise: ImageNoise {
            read: 0.001,
            shot: 2e-5,
        },
    }
}

impl Truth {
    /// Counts of a point, with noise.
    fn counts(
        &self,
        point: &Point3<f64>,
        normal: &Vector3<f64>,
        random: &mut fastrand::Rng,
    ) -> f32 {
        let lens = (point.coords.norm() / point.z).powf(-self.lens_power);
        let linear = self.albedo * lens * self.light.irradiance(point, normal).max(0.0);
        let observed = linear.powf(self.gamma) + 0.002 * (random.f64() - 0.5);
        (observed.clamp(0.0, 1.0) * FULL_SCALE) as f32
    }

    /// An image of what each ray meets.
    fn image(
        &self,
        rays: &RayGrid,
        seed: u64,
        place: Place,
        meet: impl Fn([f64; 2]) -> Option<(Point3<f64>, Vector3<f64>)>,
    ) -> TargetImage {
        let mut random = fastrand::Rng::with_seed(seed);
        let (mut counts, mut depths) = (Vec::new(), Vec::new());
        for ray in rays.rays().data() {
            // Four rays a pixel: limbs are blurred as a sensor blurs them.
            let ray = ray.map(f64::from);
            let step = 0.25 / 180.0;
            let corners = [[-step, -step], [step, -step], [-step, step], [step, step]];
            let seen = corners.map(|[dx, dy]| meet([ray[0] + dx, ray[1] + dy]));
            let of_corner = |hit: &Option<(Point3<f64>, Vector3<f64>)>, random: &mut _| {
                hit.map_or(0.0, |(point, normal)| self.counts(&point, &normal, random))
            };
            counts.push(
                seen.iter()
                    .map(|hit| of_corner(hit, &mut random))
                    .sum::<f32>()
                    / 4.0,
            );
            let depth = meet(ray).map_or(0.0, |(point, _)| point.z + 0.002 * (random.f64() - 0.5));
            depths.push(depth as f32);
        }
        let (width, height) = (rays.rays().width(), rays.rays().height());
        TargetImage {
            frame_id: seed,
            n_exposures: 1,
            ir_counts: Image::from_vec(width, height, counts),
            ambient: None,
            depth_m: Image::from_vec(width, height, depths),
            place,
        }
    }

    fn wall(&self, rays: &RayGrid) -> Scan {
        let images = (0..7).map(|k| {
            let tilt = 0.08 * f64::from(k % 3) - 0.08;
            let plane = Plane {
                normal: Vector3::new(tilt, 0.5 * tilt, -1.0)
                    .try_normalize(0.0)
                    .expect("not zero"),
                offset_m: -0.5 - 0.17 * f64::from(k),
            };
            self.image(rays, k as u64, Place::Wall(plane), |ray| {
                Some((plane.met_by(ray)?, plane.normal))
            })
        });
        Scan {
            name: "wall".to_owned(),
            target: Target::Wall,
            shares: Shares {
                plane: 1.0,
                sphere: 0.0,
            },
            images: images.collect(),
            n_unused: 0,
        }
    }

    /// Spheres whose tracked centres are 3 mm off.
    fn sphere(&self, rays: &RayGrid) -> Scan {
        let images = (0..4).map(|k| {
            let centre = Vector3::new(0.03 * f64::from(k) - 0.04, 0.02, 0.55 + 0.02 * f64::from(k));
            let believed = Point3::from(centre + Vector3::new(0.002, -0.002, 0.001));
            self.image(rays, 100 + k as u64, Place::Sphere(believed), |ray| {
                let at = meet_sphere(ray, &centre, RADIUS_M)?;
                Some((at.point, at.normal))
            })
        });
        Scan {
            name: "sphere".to_owned(),
            target: Target::Sphere(FoundSphere {
                centre_world: Point3::origin(),
                radius_m: 1.03 * RADIUS_M,
                radius_sigma_m: 0.06 * RADIUS_M,
                coverage: 0.8,
            }),
            shares: Shares {
                plane: 0.0,
                sphere: 0.8,
            },
            images: images.collect(),
            n_unused: 0,
        }
    }
}

/// What somebody might believe of that sensor: all of it wrong, the light by 15 mm.
fn priors() -> Priors {
    Priors {
        light: NearLight {
            position: TRUTH.light.position + Vector3::new(0.012, -0.009, 0.0),
            lobe_power: 2.0,
        },
        light_sigma_m: 0.025,
        lobe_sigma: 1.5,
        flat_field: FlatField::CosinePower { power: 0.0 },
    }
}

/// Fits without an end but the fit's own.
fn fit(scans: &mut [Scan], sensor: &Sensor) -> Result<Estimate, Refusal> {
    match estimate(scans, sensor, &priors(), &|| true) {
        Ok(found) => Ok(found),
        Err(NoEstimate::Refused(refusal)) => Err(refusal),
        Err(NoEstimate::Stopped) => panic!("nobody asked for an end"),
    }
}

#[test]
fn a_strange_sensor_is_found_from_sphere_and_wall() {
    let rays = rays();
    let sensor = sensor(&rays);
    let mut scans = [TRUTH.sphere(&rays), TRUTH.wall(&rays)];
    let found = fit(&mut scans, &sensor).expect("plain targets");
    let gamma = found.gamma();
    assert!((gamma.value - TRUTH.gamma).abs() < 0.004, "{gamma:?}");
    assert!(gamma.sigma < 0.004);
    for (axis, measured) in found.light_position().into_iter().enumerate() {
        let off_m = measured.value - TRUTH.light.position[axis];
        assert!(off_m.abs() < 0.004, "axis {axis}: {off_m} m off");
    }
    // Lens and lobe together are what a far wall shows.
    for ray in [[0.5, 0.4], [-0.6, 0.1], [0.2, -0.5]] {
        let radius_squared: f64 = ray.iter().map(|x| x * x).sum();
        let log_cosine = -0.5 * (1.0 + radius_squared).ln();
        let total = found.log_far_field(ray[0], ray[1]).value;
        let truth = (TRUTH.lens_power + TRUTH.light.lobe_power) * log_cosine;
        assert!(
            (total - truth).abs() < 0.015,
            "{total} for {truth} at {ray:?}"
        );
    }
    let radius = found.radius(0).expect("a sphere");
    assert!((radius.value / RADIUS_M - 1.0).abs() < 0.01, "{radius:?}");

    let law = inverse_square(&scans, 1, &sensor, &found).expect("several distances");
    assert!((law.product.value / TRUTH.gamma + 2.0).abs() < 0.02);
    let check = response_check(&scans, 0, &sensor, &found).expect("lit pixels");
    assert!(check.within > 0.99);
}

#[test]
fn an_image_that_does_not_tell_where_its_ball_is_leaves_all_else_known() {
    let rays = rays();
    let fit_to = |sphere: Scan| {
        let mut scans = [sphere, TRUTH.wall(&rays)];
        fit(&mut scans, &sensor(&rays)).expect("plain targets")
    };
    let expected = fit_to(TRUTH.sphere(&rays)).gamma();
    let mut sphere = TRUTH.sphere(&rays);
    let n_images = sphere.images.len();
    // Dark, but for how far away the ball is; and not even that.
    let mut dark = sphere.images[0].clone();
    dark.ir_counts.data_mut().fill(0.0);
    let mut empty = dark.clone();
    empty.depth_m.data_mut().fill(0.0);
    sphere.images.extend([dark, empty]);
    let found = fit_to(sphere);
    let gamma = found.gamma();
    assert!(
        (gamma.value - expected.value).abs() < 0.5 * expected.sigma,
        "{gamma:?} for {expected:?}"
    );
    assert!(
        (gamma.sigma / expected.sigma - 1.0).abs() < 0.2,
        "{gamma:?}"
    );
    let centres = found.state.session_start(0) + 3;
    let (seen, unseen) = found.is_told[centres..][..3 * (n_images + 2)].split_at(3 * n_images);
    assert!(seen.iter().all(|is_told| *is_told));
    assert!(unseen.iter().all(|is_told| !is_told));
}

#[test]
fn the_light_of_the_room_does_not_pass_for_another_response() {
    const AMBIENT: f32 = 0.003;
    let rays = rays();
    let sensor = sensor(&rays);
    let mut wall = TRUTH.wall(&rays);
    let full_scale = FULL_SCALE as f32;
    let observed = |linear: f32| linear.powf(TRUTH.gamma as f32) * full_scale;
    for image in &mut wall.images {
        let linear = |counts: &f32| (counts / full_scale).powf(1.0 / TRUTH.gamma as f32);
        let both = image
            .ir_counts
            .map(|counts| observed(linear(counts) + AMBIENT));
        let unlit = both.map(|_| observed(AMBIENT));
        image.ir_counts = both.clone();
        image.ambient = Some(Ambient { both, unlit });
    }
    let gamma = |wall: &Scan| {
        let mut wall = [wall.clone()];
        let found = fit(&mut wall, &sensor).expect("a plain wall");
        found.gamma().value
    };
    let alone = gamma(&TRUTH.wall(&rays));
    let taken_off = gamma(&wall);
    wall.images
        .iter_mut()
        .for_each(|image| image.ambient = None);
    let left_in = gamma(&wall);
    assert!((taken_off - alone).abs() < 0.004, "{taken_off} for {alone}");
    assert!(left_in < alone - 0.02, "{left_in} for {alone}");
}

#[test]
fn a_textured_wall_is_refused_with_its_deviation() {
    let rays = rays();
    let mut wall = TRUTH.wall(&rays);
    for image in &mut wall.images {
        let width = image.ir_counts.width();
        for (pixel, counts) in image.ir_counts.data_mut().iter_mut().enumerate() {
            let stripe = (pixel % width / 24 + pixel / width / 24) % 2;
            *counts *= 1.0 - 0.3 * stripe as f32;
        }
    }
    let refusal = fit(&mut [wall], &sensor(&rays)).expect_err("stripes");
    let Refusal::Textured {
        deviation, target, ..
    } = refusal
    else {
        panic!("{refusal}");
    };
    assert_eq!(target, "wall");
    assert!(deviation > 0.05);
}

#[test]
fn a_wall_at_one_distance_does_not_test_the_inverse_square_law() {
    let rays = rays();
    let mut wall = TRUTH.wall(&rays);
    wall.images.truncate(2);
    wall.images.extend_from_within(..);
    let sensor = sensor(&rays);
    let found = fit(std::slice::from_mut(&mut wall), &sensor).expect("a plain wall");
    let refusal = inverse_square(&[wall], 0, &sensor, &found).expect_err("0.5 m and 0.67 m");
    assert!(matches!(refusal, Refusal::OneDistance { .. }), "{refusal}");
}

#[test]
fn a_wall_in_few_images_is_refused_with_their_number() {
    let rays = rays();
    let mut wall = TRUTH.wall(&rays);
    wall.images.truncate(3);
    let sensor = sensor(&rays);
    let found = fit(std::slice::from_mut(&mut wall), &sensor).expect("a plain wall");
    let refusal = inverse_square(&[wall], 0, &sensor, &found).expect_err("three images");
    let expected = Refusal::FewImages {
        session: "wall".to_owned(),
        n_images: 3,
        required: 4,
    };
    assert_eq!(refusal, expected);
}

#[test]
fn a_sphere_cut_by_the_frame_is_refused() {
    let rays = rays();
    let mut sphere = TRUTH.sphere(&rays);
    let centre = Vector3::new(0.33, 0.0, 0.55);
    let place = Place::Sphere(Point3::from(centre));
    sphere.images = vec![TRUTH.image(&rays, 7, place, |ray| {
        let at = meet_sphere(ray, &centre, RADIUS_M)?;
        Some((at.point, at.normal))
    })];
    let refusal = fit(&mut [sphere], &sensor(&rays)).expect_err("a cut sphere");
    let Refusal::SphereCut { inside_share, .. } = refusal else {
        panic!("{refusal}");
    };
    assert!(inside_share < 0.9);
}

#[test]
fn a_saturated_sphere_is_refused() {
    let rays = rays();
    let mut sphere = TRUTH.sphere(&rays);
    for image in &mut sphere.images {
        for counts in image.ir_counts.data_mut() {
            *counts = if *counts > 3000.0 {
                FULL_SCALE as f32
            } else {
                *counts
            };
        }
    }
    let refusal = fit(&mut [sphere], &sensor(&rays)).expect_err("no grey pixel");
    let Refusal::Saturated { share, .. } = refusal else {
        panic!("{refusal}");
    };
    assert!(share > 0.5);
}

#[test]
fn a_fit_that_is_told_to_end_makes_no_further_step() {
    let rays = rays();
    let scans = [TRUTH.sphere(&rays), TRUTH.wall(&rays)];
    // How it ends that may make so many steps, and how often it asks.
    let fit_in = |n_steps: usize| {
        let n_asked = Cell::new(0);
        let goes_on = || {
            n_asked.set(n_asked.get() + 1);
            n_asked.get() <= n_steps
        };
        let ended = estimate(&mut scans.clone(), &sensor(&rays), &priors(), &goes_on);
        (ended.err(), n_asked.get())
    };
    let (ended, n_all) = fit_in(usize::MAX);
    assert_eq!(ended, None);
    // The first are those of outlines, the last those of intensities.
    for n_steps in [0, 1, n_all / 2, n_all - 1] {
        assert_eq!(
            fit_in(n_steps),
            (Some(NoEstimate::Stopped), n_steps + 1),
            "{n_steps} of {n_all}"
        );
    }
}

#[test]
fn derivatives_match_central_differences() {
    let rays = rays();
    let scans = [TRUTH.sphere(&rays), TRUTH.wall(&rays)];
    let mut state = State::start(&scans, &sensor(&rays), &priors()).expect("two scans");
    state.gamma = 0.8;
    state.sessions[0].log_albedo = -1.7;
    let wall_point = Point3::new(0.1, -0.07, 0.6);
    let sample = |session, place, interreflected| Sample {
        session,
        image_number: 0,
        tile: 0,
        ray: [0.02, 0.05],
        place,
        log_observed: -1.0,
        sigma: 0.02,
        noise: 0.01,
        interreflected,
    };
    let on_wall = sample(
        1,
        SamplePlace::Wall {
            point: wall_point,
            normal: Vector3::new(0.1, 0.0, -0.995),
        },
        0.0,
    );
    let on_sphere = sample(0, SamplePlace::Sphere { image: 2 }, 0.03);
    let limb = LimbPoint {
        session: 0,
        image: 1,
        direction: Vector3::new(0.17, 0.1, 1.0)
            .try_normalize(0.0)
            .expect("not zero"),
        sigma_rad: 0.001,
    };
    let cap = Cap {
        session: 0,
        image: 3,
        range_m: 0.5,
    };
    type Rows<'a> = Box<dyn Fn(&State, &mut Row) -> Option<()> + 'a>;
    let rows: [Rows; 4] = [
        Box::new(|state, row| intensity_row(&on_wall, state, row)),
        Box::new(|state, row| intensity_row(&on_sphere, state, row)),
        Box::new(|state, row| limb_row(&limb, state, row)),
        Box::new(|state, row| cap_row(&cap, state, row)),
    ];
    for evaluate in rows {
        let mut row = Row::default();
        evaluate(&state, &mut row).expect("lit");
        let mut analytic: DVector<f64> = DVector::zeros(state.n_unknowns());
        for (index, derivative) in &row.entries {
            analytic[*index] += derivative;
        }
        for index in 0..state.n_unknowns() {
            let mut at = |h: f64| {
                let mut step = DVector::zeros(state.n_unknowns());
                step[index] = h;
                evaluate(&state.moved(&step), &mut row).expect("lit");
                row.residual
            };
            let numeric: f64 = (at(1e-6) - at(-1e-6)) / 2e-6;
            let allowed = 1e-6 * (1.0 + analytic.amax());
            assert!(
                (numeric - analytic[index]).abs() < allowed,
                "{index}: {numeric}"
            );
        }
    }
}
