//! What is compared with the model: intensities of walls and spheres, limbs and caps.

use super::Sensor;
use super::gather::{Place as TargetPlace, Scan, TargetImage};
use super::interreflection::Surroundings;
use super::model::{SpherePoint, log_linear, meet_sphere};
use super::outline::{measure_cap, measure_limb};
use super::plane::{ON_PLANE_SIGMAS, residual_sigmas};
use super::state::State;
use crate::fusion::DepthNoise;
use crate::geometry::Plane;
use crate::shading::SATURATION;
use nalgebra::{Point3, Vector3};
use rayon::prelude::*;

/// One observed intensity.
#[derive(Clone, Copy, Debug)]
pub struct Sample {
    /// Session it belongs to.
    pub session: usize,
    /// Image it belongs to, counted over all sessions.
    pub image_number: usize,
    /// Tile of an image: residuals within one are taken for correlated.
    pub tile: usize,
    /// Its ray (X/Z, Y/Z).
    pub ray: [f64; 2],
    /// What the ray meets.
    pub place: Place,
    /// Logarithm of the observed share of full scale.
    pub log_observed: f64,
    /// Standard deviation of that.
    pub sigma: f64,
    /// Part of `sigma` that is the sensor's noise.
    pub noise: f64,
    /// Linear intensity that a perfectly white surface here would send back of its surroundings' light.
    pub interreflected: f64,
}

/// What a sample lies on.
#[derive(Clone, Copy, Debug)]
pub enum Place {
    /// A wall: known for good.
    Wall {
        /// Camera frame, metres.
        point: Point3<f64>,
        /// Unit normal towards the camera.
        normal: Vector3<f64>,
    },
    /// The session's sphere as it is in one of its images.
    Sphere {
        /// Which image.
        image: usize,
    },
}

/// A point of a sphere's outline.
#[derive(Clone, Copy, Debug)]
pub struct LimbPoint {
    /// Session it belongs to.
    pub session: usize,
    /// Image of that session.
    pub image: usize,
    /// Unit direction in the camera frame.
    pub direction: Vector3<f64>,
    /// Standard deviation across the outline, radians.
    pub sigma_rad: f64,
}

/// Distance of a sphere's nearest point.
#[derive(Clone, Copy, Debug)]
pub struct Cap {
    /// Session it belongs to.
    pub session: usize,
    /// Image of that session.
    pub image: usize,
    /// From the camera, metres.
    pub range_m: f64,
}

/// All that is compared with the model.
#[derive(Clone, Debug, Default)]
pub struct Samples {
    /// Intensities.
    pub intensities: Vec<Sample>,
    /// Outlines.
    pub limbs: Vec<LimbPoint>,
    /// Ranges.
    pub caps: Vec<Cap>,
}

/// Walls are averaged over squares of this side, pixels.
const WALL_CELL: usize = 8;
/// Tiles of an image are squares of this side, pixels.
const TILE_PX: usize = 64;
/// Spheres are sampled at every so many pixels, on each axis.
pub const SPHERE_STRIDE: usize = 2;
/// Darker than this many standard deviations of read noise is not looked at: the logarithm would be bent.
const MIN_READ_SIGMAS: f64 = 8.0;
/// Grazing light and grazing views are not looked at: 75°.
const MIN_COSINE: f64 = 0.25;
/// How far Eq. (1) is believed, as a share of the intensity.
const MODEL_ERROR: f64 = 0.01;
/// Where a pixel of a sphere falls is known within this, metres; it turns the normal.
const REGISTRATION_M: f64 = 0.0002;
/// How far interreflection is known, as a share of it: what lies beyond the image is missing.
const INTERREFLECTION_ERROR: f64 = 0.4;
/// Where more than this share of the light is interreflected, the sphere is masked.
pub const MAX_INTERREFLECTED: f64 = 0.06;

impl Samples {
    /// Everything, with masks, interreflection and limbs as the state predicts them.
    pub fn gather(scans: &[Scan], sensor: &Sensor, state: &State) -> Self {
        let mut samples = Samples::outlines(scans, sensor, state);
        let images = all_images(scans);
        let found: Vec<Vec<Sample>> = images
            .par_iter()
            .enumerate()
            .map(|(number, &(session, image, shown))| match shown.place {
                TargetPlace::Wall(plane) => wall_samples(session, number, shown, &plane, sensor),
                TargetPlace::Sphere(_) => {
                    let all = sphere_samples([session, image, number], shown, sensor, state);
                    all.into_iter()
                        .filter_map(|sample| unmasked(sample, state))
                        .collect()
                }
            })
            .collect();
        samples.intensities = found.concat();
        samples
    }

    /// Limbs and caps alone.
    pub fn outlines(scans: &[Scan], sensor: &Sensor, state: &State) -> Self {
        let spheres: Vec<_> = all_images(scans)
            .into_iter()
            .filter(|(session, ..)| state.sessions[*session].sphere.is_some())
            .collect();
        let found: Vec<(Vec<LimbPoint>, Option<Cap>)> = spheres
            .par_iter()
            .map(|&(session, image, shown)| {
                let limb = measure_limb(shown, sensor, state, session, image);
                let cap = measure_cap(shown, sensor, state, session, image);
                (limb.points, cap)
            })
            .collect();
        let mut samples = Samples::default();
        for (points, cap) in found {
            samples.limbs.extend(points);
            samples.caps.extend(cap);
        }
        samples
    }
}

/// The intensities of a session's wall.
pub fn wall_intensities(scan: &Scan, session: usize, sensor: &Sensor) -> Vec<Sample> {
    let images = scan.images.iter().enumerate();
    images
        .filter_map(|(number, shown)| match shown.place {
            TargetPlace::Wall(plane) => Some(wall_samples(session, number, shown, &plane, sensor)),
            TargetPlace::Sphere(_) => None,
        })
        .flatten()
        .collect()
}

/// The sample, trusted as far as its interreflection is known; `None` where that is too much.
fn unmasked(sample: Sample, state: &State) -> Option<Sample> {
    let (_, share) = log_linear(&sample, state)?;
    (share < MAX_INTERREFLECTED).then(|| Sample {
        sigma: sample.sigma.hypot(INTERREFLECTION_ERROR * share),
        ..sample
    })
}

/// Session, number within it, and image, of all scans.
fn all_images(scans: &[Scan]) -> Vec<(usize, usize, &TargetImage)> {
    let of_scan = |(session, scan): (usize, &'_ Scan)| (session, scan.images.len());
    let counts: Vec<_> = scans.iter().enumerate().map(of_scan).collect();
    let numbered = counts
        .into_iter()
        .flat_map(|(session, n)| (0..n).map(move |i| (session, i)));
    numbered
        .map(|(session, i)| (session, i, &scans[session].images[i]))
        .collect()
}

/// The tile of a pixel among those of all images.
fn tile_of(number: usize, u: usize, v: usize) -> usize {
    const PER_ROW: usize = 64;
    (number * PER_ROW + v / TILE_PX) * PER_ROW + u / TILE_PX
}

/// Relative noise of an observed share of full scale, over `n` values averaged.
fn relative_noise(sensor: &Sensor, observed: f64, n: usize) -> f64 {
    sensor.noise.sigma(observed) / (observed * (n as f64).sqrt())
}

fn sigma_of(noise: f64, registration: f64) -> f64 {
    (noise * noise + MODEL_ERROR * MODEL_ERROR + registration * registration).sqrt()
}

/// Means of the cells of a wall that are whole, lit and on its plane.
fn wall_samples(
    session: usize,
    number: usize,
    shown: &TargetImage,
    plane: &Plane,
    sensor: &Sensor,
) -> Vec<Sample> {
    let (width, height) = (shown.ir_counts.width(), shown.ir_counts.height());
    let cells = (0..height / WALL_CELL)
        .flat_map(|row| (0..width / WALL_CELL).map(move |column| (column, row)));
    cells
        .filter_map(|(column, row)| {
            let (u0, v0) = (column * WALL_CELL, row * WALL_CELL);
            let (observed, ray) = wall_cell(shown, plane, sensor, u0, v0)?;
            let noise = relative_noise(sensor, observed, WALL_CELL * WALL_CELL * shown.n_exposures);
            Some(Sample {
                session,
                image_number: number,
                tile: tile_of(number, u0, v0),
                ray,
                place: Place::Wall {
                    point: plane.met_by(ray)?,
                    normal: plane.normal,
                },
                log_observed: observed.ln(),
                sigma: sigma_of(noise, 0.0),
                noise,
                interreflected: 0.0,
            })
        })
        .collect()
}

/// Mean share of full scale of a cell and the ray of its middle.
fn wall_cell(
    shown: &TargetImage,
    plane: &Plane,
    sensor: &Sensor,
    u0: usize,
    v0: usize,
) -> Option<(f64, [f64; 2])> {
    let noise = DepthNoise::of_sensor(sensor.kind);
    let (mut sum, mut ray, mut n_off, mut n_depth) = (0.0, [0.0; 2], 0, 0);
    for v in v0..v0 + WALL_CELL {
        for u in u0..u0 + WALL_CELL {
            let counts = f64::from(*shown.ir_counts.at(u, v));
            if counts >= SATURATION * sensor.full_scale {
                return None;
            }
            let [x, y] = sensor.rays.rays().at(u, v).map(f64::from);
            let z = *shown.depth_m.at(u, v);
            if z > 0.0 {
                n_depth += 1;
                let off_sigmas = residual_sigmas(plane, [x, y], z, &noise).abs();
                n_off += usize::from(off_sigmas > ON_PLANE_SIGMAS);
            }
            sum += counts;
            ray[0] += x;
            ray[1] += y;
        }
    }
    let n = (WALL_CELL * WALL_CELL) as f64;
    let observed = sum / n / sensor.full_scale;
    let is_lit = observed > MIN_READ_SIGMAS * sensor.noise.read / n.sqrt();
    let usable = is_lit && 2 * n_off <= n_depth && ray[0].is_finite();
    usable.then(|| (observed, ray.map(|sum| sum / n)))
}

/// Pixels of a sphere that camera and light both see well, masked or not; `of` is session, image and running number.
pub fn sphere_samples(
    [session, image, number]: [usize; 3],
    shown: &TargetImage,
    sensor: &Sensor,
    state: &State,
) -> Vec<Sample> {
    let Some(sphere) = state.sessions[session].sphere.as_ref() else {
        return Vec::new();
    };
    let (centre, radius_m) = (&sphere.centres[image], sphere.radius_m);
    let surroundings = Surroundings::new(shown, sensor, state, centre, radius_m);
    let pixels = (0..shown.ir_counts.height())
        .step_by(SPHERE_STRIDE)
        .flat_map(|v| {
            (0..shown.ir_counts.width())
                .step_by(SPHERE_STRIDE)
                .map(move |u| (u, v))
        });
    pixels
        .filter_map(|(u, v)| {
            let ray = sensor.rays.rays().at(u, v).map(f64::from);
            let at = meet_sphere(ray, centre, radius_m)?;
            let observed = f64::from(*shown.ir_counts.at(u, v)) / sensor.full_scale;
            let is_lit = observed > MIN_READ_SIGMAS * sensor.noise.read && observed < SATURATION;
            if !is_lit || lowest_cosine(&at, state) < MIN_COSINE {
                return None;
            }
            let noise = relative_noise(sensor, observed, shown.n_exposures);
            let cosine = lowest_cosine(&at, state);
            let turned = REGISTRATION_M / radius_m * (1.0 - cosine * cosine).sqrt() / cosine;
            Some(Sample {
                session,
                image_number: number,
                tile: tile_of(number, u, v),
                ray,
                place: Place::Sphere { image },
                log_observed: observed.ln(),
                sigma: sigma_of(noise, turned),
                noise,
                interreflected: surroundings.at(&at.point, &at.normal),
            })
        })
        .collect()
}

fn lowest_cosine(at: &SpherePoint, state: &State) -> f64 {
    at.view_cosine().min(at.light_cosine(&state.light))
}
