//! Response and light, told by the scan's own images where the calibration is wrong.
//!
//! Many views see each place of the surface at other distances and slants; whatever its albedo, Eq. (1) says how its brightness
//! has to change. What is compared are patches, not facets: intensity, integrated over a surface, is the scalar product of
//! the light with the integral of the normal, and that depends on the rim alone, so that noise and detail that the fused surface
//! gets wrong do not count. Facet by facet gamma comes out up to 6 % too high on the recorded scans, patch by patch within 1.5 %.
//!
//! Unknown are gamma, the light's place and lobe, how strong indirect light is, how glossy the surface, and a gain a view; each patch has its own albedo
//! and tilt, which are eliminated. Residuals are of `ln I / gamma`, for it is the surface that errs and not the image.
//!
//! Not told: the light's place along the optical axis, which is nearly one with gamma, and the flat field, which is nearly one
//! with the lobe.

mod fit;
mod lit_patch;

use super::optics::Optics;
use super::sites::Sites;
use super::view::View;
use crate::shading::{Calibration, Gloss};
use fit::{Unknowns, fit, residual_scale};
use lit_patch::LitPatch;
use serde::{Deserialize, Serialize};
use std::fmt;

/// How far the images may take response and light from the calibration.
#[derive(Clone, Debug, PartialEq, Deserialize, Serialize)]
#[serde(default, deny_unknown_fields)]
pub struct SelfCalibrationParams {
    /// Whether a calibration that the images contradict is replaced by what they say.
    pub enabled: bool,
    /// Standard deviation of gamma as a share of it.
    pub gamma_sigma: f64,
    /// Standard deviation of the light's place across the optical axis, metres.
    pub light_sigma_m: f64,
    /// Standard deviation of the lobe's power.
    pub lobe_sigma: f64,
}

impl Default for SelfCalibrationParams {
    fn default() -> Self {
        SelfCalibrationParams {
            enabled: true,
            gamma_sigma: 0.3,
            light_sigma_m: 0.005,
            lobe_sigma: 0.5,
        }
    }
}

/// Fewer patches say nothing.
const MIN_PATCHES: usize = 30;
/// Standard deviation of the strength of gloss, in albedos, and where there is to be none.
const GLOSS_SIGMA: f64 = 0.3;
const MATTE_SIGMA: f64 = 1e-6;

/// From which differences on the images contradict a calibration.
#[derive(Clone, Copy, Debug)]
pub struct Tolerance {
    /// Share of gamma.
    gamma: f64,
    /// The light's place across the optical axis, metres.
    light_m: f64,
    /// The lobe's power.
    lobe: f64,
}

impl Tolerance {
    /// On a finished surface: with the right calibration the recorded scans differ by 2 %, 8 mm and 0.9. A light 20 mm off or a
    /// lobe two powers off cost 0.3° of mean normals, gamma 26 % off 2.3°.
    pub const FINISHED: Tolerance = Tolerance {
        gamma: 0.04,
        light_m: 0.02,
        lobe: 2.0,
    };
    /// While depth is corrected no better than a single frame allows.
    pub const AS_TRACKED: Tolerance = Tolerance {
        gamma: 0.08,
        light_m: 0.04,
        lobe: 3.0,
    };
}

/// Less gloss is none: recorded scans of matte surfaces show 0.01 at most.
const MIN_GLOSS: f64 = 0.05;

/// And by at least so many standard deviations.
const MIN_SIGMAS: f64 = 3.0;

/// Patches that disagree with Eq. (1) by more than so many standard deviations tell nothing of it: 1.0 on the recorded
/// scans of an object, 6.7 on real views of a printed board whose depth is off by centimetres.
const MAX_MISFIT: f64 = 2.0;

/// A calibration that the images do not agree with, and what they say instead.
#[derive(Clone, Debug, PartialEq)]
pub struct Contradiction {
    /// Gamma as it was believed.
    pub believed_gamma: f64,
    /// How far across the optical axis the light stands from where it was believed, metres.
    pub light_moved_m: f64,
    /// What the images say.
    pub calibration: Calibration,
}

impl fmt::Display for Contradiction {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Calibration { gamma, light, .. } = &self.calibration;
        write!(
            f,
            "the shading images contradict the calibration: they tell a gamma of {gamma:.2}, not {:.2}, a light {:.0} mm from where \
             it is stated, and a lobe of cosine to the power of {:.1}",
            self.believed_gamma,
            1e3 * self.light_moved_m,
            light.lobe_power
        )
    }
}

/// What the images tell.
#[derive(Clone, Debug, Default)]
pub struct Told {
    /// Of response and light, where that is something else than the calibration.
    pub contradiction: Option<Contradiction>,
    /// Of the surface.
    pub gloss: Gloss,
}

/// What the images tell of response, light and gloss from the `sites` of a surface that the views see.
pub fn told_by_images(
    sites: &Sites,
    views: &[View],
    optics: &Optics,
    params: &SelfCalibrationParams,
    tolerance: Tolerance,
) -> Told {
    let believed = optics.calibration;
    let mut patches = LitPatch::all(sites, views, optics);
    if patches.len() < MIN_PATCHES {
        return Told::default();
    }
    let start = Unknowns {
        inv_gamma: 1.0 / believed.gamma,
        light: optics.light,
        log_indirect: 0.0,
        gloss: Gloss::default(),
        log_gains: vec![0.0; views.len()],
    };
    let mut fitted = |gloss_sigma: f64| {
        let (found, sigmas) = fit(&mut patches, &start, params, gloss_sigma)?;
        let misfit = residual_scale(&patches, &found);
        Some((found, sigmas, misfit))
    };
    let glossy = fitted(GLOSS_SIGMA).filter(|(found, sigmas, misfit)| {
        let strength = found.gloss.strength;
        *misfit < MAX_MISFIT && strength > MIN_GLOSS && strength > MIN_SIGMAS * sigmas[6]
    });
    let is_glossy = glossy.is_some();
    // Gloss that is not there would make gamma less sure.
    let Some((found, sigmas, misfit)) = glossy.or_else(|| fitted(MATTE_SIGMA)) else {
        return Told::default();
    };
    let gamma_change = (found.inv_gamma / start.inv_gamma).ln();
    let moved = found.light.position - start.light.position;
    let lobe_change = found.light.lobe_power - start.light.lobe_power;
    let exceeds = |change: f64, tolerance: f64, sigma: f64| {
        change.abs() > tolerance && change.abs() > MIN_SIGMAS * sigma
    };
    let light_sigma_m = sigmas[1].max(sigmas[2]);
    let is_explained = misfit < MAX_MISFIT;
    let is_contradicted = is_explained
        && (exceeds(gamma_change, tolerance.gamma, sigmas[0] / start.inv_gamma)
            || exceeds(moved.xy().norm(), tolerance.light_m, light_sigma_m)
            || exceeds(lobe_change, tolerance.lobe, sigmas[4]));
    let calibration = found.calibration(believed);
    tracing::info!(
        gamma = calibration.gamma,
        gamma_sigma = sigmas[0] * calibration.gamma * calibration.gamma,
        light_moved_mm = 1e3 * moved.xy().norm(),
        lobe_power = calibration.light.lobe_power,
        indirect = found.log_indirect.exp(),
        gloss = found.gloss.strength,
        gloss_power = found.gloss.power,
        patches = patches.len(),
        misfit,
        is_contradicted,
        "response and light by the images"
    );
    let is_contradicted = is_contradicted && calibration.validate().is_ok();
    Told {
        contradiction: is_contradicted.then(|| Contradiction {
            believed_gamma: believed.gamma,
            light_moved_m: moved.xy().norm(),
            calibration,
        }),
        gloss: match is_glossy {
            true => found.gloss,
            false => Gloss::default(),
        },
    }
}

#[cfg(test)]
mod tests;
