//! From phasors to depth: phase unwrapping over three frequencies, then the geometry of emitter and camera.
//!
//! The *travel* t of the light from emitter to surface to camera is measured in units of 1.25 m. Frequency k sees it modulo
//! its period P_k = 3, 15 and 2, so that the three together see it modulo 30. The two short periods, the more precise
//! ones, are joined first: t_0 − t_2 is a whole number, which tells t modulo 6. That and t_1 differ by a multiple of 3, which
//! tells t modulo 30. How far the two differences are from what they must be is the *misfit*.

use pulp::{Simd, WithSimd};

use crate::{
    HEIGHT, WIDTH,
    arctangent::turns,
    ir_parameters::IrParameters,
    options::DecoderOptions,
    p0_tables::N_FREQUENCIES,
    phasors::{PHASOR_GAIN, PhasorRow},
};

/// Metres of one unit of travel.
pub(crate) const TRAVEL_UNIT_M: f32 = 1.25;

/// Units of travel after which a frequency repeats.
pub(crate) const PERIOD: [f32; N_FREQUENCIES] = [3.0, 15.0, 2.0];

/// Distance from camera to emitter, along the rows of the mirrored image, that ranging takes into account, metres.
pub(crate) const EMITTER_OFFSET_M: f64 = 0.045;

/// Standard deviation of the logarithmic code's rounding as a share of the signal's amplitude: steps are 1/256 to 1/128 of the
/// value, and the mean square of a cosine is a half.
const CODE_NOISE: f32 = 0.0012;

/// Variance of rounding to whole counts.
const COUNT_NOISE: f32 = 1.0 / 12.0;

/// Variances of the amplitude that a sample's noise makes in a phase, squared radians: three exposures.
const PHASE_VARIANCE: f32 = 2.0 / 3.0;

/// What ranging knows of the rays of one row, with unit depth.
#[derive(Clone, Debug)]
pub(crate) struct RayRow {
    /// Length of the ray; infinite where the lens has none, which makes the depth 0.
    length: [f32; WIDTH],
    /// [`EMITTER_OFFSET_M`] times the ray's slope towards the emitter, metres.
    towards_emitter: [f32; WIDTH],
}

impl RayRow {
    /// The rays of the image's row `v`.
    pub(crate) fn new(camera: &IrParameters, v: usize, options: &DecoderOptions) -> Self {
        let v = if options.legacy_row_order {
            HEIGHT - 1 - v
        } else {
            v
        };
        let mut row = RayRow {
            length: [f32::INFINITY; WIDTH],
            towards_emitter: [0.0; WIDTH],
        };
        for u in 0..WIDTH {
            let column = if options.unmirrored { WIDTH - 1 - u } else { u };
            if let Some([x, y]) = camera.ray(column, v) {
                row.length[u] = (x * x + y * y + 1.0).sqrt() as f32;
                row.towards_emitter[u] = (EMITTER_OFFSET_M * x) as f32;
            }
        }
        row
    }
}

/// One row of phasors, to be turned into depth.
pub(crate) struct UnwrapRow<'a> {
    pub(crate) phasors: &'a PhasorRow,
    /// Share of a measurement's variance that smoothing has left.
    pub(crate) variance_left: &'a [f32; WIDTH],
    pub(crate) rays: &'a RayRow,
    pub(crate) options: &'a DecoderOptions,
    /// Metres, 0 for no measurement.
    pub(crate) depth: &'a mut [f32],
    /// Metres, infinite for no measurement.
    pub(crate) sigma_m: &'a mut [f32],
}

impl WithSimd for UnwrapRow<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, _: S) {
        let PhasorRow { re, im } = self.phasors;
        let (depth, sigma_m) = (&mut self.depth[..WIDTH], &mut self.sigma_m[..WIDTH]);
        let RayRow {
            length,
            towards_emitter,
        } = self.rays;
        // A copy, so that writing depth cannot change it and the loop becomes one of vectors.
        let options = *self.options;
        for u in 0..WIDTH {
            let m = [
                [re[0][u], im[0][u]],
                [re[1][u], im[1][u]],
                [re[2][u], im[2][u]],
            ];
            let travel = unwrap(m, &options);
            let range = Ranging::of(travel.units * TRAVEL_UNIT_M, length[u], towards_emitter[u]);
            let z = range.depth_m + options.depth_offset_m;
            let variance = travel.variance * self.variance_left[u];
            let sigma = variance.sqrt() * TRAVEL_UNIT_M * range.depth_by_travel.abs();
            let valid = travel.valid & (z >= options.near_m) & (z <= options.far_m);
            depth[u] = if valid { z } else { 0.0 };
            sigma_m[u] = if valid { sigma } else { f32::INFINITY };
        }
    }
}

/// The travel that three phasors tell.
struct Travel {
    /// Units of 1.25 m.
    units: f32,
    /// Squared units.
    variance: f32,
    /// Whether signal and misfit are good enough.
    valid: bool,
}

#[inline(always)]
fn unwrap(m: [[f32; 2]; N_FREQUENCIES], options: &DecoderOptions) -> Travel {
    let read_variance = options.read_noise * options.read_noise + COUNT_NOISE;
    let mut wrapped = [0.0; N_FREQUENCIES];
    let mut weight = [0.0; N_FREQUENCIES];
    let mut strong = true;
    for k in 0..N_FREQUENCIES {
        let [re, im] = m[k];
        wrapped[k] = turns(im, re) * PERIOD[k];
        let power = (re * re + im * im) / (PHASOR_GAIN * PHASOR_GAIN);
        strong &= power >= options.min_amplitude * options.min_amplitude;
        // The inverse of the variance of t_k, but for a factor that all frequencies share.
        let noise = read_variance + CODE_NOISE * CODE_NOISE * power;
        weight[k] = power / (noise * PERIOD[k] * PERIOD[k]);
    }
    let [t0, t1, t2] = wrapped;
    let [w0, w1, w2] = weight;

    let apart = (t0 - t2 + 0.5).floor();
    let fine_misfit = (t0 - t2 - apart).abs() * 2.0;
    // t_0 + 3 n_0 = t_2 + 2 n_2, so that n_0 is odd where t_0 − t_2 is.
    let n0 = apart - 2.0 * (apart * 0.5).floor();
    let u0 = t0 + 3.0 * n0;
    let u2 = t2 + apart + 3.0 * n0;
    let fine = (w0 * u0 + w2 * u2) / (w0 + w2).max(f32::MIN_POSITIVE);

    // fine + 6 n = t_1 + 15 m, so that n is three times their difference's thirds, modulo 5.
    let thirds = (t1 - fine) * (1.0 / 3.0);
    let whole = (thirds + 0.5).floor();
    let coarse_misfit = (thirds - whole).abs() * 2.0;
    // A tenth keeps multiples of 5 clear of rounding.
    let n = 3.0 * whole - 5.0 * (3.0 * whole * 0.2 + 0.1).floor();
    let u1 = t1 + 6.0 * n - 3.0 * whole;

    let total = (w0 + w1 + w2).max(f32::MIN_POSITIVE);
    let units = ((u0 + 6.0 * n) * w0 + u1 * w1 + (u2 + 6.0 * n) * w2) / total;
    let per_turn = std::f32::consts::TAU;
    Travel {
        units,
        variance: PHASE_VARIANCE / (per_turn * per_turn * total),
        valid: strong & (fine_misfit.max(coarse_misfit) <= options.max_misfit),
    }
}

/// Where light came from that travelled so far and arrived along a ray.
struct Ranging {
    depth_m: f32,
    depth_by_travel: f32,
}

impl Ranging {
    /// z = d² / (2 (s d − e)) with the ray's length s at unit depth and e as [`RayRow::towards_emitter`].
    ///
    /// For an emitter at a distance b the numerator is d² − b². b² is left out, as libfreenect2 leaves it out, which makes depth too
    /// large by b² / 4z: 1.0 mm at 0.5 m, 0.5 mm at 1 m.
    #[inline(always)]
    fn of(travel_m: f32, length: f32, towards_emitter: f32) -> Self {
        let reach = length * travel_m - towards_emitter;
        let depth_m = 0.5 * travel_m * travel_m / reach;
        let depth_by_travel = (travel_m - depth_m * length) / reach;
        Ranging {
            depth_m,
            depth_by_travel,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::f64::consts::TAU;

    /// Phasors of a travel, with an error of each phase in turns.
    fn phasors(units: f64, amplitude: f64, error: [f64; 3]) -> [[f32; 2]; 3] {
        [0, 1, 2].map(|k| {
            let phase = TAU * (units / f64::from(PERIOD[k]) + error[k]);
            [
                (1.5 * amplitude * phase.cos()) as f32,
                (1.5 * amplitude * phase.sin()) as f32,
            ]
        })
    }

    #[test]
    fn every_travel_within_the_common_period_is_found() {
        let options = DecoderOptions::default();
        for i in 0..6000 {
            let units = 0.002 + f64::from(i) * 0.005;
            // Errors of both signs, up to 0.2 units between the short periods and 0.9 of the long one.
            let sign = if i % 2 == 0 { 1.0 } else { -1.0 };
            let error = [0.03 * sign, 0.05 * sign, -0.05 * sign];
            let travel = unwrap(phasors(units, 100.0, error), &options);
            let apart = (f64::from(travel.units) - units).abs();
            assert!(travel.valid, "{units}");
            assert!(apart.min(30.0 - apart) < 0.1, "{units}: {}", travel.units);
            let exact = unwrap(phasors(units, 100.0, [0.0; 3]), &options);
            let apart = (f64::from(exact.units) - units).abs();
            assert!(apart.min(30.0 - apart) < 1e-5, "{units}: {}", exact.units);
        }
    }

    #[test]
    fn phases_that_fit_nothing_and_faint_signals_are_refused() {
        let options = DecoderOptions::default();
        assert!(!unwrap(phasors(2.0, 100.0, [0.15, 0.0, 0.0]), &options).valid);
        assert!(!unwrap(phasors(2.0, 100.0, [0.0, 0.08, 0.0]), &options).valid);
        assert!(unwrap(phasors(2.0, 3.1, [0.0; 3]), &options).valid);
        assert!(!unwrap(phasors(2.0, 2.9, [0.0; 3]), &options).valid);
        assert!(!unwrap([[0.0; 2]; 3], &options).valid);
    }

    #[test]
    fn the_derivative_of_ranging_is_that_of_differences() {
        let (length, towards_emitter, step) = (1.13, 0.012, 1e-2);
        for travel_m in [0.8f32, 1.7, 4.0] {
            let at = |travel_m| Ranging::of(travel_m, length, towards_emitter);
            let difference = at(travel_m + step).depth_m - at(travel_m - step).depth_m;
            let slope = at(travel_m).depth_by_travel;
            assert!((difference / (2.0 * step) - slope).abs() < 1e-4);
        }
    }
}
