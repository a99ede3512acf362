//! An IR image of 1280×1024 on the depth image's grid of 640×480.
//!
//! The sensor has 1280×1024 pixels, and the smaller images are its, reduced: pixel (u, v) lies where columns 2u and 2u + 1 of rows
//! 2v and 2v + 1 do. They share the first row; what the larger one has more, rows 960 to 1023, is at the bottom, as the eight rows are that the
//! device's own smaller image has below the depth image's 480. With pixel centres at integers the larger image's camera so has twice
//! the focal length and the principal point (2 cx + ½, 2 cy + ½). That is how ROS's drivers relate the two sizes, whose centre is
//! 3/8 of the width less half a pixel from the top in both; nobody here has seen it on a device.
//!
//! The mean of four pixels has half the noise of one, if theirs is independent.

use depth_camera::Image;

use crate::{frames::IR_FULL_SCALE, streams::DEPTH_SIZE};

/// Reduces an image of [`crate::streams::IrSize::High`] to the `DEPTH_SIZE` pixels of `reduced`. Counts are rounded to whole ones;
/// a pixel of which a part is saturated is saturated.
pub(crate) fn reduce(high: &Image<u16>, reduced: &mut [u16]) {
    let (width, _) = DEPTH_SIZE;
    for (v, row) in reduced.chunks_exact_mut(width).enumerate() {
        let (upper, lower) = (high.row(2 * v), high.row(2 * v + 1));
        let pairs = upper.chunks_exact(2).zip(lower.chunks_exact(2));
        for (value, (upper, lower)) in row.iter_mut().zip(pairs) {
            *value = mean_of_four([upper[0], upper[1], lower[0], lower[1]]);
        }
    }
}

fn mean_of_four(counts: [u16; 4]) -> u16 {
    if counts.iter().any(|count| *count >= IR_FULL_SCALE) {
        return IR_FULL_SCALE;
    }
    (counts.iter().sum::<u16>() + 2) / 4
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::streams::IrSize;

    fn reduced(high: &Image<u16>) -> Image<u16> {
        let (width, height) = DEPTH_SIZE;
        let mut pixels = vec![0; width * height];
        reduce(high, &mut pixels);
        Image::from_vec(width, height, pixels)
    }

    /// What a camera of `focal_px` and principal point `centre_px` sees of waves that are fixed to its frame.
    fn waves(size: (usize, usize), focal_px: f64, centre_px: [f64; 2]) -> Image<f64> {
        // A period is 64 pixels at 580 px: slopes of 20 counts a pixel.
        let wave =
            |offset_px: f64| (offset_px / focal_px * 580.0 * std::f64::consts::TAU / 64.0).sin();
        let pixels = (0..size.0 * size.1).map(|i| {
            let (u, v) = ((i % size.0) as f64, (i / size.0) as f64);
            500.0 + 200.0 * wave(u - centre_px[0]) + 200.0 * wave(v - centre_px[1])
        });
        Image::from_vec(size.0, size.1, pixels.collect())
    }

    #[test]
    fn both_sizes_are_of_one_camera() {
        let high = waves(IrSize::High.pixels(), 1160.0, [639.5, 479.5]);
        let reduced = reduced(&high.map(|value| value.round() as u16));
        let expected = waves(DEPTH_SIZE, 580.0, [319.5, 239.5]);
        for (value, expected) in reduced.data().iter().zip(expected.data()) {
            // Twice rounding; the waves' curvature makes a tenth of a count. A row or column amiss would be ten.
            assert!(
                (f64::from(*value) - expected).abs() < 1.2,
                "{value} for {expected}"
            );
        }
    }

    #[test]
    fn a_mean_is_rounded_and_saturation_is_not_hidden_in_it() {
        let (width, height) = IrSize::High.pixels();
        let mut high = Image::filled(width, height, 0);
        let four = [1, 2, 2, 2];
        for (at, count) in [0, 1, width, width + 1].into_iter().zip(four) {
            high.data_mut()[at] = count;
            high.data_mut()[at + 2] = 1022;
            high.data_mut()[at + 4] = 300 + count;
        }
        high.data_mut()[5] = 1023;
        let reduced = reduced(&high);
        assert_eq!(reduced.row(0)[..4], [2, 1022, 1023, 0]);
    }
}
