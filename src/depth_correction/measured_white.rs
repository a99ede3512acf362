//! How strong multipath is, as the views of a scan tell it.

use super::DepthCorrection;
use super::revision::Settled;
use crate::{
    fusion::Fusion,
    geometry::Pose,
    interreflection::WhiteLevel,
    multipath::{Evidence, RangeBias, Seen},
};
use depth_camera::Image;

/// A device's white level as one scan tells it.
#[derive(Clone, Copy, Debug)]
pub struct MeasuredWhite {
    /// The white level.
    pub white: WhiteLevel,
    /// Its standard deviation as a share of it: what views tell and what is plausible together.
    pub relative_sigma: f64,
    /// How well views agree with it.
    pub evidence: Evidence,
}

/// Most frames whose views are compared at the end of a scan.
const MAX_VIEWS: usize = 60;

impl DepthCorrection {
    /// The white level of the device by a scan that was fused as corrected here, refined by how its views agree; `None` where
    /// views agree best without multipath, or show none.
    pub fn measure_white(&self, fusion: &Fusion) -> Option<MeasuredWhite> {
        let Settled {
            revised,
            search,
            evidence,
        } = self.settled(fusion, &|_| true);
        let fused_again = revised.as_ref().map_or(fusion, |revised| &revised.fusion);
        let white = revised
            .as_ref()
            .map_or(self.live, |revised| revised.known.white)?;
        let evidence = evidence.or_else(|| self.evidence(fused_again, Some(white)))?;
        Some(MeasuredWhite {
            white,
            relative_sigma: search?.relative_sigma(white),
            evidence,
        })
    }

    /// What the views of a scan that was fused with a white level tell of it.
    pub(super) fn evidence(&self, fusion: &Fusion, white: Option<WhiteLevel>) -> Option<Evidence> {
        let multipath = self.multipath.as_ref().filter(|_| !self.is_measured)?;
        let frames = fusion.keyframes();
        let every = frames.len().div_ceil(MAX_VIEWS).max(1);
        let views: Vec<(Image<f32>, &Pose, RangeBias)> = frames
            .iter()
            .step_by(every)
            .filter_map(|frame| {
                let nearest = self.predictions.near(frame.time_secs)?;
                let (depth, pose) = (frame.depth_m(), &frame.world_from_camera);
                let bias = nearest.bias_on(fusion, multipath, &depth, pose);
                let bias = multipath.by_patches(&bias);
                Some((depth, pose, bias))
            })
            .collect();
        let seen: Vec<Seen> = views
            .iter()
            .map(|(depth_m, world_from_camera, bias)| Seen {
                depth_m,
                world_from_camera,
                bias,
            })
            .collect();
        let evidence = multipath.evidence(&seen, white, |point| fusion.signed_distance(point))?;
        tracing::info!(
            white_level = white.map(|white| white.0),
            strength_change = evidence.slope,
            sigma = evidence.sigma,
            predicted_mm = 1e3 * evidence.predicted_m,
            disagreement_mm = 1e3 * evidence.residual_m,
            patches = evidence.n_patches,
            "multipath: how well the views of one place agree"
        );
        Some(evidence)
    }
}
