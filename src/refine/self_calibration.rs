//! Response and light, told by the scan's own images where the calibration is wrong.
//!
//! Many views see each place of the surface at other distances and slants; whatever its albedo, Eq. (1) says how its brightness
//! has to change. What is compared are patches, not facets: intensity, integrated over a surface, is the scalar product of
//! the light with the integral of the normal, and that depends on the rim alone, so that noise and detail that the fused surface
//! gets wrong do not count. Facet by facet gamma comes out up to 6 % too high on the recorded scans, patch by patch within 1.5 %.
//!
//! Unknown are gamma, the light's place and lobe, how strong indirect light is, how glossy each material, and a gain a view;
//! each patch has its own albedo and tilt, which are eliminated. Residuals are of `ln I / gamma`, for it is the surface that
//! errs and not the image.
//!
//! Not told: the light's place along the optical axis, which is nearly one with gamma, and the flat field, which is nearly one
//! with the lobe.

mod fit;
mod lit_patch;

use super::optics::Optics;
use super::sites::Sites;
use super::view::View;
use crate::shading::{Calibration, Gloss};
use fit::{Fit, GAIN_SIGMA, LAMP_GAIN_SIGMA, Unknowns, fit, loss, residual_scale};
use lit_patch::LitPatch;
use serde::{Deserialize, Serialize};
use std::fmt;

/// How far the images may take response and light from the calibration, each time that they are asked.
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

impl SelfCalibrationParams {
    /// The same with response and light held as they are believed.
    pub fn held(&self) -> Self {
        const HELD: f64 = 1e-6;
        SelfCalibrationParams {
            gamma_sigma: HELD,
            light_sigma_m: HELD,
            lobe_sigma: HELD,
            ..self.clone()
        }
    }
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

/// Nearer to what is believed it is not worth asking whether what the images say is better: the share of gamma, the light's place across the
/// optical axis (m), the lobe's power. With the right calibration scans tell others by up to 4 %, 8 mm and 0.9, which does not pass the judge.
const NEAR_GAMMA: f64 = 0.02;
const NEAR_LIGHT_M: f64 = 0.01;
const NEAR_LOBE: f64 = 0.7;

/// Less gloss is none: recorded scans of matte surfaces show 0.01 at most.
const MIN_GLOSS: f64 = 0.05;

/// A calibration is contradicted by at least so many standard deviations, with what the model gets wrong of all patches alike.
const MIN_SIGMAS_WITH_MODEL: f64 = 2.0;
/// Gloss is there by at least so many standard deviations of patches that err on their own.
const MIN_SIGMAS: f64 = 3.0;

/// Patches that disagree with Eq. (1) by more than so many standard deviations tell nothing of indirect light, and a warning says so: 1.0 on the recorded
/// scans of an object, up to 1.6 where their depth is off by 3 cm, 2.6 to 3.0 where images lie by 5 pixels, or poses by 8 mm, from where they
/// should, but 2.6 on a rough rock, too, 6.7 on real views of a printed board whose depth is off by centimetres.
pub const MAX_MISFIT: f64 = 2.0;
/// Up to this one they may tell of response and light, since views that are held out judge: a figure with arms told the right gamma at 2.1.
const MAX_JUDGED_MISFIT: f64 = 2.5;

/// A calibration that the images do not agree with, and what they say instead, or what on the way there explains them best.
#[derive(Clone, Debug, PartialEq)]
pub struct Contradiction {
    /// Gamma as it was believed.
    pub believed_gamma: f64,
    /// Power of the light's lobe as it was believed.
    pub believed_lobe_power: f64,
    /// How far across the optical axis the light stands from where it was believed, metres.
    pub light_moved_m: f64,
    /// The one instead.
    pub calibration: Calibration,
}

impl Contradiction {
    /// What images say instead of what is believed.
    pub fn of(believed: &Optics, calibration: Calibration) -> Self {
        let moved = believed.with(&calibration).light.position - believed.light.position;
        Contradiction {
            believed_gamma: believed.calibration.gamma,
            believed_lobe_power: believed.light.lobe_power,
            light_moved_m: moved.xy().norm(),
            calibration,
        }
    }

    /// The calibration that lies a share of the way from the one believed to what the images say; `None` if there is none such.
    pub fn part(&self, believed: &Optics, share: f64) -> Option<Calibration> {
        let told = believed.with(&self.calibration).light;
        let mix = |from: f64, to: f64| from + share * (to - from);
        let inv_gamma = mix(1.0 / self.believed_gamma, 1.0 / self.calibration.gamma);
        let place = believed.light.position + share * (told.position - believed.light.position);
        let lobe_power = mix(believed.light.lobe_power, told.lobe_power);
        let mut calibration = self.calibration.with_gamma(1.0 / inv_gamma);
        calibration.light.position_m = Some(place.coords.into());
        calibration.light.lobe_power = lobe_power.max(0.0);
        calibration.validate().is_ok().then_some(calibration)
    }
}

impl fmt::Display for Contradiction {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Calibration { gamma, light, .. } = &self.calibration;
        write!(
            f,
            "the shading images contradict the calibration: they tell a gamma of {gamma:.2}, not {:.2}, a light {:.0} mm from where \
             it is stated, and a lobe of cosine to the power of {:.1}, not {:.1}",
            self.believed_gamma,
            1e3 * self.light_moved_m,
            light.lobe_power,
            self.believed_lobe_power
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
    /// Logarithm of how much more of that light there is than by the views' white level; 0 where nothing explains the images.
    pub log_indirect: f64,
    /// How much patches of the surface disagree with that, in standard deviations; 0 where they were not asked.
    pub misfit: f64,
}

/// What the images tell of response, light and gloss from the `sites` of a surface that the views see.
pub fn told_by_images(
    sites: &Sites,
    views: &[View],
    optics: &Optics,
    params: &SelfCalibrationParams,
) -> Told {
    let believed = optics.calibration;
    let mut patches = LitPatch::all(sites, views, optics, &[]);
    if patches.len() < MIN_PATCHES {
        return Told::default();
    }
    let start = start(optics, views.len(), &[Gloss::default()]);
    let Some(Fitted { fit, misfit }) = Fitted::new(&mut patches, &start, params) else {
        return Told::default();
    };
    let Fit {
        found,
        sigmas_with_model: sigmas,
        ..
    } = &fit;
    let gloss = found.gloss[0];
    let gamma_change = (found.inv_gamma / start.inv_gamma).ln();
    let moved = found.light.position - start.light.position;
    let lobe_change = found.light.lobe_power - start.light.lobe_power;
    let differs = |change: f64, near: f64, sigma: f64| {
        change.abs() > near && change.abs() > MIN_SIGMAS_WITH_MODEL * sigma
    };
    let light_sigma_m = sigmas[1].max(sigmas[2]);
    let is_contradicted = misfit < MAX_JUDGED_MISFIT
        && (differs(gamma_change, NEAR_GAMMA, sigmas[0] / start.inv_gamma)
            || differs(moved.xy().norm(), NEAR_LIGHT_M, light_sigma_m)
            || differs(lobe_change, NEAR_LOBE, sigmas[4]));
    let calibration = found.calibration(believed);
    tracing::info!(
        gamma = calibration.gamma,
        gamma_sigma = sigmas[0] * calibration.gamma * calibration.gamma,
        light_moved_mm = 1e3 * moved.xy().norm(),
        lobe_power = calibration.light.lobe_power,
        indirect = found.log_indirect.exp(),
        gloss = gloss.strength,
        gloss_power = gloss.power,
        patches = patches.len(),
        misfit,
        is_contradicted,
        "response and light by the images"
    );
    let is_contradicted = is_contradicted && calibration.validate().is_ok();
    Told {
        contradiction: is_contradicted.then(|| Contradiction::of(optics, calibration)),
        gloss,
        // Also where response and light stay as believed: held, they leave to it what they would explain, 0.1° on `relief-k2`.
        log_indirect: if misfit < MAX_MISFIT {
            found.log_indirect
        } else {
            0.0
        },
        misfit,
    }
}

/// How glossy the images show each of some materials to be, given with those of the facets, which are the `sites`, when all of them
/// together are as glossy as `shared`. Response and light are held as the views and their `optics` have them. `None` where nothing is
/// to be told.
pub fn gloss_of_materials(
    sites: &Sites,
    views: &[View],
    optics: &Optics,
    params: &SelfCalibrationParams,
    (materials, n_materials): (&[u8], usize),
    shared: Gloss,
) -> Option<Vec<Gloss>> {
    let mut patches = LitPatch::all(sites, views, optics, materials);
    if patches.len() < MIN_PATCHES {
        return None;
    }
    let start = start(optics, views.len(), &vec![shared; n_materials]);
    let gloss = Fitted::new(&mut patches, &start, &params.held())?
        .fit
        .found
        .gloss;
    tracing::info!(
        strength = ?gloss.iter().map(|gloss| gloss.strength).collect::<Vec<f64>>(),
        power = ?gloss.iter().map(|gloss| gloss.power).collect::<Vec<f64>>(),
        "gloss of each material by the images"
    );
    Some(gloss)
}

/// A calibration as it is believed, with so many views, and the gloss of each material.
fn start(optics: &Optics, n_views: usize, gloss: &[Gloss]) -> Unknowns {
    Unknowns {
        inv_gamma: 1.0 / optics.calibration.gamma,
        light: optics.light,
        log_indirect: 0.0,
        gloss: gloss.to_vec(),
        log_gains: vec![0.0; n_views],
        gain_sigma: match optics.is_steady {
            true => GAIN_SIGMA,
            false => LAMP_GAIN_SIGMA,
        },
    }
}

/// What fits the patches. Gloss is that of those materials alone that show it; the others are matte.
struct Fitted {
    fit: Fit,
    /// How much patches disagree, in standard deviations.
    misfit: f64,
}

/// Exponents of gloss from which it is looked for. A lobe that is too narrow for what is there is taken for none.
const FIRST_POWERS: [f64; 3] = [30.0, 10.0, 100.0];

impl Fitted {
    /// Fits patches from a start, which is also what is believed.
    fn new(
        patches: &mut [LitPatch],
        start: &Unknowns,
        params: &SelfCalibrationParams,
    ) -> Option<Fitted> {
        let (mut start, mut fitted) = Self::all_glossy(patches, start, params);
        let mut is_glossy = vec![true; start.gloss.len()];
        loop {
            let shows = |material| {
                let fitted = fitted.as_ref();
                fitted.is_some_and(|fitted| fitted.shows_gloss(material, &start))
            };
            let stays = |(material, &is_glossy)| is_glossy && shows(material);
            let stay: Vec<bool> = is_glossy.iter().enumerate().map(stays).collect();
            if stay == is_glossy {
                break;
            }
            is_glossy = stay;
            // Gloss that is not there would make gamma less sure.
            make_matte(&mut start.gloss, &is_glossy);
            let sigma = |&is_glossy: &bool| if is_glossy { GLOSS_SIGMA } else { MATTE_SIGMA };
            let gloss_sigmas: Vec<f64> = is_glossy.iter().map(sigma).collect();
            fitted = Self::with(patches, &start, params, &gloss_sigmas);
        }
        let mut fitted = fitted?;
        make_matte(&mut fitted.fit.found.gloss, &is_glossy);
        Some(fitted)
    }

    /// Fits patches with gloss as stated.
    fn with(
        patches: &mut [LitPatch],
        start: &Unknowns,
        params: &SelfCalibrationParams,
        gloss_sigmas: &[f64],
    ) -> Option<Fitted> {
        let fit = fit(patches, start, params, gloss_sigmas)?;
        Some(Fitted {
            misfit: residual_scale(patches, &fit.found),
            fit,
        })
    }

    /// Fits patches that may all be glossy: from that exponent from which they are fitted best, or from gloss that is believed.
    fn all_glossy(
        patches: &mut [LitPatch],
        start: &Unknowns,
        params: &SelfCalibrationParams,
    ) -> (Unknowns, Option<Fitted>) {
        let sigmas = vec![GLOSS_SIGMA; start.gloss.len()];
        if !start.gloss.iter().all(Gloss::is_matte) {
            return (start.clone(), Self::with(patches, start, params, &sigmas));
        }
        let fits = FIRST_POWERS.into_iter().filter_map(|power| {
            let mut start = start.clone();
            start.gloss.iter_mut().for_each(|gloss| gloss.power = power);
            let fitted = Self::with(patches, &start, params, &sigmas)?;
            Some((loss(patches, &fitted.fit.found), start, fitted))
        });
        match fits.min_by(|(a, ..), (b, ..)| a.total_cmp(b)) {
            Some((_, start, fitted)) => (start, Some(fitted)),
            None => (start.clone(), None),
        }
    }

    /// Whether a material is glossy: for sure, or one of many that are, unless it shows that it is not.
    fn shows_gloss(&self, material: usize, start: &Unknowns) -> bool {
        let strength = self.fit.found.gloss[material].strength;
        let sigma = self.fit.sigmas[Unknowns::at_gloss(material)];
        let is_sure = strength > MIN_SIGMAS * sigma;
        self.misfit < MAX_MISFIT
            && strength > MIN_GLOSS
            && (is_sure || !start.gloss[material].is_matte())
    }
}

/// Takes gloss from the materials that are not glossy.
fn make_matte(gloss: &mut [Gloss], is_glossy: &[bool]) {
    for (gloss, &is_glossy) in gloss.iter_mut().zip(is_glossy) {
        if !is_glossy {
            *gloss = Gloss::default();
        }
    }
}

#[cfg(test)]
mod tests;
