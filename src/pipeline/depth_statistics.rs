//! Where a depth image lies against the working range: what is too close, too far, or covered shows before anything is
//! tracked.

use depth_camera::Image;

/// Every so many pixels, along rows and columns, are looked at.
const STEP_PX: usize = 4;

/// Shares of the pixels of a depth image.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct DepthStatistics {
    /// Within the working range.
    pub in_range_share: f64,
    /// Nearer.
    pub near_share: f64,
    /// Farther.
    pub far_share: f64,
}

impl DepthStatistics {
    /// Those of a depth image in metres, 0 is none; all are 0 where there is no image.
    pub fn of(depth_m: Option<&Image<f32>>, near_m: f32, far_m: f32) -> Self {
        let Some(depth) = depth_m else {
            return DepthStatistics::default();
        };
        let rows = (0..depth.height()).step_by(STEP_PX);
        let pixels = rows.flat_map(|v| depth.row(v).iter().step_by(STEP_PX));
        let (mut n, mut n_in_range, mut n_near, mut n_far) = (0usize, 0usize, 0usize, 0usize);
        for &z in pixels {
            n += 1;
            n_near += usize::from(z > 0.0 && z < near_m);
            n_in_range += usize::from(z >= near_m && z <= far_m);
            n_far += usize::from(z > far_m);
        }
        let share = |part: usize| part as f64 / n.max(1) as f64;
        DepthStatistics {
            in_range_share: share(n_in_range),
            near_share: share(n_near),
            far_share: share(n_far),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn pixels_are_parted_by_the_range() {
        let row = [0.0, 0.3, 0.5, 2.5].map(|z| [z; 4]).concat();
        let depth = Image::from_vec(16, 4, row.repeat(4));
        let statistics = DepthStatistics::of(Some(&depth), 0.35, 2.0);
        let expected = DepthStatistics {
            in_range_share: 0.25,
            near_share: 0.25,
            far_share: 0.25,
        };
        assert_eq!(statistics, expected);
        assert_eq!(
            DepthStatistics::of(None, 0.35, 2.0),
            DepthStatistics::default()
        );
    }
}
