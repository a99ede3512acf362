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

use super::gaze::Gaze;
use super::optics::Optics;
use super::sites::Sites;
use super::view::View;
use crate::shading::{Calibration, Gloss, NearLight, Tukey, median, median_absolute_deviation};
use nalgebra::{DMatrix, DVector, Matrix3, Point3, SVector, Vector3};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
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

/// Side of a patch, metres: many facets, and yet nearly one distance to the light. Where facets are large so are patches, for as many.
const PATCH_M: f64 = 0.01;
const FACETS: f64 = 60.0;
/// Facets that a view must see of a patch.
const MIN_FACETS: usize = 20;
/// And the share of its area: where its rim is hidden by a fold or a tooth, that rim is the surface's error.
const MIN_SEEN_SHARE: f64 = 0.8;
/// Views that must see a patch: it has three unknowns of its own.
const MIN_VIEWS: usize = 4;
/// Fewer patches say nothing.
const MIN_PATCHES: usize = 30;
/// Standard deviation of a patch's mean normal on the fused surface, radians.
const TILT_SIGMA_RAD: f64 = 0.015;
/// How far Eq. (1) is believed of a patch, as a share of its intensity.
const MODEL_SIGMA: f64 = 0.02;
/// Distance over which what surface and model get wrong goes together, metres: as in alignment.
const CORRELATION_M: f64 = 0.03;
/// Standard deviation of the light's place along the optical axis, metres.
const LIGHT_DEPTH_SIGMA_M: f64 = 0.001;
/// Standard deviation of the strength of indirect light as a share of it.
const INDIRECT_SIGMA: f64 = 0.3;
/// Standard deviation of a view's gain as a share of it: as in alignment.
const GAIN_SIGMA: f64 = 0.015;
/// Standard deviation of the strength of gloss, in albedos, and where there is to be none.
const GLOSS_SIGMA: f64 = 0.3;
const MATTE_SIGMA: f64 = 1e-6;
/// Standard deviation of the logarithm of its exponent, and the exponents that are believed.
const GLOSS_LOG_POWER_SIGMA: f64 = 0.7;
const GLOSS_POWERS: (f64, f64) = (5.0, 300.0);
/// Unknowns that all views share: 1/gamma, the light's place, its lobe, the logarithm of the strength of indirect light, strength
/// of gloss and the logarithm of its exponent.
const N_SHARED: usize = 8;
/// Gauss-Newton steps at most, and the change of 1/gamma that ends them.
const MAX_STEPS: usize = 12;
const SETTLED: f64 = 1e-4;
/// Patches that are summed one after the other, whatever the threads.
const TILE: usize = 128;
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

/// A patch in one view.
struct Reading {
    view: usize,
    /// Logarithm of the observed share of full scale.
    log_observed: f64,
    /// Logarithm of the flat field.
    log_flat: f64,
    /// Mean place and normal, camera frame, and the directions in which the normal may tilt; the normal is no unit vector.
    point: Point3<f64>,
    normal: Vector3<f64>,
    tilts: [Vector3<f64>; 2],
    /// Indirect light that arrives.
    indirect: Vector3<f64>,
    /// Standard deviation of the logarithm of the intensity.
    sigma: f64,
}

/// A patch of the surface with all its readings.
struct LitPatch {
    readings: Vec<Reading>,
    /// How many independent patches it stands for.
    share: f64,
    /// Logarithm of its albedo, and its tilts.
    own: Vector3<f64>,
}

impl LitPatch {
    /// Cuts what the views see of a surface into patches.
    fn all(sites: &Sites, views: &[View], optics: &Optics) -> Vec<LitPatch> {
        let facet_m2 = sites.areas_m2.iter().sum::<f64>() / sites.points.len().max(1) as f64;
        let side_m = (FACETS * facet_m2).sqrt().max(PATCH_M);
        let mut cells: BTreeMap<[i32; 3], Vec<u32>> = BTreeMap::new();
        for (face, point) in sites.points.iter().enumerate() {
            if sites.visible[face] != 0 {
                let cell = [point.x, point.y, point.z].map(|x| (x / side_m).floor() as i32);
                cells.entry(cell).or_default().push(face as u32);
            }
        }
        let cells: Vec<Vec<u32>> = cells.into_values().collect();
        let patch = |faces: &Vec<u32>| LitPatch::new(faces, sites, views, optics);
        cells.par_iter().filter_map(patch).collect()
    }

    fn new(faces: &[u32], sites: &Sites, views: &[View], optics: &Optics) -> Option<LitPatch> {
        let facets = faces.iter().filter_map(|&face| {
            let face = face as usize;
            let area = sites.areas_m2[face];
            (area > 0.0).then(|| (face, sites.normals[face], area))
        });
        let facets: Vec<(usize, Vector3<f64>, f64)> = facets.collect();
        let area_m2: f64 = facets.iter().map(|(_, _, area)| area).sum();
        let mean: Vector3<f64> = facets.iter().map(|(_, normal, area)| normal * *area).sum();
        let mean = mean.try_normalize(0.0)?;
        let first = mean
            .cross(&Vector3::ith(mean.iamin(), 1.0))
            .try_normalize(0.0)?;
        let tilts = [first, mean.cross(&first)];
        let readings = views.iter().enumerate().filter_map(|(index, view)| {
            let seen = facets.iter().copied();
            let seen = seen.filter(|(face, ..)| sites.visible[*face] >> index & 1 == 1);
            let seen: Vec<_> = seen
                .map(|(face, normal, area)| (&sites.points[face], normal, area))
                .collect();
            let seen_m2: f64 = seen.iter().map(|(.., area)| area).sum();
            (seen_m2 >= MIN_SEEN_SHARE * area_m2)
                .then(|| read(index, view, &seen, &tilts, optics.calibration))?
        });
        let readings: Vec<Reading> = readings.collect();
        (readings.len() >= MIN_VIEWS).then(|| LitPatch {
            readings,
            share: (area_m2 / (CORRELATION_M * CORRELATION_M)).min(1.0),
            own: Vector3::zeros(),
        })
    }
}

/// Integrates what a view shows of facets (centroid, normal, area), world frame.
fn read(
    index: usize,
    view: &View,
    facets: &[(&Point3<f64>, Vector3<f64>, f64)],
    tilts: &[Vector3<f64>; 2],
    calibration: &Calibration,
) -> Option<Reading> {
    let (mut area, mut observed, mut weighted_log) = (0.0, 0.0, 0.0);
    let mut sums = [Vector3::zeros(); 3];
    let (mut n_facets, mut variance) = (0, 0.0);
    let points = facets.iter().map(|(point, ..)| *point);
    Gaze::new(view).each(points, |index, look| {
        let (_, normal, a) = facets[index];
        if look.observed.is_nan() || look.observed <= 0.0 {
            return;
        }
        let p = look.point_camera;
        let flat = calibration.flat_field.factor(p.x / p.z, p.y / p.z);
        let response = calibration.gamma * (look.observed * flat).ln();
        area += a;
        observed += a * look.observed;
        weighted_log += a * look.observed * response;
        for (sum, part) in sums.iter_mut().zip([p.coords, normal, look.indirect]) {
            *sum += part * a;
        }
        variance += (look.sigma / look.observed).powi(2);
        n_facets += 1;
    });
    let [point, normal, indirect] = sums.map(|sum| sum / area);
    let log_observed = weighted_log / observed;
    let turn = view.camera_from_world.rotation;
    let noise = variance.sqrt() / f64::from(n_facets);
    (n_facets as usize >= MIN_FACETS).then(|| Reading {
        view: index,
        log_observed,
        // So that, with the gamma of the image, the reading is the logarithm of the mean intensity.
        log_flat: log_observed / calibration.gamma - (observed / area).ln(),
        point: Point3::from(point),
        normal: turn * normal,
        tilts: tilts.map(|tilt| turn * tilt),
        indirect,
        sigma: noise.hypot(MODEL_SIGMA),
    })
}

/// What all patches share.
#[derive(Clone)]
struct Unknowns {
    inv_gamma: f64,
    light: NearLight,
    log_indirect: f64,
    gloss: Gloss,
    log_gains: Vec<f64>,
}

/// A residual, `ln I / gamma - ln flat - ln (n · E + gloss) - ln rho - ln gain`, and its derivatives; gloss is taken to stay as the light
/// moves.
struct Row {
    residual: f64,
    by_shared: SVector<f64, N_SHARED>,
    by_own: Vector3<f64>,
}

impl Unknowns {
    /// The residual of a reading of a patch; `None` where it faces away from the light.
    fn row(&self, reading: &Reading, own: &Vector3<f64>) -> Option<Row> {
        let [first, second] = &reading.tilts;
        let normal = reading.normal + first * own[1] + second * own[2];
        let indirect = reading.indirect * self.log_indirect.exp();
        let direct = self.light.incident(&reading.point);
        let arriving = direct + indirect;
        // Of strength 1, which is also the derivative by the strength.
        let strength = self.gloss.strength;
        let gloss = Gloss {
            strength: 1.0,
            ..self.gloss
        };
        let highlight = gloss.highlight(&reading.point, &normal, &direct);
        let cosine_to_power = (highlight.value / direct.norm()).max(f64::MIN_POSITIVE);
        let irradiance = normal.dot(&arriving) + strength * highlight.value;
        if irradiance <= 0.0 {
            return None;
        }
        let by_normal = arriving + highlight.by_normal * strength;
        // The light moves as the point does, the other way.
        let by_light = self.light.irradiance_by_point(&reading.point, &normal) / irradiance;
        let ray = reading.point - self.light.position;
        let log_cosine = (ray.z / ray.norm()).max(f64::MIN_POSITIVE).ln();
        let lit_directly = normal.dot(&direct) + strength * highlight.value;
        let by_lobe = -lit_directly / irradiance * log_cosine;
        let by_indirect = -normal.dot(&indirect) / irradiance;
        Some(Row {
            residual: reading.log_observed * self.inv_gamma
                - reading.log_flat
                - irradiance.ln()
                - own[0]
                - self.log_gains[reading.view],
            by_shared: SVector::from([
                reading.log_observed,
                by_light.x,
                by_light.y,
                by_light.z,
                by_lobe,
                by_indirect,
                -highlight.value / irradiance,
                -strength * highlight.value * cosine_to_power.ln() / irradiance,
            ]),
            by_own: Vector3::new(
                -1.0,
                -first.dot(&by_normal) / irradiance,
                -second.dot(&by_normal) / irradiance,
            ),
        })
    }

    fn moved(&self, step: &DVector<f64>) -> Unknowns {
        let mut next = self.clone();
        next.inv_gamma += step[0];
        for axis in 0..3 {
            next.light.position[axis] += step[1 + axis];
        }
        next.light.lobe_power = (next.light.lobe_power + step[4]).max(0.0);
        next.log_indirect += step[5];
        next.gloss.strength = (next.gloss.strength + step[6]).max(0.0);
        let (least, most) = GLOSS_POWERS;
        next.gloss.power = (next.gloss.power * step[7].exp()).clamp(least, most);
        for (gain, part) in next.log_gains.iter_mut().zip(step.iter().skip(N_SHARED)) {
            *gain += part;
        }
        next
    }

    fn calibration(&self, believed: &Calibration) -> Calibration {
        let mut calibration = believed.clone();
        calibration.gamma = 1.0 / self.inv_gamma;
        calibration.light.position_m = Some(self.light.position.coords.into());
        calibration.light.lobe_power = self.light.lobe_power;
        calibration
    }

    /// Distance of every unknown from where it is believed to be, and its inverse variance.
    fn prior(
        &self,
        start: &Unknowns,
        params: &SelfCalibrationParams,
        gloss_sigma: f64,
    ) -> Vec<(f64, f64)> {
        let moved = self.light.position - start.light.position;
        let shared = [
            (
                self.inv_gamma - start.inv_gamma,
                params.gamma_sigma * start.inv_gamma,
            ),
            (moved.x, params.light_sigma_m),
            (moved.y, params.light_sigma_m),
            (moved.z, LIGHT_DEPTH_SIGMA_M),
            (
                self.light.lobe_power - start.light.lobe_power,
                params.lobe_sigma,
            ),
            (self.log_indirect, INDIRECT_SIGMA),
            (self.gloss.strength, gloss_sigma),
            (
                (self.gloss.power / start.gloss.power).ln(),
                GLOSS_LOG_POWER_SIGMA,
            ),
        ];
        let gains = self.log_gains.iter().map(|gain| (*gain, GAIN_SIGMA));
        let all = shared.into_iter().chain(gains);
        all.map(|(distance, sigma)| (distance, 1.0 / (sigma * sigma)))
            .collect()
    }
}

/// Normal equations of a patch's own unknowns, and how they couple with those that all share.
struct Own {
    inverse: Matrix3<f64>,
    gradient: Vector3<f64>,
    coupling: DMatrix<f64>,
}

/// Normal equations of the shared unknowns with every patch's own eliminated.
struct Normal {
    jtj: DMatrix<f64>,
    jtr: DVector<f64>,
}

impl Normal {
    fn zero(n: usize) -> Normal {
        Normal {
            jtj: DMatrix::zeros(n, n),
            jtr: DVector::zeros(n),
        }
    }

    /// Adds a patch; `None` if its own unknowns are not determined, which their priors exclude.
    fn add(&mut self, patch: &LitPatch, unknowns: &Unknowns, loss: &Tukey) -> Option<Own> {
        let tilt_weight = 1.0 / (TILT_SIGMA_RAD * TILT_SIGMA_RAD);
        // Any albedo will do; a patch without a reading that counts is held all the same.
        let prior = Vector3::new(1e-6, tilt_weight, tilt_weight);
        let mut own = Matrix3::from_diagonal(&prior);
        let mut gradient = Vector3::new(0.0, patch.own[1], patch.own[2]) * tilt_weight;
        let mut coupling = DMatrix::zeros(3, self.jtr.len());
        for reading in &patch.readings {
            let Some(row) = unknowns.row(reading, &patch.own) else {
                continue;
            };
            let sigma = reading.sigma;
            let weight = loss.weight(row.residual / sigma) / (sigma * sigma);
            own += row.by_own * row.by_own.transpose() * weight;
            gradient += row.by_own * (row.residual * weight);
            // The shared unknowns, and the view's gain.
            let mut touched = [(N_SHARED + reading.view, -1.0); N_SHARED + 1];
            for (entry, shared) in touched.iter_mut().zip(row.by_shared.iter().enumerate()) {
                *entry = (shared.0, *shared.1);
            }
            for (i, a) in touched {
                self.jtr[i] += patch.share * weight * a * row.residual;
                for (j, b) in touched {
                    self.jtj[(i, j)] += patch.share * weight * a * b;
                }
                for k in 0..3 {
                    coupling[(k, i)] += weight * row.by_own[k] * a;
                }
            }
        }
        let inverse = own.try_inverse()?;
        self.jtj -= coupling.transpose() * (inverse * &coupling) * patch.share;
        self.jtr -= coupling.transpose() * (inverse * gradient) * patch.share;
        Some(Own {
            inverse,
            gradient,
            coupling,
        })
    }
}

/// Gauss-Newton from `start`, which is also the prior, that of gloss as stated; the shared unknowns and their standard deviations.
fn fit(
    patches: &mut [LitPatch],
    start: &Unknowns,
    params: &SelfCalibrationParams,
    gloss_sigma: f64,
) -> Option<(Unknowns, Vec<f64>)> {
    for patch in patches.iter_mut() {
        patch.own = Vector3::zeros();
        let rows = patch
            .readings
            .iter()
            .filter_map(|reading| start.row(reading, &patch.own));
        let mut residuals: Vec<f64> = rows.map(|row| row.residual).collect();
        patch.own[0] = median(&mut residuals)?;
    }
    let (mut unknowns, mut sigmas) = (start.clone(), Vec::new());
    for _ in 0..MAX_STEPS {
        let loss = Tukey {
            scale: residual_scale(patches, &unknowns),
            cutoff: 4.685,
        };
        let n = N_SHARED + unknowns.log_gains.len();
        let tiles: Option<Vec<(Normal, Vec<Own>)>> = patches
            .par_chunks(TILE)
            .map(|tile| {
                let mut normal = Normal::zero(n);
                let own: Option<Vec<Own>> = tile
                    .iter()
                    .map(|patch| normal.add(patch, &unknowns, &loss))
                    .collect();
                Some((normal, own?))
            })
            .collect();
        let tiles = tiles?;
        let mut normal = Normal::zero(n);
        for (tile, _) in &tiles {
            normal.jtj += &tile.jtj;
            normal.jtr += &tile.jtr;
        }
        let prior = unknowns.prior(start, params, gloss_sigma);
        for (k, (distance, weight)) in prior.into_iter().enumerate() {
            normal.jtj[(k, k)] += weight;
            normal.jtr[k] += weight * distance;
        }
        let cholesky = normal.jtj.cholesky()?;
        let step = -cholesky.solve(&normal.jtr);
        unknowns = unknowns.moved(&step);
        let all_own = tiles.iter().flat_map(|(_, own)| own);
        for (patch, own) in patches.iter_mut().zip(all_own) {
            let coupled = &own.coupling * &step;
            patch.own -= own.inverse * (own.gradient + coupled.fixed_rows::<3>(0));
        }
        let variances = cholesky.inverse().diagonal();
        sigmas = variances.iter().map(|variance| variance.sqrt()).collect();
        if step[0].abs() < SETTLED {
            break;
        }
    }
    let is_finite = unknowns.inv_gamma.is_finite() && unknowns.inv_gamma > 0.0;
    is_finite.then_some((unknowns, sigmas))
}

/// Robust standard deviation of all residuals, in sigmas, at least 1.
fn residual_scale(patches: &[LitPatch], unknowns: &Unknowns) -> f64 {
    let mut residuals: Vec<f64> = patches
        .par_iter()
        .flat_map_iter(|patch| {
            let rows = patch.readings.iter().filter_map(|reading| {
                let row = unknowns.row(reading, &patch.own)?;
                Some(row.residual / reading.sigma)
            });
            rows.collect::<Vec<f64>>()
        })
        .collect();
    median_absolute_deviation(&mut residuals).max(1.0)
}

#[cfg(test)]
mod tests;
