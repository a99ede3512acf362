//! Where a sphere is in an image, without believing its brightness: its limb in the IR image and the range of its cap.
//!
//! Lit from near the camera, a sphere darkens towards its limb like the root of the distance to it and ends in a step; the
//! pixel blurs that. The limb is found where the model's own profile, blurred alike, fits the image best. The steepest place
//! of the profile would be up to a pixel further in, and shift with the light.

use super::gather::{Scan, Target, TargetImage};
use super::model::meet_sphere;
use super::refusal::{NoEstimate, Refusal};
use super::samples::{Cap, LimbPoint, Samples};
use super::solve::Problem;
use super::state::{SphereState, State};
use super::{Fit, Sensor};
use crate::geometry::bilinear;
use crate::robust::median;
use nalgebra::{Point3, Vector3};
use std::f64::consts::TAU;

/// What the image shows of a sphere's outline.
pub struct Limb {
    /// Its points.
    pub points: Vec<LimbPoint>,
    /// Share of the directions in which it could be found.
    pub shown_share: f64,
    /// Share of the outline that lies within the image.
    pub inside_share: f64,
}

/// Directions from the sphere's middle in which the limb is looked for.
const N_DIRECTIONS: usize = 120;
/// Samples of a profile per pixel.
const PER_PIXEL: usize = 8;
/// Profiles reach this far to both sides of the predicted limb, pixels.
const REACH_PX: usize = 12;
/// The limb is looked for this far to both sides, pixels: 5 mm at 0.6 m are 3 pixels of a Kinect II.
const SEARCH_PX: usize = 7;
/// The profile is compared from this far inside to that far outside the limb, pixels.
const INSIDE_PX: usize = 4;
const OUTSIDE_PX: usize = 3;
/// Standard deviation of a limb point, pixels.
const SIGMA_PX: f64 = 0.25;
/// A limb whose profile fits worse than this share of its step is none.
const MAX_MISFIT: f64 = 0.2;
/// A step must exceed the noise this many times, and this share of full scale.
const MIN_STEP_SIGMAS: f64 = 8.0;
const MIN_STEP: f64 = 0.012;

/// Looks for the limb of a session's sphere in one of its images.
pub fn measure_limb(
    shown: &TargetImage,
    sensor: &Sensor,
    state: &State,
    session: usize,
    image: usize,
) -> Limb {
    let mut limb = Limb {
        points: Vec::new(),
        shown_share: 0.0,
        inside_share: 0.0,
    };
    let Some(fan) = Fan::new(state, session, image) else {
        return limb;
    };
    let radians_per_px = 1.0 / sensor.rays.camera().intrinsics().fx;
    for direction in 0..N_DIRECTIONS {
        let turn = TAU * direction as f64 / N_DIRECTIONS as f64;
        let profile = fan.profile(turn, radians_per_px, shown, sensor, state);
        let Some(profile) = profile else { continue };
        limb.inside_share += 1.0 / N_DIRECTIONS as f64;
        if let Some(offset_px) = profile.limb_px(sensor) {
            limb.points.push(LimbPoint {
                session,
                image,
                direction: fan.direction(turn, offset_px * radians_per_px),
                sigma_rad: SIGMA_PX * radians_per_px,
            });
        }
    }
    limb.shown_share = limb.points.len() as f64 / N_DIRECTIONS as f64;
    limb
}

/// Directions round a sphere as the camera sees it.
struct Fan<'a> {
    sphere: &'a SphereState,
    centre: &'a Vector3<f64>,
    axis: Vector3<f64>,
    across: [Vector3<f64>; 2],
    radius_rad: f64,
}

impl<'a> Fan<'a> {
    fn new(state: &'a State, session: usize, image: usize) -> Option<Self> {
        let sphere = state.sessions[session].sphere.as_ref()?;
        let centre = &sphere.centres[image];
        let axis = centre.try_normalize(1e-9)?;
        let right = Vector3::y().cross(&axis).try_normalize(1e-6)?;
        let sine = sphere.radius_m / centre.norm();
        (sine < 0.95).then(|| Fan {
            sphere,
            centre,
            axis,
            across: [right, axis.cross(&right)],
            radius_rad: sine.asin(),
        })
    }

    /// Unit direction that is `beyond_rad` outside the predicted limb.
    fn direction(&self, turn: f64, beyond_rad: f64) -> Vector3<f64> {
        let aside = self.across[0] * turn.cos() + self.across[1] * turn.sin();
        let angle = self.radius_rad + beyond_rad;
        self.axis * angle.cos() + aside * angle.sin()
    }

    /// What is seen and what is predicted along one direction; `None` where that leaves the image.
    fn profile(
        &self,
        turn: f64,
        radians_per_px: f64,
        shown: &TargetImage,
        sensor: &Sensor,
        state: &State,
    ) -> Option<Profile> {
        let camera = sensor.rays.camera();
        let n = 2 * REACH_PX * PER_PIXEL + 1;
        let (mut observed, mut predicted) = (Vec::with_capacity(n), Vec::with_capacity(n));
        for k in 0..n {
            let offset_px = k as f64 / PER_PIXEL as f64 - REACH_PX as f64;
            let towards = self.direction(turn, offset_px * radians_per_px);
            let pixel = camera.project(&Point3::from(towards))?;
            observed.push(bilinear(&shown.ir_counts, &pixel)? / sensor.full_scale);
            let ray = [towards.x / towards.z, towards.y / towards.z];
            let lit = meet_sphere(ray, self.centre, self.sphere.radius_m).map(|at| {
                let irradiance = state.light.irradiance(&at.point, &at.normal).max(0.0);
                let flat = state.flat.log_factor(ray[0], ray[1]).exp();
                (irradiance * flat).powf(state.gamma)
            });
            predicted.push(lit);
        }
        Some(Profile {
            observed,
            predicted,
        })
    }
}

/// Intensity across a limb, `PER_PIXEL` samples a pixel, from `REACH_PX` inside the predicted limb to as far outside.
struct Profile {
    observed: Vec<f64>,
    /// Brightness but for a factor; `None` beyond the limb.
    predicted: Vec<Option<f64>>,
}

impl Profile {
    /// Where the limb is, pixels beyond the predicted one.
    fn limb_px(&self, sensor: &Sensor) -> Option<f64> {
        let n_shifts = 2 * SEARCH_PX * PER_PIXEL + 1;
        let misfits: Vec<f64> = (0..n_shifts)
            .map(|k| k as isize - (SEARCH_PX * PER_PIXEL) as isize)
            .map(|shift| self.misfit(shift, sensor))
            .collect();
        let best = (0..n_shifts).min_by(|a, b| misfits[*a].total_cmp(&misfits[*b]))?;
        if best == 0 || best + 1 == n_shifts || misfits[best] >= MAX_MISFIT {
            return None;
        }
        let [before, at, after] = [best - 1, best, best + 1].map(|k| misfits[k].powi(2));
        let curvature = before - 2.0 * at + after;
        if !(curvature.is_finite() && curvature > 0.0) {
            return None;
        }
        let fraction = 0.5 * (before - after) / curvature;
        Some((best as f64 + fraction) / PER_PIXEL as f64 - SEARCH_PX as f64)
    }

    /// Root mean square difference between the image and the model's profile moved outwards by `shift` samples, as a share
    /// of the step at the limb; infinite where there is no step.
    fn misfit(&self, shift: isize, sensor: &Sensor) -> f64 {
        let limb = (REACH_PX * PER_PIXEL) as isize + shift;
        let window = |from_px: isize, to_px: isize| {
            let from = limb + from_px * PER_PIXEL as isize;
            let to = limb + to_px * PER_PIXEL as isize;
            from.max(0) as usize..(to.max(0) as usize).min(self.observed.len())
        };
        let model = |k: usize| {
            let index = k as isize - shift;
            let last = self.predicted.len() as isize - 1;
            self.predicted[index.clamp(0, last) as usize]
        };
        let beyond = window(1, 1 + OUTSIDE_PX as isize);
        let background = mean(beyond.map(|k| self.observed[k]));
        let inner = window(-1 - INSIDE_PX as isize, -2);
        let seen = mean(inner.clone().map(|k| self.observed[k]));
        let scale = seen / mean(inner.map(|k| model(k).unwrap_or(0.0)));
        let step = model(limb as usize - PER_PIXEL / 2).unwrap_or(0.0) * scale - background;
        let least = MIN_STEP.max(MIN_STEP_SIGMAS * sensor.noise.sigma(seen));
        if step.is_nan() || step.abs() <= least {
            return f64::INFINITY;
        }
        let compared = window(-(INSIDE_PX as isize), OUTSIDE_PX as isize);
        let squares = compared.map(|k| {
            let blurred: f64 = BLUR
                .iter()
                .enumerate()
                .map(|(tap, weight)| {
                    let from = (k + tap).saturating_sub(BLUR.len() / 2);
                    weight * model(from).map_or(background, |value| value * scale)
                })
                .sum();
            (blurred - self.observed[k]).powi(2)
        });
        mean(squares).sqrt() / step.abs()
    }
}

/// Order of the binomial that stands for the blur of a pixel's box and of bilinear sampling: its variance, a quarter of the
/// order in squared samples, is their 0.25 px².
const BLUR_ORDER: usize = PER_PIXEL * PER_PIXEL;
/// Weights of the blur; those beyond 2 px are below 10^-4 and left out.
const BLUR: [f64; 4 * PER_PIXEL + 1] = binomial();

const fn binomial() -> [f64; 4 * PER_PIXEL + 1] {
    const SIDE: usize = 2 * PER_PIXEL;
    let mut weights = [0.0; 4 * PER_PIXEL + 1];
    let mut sum = 1.0;
    weights[SIDE] = 1.0;
    let mut k = 1;
    while k <= SIDE {
        let ratio = (BLUR_ORDER / 2 + 1 - k) as f64 / (BLUR_ORDER / 2 + k) as f64;
        weights[SIDE + k] = weights[SIDE + k - 1] * ratio;
        weights[SIDE - k] = weights[SIDE + k];
        sum += 2.0 * weights[SIDE + k];
        k += 1;
    }
    let mut k = 0;
    while k <= 2 * SIDE {
        weights[k] /= sum;
        k += 1;
    }
    weights
}

fn mean(values: impl Iterator<Item = f64>) -> f64 {
    let (mut sum, mut n) = (0.0, 0.0);
    for value in values {
        sum += value;
        n += 1.0;
    }
    sum / n
}

/// Range of the sphere's nearest point, as the depth of the cap that faces the camera says: its median. `None` without
/// depth there.
pub fn measure_cap(
    shown: &TargetImage,
    sensor: &Sensor,
    state: &State,
    session: usize,
    image: usize,
) -> Option<Cap> {
    /// Share of the radius that the cap reaches sideways.
    const CAP: f64 = 0.5;
    let sphere = state.sessions[session].sphere.as_ref()?;
    let axis = sphere.centres[image].try_normalize(1e-9)?;
    let squared = sphere.radius_m * sphere.radius_m;
    let mut ranges = Vec::new();
    for (z, [x, y]) in shown.depth_m.data().iter().zip(sensor.rays.rays().data()) {
        let point = Vector3::new(f64::from(*x), f64::from(*y), 1.0) * f64::from(*z);
        let along = point.dot(&axis);
        let aside = (point - axis * along).norm_squared();
        if *z > 0.0 && aside < CAP * CAP * squared {
            ranges.push(along + (squared - aside).sqrt() - sphere.radius_m);
        }
    }
    // Fewer are the rim of something else.
    if ranges.len() < 50 {
        return None;
    }
    Some(Cap {
        session,
        image,
        range_m: median(&mut ranges)?,
    })
}

/// Places the spheres by their limbs and caps alone, before any brightness is believed.
///
/// # Errors
/// If a sphere is cut by the frame in all its images, or its limb shows in too few directions; if the fit is not to go on.
pub(super) fn place_by_outlines(
    scans: &[Scan],
    fit: &Fit,
    state: &mut State,
) -> Result<(), NoEstimate> {
    const N_ROUNDS: usize = 4;
    let sensor = fit.sensor;
    for _ in 0..N_ROUNDS {
        let outlines = Samples::outlines(scans, sensor, state);
        Problem::new(outlines, fit.priors, state).minimise(state, fit.goes_on)?;
    }
    for (session, scan) in scans.iter().enumerate() {
        if let Target::Sphere(_) = scan.target {
            check_outlines(session, scan, sensor, state)?;
        }
    }
    Ok(())
}

/// Refuses a session none of whose images shows the outline well.
fn check_outlines(
    session: usize,
    scan: &Scan,
    sensor: &Sensor,
    state: &State,
) -> Result<(), Refusal> {
    /// Share of the outline that lies within the image.
    const MIN_INSIDE: f64 = 0.97;
    /// Share of the directions in which the limb must show.
    const MIN_SHOWN: f64 = 0.3;
    let limbs = scan.images.iter().enumerate();
    let limbs: Vec<Limb> = limbs
        .map(|(image, shown)| measure_limb(shown, sensor, state, session, image))
        .collect();
    let best = |share: fn(&Limb) -> f64| limbs.iter().map(share).fold(0.0, f64::max);
    let (inside_share, shown_share) = (best(|l| l.inside_share), best(|l| l.shown_share));
    if inside_share < MIN_INSIDE {
        return Err(Refusal::SphereCut {
            session: scan.name.clone(),
            inside_share,
            required: MIN_INSIDE,
        });
    }
    if shown_share < MIN_SHOWN {
        return Err(Refusal::NoLimb {
            session: scan.name.clone(),
            shown_share,
            required: MIN_SHOWN,
        });
    }
    Ok(())
}
