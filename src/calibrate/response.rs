//! The response on the sphere (Sec. 3.3, Fig. 7): a plain power law by RANSAC, and how well the whole model fits.

use super::estimate::Estimate;
use super::gather::Scan;
use super::model::log_linear;
use super::samples::{MAX_INTERREFLECTED, SPHERE_STRIDE, Sample, sphere_samples};
use super::state::State;
use super::{Refusal, Sensor};
use crate::robust::{Tukey, median_absolute_deviation};
use depth_camera::Image;

/// `observed = scale · rendered^γ`, both as shares of full scale: what the paper fits.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PowerLaw {
    /// Exponent.
    pub gamma: f64,
    /// Logarithm of the factor.
    pub log_scale: f64,
    /// Share of the pixels within 0.05 of it.
    pub inlier_share: f64,
}

/// The paper's inlier bound, as a share of full scale.
pub const INLIER: f64 = 0.05;
/// Samples and iterations of the paper's RANSAC.
const N_SAMPLES: usize = 1_000;
const N_ITERATIONS: usize = 1_000;

/// Observed against predicted intensity on one sphere.
#[derive(Clone, Debug)]
pub struct ResponseCheck {
    /// Share of all its pixels that camera and light see well within 0.05 of the prediction.
    pub within: f64,
    /// The same without those that interreflection masks.
    pub within_unmasked: f64,
    /// Share of the pixels that are masked.
    pub masked_share: f64,
    /// The paper's fit to all pixels, with falloff and flat field, but without interreflection or mask.
    pub plain: PowerLaw,
    /// Mean relative residual by share of interreflected light, least first, and by incidence (cosine), grazing first.
    pub residuals: [[Option<f64>; INCIDENCES.len() - 1]; SHARES.len() - 1],
    /// Predicted linear intensity, predicted and observed share of full scale: a thinned sample of pixels.
    pub scatter: Vec<[f64; 3]>,
    /// Observed less predicted share of full scale over the image that lies in the middle of the session; NaN elsewhere.
    pub residual_map: Image<f32>,
}

/// Borders of the bins by share of interreflected light.
pub const SHARES: [f64; 5] = [0.0, 0.02, MAX_INTERREFLECTED, 0.15, 1.0];
/// Borders of the bins by incidence.
pub const INCIDENCES: [f64; 5] = [0.25, 0.45, 0.65, 0.85, 1.0];
/// Points of the scatter plot at most.
const MAX_SCATTER: usize = 6_000;

/// One pixel of the sphere against the model.
struct Compared {
    observed: f64,
    predicted: f64,
    log_linear: f64,
    interreflected_share: f64,
}

/// The paper's fit: `log I_obs = γ log I_ren + b` through pairs of samples, most within 0.05 win; then Tukey-weighted least
/// squares over all inliers. `pairs` are the logarithms of rendered linear and of observed intensity.
pub fn plain_power_law(pairs: &[[f64; 2]]) -> Option<PowerLaw> {
    let mut random = fastrand::Rng::with_seed(1);
    let mut draw = || pairs[random.usize(..pairs.len())];
    if pairs.len() < 10 {
        return None;
    }
    let samples: Vec<[f64; 2]> = (0..N_SAMPLES).map(|_| draw()).collect();
    let mut best = (0, 0.0, 0.0);
    for _ in 0..N_ITERATIONS {
        let ([x0, y0], [x1, y1]) = (draw(), draw());
        let gamma = (y1 - y0) / (x1 - x0);
        if !(0.2..3.0).contains(&gamma) {
            continue;
        }
        let log_scale = y0 - gamma * x0;
        let n_inliers = count_inliers(&samples, gamma, log_scale);
        if n_inliers > best.0 {
            best = (n_inliers, gamma, log_scale);
        }
    }
    let (_, mut gamma, mut log_scale) = best;
    for _ in 0..10 {
        (gamma, log_scale) = polished(pairs, gamma, log_scale)?;
    }
    Some(PowerLaw {
        gamma,
        log_scale,
        inlier_share: count_inliers(pairs, gamma, log_scale) as f64 / pairs.len() as f64,
    })
}

fn is_inlier([x, y]: &[f64; 2], gamma: f64, log_scale: f64) -> bool {
    (y.exp() - (gamma * x + log_scale).exp()).abs() < INLIER
}

fn count_inliers(pairs: &[[f64; 2]], gamma: f64, log_scale: f64) -> usize {
    pairs
        .iter()
        .filter(|pair| is_inlier(pair, gamma, log_scale))
        .count()
}

/// One step of reweighted least squares over the inliers.
fn polished(pairs: &[[f64; 2]], gamma: f64, log_scale: f64) -> Option<(f64, f64)> {
    let residual = |[x, y]: &[f64; 2]| y - gamma * x - log_scale;
    let inliers: Vec<_> = pairs
        .iter()
        .filter(|pair| is_inlier(pair, gamma, log_scale))
        .collect();
    let mut residuals: Vec<f64> = inliers.iter().map(|pair| residual(pair)).collect();
    let loss = Tukey {
        scale: median_absolute_deviation(&mut residuals).max(1e-4),
        cutoff: Tukey::EFFICIENT_CUTOFF,
    };
    let [mut w, mut wx, mut wy, mut wxx, mut wxy] = [0.0; 5];
    for pair in inliers {
        let ([x, y], weight) = (pair, loss.weight(residual(pair)));
        w += weight;
        wx += weight * x;
        wy += weight * y;
        wxx += weight * x * x;
        wxy += weight * x * y;
    }
    let determinant = w * wxx - wx * wx;
    (determinant > 0.0).then(|| {
        let gamma = (w * wxy - wx * wy) / determinant;
        (gamma, (wy - gamma * wx) / w)
    })
}

/// Logarithms of rendered and observed intensity of a session's sphere pixels, the rendering without interreflection or
/// albedo.
pub(super) fn rendered_pairs(samples: &[Sample], session: usize, state: &State) -> Vec<[f64; 2]> {
    let mut plain = state.clone();
    plain.sessions[session].log_albedo = 0.0;
    if let Some(sphere) = &mut plain.sessions[session].sphere {
        sphere.reflectance = 0.0;
    }
    samples
        .iter()
        .filter_map(|sample| Some([log_linear(sample, &plain)?.0, sample.log_observed]))
        .collect()
}

/// All pixels of a scan's sphere that camera and light see well, masked or not.
pub(super) fn sphere_pixels(
    scan: &Scan,
    session: usize,
    sensor: &Sensor,
    state: &State,
) -> Vec<Sample> {
    let images = scan.images.iter().enumerate();
    images
        .flat_map(|(image, shown)| sphere_samples([session, image, image], shown, sensor, state))
        .collect()
}

/// Holds the fitted model against all pixels of a sphere.
///
/// # Errors
/// If too few of its pixels are lit.
pub fn response_check(
    scans: &[Scan],
    session: usize,
    sensor: &Sensor,
    estimate: &Estimate,
) -> Result<ResponseCheck, Refusal> {
    let (scan, state) = (&scans[session], &estimate.state);
    let compare = |sample: &Sample| {
        let (log_linear, interreflected_share) = log_linear(sample, state)?;
        Some(Compared {
            observed: sample.log_observed.exp(),
            predicted: (state.gamma * log_linear).exp(),
            log_linear,
            interreflected_share,
        })
    };
    let samples = sphere_pixels(scan, session, sensor, state);
    let compared: Vec<(f64, Compared)> = samples
        .iter()
        .filter_map(|sample| Some((incidence(sample, state)?, compare(sample)?)))
        .collect();
    let plain = plain_power_law(&rendered_pairs(&samples, session, state)).ok_or_else(|| {
        Refusal::FewSamples {
            session: scan.name.clone(),
            n_samples: compared.len(),
            required: 10,
        }
    })?;
    let is_masked = |c: &Compared| c.interreflected_share >= MAX_INTERREFLECTED;
    let unmasked = || compared.iter().filter(|(_, c)| !is_masked(c));
    let thin = compared.len().div_ceil(MAX_SCATTER).max(1);
    let middle = scan.images.len() / 2;
    Ok(ResponseCheck {
        within: share_within(compared.iter()),
        within_unmasked: share_within(unmasked()),
        masked_share: 1.0 - unmasked().count() as f64 / compared.len().max(1) as f64,
        plain,
        residuals: binned(&compared),
        scatter: unmasked()
            .step_by(thin)
            .map(|(_, c)| [c.log_linear.exp(), c.predicted, c.observed])
            .collect(),
        residual_map: residual_map(scan, session, middle, sensor, state, compare),
    })
}

fn share_within<'a>(compared: impl Iterator<Item = &'a (f64, Compared)>) -> f64 {
    let (mut n, mut n_within) = (0usize, 0usize);
    for (_, c) in compared {
        n += 1;
        n_within += usize::from((c.observed - c.predicted).abs() < INLIER);
    }
    n_within as f64 / n.max(1) as f64
}

/// Cosine of the angle of incidence at a sample of a sphere.
fn incidence(sample: &Sample, state: &State) -> Option<f64> {
    let super::samples::Place::Sphere { image } = sample.place else {
        return None;
    };
    let sphere = state.sessions[sample.session].sphere.as_ref()?;
    let at = super::model::meet_sphere(sample.ray, &sphere.centres[image], sphere.radius_m)?;
    Some(at.light_cosine(&state.light))
}

fn binned(compared: &[(f64, Compared)]) -> [[Option<f64>; INCIDENCES.len() - 1]; SHARES.len() - 1] {
    /// Bins with fewer pixels say nothing.
    const MIN_PIXELS: usize = 50;
    std::array::from_fn(|by_share| {
        std::array::from_fn(|by_incidence| {
            let in_bin = compared.iter().filter(|(cosine, c)| {
                (SHARES[by_share]..SHARES[by_share + 1]).contains(&c.interreflected_share)
                    && (INCIDENCES[by_incidence]..INCIDENCES[by_incidence + 1]).contains(cosine)
            });
            let residuals: Vec<f64> = in_bin
                .map(|(_, c)| c.observed / c.predicted - 1.0)
                .collect();
            let n = residuals.len();
            (n >= MIN_PIXELS).then(|| residuals.iter().sum::<f64>() / n as f64)
        })
    })
}

fn residual_map(
    scan: &Scan,
    session: usize,
    image: usize,
    sensor: &Sensor,
    state: &State,
    compare: impl Fn(&Sample) -> Option<Compared>,
) -> Image<f32> {
    let shown = &scan.images[image];
    let (width, height) = (shown.ir_counts.width(), shown.ir_counts.height());
    let mut map = Image::filled(width, height, f32::NAN);
    let camera = sensor.rays.camera();
    for sample in sphere_samples([session, image, 0], shown, sensor, state) {
        let [x, y] = sample.ray;
        let Some(pixel) = camera.project(&nalgebra::Point3::new(x, y, 1.0)) else {
            continue;
        };
        let (u0, v0) = (pixel.x.round() as usize, pixel.y.round() as usize);
        let Some(c) = compare(&sample) else { continue };
        // A sample stands for the pixels that were stepped over.
        for v in v0..(v0 + SPHERE_STRIDE).min(height) {
            for u in u0..(u0 + SPHERE_STRIDE).min(width) {
                map.data_mut()[v * width + u] = (c.observed - c.predicted) as f32;
            }
        }
    }
    map
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_power_law_is_found_among_outliers() {
        let mut random = fastrand::Rng::with_seed(5);
        let pairs: Vec<[f64; 2]> = (0..5_000)
            .map(|k| {
                let x = random.f64() * 2.0 - 2.2;
                let lifted = if k % 6 == 0 { 0.4 * random.f64() } else { 0.0 };
                [x, 0.8 * x - 0.3 + lifted + 0.01 * (random.f64() - 0.5)]
            })
            .collect();
        let law = plain_power_law(&pairs).expect("enough pairs");
        assert!((law.gamma - 0.8).abs() < 0.005, "{}", law.gamma);
        assert!((law.log_scale + 0.3).abs() < 0.005);
        assert!(law.inlier_share > 0.8);
    }
}
