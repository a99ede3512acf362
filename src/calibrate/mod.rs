//! What the IR image means: response, flat field and light of one sensor, measured on a white sphere and a plain wall.
//!
//! Eq. (1) is fitted whole, by one estimator, to every image of every session given (Sec. 3.3 fits the exponent alone):
//! `I = (A · V(ray) · E(direction from the light) · (n·l)/d² + interreflection)^γ`, with an albedo A for each session, the
//! lens V as a smooth map, the light's place and lobe E. Geometry comes from the depth images: a *wall* is a plane in each
//! image, known once and for all; a *sphere* has one radius and a centre in each image that are unknowns too, since depth
//! bends near a table (multipath moved the centre by 5 mm). What tells where the sphere is: its *limb*, the outline in the
//! IR image, and the range of its *cap*, the part that faces the camera.
//!
//! What a sphere at one distance cannot tell from each other (γ, the radius, vignetting, the light's place) a wall at
//! several distances can, and the other way round; [`Estimate`] carries the covariance of what was found, robust to
//! residuals that are correlated within tiles of an image.
//!
//! Interreflection is not guessed: what the camera sees around the sphere is what lights it a second time, and is summed
//! over the depth image. Where that exceeds a share of the direct light the sphere is masked.
//!
//! Not handled: specular spheres, light that does not move with the camera, motion blur.

mod ball;
mod depth_edges;
mod edge_match;
mod estimate;
mod gather;
mod interreflection;
mod inverse_square;
mod lit_images;
mod model;
mod normal_equations;
mod offset;
mod outline;
mod plane;
mod refusal;
mod response;
mod samples;
mod solve;
mod sphere;
mod state;
#[cfg(test)]
mod tests;

pub use ball::BALL_RADII_M;
pub use estimate::{Estimate, INTERVAL_SIGMAS, Measured, SessionFit};
pub use gather::{Gatherer, Scan, Shares, Target, TargetImage};
pub use inverse_square::{InverseSquare, N_REGIONS, inverse_square};
pub use offset::{ImageOffset, OffsetError, OffsetEstimate, combine_offsets, image_offset};
pub use refusal::{NoEstimate, Refusal};
pub use response::{INCIDENCES, INLIER, PowerLaw, ResponseCheck, SHARES, response_check};
pub use sphere::{BallRadius, FoundSphere};
pub use state::{Priors, State};

use crate::geometry::RayGrid;
use crate::shading::ImageNoise;
use samples::Samples;
use solve::Problem;

/// What all images of one sensor share.
#[derive(Clone, Copy, Debug)]
pub struct Sensor<'a> {
    /// Which sensor it is.
    pub kind: depth_camera::Sensor,
    /// Rays and camera.
    pub rays: &'a RayGrid,
    /// IR counts at full scale.
    pub full_scale: f64,
    /// Noise of the observed values.
    pub noise: ImageNoise,
}

/// Is asked before every step of a fit whether it shall go on.
pub type GoesOn<'a> = dyn Fn() -> bool + 'a;

/// What all rounds of a fit go by.
struct Fit<'a> {
    sensor: &'a Sensor<'a>,
    priors: &'a Priors,
    goes_on: &'a GoesOn<'a>,
}

/// Rounds in which limbs, masks and interreflection are measured anew.
const N_ROUNDS: usize = 5;

/// Fits Eq. (1) to all scans at once. From their images the room's light is taken off as gamma is found, and stays off.
///
/// # Errors
/// If the scans cannot be fitted by it: see [`Refusal`]; if `goes_on` says no.
pub fn estimate(
    scans: &mut [Scan],
    sensor: &Sensor,
    priors: &Priors,
    goes_on: &GoesOn,
) -> Result<Estimate, NoEstimate> {
    let fit = Fit {
        sensor,
        priors,
        goes_on,
    };
    refusal::check_brightness(scans, sensor.full_scale)?;
    let mut state = State::start(scans, sensor, priors)?;
    outline::place_by_outlines(scans, &fit, &mut state)?;
    state.start_intensities(scans, sensor);
    let mut problem = round(scans, &fit, &mut state)?;
    for _ in 1..N_ROUNDS {
        problem = round(scans, &fit, &mut state)?;
    }
    let estimate = problem.estimate(state);
    refusal::check_fits(scans, &estimate)?;
    Ok(estimate)
}

/// Measures everything anew as the state has it, and fits that.
fn round<'a>(
    scans: &mut [Scan],
    fit: &Fit<'a>,
    state: &mut State,
) -> Result<Problem<'a>, NoEstimate> {
    let sensor = fit.sensor;
    let images = scans.iter_mut().flat_map(|scan| &mut scan.images);
    images.for_each(|image| image.take_ambient_off(sensor.full_scale, state.gamma));
    let problem = Problem::new(Samples::gather(scans, sensor, state), fit.priors, state);
    problem.minimise(state, fit.goes_on)?;
    Ok(problem)
}
