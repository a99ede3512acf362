//! Telling the lamp's smooth shading from the projector's speckle by the image alone.

use crate::robust::median;
use depth_camera::Image;

/// Side of the tiles that images are looked at and compared by, pixels: a few dots wide, smaller than most objects.
pub(super) const TILE: usize = 8;
/// A tile is lit from this share of full scale on; a covered, unlit Kinect I shows read noise of 0.005 at most.
pub(super) const LIT: f64 = 0.04;
/// From this energy on an image is speckled. Recorded images of a wall, a sphere and a pot have 0.378 to 0.456 under the
/// projector and 0.016 to 0.040 under the lamp; this is the geometric middle of the gap.
pub(super) const SPECKLED: f64 = 0.12;
/// With less than this share of lit tiles nothing but noise is there. Under the lamp 0.45 and more is lit; arbitrary.
const MIN_LIT_SHARE: f64 = 0.03;

/// How bright and how grainy an image is.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Texture {
    /// Share of the tiles that are lit.
    pub lit_share: f64,
    /// Median over the lit tiles of the pixel-to-pixel deviation that smooth shading does not have, as a share of the
    /// tile's mean: the noise-to-signal ratio of a smooth image, several times that for bright isolated dots. 0 where
    /// nothing is lit.
    pub speckle_energy: f64,
}

impl Texture {
    /// From this speckle energy on an image shows the projector.
    pub const SPECKLE_LIMIT: f64 = SPECKLED;

    /// Whether nothing but noise is there.
    pub fn is_dark(&self) -> bool {
        self.lit_share < MIN_LIT_SHARE
    }

    /// Whether the projector shows.
    pub fn is_speckled(&self) -> bool {
        !self.is_dark() && self.speckle_energy >= SPECKLED
    }
}

/// Measures an image whose counts end at `full_scale`.
pub fn texture(counts: &Image<u16>, full_scale: f64) -> Texture {
    let (columns, rows) = (
        counts.width().saturating_sub(2) / TILE,
        counts.height().saturating_sub(2) / TILE,
    );
    let mut energies = Vec::with_capacity(columns * rows);
    for row in 0..rows {
        for column in 0..columns {
            let (mean, deviation) = tile(counts, 1 + column * TILE, 1 + row * TILE);
            if mean >= LIT * full_scale {
                energies.push(deviation / mean);
            }
        }
    }
    let n_lit = energies.len();
    Texture {
        lit_share: n_lit as f64 / (columns * rows).max(1) as f64,
        speckle_energy: median(&mut energies).unwrap_or(0.0),
    }
}

/// Mean of a tile, and the standard deviation of white noise that has the same energy under the Laplacian: slopes drop
/// out. The tile must keep one pixel from the border.
fn tile(counts: &Image<u16>, u0: usize, v0: usize) -> (f64, f64) {
    /// Sum of the Laplacian's squared coefficients (1, 1, 1, 1, -4).
    const GAIN: f64 = 20.0;
    let (mut sum, mut energy) = (0_i64, 0_i64);
    for v in v0..v0 + TILE {
        let (above, row, below) = (counts.row(v - 1), counts.row(v), counts.row(v + 1));
        for u in u0..u0 + TILE {
            let neighbours = [row[u - 1], row[u + 1], above[u], below[u]];
            let laplacian = neighbours.map(i64::from).iter().sum::<i64>() - 4 * i64::from(row[u]);
            sum += i64::from(row[u]);
            energy += laplacian * laplacian;
        }
    }
    let n = (TILE * TILE) as f64;
    (sum as f64 / n, (energy as f64 / n / GAIN).sqrt())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn image(value: impl Fn(usize, usize) -> u16) -> Image<u16> {
        let pixels = (0..64 * 48).map(|pixel| value(pixel % 64, pixel / 64));
        Image::from_vec(64, 48, pixels.collect())
    }

    #[test]
    fn a_slope_has_no_speckle_and_isolated_dots_have_much() {
        let slope = texture(&image(|u, v| (200 + 5 * u + 3 * v) as u16), 1023.0);
        assert_eq!((slope.lit_share, slope.speckle_energy), (1.0, 0.0));
        assert!(!slope.is_speckled() && !slope.is_dark());

        // One pixel in sixteen shines: mean 50 of 800, Laplacian energy 20 · 800² / 16.
        let dots = texture(
            &image(|u, v| if u % 4 == 0 && v % 4 == 0 { 800 } else { 0 }),
            1023.0,
        );
        assert!((dots.speckle_energy - 4.0).abs() < 1e-9);
        assert!(dots.is_speckled());
    }

    #[test]
    fn white_noise_reads_as_its_noise_to_signal_ratio() {
        // ±10 in no order that neighbours share: standard deviation 10 of 500.
        let hash = |u: usize, v: usize| (u * 7919 + v * 104_729 + u * v * 31) % 17 < 8;
        let noisy = texture(&image(|u, v| if hash(u, v) { 510 } else { 490 }), 1023.0);
        assert!((noisy.speckle_energy - 0.02).abs() < 0.005);
        assert!(!noisy.is_speckled());
    }

    #[test]
    fn read_noise_alone_is_dark_and_not_speckle() {
        let dark = texture(&image(|u, v| ((u * 5 + v * 3) % 7) as u16), 1023.0);
        assert_eq!(dark.lit_share, 0.0);
        assert!(dark.is_dark() && !dark.is_speckled());
    }
}
