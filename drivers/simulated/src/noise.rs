//! Random numbers that depend on what they are for, never on the order in which they are asked for.

use std::f64::consts::TAU;

/// What a random number decides; different streams are independent.
#[derive(Clone, Copy, Debug)]
pub(crate) enum Stream {
    Depth = 1,
    FixedPattern,
    Dropout,
    Infrared,
    Speckle,
}

/// Noise of one frame.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Noise {
    key: u64,
}

impl Noise {
    /// The noise of this seed, frame and stream.
    pub(crate) fn new(seed: u64, frame: u64, stream: Stream) -> Self {
        let key = scramble(scramble(seed).wrapping_add(frame));
        Noise {
            key: scramble(key.wrapping_add(stream as u64)),
        }
    }

    /// Uniform in [0, 1).
    pub(crate) fn uniform(&self, pixel: u64) -> f64 {
        let bits = scramble(self.key ^ scramble(pixel)) >> 11;
        bits as f64 / (1_u64 << 53) as f64
    }

    /// Normal with mean 0 and deviation 1, by the transform of Box and Muller.
    pub(crate) fn normal(&self, pixel: u64) -> f64 {
        // From the open end of the unit interval: the logarithm stays finite.
        let radius = (-2.0 * (1.0 - self.uniform(2 * pixel)).ln()).sqrt();
        radius * (TAU * self.uniform(2 * pixel + 1)).cos()
    }
}

/// One step of SplitMix64 (Steele, Lea, Flood 2014): every input bit reaches every output bit.
fn scramble(state: u64) -> u64 {
    let z = state.wrapping_add(0x9e37_79b9_7f4a_7c15);
    let z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    let z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
    z ^ (z >> 31)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn normal_noise_has_mean_zero_and_deviation_one() {
        let noise = Noise::new(7, 3, Stream::Depth);
        let samples: Vec<f64> = (0..40_000).map(|pixel| noise.normal(pixel)).collect();
        let mean = samples.iter().sum::<f64>() / 40_000.0;
        let variance = samples.iter().map(|x| x * x).sum::<f64>() / 40_000.0;
        // Four standard errors of the mean and of the variance.
        assert!(mean.abs() < 0.02 && (variance - 1.0).abs() < 0.03);
    }

    #[test]
    fn frames_and_streams_differ() {
        let values = [
            Noise::new(7, 3, Stream::Depth).uniform(11),
            Noise::new(7, 4, Stream::Depth).uniform(11),
            Noise::new(8, 3, Stream::Depth).uniform(11),
            Noise::new(7, 3, Stream::Infrared).uniform(11),
        ];
        for (index, value) in values.iter().enumerate() {
            assert!(!values[..index].contains(value));
        }
    }
}
