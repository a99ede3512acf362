//! What all patches share, by Gauss-Newton with every patch's own unknowns eliminated.

use super::SelfCalibrationParams;
use super::lit_patch::{LitPatch, Reading};
use crate::robust::{Tukey, median, median_absolute_deviation};
use crate::shading::{Calibration, Gloss, NearLight};
use nalgebra::{Cholesky, DMatrix, DVector, Dyn, Matrix3, SVector, Vector3};
use rayon::prelude::*;

/// Standard deviation of a patch's mean normal on the fused surface, radians.
const TILT_SIGMA_RAD: f64 = 0.015;
/// Standard deviation of the light's place along the optical axis, metres.
const LIGHT_DEPTH_SIGMA_M: f64 = 0.001;
/// Standard deviation of the strength of indirect light as a share of it.
const INDIRECT_SIGMA: f64 = 0.3;
/// What Eq. (1) gets wrong over a whole scan alike, as shares of intensity and of what of it is indirect: light from what the image does not
/// show is missing, and what stands between is not seen. However many patches there are, they tell no better than that.
const MODEL_SIGMA: f64 = 0.0022;
const INDIRECT_MODEL_SIGMA: f64 = 0.035;
/// Standard deviation of a view's gain as a share of it: how much the exposures of one device differ. What alignment is configured
/// to allow changes none of that.
pub const GAIN_SIGMA: f64 = 0.015;
/// The same of a lamp, which fades, and is exposed otherwise; arbitrary, three times as much as an emitter's costs gamma hardly anything.
pub const LAMP_GAIN_SIGMA: f64 = 0.05;
/// Standard deviation of the logarithm of gloss's exponent, and the exponents that are believed.
const GLOSS_LOG_POWER_SIGMA: f64 = 0.7;
const GLOSS_POWERS: (f64, f64) = (5.0, 300.0);
/// Unknowns that all patches share: 1/gamma, the light's place, its lobe, the logarithm of the strength of indirect light.
const N_LIT: usize = 6;
const AT_LOBE: usize = N_LIT - 2;
const AT_INDIRECT: usize = N_LIT - 1;
/// Those of each material: strength of gloss and the logarithm of its exponent.
const N_OF_GLOSS: usize = 2;
/// What a reading depends on beside its patch and the gain of its view.
const N_SHARED: usize = N_LIT + N_OF_GLOSS;
/// Gauss-Newton steps at most, and the largest change, in standard deviations of what changes, that ends them.
const MAX_STEPS: usize = 12;
const SETTLED_SIGMAS: f64 = 0.05;
/// Patches that are summed one after the other, whatever the threads.
const TILE: usize = 128;

/// What all patches share.
#[derive(Clone)]
pub struct Unknowns {
    /// 1/gamma.
    pub inv_gamma: f64,
    /// The lamp, camera frame.
    pub light: NearLight,
    /// Logarithm of the factor on indirect light.
    pub log_indirect: f64,
    /// Of each material.
    pub gloss: Vec<Gloss>,
    /// Logarithm of the gain of each view.
    pub log_gains: Vec<f64>,
    /// Standard deviation of these.
    pub gain_sigma: f64,
}

/// A residual, `ln I / gamma - ln flat - ln (n · E + gloss) - ln rho - ln gain`, and its derivatives; gloss is taken to stay as the light
/// moves.
struct Row {
    residual: f64,
    by_shared: SVector<f64, N_SHARED>,
    by_own: Vector3<f64>,
}

/// A residual's derivative by the logarithm of its view's gain.
const BY_GAIN: f64 = -1.0;

impl Unknowns {
    /// Where a material's gloss stands among the unknowns, its strength first; the gains stand after the last.
    pub fn at_gloss(material: usize) -> usize {
        N_LIT + N_OF_GLOSS * material
    }

    /// Which unknowns a reading of a patch of a material depends on: those of a [`Row`], then the gain.
    fn touched(&self, material: usize, view: usize) -> [usize; N_SHARED + 1] {
        let mut touched = [0; N_SHARED + 1];
        for (k, unknown) in touched.iter_mut().enumerate() {
            *unknown = match k {
                0..N_LIT => k,
                N_LIT..N_SHARED => Self::at_gloss(material) + k - N_LIT,
                _ => Self::at_gloss(self.gloss.len()) + view,
            };
        }
        touched
    }

    /// The residual of a reading of a patch of a material; `None` where it faces away from the light.
    fn row(&self, reading: &Reading, material: usize, own: &Vector3<f64>) -> Option<Row> {
        let [first, second] = &reading.tilts;
        let normal = reading.normal + first * own[1] + second * own[2];
        let indirect = reading.indirect * self.log_indirect.exp();
        let direct = self.light.incident(&reading.point);
        let arriving = direct + indirect;
        // Of strength 1, which is also the derivative by the strength.
        let Gloss { strength, power } = self.gloss[material];
        let gloss = Gloss {
            strength: 1.0,
            power,
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
        let lit_directly = normal.dot(&direct) + strength * highlight.value;
        let by_lobe = -lit_directly / irradiance * self.light.log_cosine(&reading.point);
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
        next.light.lobe_power = (next.light.lobe_power + step[AT_LOBE]).max(0.0);
        next.log_indirect += step[5];
        let (least, most) = GLOSS_POWERS;
        for (material, gloss) in next.gloss.iter_mut().enumerate() {
            let at = Self::at_gloss(material);
            gloss.strength = (gloss.strength + step[at]).max(0.0);
            gloss.power = (gloss.power * step[at + 1].exp()).clamp(least, most);
        }
        let gains = step.iter().skip(Self::at_gloss(self.gloss.len()));
        for (gain, part) in next.log_gains.iter_mut().zip(gains) {
            *gain += part;
        }
        next
    }

    /// What is believed with the response and light of these.
    pub fn calibration(&self, believed: &Calibration) -> Calibration {
        let mut calibration = believed.with_gamma(1.0 / self.inv_gamma);
        calibration.light.position_m = Some(self.light.position.coords.into());
        calibration.light.lobe_power = self.light.lobe_power;
        calibration
    }

    /// Distance of every unknown from another's; of gloss's exponent and the strength of indirect light, of their logarithms.
    fn distances(&self, from: &Unknowns) -> Vec<f64> {
        let moved = self.light.position - from.light.position;
        let shared = [
            self.inv_gamma - from.inv_gamma,
            moved.x,
            moved.y,
            moved.z,
            self.light.lobe_power - from.light.lobe_power,
            self.log_indirect - from.log_indirect,
        ];
        let gloss = self.gloss.iter().zip(&from.gloss);
        let gloss = gloss.flat_map(|(gloss, from)| {
            [
                gloss.strength - from.strength,
                (gloss.power / from.power).ln(),
            ]
        });
        let gains = self.log_gains.iter().zip(&from.log_gains);
        let gains = gains.map(|(gain, from)| gain - from);
        shared.into_iter().chain(gloss).chain(gains).collect()
    }

    /// Distance of every unknown from where it is believed to be, and its inverse variance.
    fn prior(
        &self,
        start: &Unknowns,
        params: &SelfCalibrationParams,
        gloss_sigmas: &[f64],
    ) -> Vec<(f64, f64)> {
        let shared = [
            params.gamma_sigma * start.inv_gamma,
            params.light_sigma_m,
            params.light_sigma_m,
            LIGHT_DEPTH_SIGMA_M,
            params.lobe_sigma,
            INDIRECT_SIGMA,
        ];
        let gloss = gloss_sigmas.iter();
        let gloss = gloss.flat_map(|&sigma| [sigma, GLOSS_LOG_POWER_SIGMA]);
        let gains = self.log_gains.iter().map(|_| start.gain_sigma);
        let sigmas = shared.into_iter().chain(gloss).chain(gains);
        let distances = self.distances(start).into_iter();
        distances
            .zip(sigmas)
            .map(|(distance, sigma)| (distance, 1.0 / (sigma * sigma)))
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
    /// Weight of all readings, and that times the share of indirect light.
    weight: f64,
    weighted_indirect: f64,
}

impl Normal {
    fn zero(n: usize) -> Normal {
        Normal {
            jtj: DMatrix::zeros(n, n),
            jtr: DVector::zeros(n),
            weight: 0.0,
            weighted_indirect: 0.0,
        }
    }

    fn plus(mut self, other: &Normal) -> Normal {
        self.jtj += &other.jtj;
        self.jtr += &other.jtr;
        self.weight += other.weight;
        self.weighted_indirect += other.weighted_indirect;
        self
    }

    /// Lets an unknown stay where it is.
    fn hold(&mut self, unknown: usize) {
        self.jtj.row_mut(unknown).fill(0.0);
        self.jtj.column_mut(unknown).fill(0.0);
        self.jtj[(unknown, unknown)] = 1.0;
        self.jtr[unknown] = 0.0;
    }

    /// Share of the light that is indirect.
    fn indirect_share(&self) -> f64 {
        self.weighted_indirect / self.weight.max(f64::MIN_POSITIVE)
    }

    /// Variance of a reading of weight 1 with what the model gets wrong of all alike, which no number of readings makes less.
    fn variance_with_model(&self) -> f64 {
        let of_indirect = INDIRECT_MODEL_SIGMA * self.indirect_share();
        1.0 + (MODEL_SIGMA.powi(2) + of_indirect.powi(2)) * self.weight
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
            let Some(row) = unknowns.row(reading, patch.material, &patch.own) else {
                continue;
            };
            let sigma = reading.sigma;
            let weight = loss.weight(row.residual / sigma) / (sigma * sigma);
            self.weight += patch.share * weight;
            self.weighted_indirect -= patch.share * weight * row.by_shared[AT_INDIRECT];
            own += row.by_own * row.by_own.transpose() * weight;
            gradient += row.by_own * (row.residual * weight);
            let mut touched = unknowns
                .touched(patch.material, reading.view)
                .map(|unknown| (unknown, BY_GAIN));
            for ((_, derivative), &by_shared) in touched.iter_mut().zip(&row.by_shared) {
                *derivative = by_shared;
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

/// What fits, and how sure it is.
pub struct Fit {
    /// What all patches share.
    pub found: Unknowns,
    /// Standard deviations, if all readings err on their own.
    pub sigmas: Vec<f64>,
    /// The same with what the model gets wrong of all alike.
    pub sigmas_with_model: Vec<f64>,
}

/// Gauss-Newton from `start`, which is also the prior, the strength of each material's gloss held as stated.
pub fn fit(
    patches: &mut [LitPatch],
    start: &Unknowns,
    params: &SelfCalibrationParams,
    gloss_sigmas: &[f64],
) -> Option<Fit> {
    for patch in patches.iter_mut() {
        patch.own = Vector3::zeros();
        let rows = patch
            .readings
            .iter()
            .filter_map(|reading| start.row(reading, patch.material, &patch.own));
        let mut residuals: Vec<f64> = rows.map(|row| row.residual).collect();
        patch.own[0] = median(&mut residuals)?;
    }
    let (mut unknowns, mut sigmas) = (start.clone(), Default::default());
    for _ in 0..MAX_STEPS {
        let loss = Tukey {
            scale: residual_scale(patches, &unknowns),
            cutoff: Tukey::EFFICIENT_CUTOFF,
        };
        let n = Unknowns::at_gloss(unknowns.gloss.len()) + unknowns.log_gains.len();
        let tiles: Option<Vec<(Normal, Vec<Own>)>> = patches
            .par_chunks(TILE)
            .with_max_len(1)
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
        let all = tiles.iter().map(|(tile, _)| tile);
        let mut normal = all.fold(Normal::zero(n), Normal::plus);
        let mut with_model = &normal.jtj / normal.variance_with_model();
        let prior = unknowns.prior(start, params, gloss_sigmas);
        for (k, (distance, weight)) in prior.into_iter().enumerate() {
            normal.jtj[(k, k)] += weight;
            with_model[(k, k)] += weight;
            normal.jtr[k] += weight * distance;
        }
        let cholesky = normal.jtj.clone().cholesky()?;
        let mut step = -cholesky.solve(&normal.jtr);
        if unknowns.light.lobe_power <= 0.0 && step[AT_LOBE] < 0.0 {
            // No lobe is narrower than none: the others answer for what it would explain.
            normal.hold(AT_LOBE);
            step = -normal.jtj.cholesky()?.solve(&normal.jtr);
        }
        let next = unknowns.moved(&step);
        let moved = next.distances(&unknowns);
        unknowns = next;
        let all_own = tiles.iter().flat_map(|(_, own)| own);
        for (patch, own) in patches.iter_mut().zip(all_own) {
            let coupled = &own.coupling * &step;
            patch.own -= own.inverse * (own.gradient + coupled.fixed_rows::<3>(0));
        }
        sigmas = (deviations(&cholesky), deviations(&with_model.cholesky()?));
        // Steps may go on against a bound, but nothing moves.
        let mut in_sigmas = moved.iter().zip(&sigmas.0).map(|(by, sigma)| by / sigma);
        if in_sigmas.all(|by| by.abs() < SETTLED_SIGMAS) {
            break;
        }
    }
    let (sigmas, sigmas_with_model) = sigmas;
    let is_finite = unknowns.inv_gamma.is_finite() && unknowns.inv_gamma > 0.0;
    is_finite.then_some(Fit {
        found: unknowns,
        sigmas,
        sigmas_with_model,
    })
}

/// Standard deviations by an information matrix.
fn deviations(information: &Cholesky<f64, Dyn>) -> Vec<f64> {
    let variances = information.inverse().diagonal();
    variances.iter().map(|variance| variance.sqrt()).collect()
}

/// Robust loss of all residuals, in squared sigmas.
pub fn loss(patches: &[LitPatch], unknowns: &Unknowns) -> f64 {
    let loss = Tukey {
        scale: 1.0,
        cutoff: Tukey::EFFICIENT_CUTOFF,
    };
    let of_patch = |patch: &LitPatch| {
        let readings = patch.readings.iter().filter_map(|reading| {
            let row = unknowns.row(reading, patch.material, &patch.own)?;
            Some(loss.loss(row.residual / reading.sigma))
        });
        patch.share * readings.sum::<f64>()
    };
    let of_patches: Vec<f64> = patches.par_iter().map(of_patch).collect();
    of_patches.iter().sum()
}

/// Robust standard deviation of all residuals, in sigmas, at least 1.
pub fn residual_scale(patches: &[LitPatch], unknowns: &Unknowns) -> f64 {
    let mut residuals: Vec<f64> = patches
        .par_iter()
        .flat_map_iter(|patch| {
            let rows = patch.readings.iter().filter_map(|reading| {
                let row = unknowns.row(reading, patch.material, &patch.own)?;
                Some(row.residual / reading.sigma)
            });
            rows.collect::<Vec<f64>>()
        })
        .collect();
    median_absolute_deviation(&mut residuals).max(1.0)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::refine::scenes::calibration;
    use nalgebra::Point3;

    #[test]
    fn derivatives_match_differences() {
        for strength in [0.0, 0.3] {
            derivatives_match_differences_with(Gloss {
                strength,
                power: 20.0,
            });
        }
    }

    #[test]
    fn at_no_lobe_the_others_answer_as_if_it_were_held() {
        // Brighter towards the rim than any lobe makes it.
        let truth = Unknowns {
            inv_gamma: 1.15,
            light: NearLight {
                lobe_power: -0.5,
                ..calibration().light.near_light([0.05, 0.01, 0.0])
            },
            log_indirect: 0.0,
            gloss: vec![Gloss::default()],
            log_gains: vec![0.0; 6],
            gain_sigma: GAIN_SIGMA,
        };
        let golden = |k: usize, step: f64| (k as f64 * step).fract() - 0.5;
        let patch = |k: usize| {
            let reading = |view: usize| {
                let at = 6 * k + view;
                let z = 0.7 + 0.3 * golden(at, 0.618_034);
                let point = Point3::new(golden(at, 0.754_878), golden(at, 0.569_84), z);
                let normal = Vector3::new(golden(at, 0.324_718), golden(at, 0.414_214), -1.0);
                let mut reading = Reading {
                    view,
                    log_observed: 0.0,
                    log_flat: 0.0,
                    point,
                    normal: normal / normal.norm(),
                    tilts: [Vector3::x(), Vector3::y()],
                    indirect: Vector3::zeros(),
                    sigma: 0.02,
                };
                let row = truth.row(&reading, 0, &Vector3::zeros()).expect("lit");
                reading.log_observed = -row.residual / truth.inv_gamma;
                reading
            };
            LitPatch {
                readings: (0..6).map(reading).collect(),
                share: 1.0,
                own: Vector3::zeros(),
                material: 0,
            }
        };
        let start = Unknowns {
            inv_gamma: 1.25,
            light: NearLight {
                lobe_power: 0.0,
                ..truth.light
            },
            ..truth.clone()
        };
        let found = |lobe_sigma: f64| {
            let mut patches: Vec<LitPatch> = (0..100).map(patch).collect();
            let params = SelfCalibrationParams {
                lobe_sigma,
                ..SelfCalibrationParams::default()
            };
            let fitted = fit(&mut patches, &start, &params, &[1e-9]).expect("determined");
            fitted.found
        };
        let (free, held) = (found(1.0), found(1e-9));
        assert_eq!(free.light.lobe_power, 0.0);
        assert!((free.inv_gamma / held.inv_gamma - 1.0).abs() < 1e-3);
        assert!((held.inv_gamma / truth.inv_gamma - 1.0).abs() > 5e-3);
    }

    fn derivatives_match_differences_with(gloss: Gloss) {
        let unknowns = Unknowns {
            inv_gamma: 1.2,
            light: calibration().light.near_light([0.05, 0.01, 0.0]),
            log_indirect: 0.2,
            gloss: vec![Gloss::default(), gloss],
            log_gains: vec![0.1],
            gain_sigma: GAIN_SIGMA,
        };
        let normal = Vector3::new(0.3, -0.2, -0.9);
        let reading = Reading {
            view: 0,
            log_observed: -1.3,
            log_flat: -0.1,
            point: Point3::new(0.1, -0.05, 0.7),
            normal,
            tilts: [Vector3::x(), Vector3::y()],
            indirect: Vector3::new(0.1, 0.2, -0.3),
            sigma: 0.02,
        };
        let own = Vector3::new(-2.0, 0.01, 0.02);
        const MATERIAL: usize = 1;
        let row = unknowns.row(&reading, MATERIAL, &own).expect("lit");
        let residual = |unknowns: &Unknowns, own: &Vector3<f64>| {
            unknowns.row(&reading, MATERIAL, own).expect("lit").residual
        };
        const STEP: f64 = 1e-6;
        for k in 0..=N_SHARED {
            // Gloss is taken to stay as the light moves, and there is no less than none.
            let is_left_out = match gloss.strength > 0.0 {
                true => (1..4).contains(&k),
                false => k == 6,
            };
            if is_left_out {
                continue;
            }
            let mut step = DVector::zeros(N_SHARED + N_OF_GLOSS + 1);
            step[unknowns.touched(MATERIAL, reading.view)[k]] = STEP;
            let difference =
                residual(&unknowns.moved(&step), &own) - residual(&unknowns.moved(&-step), &own);
            let expected = if k < N_SHARED {
                row.by_shared[k]
            } else {
                BY_GAIN
            };
            assert!((difference / (2.0 * STEP) - expected).abs() < 1e-6, "{k}");
        }
        for k in 0..3 {
            let step = Vector3::ith(k, STEP);
            let difference =
                residual(&unknowns, &(own + step)) - residual(&unknowns, &(own - step));
            let derivative = difference / (2.0 * STEP);
            assert!((derivative - row.by_own[k]).abs() < 1e-6, "{k}");
        }
    }
}
