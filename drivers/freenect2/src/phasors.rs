//! From the codes of a row to one phasor for each frequency.
//!
//! The three exposures of frequency k hold m_j = B_k cos(θ_k + p_k + j 2π/3): θ_k is the phase of the light's travel, p_k
//! that of the reference, B_k the signal's amplitude. Their discrete Fourier component, turned by −p_k, is the *phasor*
//! M_k = 3/2 B_k exp(i θ_k).

use pulp::{Simd, WithSimd};

use crate::{
    WIDTH,
    options::DecoderOptions,
    p0_tables::{N_FREQUENCIES, P0Tables},
    packet::{self, N_SUB_IMAGES, RawPacket, SATURATED_CODE},
};

/// Length of a phasor for an amplitude of 1.
pub(crate) const PHASOR_GAIN: f32 = 1.5;

/// IR counts for the mean of the amplitudes.
const IR_GAIN: f32 = 16.0;

/// What makes the amplitudes of the three frequencies alike: the emitter's modulation differs.
pub(crate) const EQUALISER: [f32; N_FREQUENCIES] = [1.322_581, 1.0, 1.612_903];

/// Half of the square root of 3: the sine of a third of a turn.
const THIRD_TURN_SINE: f32 = 0.866_025_4;

/// The phasors of a row, linear counts; all zero where there is no signal.
#[derive(Clone, Debug)]
pub(crate) struct PhasorRow {
    pub(crate) re: [[f32; WIDTH]; N_FREQUENCIES],
    pub(crate) im: [[f32; WIDTH]; N_FREQUENCIES],
}

impl PhasorRow {
    /// No signal at all.
    pub(crate) const ZERO: PhasorRow = PhasorRow {
        re: [[0.0; WIDTH]; N_FREQUENCIES],
        im: [[0.0; WIDTH]; N_FREQUENCIES],
    };
}

/// Cosine and sine of the reference's phase for the pixels of one row.
#[derive(Clone, Debug)]
pub(crate) struct ReferenceRow {
    cos: [[f32; WIDTH]; N_FREQUENCIES],
    sin: [[f32; WIDTH]; N_FREQUENCIES],
}

impl ReferenceRow {
    /// The tables' row `v`, its columns turned round if the image is.
    pub(crate) fn new(tables: &P0Tables, v: usize, options: &DecoderOptions) -> Self {
        let mut row = ReferenceRow {
            cos: [[0.0; WIDTH]; N_FREQUENCIES],
            sin: [[0.0; WIDTH]; N_FREQUENCIES],
        };
        for k in 0..N_FREQUENCIES {
            for u in 0..WIDTH {
                let column = if options.unmirrored { WIDTH - 1 - u } else { u };
                let (sin, cos) = tables.phase_rad(k, column, v).sin_cos();
                row.cos[k][u] = cos as f32;
                row.sin[k][u] = sin as f32;
            }
        }
        row
    }
}

/// One row of a packet, to be measured.
pub(crate) struct MeasureRow<'a> {
    pub(crate) packet: RawPacket<'a>,
    pub(crate) v: usize,
    pub(crate) unmirrored: bool,
    pub(crate) reference: &'a ReferenceRow,
    pub(crate) phasors: &'a mut PhasorRow,
    pub(crate) ir: &'a mut [u16; WIDTH],
    pub(crate) ambient: &'a mut [i16; WIDTH],
}

impl WithSimd for MeasureRow<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, _: S) {
        let mut codes = [[0; WIDTH]; N_SUB_IMAGES];
        for (sub_image, codes) in codes.iter_mut().enumerate() {
            packet::unpack_row(self.packet.row(sub_image, self.v), codes);
            if self.unmirrored {
                codes.reverse();
            }
        }
        let [exposures @ .., unlit] = &codes;

        let mut saturated = [false; WIDTH];
        for codes in exposures {
            for u in 0..WIDTH {
                saturated[u] |= codes[u] == SATURATED_CODE;
            }
        }
        // The sensor's outermost columns are not exposed like the others; no decoder uses them.
        let (mut lit, mut sum) = ([1.0f32; WIDTH], [0.0f32; WIDTH]);
        for u in 0..WIDTH {
            lit[u] = if saturated[u] { 0.0 } else { 1.0 };
        }
        (lit[0], lit[WIDTH - 1]) = (0.0, 0.0);

        for k in 0..N_FREQUENCIES {
            let [first, second, third] = [&codes[3 * k], &codes[3 * k + 1], &codes[3 * k + 2]];
            let (cos, sin) = (&self.reference.cos[k], &self.reference.sin[k]);
            let (re, im) = (&mut self.phasors.re[k], &mut self.phasors.im[k]);
            for u in 0..WIDTH {
                let m = [first[u], second[u], third[u]].map(packet::linear);
                let x = (m[0] - 0.5 * (m[1] + m[2])) * lit[u];
                let y = (m[2] - m[1]) * THIRD_TURN_SINE * lit[u];
                re[u] = cos[u] * x + sin[u] * y;
                im[u] = cos[u] * y - sin[u] * x;
                sum[u] += (x * x + y * y).sqrt() * EQUALISER[k];
            }
        }

        let gain = IR_GAIN / (PHASOR_GAIN * N_FREQUENCIES as f32);
        for u in 0..WIDTH {
            let counts = (sum[u] * gain + 0.5).min(65_535.0);
            let counts = if saturated[u] { 65_535.0 } else { counts };
            self.ir[u] = counts as u16;
            let ambient = packet::linear(unlit[u]) as i16;
            self.ambient[u] = if unlit[u] == SATURATED_CODE {
                i16::MAX
            } else {
                ambient
            };
        }
        for edge in [0, WIDTH - 1] {
            (self.ir[edge], self.ambient[edge]) = (0, 0);
        }
    }
}
