//! Several exposures of one pose into one image.
//!
//! The lamp flickers and the scene may move between exposures; the sensor's noise is what averaging is to lower. Exposures
//! are compared by the means of tiles, where noise is small: a common factor is the lamp's, and differences that are left
//! in part of the image are movement. Counts are averaged with the response not removed: it is nearly straight over the
//! noise.

use super::rejection::{RejectReason, Rejection};
use super::speckle::{LIT, TILE};
use crate::robust::median_between;
use crate::shading::SATURATION;
use depth_camera::Image;

/// A tile differs from this relative deviation on: noise of the mean of 64 pixels reached 0.036 in recorded exposures.
const DIFFERS: f64 = 0.1;

/// One IR image under the lamp.
#[derive(Clone, Debug)]
pub(super) struct Exposure {
    pub(super) frame_id: u64,
    pub(super) device_time_secs: f64,
    pub(super) counts: Image<u16>,
    mean_counts: f64,
}

impl Exposure {
    /// An image from where `depth_m` was seen before.
    pub(super) fn new(
        frame_id: u64,
        device_time_secs: f64,
        counts: Image<u16>,
        depth_m: Option<&Image<f32>>,
    ) -> Self {
        Exposure {
            frame_id,
            device_time_secs,
            mean_counts: mean_counts(&counts, depth_m),
            counts,
        }
    }

    /// Mean over the pixels with depth, see [`mean_counts`].
    pub(super) fn mean_counts(&self) -> f64 {
        self.mean_counts
    }
}

/// Exposures that agree, each with its brightness relative to the others.
pub(super) struct Agreeing<'a> {
    pub(super) exposures: Vec<&'a Exposure>,
    gains: Vec<f64>,
}

/// Parts the exposures into those that show the same scene and those that do not; the lamp's flicker is no difference.
pub(super) fn agreeing(
    exposures: &[Exposure],
    full_scale: f64,
    max_changed_share: f64,
) -> (Agreeing<'_>, Vec<Rejection>) {
    let means: Vec<_> = exposures
        .iter()
        .map(|exposure| tile_means(&exposure.counts, full_scale))
        .collect();
    let gains = gains(&means);
    let normalised: Vec<Vec<f64>> = means
        .iter()
        .zip(&gains)
        .map(|(means, gain)| means.iter().map(|mean| mean / gain).collect())
        .collect();
    let reference = median_of_each(&normalised);

    let mut kept = Agreeing {
        exposures: Vec::new(),
        gains: Vec::new(),
    };
    let mut rejected = Vec::new();
    for ((exposure, means), gain) in exposures.iter().zip(&normalised).zip(gains) {
        let share = changed_share(means, &reference);
        if share <= max_changed_share {
            kept.exposures.push(exposure);
            kept.gains.push(gain);
        } else {
            rejected.push(Rejection {
                frame_id: exposure.frame_id,
                reason: RejectReason::Changed { share },
            });
        }
    }
    (kept, rejected)
}

impl Agreeing<'_> {
    /// The mean of the exposures at their mean brightness. A pixel that is saturated in half of them or more is at full
    /// scale; of others only the unsaturated values count.
    ///
    /// # Panics
    /// If there is no exposure.
    pub(super) fn average(&self, full_scale: f64) -> Image<f32> {
        let n = self.exposures.len();
        let mean_gain = self.gains.iter().sum::<f64>() / n as f64;
        let saturated = SATURATION * full_scale;
        let (width, height) = (
            self.exposures[0].counts.width(),
            self.exposures[0].counts.height(),
        );
        let mut sums = vec![(0.0_f64, 0_usize); width * height];
        for (exposure, gain) in self.exposures.iter().zip(&self.gains) {
            let scale = mean_gain / gain;
            for (sum, &counts) in sums.iter_mut().zip(exposure.counts.data()) {
                if f64::from(counts) < saturated {
                    *sum = (sum.0 + f64::from(counts) * scale, sum.1 + 1);
                }
            }
        }
        let mean = |(sum, n_used): (f64, usize)| match 2 * n_used > n {
            true => (sum / n_used as f64) as f32,
            false => full_scale as f32,
        };
        Image::from_vec(width, height, sums.into_iter().map(mean).collect())
    }
}

/// Mean over the pixels with depth; over all pixels where none has.
pub(super) fn mean_counts<T: Copy + Into<f64>>(
    counts: &Image<T>,
    depth_m: Option<&Image<f32>>,
) -> f64 {
    let all = counts.data();
    let mean = |sum: f64, n: usize| sum / n.max(1) as f64;
    let measured = depth_m.into_iter().flat_map(|depth_m| depth_m.data());
    let measured = all.iter().zip(measured).filter(|(_, z)| **z > 0.0);
    let (sum, n) = measured.fold((0.0, 0), |(sum, n), (&counts, _)| {
        (sum + counts.into(), n + 1)
    });
    match n {
        0 => mean(all.iter().map(|&counts| counts.into()).sum(), all.len()),
        n => mean(sum, n),
    }
}

/// Share of the pixels at full scale.
pub(super) fn saturated_share<T: Copy + Into<f32>>(counts: &Image<T>, full_scale: f64) -> f64 {
    let limit = (SATURATION * full_scale) as f32;
    let n_saturated = counts
        .data()
        .iter()
        .filter(|c| (**c).into() >= limit)
        .count();
    n_saturated as f64 / counts.data().len().max(1) as f64
}

/// Means of the tiles: 0 where a tile is too dark, NaN where it touches saturation and cannot be compared.
fn tile_means(counts: &Image<u16>, full_scale: f64) -> Vec<f64> {
    let (columns, rows) = (counts.width() / TILE, counts.height() / TILE);
    let tiles = (0..columns * rows).map(|tile| (tile % columns * TILE, tile / columns * TILE));
    tiles
        .map(|(u, v)| {
            let pixels = (v..v + TILE).flat_map(|row| &counts.row(row)[u..u + TILE]);
            let (sum, largest) = pixels.fold((0, 0), |(sum, largest), &counts| {
                (sum + u32::from(counts), largest.max(counts))
            });
            let mean = f64::from(sum) / (TILE * TILE) as f64;
            if f64::from(largest) >= SATURATION * full_scale {
                f64::NAN
            } else if mean < LIT * full_scale {
                0.0
            } else {
                mean
            }
        })
        .collect()
}

/// Brightness of each exposure against the middle one, by the median over the tiles: what covers less than half of the
/// image does not count.
fn gains(means: &[Vec<f64>]) -> Vec<f64> {
    let reference = median_of_each(means);
    means
        .iter()
        .map(|means| {
            let ratios = means.iter().zip(&reference);
            let ratios = ratios.filter(|(mean, reference)| **mean > 0.0 && **reference > 0.0);
            let ratios = ratios.map(|(mean, reference)| mean / reference);
            median_between(&mut ratios.collect::<Vec<_>>()).unwrap_or(1.0)
        })
        .collect()
}

/// Share of the reference's lit tiles that differ; a tile that is not lit in the exposure differs by all it has.
fn changed_share(means: &[f64], reference: &[f64]) -> f64 {
    let lit = || means.iter().zip(reference).filter(|(_, r)| **r > 0.0);
    let n_changed = lit()
        .filter(|(mean, reference)| (*mean - *reference).abs() > DIFFERS * *reference)
        .count();
    n_changed as f64 / lit().count().max(1) as f64
}

/// The median over the exposures, tile by tile; NaN where one of them has NaN.
fn median_of_each(means: &[Vec<f64>]) -> Vec<f64> {
    let n_tiles = means.first().map_or(0, Vec::len);
    (0..n_tiles)
        .map(|tile| {
            let mut of_tile: Vec<f64> = means.iter().map(|means| means[tile]).collect();
            median_between(&mut of_tile).unwrap_or(0.0)
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    const FULL_SCALE: f64 = 1023.0;

    fn exposure(frame_id: u64, value: impl Fn(usize, usize) -> f64) -> Exposure {
        let pixels = (0..64 * 48).map(|pixel| value(pixel % 64, pixel / 64) as u16);
        let counts = Image::from_vec(64, 48, pixels.collect());
        Exposure::new(frame_id, frame_id as f64 / 30.0, counts, None)
    }

    #[test]
    fn brightness_is_that_of_the_pixels_with_depth() {
        let counts = Image::from_vec(2, 2, vec![100_u16, 200, 300, 600]);
        let mean = |depth_m: [f32; 4]| {
            let depth_m = Image::from_vec(2, 2, depth_m.to_vec());
            mean_counts(&counts, Some(&depth_m))
        };
        assert_eq!(mean([0.5, 0.0, 0.7, 0.0]), 200.0);
        assert_eq!(mean([0.0; 4]), 300.0);
        assert_eq!(mean_counts(&counts, None), 300.0);
    }

    #[test]
    fn flicker_is_divided_out() {
        let scene = |u: usize, v: usize| 200.0 + 2.0 * u as f64 + v as f64;
        let exposures = [0.9, 1.0, 1.1]
            .map(|lamp| exposure((lamp * 10.0) as u64, |u, v| (lamp * scene(u, v)).round()));
        let (kept, rejected) = agreeing(&exposures, FULL_SCALE, 0.02);
        assert!(rejected.is_empty());
        let mean = kept.average(FULL_SCALE);
        // Rounding to whole counts.
        assert!((f64::from(*mean.at(20, 30)) - scene(20, 30)).abs() < 0.5);
    }

    #[test]
    fn an_exposure_with_a_hand_in_it_is_left_out() {
        let hand = |u: usize, v: usize| if u < 16 && v < 16 { 600.0 } else { 300.0 };
        let exposures = [
            exposure(4, |_, _| 300.0),
            exposure(5, hand),
            exposure(6, |_, _| 330.0),
            exposure(7, |_, _| 300.0),
        ];
        let (kept, rejected) = agreeing(&exposures, FULL_SCALE, 0.02);
        assert_eq!(kept.exposures.len(), 3);
        // Four of the 48 tiles.
        let reason = RejectReason::Changed { share: 4.0 / 48.0 };
        assert_eq!(
            rejected,
            [Rejection {
                frame_id: 5,
                reason
            }]
        );
        assert!((kept.average(FULL_SCALE).at(3, 3) - 310.0).abs() < 0.01);
    }

    #[test]
    fn two_exposures_that_differ_are_both_left_out() {
        let exposures = [
            exposure(1, |_, _| 300.0),
            exposure(2, |u, _| if u < 32 { 300.0 } else { 900.0 }),
        ];
        let (kept, rejected) = agreeing(&exposures, FULL_SCALE, 0.02);
        assert!(kept.exposures.is_empty());
        assert_eq!(rejected.len(), 2);
    }

    #[test]
    fn saturated_values_do_not_enter_the_mean() {
        let bright =
            |value: f64| move |u: usize, v: usize| if (u, v) == (3, 3) { value } else { 400.0 };
        let most = [1000.0, 990.0, 1023.0].map(|value| exposure(0, bright(value)));
        let (kept, _) = agreeing(&most, FULL_SCALE, 0.02);
        assert_eq!(*kept.average(FULL_SCALE).at(3, 3), 995.0);
        let few = [1000.0, 1023.0].map(|value| exposure(0, bright(value)));
        let (kept, _) = agreeing(&few, FULL_SCALE, 0.02);
        assert_eq!(*kept.average(FULL_SCALE).at(3, 3), 1023.0);
    }
}
