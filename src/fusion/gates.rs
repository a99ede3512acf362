//! Whether an aligned frame is believed. When in doubt it is not.

use super::noise::DepthNoise;
use super::pyramid::FramePyramid;
use super::track::LEAST_INTERVAL_SECS;
use super::{Fit, FusionParams, LossReason};
use crate::geometry::Motion;

/// Judges how well a frame fits.
pub(super) fn judge_fit(
    fit: &Fit,
    frame: &FramePyramid,
    noise: &DepthNoise,
    params: &FusionParams,
) -> Result<(), LossReason> {
    let sigma_m = noise.sigma_m(frame.median_depth_m()) as f64;
    if fit.inlier_share < params.min_inlier_share {
        Err(LossReason::FewInliers {
            inlier_share: fit.inlier_share,
        })
    } else if fit.see_through_share > params.max_see_through_share {
        Err(LossReason::SeeThrough {
            share: fit.see_through_share,
        })
    } else if fit.rmse_m > params.max_rmse_sigmas * sigma_m {
        Err(LossReason::LargeResidual { rmse_m: fit.rmse_m })
    } else if fit.conditioning < params.min_conditioning {
        Err(LossReason::FlatScene {
            conditioning: fit.conditioning,
        })
    } else {
        Ok(())
    }
}

/// How far a fit is from the gates: see [`Fit::fitness`].
pub(super) fn fitness(
    fit: &Fit,
    frame: &FramePyramid,
    noise: &DepthNoise,
    params: &FusionParams,
) -> f64 {
    let sigma_m = noise.sigma_m(frame.median_depth_m()) as f64;
    // 0 at the gate, 1 halfway from there to what is perfect.
    let margin = |value: f64, gate: f64, perfect: f64| 2.0 * (value - gate) / (perfect - gate);
    [
        margin(fit.inlier_share, params.min_inlier_share, 1.0),
        margin(fit.see_through_share, params.max_see_through_share, 0.0),
        margin(fit.rmse_m, params.max_rmse_sigmas * sigma_m, 0.0),
        // A share that spans decades: one of them.
        (fit.conditioning / params.min_conditioning).log10(),
    ]
    .into_iter()
    // A gate that is switched off has no margin: 0/0.
    .filter(|margin| !margin.is_nan())
    .fold(1.0, f64::min)
    .max(0.0)
}

/// A camera that was as fast before may be faster than the limits by this factor: from frame to frame a hand can hardly stop. The
/// factor is arbitrary.
const IN_FULL_SWING: f64 = 2.0;
/// It is as fast as before if it is where that leads within this share of the limits; arbitrary, 17 mm from one frame to the
/// next are an acceleration of 15 m/s².
const AS_BEFORE: f64 = 0.25;

/// Judges how far the camera has moved in a time, and how far it is from where its motion before leads.
pub(super) fn judge_motion(
    motion: &Motion,
    deviation: &Motion,
    elapsed_secs: f64,
    params: &FusionParams,
) -> Result<(), LossReason> {
    let is_within = |factor| is_within(motion, factor, elapsed_secs, params);
    let is_in_full_swing =
        || is_within(IN_FULL_SWING) && is_as_before(deviation, elapsed_secs, params);
    if is_within(1.0) || is_in_full_swing() {
        Ok(())
    } else {
        Err(LossReason::Jump {
            rotation_rad: motion.rotation_rad,
            translation_m: motion.translation_m,
        })
    }
}

/// Whether the camera is where its motion before leads, given how far it is from there after a time.
pub(super) fn is_as_before(deviation: &Motion, elapsed_secs: f64, params: &FusionParams) -> bool {
    is_within(deviation, AS_BEFORE, elapsed_secs, params)
}

/// Whether a motion in a time is within the limits times a factor.
fn is_within(motion: &Motion, factor: f64, elapsed_secs: f64, params: &FusionParams) -> bool {
    let elapsed = elapsed_secs.max(LEAST_INTERVAL_SECS);
    motion.rotation_rad <= factor * params.max_rotation_rad_per_s * elapsed
        && motion.translation_m <= factor * params.max_speed_m_per_s * elapsed
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_jump_is_not_believed_unless_the_camera_was_as_fast_before() {
        let params = FusionParams::default();
        // At 30 frames a second and 2 m/s.
        let (elapsed_secs, limit_m) = (1.0 / 30.0, 0.0667);
        let judge = |moved_m: f64, off_m: f64| {
            let [motion, deviation] = [moved_m, off_m].map(|translation_m| Motion {
                rotation_rad: 0.08,
                translation_m,
            });
            let deviation = Motion {
                rotation_rad: 0.01,
                ..deviation
            };
            judge_motion(&motion, &deviation, elapsed_secs, &params)
        };
        assert_eq!(judge(0.95 * limit_m, 0.95 * limit_m), Ok(()));
        let jump = Err(LossReason::Jump {
            rotation_rad: 0.08,
            translation_m: 0.08,
        });
        assert_eq!(judge(0.08, 0.08), jump, "from rest");
        assert_eq!(judge(0.08, 0.2 * limit_m), Ok(()), "in full swing");
        assert_eq!(judge(0.08, 0.3 * limit_m), jump, "beside the swing");
        assert!(judge(2.1 * limit_m, 0.0).is_err(), "too fast for any hand");
    }
}
