//! Bilateral filter of phasors: a weighted mean over 3×3 pixels, before unwrapping.
//!
//! After Tomasi and Manduchi, *Bilateral filtering for gray and color images* (1998), carried over to complex measurements:
//! adding phasors averages phases by their signal, and needs no unwrapping. How much a neighbour counts falls with the
//! squared difference of its three phases, in units of their noise, as Tukey's biweight does: to exactly nothing at the
//! cutoff. Brightness has no say, so that print on a surface stays part of it. IR is taken from the unfiltered phasors:
//! shading images keep their detail.

use pulp::{Simd, WithSimd};

use crate::{
    WIDTH,
    options::{BilateralOptions, DecoderOptions},
    p0_tables::N_FREQUENCIES,
    phasors::PhasorRow,
    unwrap::{PERIOD, TRAVEL_UNIT_M},
};

/// Weights of the neighbours by place, binomial: rows, columns, weight.
const NEIGHBOURS: [(usize, usize, f32); 8] = [
    (0, 0, 1.0),
    (0, 1, 2.0),
    (0, 2, 1.0),
    (1, 0, 2.0),
    (1, 2, 2.0),
    (2, 0, 1.0),
    (2, 1, 2.0),
    (2, 2, 1.0),
];
const CENTRE_WEIGHT: f32 = 4.0;

/// Pixels of a row that have neighbours on both sides.
const INNER: usize = WIDTH - 2;

/// Variance of a phasor's part per variance of a sample: the sum of three squared cosines a third of a turn apart.
const PHASOR_VARIANCE: f32 = 1.5;

/// The filter's constants, worked out from its options.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Bilateral {
    /// Variance of a phasor's real or imaginary part, squared counts.
    noise: f32,
    /// Squared phase difference of each frequency that a slanted surface makes, squared radians.
    slant: [f32; N_FREQUENCIES],
    /// One over the squared cutoff.
    falloff: f32,
}

impl Bilateral {
    pub(crate) fn new(filter: &BilateralOptions, options: &DecoderOptions) -> Self {
        let phase_rad =
            |period: f32| std::f32::consts::TAU * filter.same_surface_m / (period * TRAVEL_UNIT_M);
        Bilateral {
            noise: PHASOR_VARIANCE * options.read_noise * options.read_noise,
            slant: PERIOD.map(|period| phase_rad(period).powi(2)),
            falloff: 1.0 / (filter.cutoff_sigmas * filter.cutoff_sigmas),
        }
    }
}

/// One row to be filtered, with the rows above and below; beyond the image's edge they are zero and count for nothing.
pub(crate) struct FilterRow<'a> {
    pub(crate) filter: Bilateral,
    pub(crate) rows: [&'a PhasorRow; 3],
    pub(crate) filtered: &'a mut PhasorRow,
    /// Receives the share of the variance that is left.
    pub(crate) variance_left: &'a mut [f32; WIDTH],
}

impl WithSimd for FilterRow<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, _: S) {
        let centre = self.rows[1];
        let mut sum = PhasorRow::ZERO;
        for k in 0..N_FREQUENCIES {
            for u in 0..WIDTH {
                sum.re[k][u] = CENTRE_WEIGHT * centre.re[k][u];
                sum.im[k][u] = CENTRE_WEIGHT * centre.im[k][u];
            }
        }
        let mut total = [CENTRE_WEIGHT; WIDTH];
        let mut total_squares = [CENTRE_WEIGHT * CENTRE_WEIGHT; WIDTH];
        for (row, column, place_weight) in NEIGHBOURS {
            let weight = range_weight(self.filter, centre, self.rows[row], column, place_weight);
            for u in 0..INNER {
                total[u + 1] += weight[u];
                total_squares[u + 1] += weight[u] * weight[u];
            }
            for k in 0..N_FREQUENCIES {
                let re = &self.rows[row].re[k][column..column + INNER];
                let im = &self.rows[row].im[k][column..column + INNER];
                let (sum_re, sum_im) = (&mut sum.re[k][1..=INNER], &mut sum.im[k][1..=INNER]);
                for u in 0..INNER {
                    sum_re[u] += weight[u] * re[u];
                    sum_im[u] += weight[u] * im[u];
                }
            }
        }
        for u in 0..WIDTH {
            let scale = 1.0 / total[u];
            self.variance_left[u] = total_squares[u] * scale * scale;
            for k in 0..N_FREQUENCIES {
                self.filtered.re[k][u] = sum.re[k][u] * scale;
                self.filtered.im[k][u] = sum.im[k][u] * scale;
            }
        }
    }
}

/// What the neighbours in one direction count; `column` is 0 for those on the left, 2 for those on the right.
#[inline(always)]
fn range_weight(
    filter: Bilateral,
    centre: &PhasorRow,
    neighbour: &PhasorRow,
    column: usize,
    place_weight: f32,
) -> [f32; INNER] {
    let mut distance = [0.0; INNER];
    for k in 0..N_FREQUENCIES {
        let (re, im) = (&centre.re[k][1..=INNER], &centre.im[k][1..=INNER]);
        let re_other = &neighbour.re[k][column..column + INNER];
        let im_other = &neighbour.im[k][column..column + INNER];
        for u in 0..INNER {
            let (a, b, c, d) = (re[u], im[u], re_other[u], im_other[u]);
            let dot = a * c + b * d;
            let cross = a * d - b * c;
            let (power, other) = (a * a + b * b, c * c + d * d);
            // The squared sine of the difference over its variance, both times the powers of the two.
            let variance = filter.noise * (power + other)
                + filter.slant[k] * power * other
                + f32::MIN_POSITIVE;
            let sigmas = cross * cross / variance;
            distance[u] += if dot > 0.0 { sigmas } else { f32::INFINITY };
        }
    }
    distance.map(|distance| {
        let closeness = (1.0 - distance * filter.falloff).max(0.0);
        place_weight * closeness * closeness
    })
}
