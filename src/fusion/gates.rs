//! Whether an aligned frame is believed. When in doubt it is not.

use super::noise::DepthNoise;
use super::pyramid::FramePyramid;
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

/// Judges how far the camera has moved in a time, of which at most `max_secs` count.
pub(super) fn judge_motion(
    motion: &Motion,
    elapsed_secs: f64,
    max_secs: f64,
    params: &FusionParams,
) -> Result<(), LossReason> {
    let elapsed = elapsed_secs.clamp(1.0 / 60.0, max_secs);
    if motion.rotation_rad > params.max_rotation_rad_per_s * elapsed
        || motion.translation_m > params.max_speed_m_per_s * elapsed
    {
        Err(LossReason::Jump {
            rotation_rad: motion.rotation_rad,
            translation_m: motion.translation_m,
        })
    } else {
        Ok(())
    }
}
