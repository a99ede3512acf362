//! Images for the eye: 8 bits a pixel, and small.

use super::Preview;
use crate::shading::SATURATION;
use depth_camera::Image;

/// Widest preview, columns.
pub const PREVIEW_COLUMNS: usize = 256;
/// Widest thumbnail, columns.
pub const THUMBNAIL_COLUMNS: usize = 128;
/// The darkest and brightest byte of what is measured.
const FIRST: f32 = 1.0;
const LAST: f32 = 254.0;
const SATURATED: u8 = 255;
/// This share of the pixels is brighter than what the brightest byte stands for, so that a highlight does not darken the
/// rest.
const WHITE_SHARE: f64 = 0.01;

/// A depth image (metres, 0 is none) with a range of depths.
pub fn of_depth(frame_id: u64, depth: &Image<f32>, [near_m, far_m]: [f32; 2]) -> Preview {
    let blocks = Blocks::of(depth, PREVIEW_COLUMNS);
    let pixel = |block: &mut dyn Iterator<Item = f32>| {
        // Of what a block shows the nearest; a mean would make up surface between two.
        let nearest = block.filter(|z| *z > 0.0).reduce(f32::min);
        nearest.map_or(0, |z| byte(z, near_m, far_m))
    };
    blocks.preview(frame_id, [near_m, far_m], pixel)
}

/// An infrared image in counts, at most so many columns wide.
pub fn of_infrared<T: Copy + Into<f32>>(
    frame_id: u64,
    counts: &Image<T>,
    full_scale: f64,
    max_columns: usize,
) -> Preview {
    let blocks = Blocks::of(counts, max_columns);
    let limit = (SATURATION * full_scale) as f32;
    let shown = blocks.map(|block| {
        let (mut sum, mut n, mut largest) = (0.0, 0.0, 0.0f32);
        for counts in block {
            sum += counts;
            n += 1.0;
            largest = largest.max(counts);
        }
        // One saturated pixel shows.
        if largest >= limit {
            f32::INFINITY
        } else {
            sum / n
        }
    });
    let high = white(&shown);
    let pixel = |block: &mut dyn Iterator<Item = f32>| match block.next() {
        Some(f32::INFINITY) => SATURATED,
        Some(mean) => byte(mean, 0.0, high),
        None => 0,
    };
    Blocks::of(&shown, usize::MAX).preview(frame_id, [0.0, high], pixel)
}

/// What is shown as white.
fn white(means: &Image<f32>) -> f32 {
    let mut finite: Vec<f32> = means
        .data()
        .iter()
        .copied()
        .filter(|m| m.is_finite())
        .collect();
    let Some(last) = finite.len().checked_sub(1) else {
        return 1.0;
    };
    let rank = last - (WHITE_SHARE * last as f64) as usize;
    finite
        .select_nth_unstable_by(rank, f32::total_cmp)
        .1
        .max(1.0)
}

fn byte(value: f32, low: f32, high: f32) -> u8 {
    let share = (value - low) / (high - low);
    (FIRST + share * (LAST - FIRST)).round().clamp(FIRST, LAST) as u8
}

/// An image as squares of pixels, one for each pixel of a smaller image; what is left over at the right and below is not
/// shown.
struct Blocks<'a, T> {
    image: &'a Image<T>,
    side: usize,
    columns: usize,
    rows: usize,
}

impl<'a, T: Copy + Into<f32>> Blocks<'a, T> {
    fn of(image: &'a Image<T>, max_columns: usize) -> Self {
        let side = image.width().div_ceil(max_columns).max(1);
        Blocks {
            image,
            side,
            columns: image.width() / side,
            rows: image.height() / side,
        }
    }

    fn map<U>(&self, mut pixel: impl FnMut(&mut dyn Iterator<Item = f32>) -> U) -> Image<U> {
        let mut pixels = Vec::with_capacity(self.columns * self.rows);
        for row in 0..self.rows {
            for column in 0..self.columns {
                let lines = row * self.side..(row + 1) * self.side;
                let of_line = |v| &self.image.row(v)[column * self.side..][..self.side];
                let mut block = lines.flat_map(of_line).map(|value| (*value).into());
                pixels.push(pixel(&mut block));
            }
        }
        Image::from_vec(self.columns, self.rows, pixels)
    }

    fn preview(
        &self,
        frame_id: u64,
        [low, high]: [f32; 2],
        pixel: impl FnMut(&mut dyn Iterator<Item = f32>) -> u8,
    ) -> Preview {
        Preview {
            frame_id,
            width: self.columns as u16,
            height: self.rows as u16,
            low,
            high,
            pixels: self.map(pixel).into_vec(),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn depth_is_the_nearest_of_a_block_and_none_is_black() {
        let mut depth = Image::filled(512, 424, 2.0f32);
        depth.data_mut()[0] = 0.5;
        for pixel in [2, 3, 514, 515] {
            depth.data_mut()[pixel] = 0.0;
        }
        let preview = of_depth(3, &depth, [0.5, 2.0]);
        assert_eq!((preview.width, preview.height), (256, 212));
        assert_eq!((preview.low, preview.high), (0.5, 2.0));
        assert_eq!(preview.pixels[..3], [1, 0, 254]);
    }

    #[test]
    fn saturation_stands_out_of_the_brightest_that_is_not() {
        let mut counts = Image::filled(640, 480, 1000u16);
        for pixel in &mut counts.data_mut()[..640 * 100] {
            *pixel = 250;
        }
        counts.data_mut()[7] = 1023;
        let thumbnail = of_infrared(0, &counts, 1023.0, THUMBNAIL_COLUMNS);
        assert_eq!((thumbnail.width, thumbnail.height), (128, 96));
        assert_eq!(thumbnail.high, 1000.0);
        // Blocks of 5 pixels: the second one holds the saturated pixel.
        assert_eq!(thumbnail.pixels[..3], [64, 255, 64]);
        assert_eq!(thumbnail.pixels.last(), Some(&254));
        let all = of_infrared(0, &Image::filled(8, 8, 1023u16), 1023.0, 8);
        assert!(all.pixels.iter().all(|pixel| *pixel == 255));
    }
}
