//! Depth images in memory at about a byte a pixel: steps of the sensor's precision, differences along the rows, runs of
//! missing pixels.

use crate::geometry::lanes::{LANES, floor};
use depth_camera::Image;
use std::sync::Arc;

/// Depth is kept in steps of 0.1 mm, a tenth of the least depth noise (1.2 mm), or of what 16 bits allow.
const FINEST_STEP_M: f32 = 1e-4;
/// Codes up to this are a difference from the pixel before, biased by half of it.
const LAST_DIFFERENCE: u8 = 252;
const DIFFERENCE_BIAS: i32 = LAST_DIFFERENCE as i32 / 2;
/// The code before a whole value of two bytes.
const WHOLE: u8 = 253;
/// The code before the length of a run of missing pixels, two bytes.
const GAP: u8 = 254;

/// A depth image (metres, 0 is none), rounded to its step.
#[derive(Clone, Debug)]
pub struct PackedDepth {
    width: usize,
    height: usize,
    step_m: f32,
    /// Shared between copies.
    codes: Arc<[u8]>,
}

impl PackedDepth {
    /// Packs an image, row by row, whose depths are at most `far_m`; `codes` is where that is done.
    pub fn pack(depth: &[f32], width: usize, far_m: f32, codes: &mut Vec<u8>) -> Self {
        let step_m = FINEST_STEP_M.max(far_m / u16::MAX as f32);
        codes.clear();
        codes.reserve(depth.len());
        let (mut before, mut gap) = (0, 0);
        for depth in depth.chunks(LANES) {
            let mut values = [0; LANES];
            for (value, &z) in values.iter_mut().zip(depth) {
                *value = floor(z / step_m + 0.5);
            }
            match small_differences(before, &values) {
                Some(differences) if gap == 0 && depth.len() == LANES => {
                    codes.extend_from_slice(&differences);
                    before = values[LANES - 1];
                }
                _ => {
                    for &value in &values[..depth.len()] {
                        push(codes, value, &mut before, &mut gap);
                    }
                }
            }
        }
        close_gap(codes, &mut gap);
        PackedDepth {
            width,
            height: depth.len() / width,
            step_m,
            codes: Arc::from(&codes[..]),
        }
    }

    /// The image again.
    pub fn unpack(&self) -> Image<f32> {
        let mut data = Vec::with_capacity(self.width * self.height);
        let mut codes = self.codes.iter().copied();
        let mut before = 0i32;
        while let Some(code) = codes.next() {
            if code == GAP {
                let n_missing = usize::from(pair(&mut codes));
                data.resize(data.len() + n_missing, 0.0);
                continue;
            }
            before = match code {
                WHOLE => i32::from(pair(&mut codes)),
                difference => before + i32::from(difference) - DIFFERENCE_BIAS,
            };
            data.push(before as f32 * self.step_m);
        }
        Image::from_vec(self.width, self.height, data)
    }

    /// Bytes held.
    pub fn memory_bytes(&self) -> usize {
        self.codes.len()
    }
}

/// The codes of a stretch without gaps or leaps; `None` if it has any.
#[inline(always)]
fn small_differences(before: i32, values: &[i32; LANES]) -> Option<[u8; LANES]> {
    let (mut codes, mut all_small) = ([0; LANES], true);
    let mut previous = [before; LANES];
    previous[1..].copy_from_slice(&values[..LANES - 1]);
    for i in 0..LANES {
        let code = (values[i] - previous[i] + DIFFERENCE_BIAS) as u32;
        all_small &= (code <= u32::from(LAST_DIFFERENCE)) & (values[i] > 0);
        codes[i] = code as u8;
    }
    all_small.then_some(codes)
}

/// Appends one value, with what is to be told of the missing pixels before it; 0 is missing itself.
fn push(codes: &mut Vec<u8>, value: i32, before: &mut i32, gap: &mut u16) {
    if value == 0 && *gap < u16::MAX {
        *gap += 1;
        return;
    }
    close_gap(codes, gap);
    match u8::try_from(value - *before + DIFFERENCE_BIAS) {
        Ok(code) if code <= LAST_DIFFERENCE => codes.push(code),
        _ => push_pair(codes, WHOLE, value as u16),
    }
    *before = value;
}

fn close_gap(codes: &mut Vec<u8>, gap: &mut u16) {
    if *gap > 0 {
        push_pair(codes, GAP, *gap);
        *gap = 0;
    }
}

fn push_pair(codes: &mut Vec<u8>, code: u8, value: u16) {
    let [low, high] = value.to_le_bytes();
    codes.extend([code, low, high]);
}

fn pair(codes: &mut impl Iterator<Item = u8>) -> u16 {
    let mut next = || codes.next().expect("a pair follows its code");
    u16::from_le_bytes([next(), next()])
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn depth_survives_to_half_a_step_and_missing_pixels_stay_missing() {
        let (width, height) = (320, 240);
        let data = (0..width * height)
            .map(|pixel| match pixel {
                // Longer than one run can be.
                0..70_000 => 0.0,
                _ if pixel % 97 == 0 => 0.0,
                _ if pixel % 31 < 3 => 1.9 - (pixel % 7) as f32 * 0.0003,
                _ => 0.6 + (pixel % 11) as f32 * 0.00117,
            })
            .collect();
        let depth = Image::from_vec(width, height, data);
        let packed = PackedDepth::pack(depth.data(), width, 2.0, &mut Vec::new());
        let back = packed.unpack();
        assert_eq!((back.width(), back.height()), (width, height));
        for (a, b) in depth.data().iter().zip(back.data()) {
            assert!((a - b).abs() <= 0.51e-4 && (*a > 0.0) == (*b > 0.0));
        }
        assert!(packed.memory_bytes() < 2 * 7000);
    }
}
