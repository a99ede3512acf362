//! What a device's depth gets wrong, as the views of a scan tell it.

use super::DepthCorrection;
use super::revision::{Revised, Settled};
use crate::{
    fusion::Fusion,
    geometry::{Pose, RangeError},
    interreflection::WhiteLevel,
    multipath::{Compared, Evidence, RangeBias, Seen},
};
use depth_camera::Image;

/// What one scan tells of a device's depth.
#[derive(Clone, Debug)]
pub struct MeasuredDepth {
    /// The white level.
    pub white: WhiteLevel,
    /// Its standard deviation as a share of it: what views tell and what is plausible together.
    pub relative_sigma: f64,
    /// How well views agree with it.
    pub evidence: Evidence,
    /// The error by range alone, with what was known of it before; `None` if the scan shows no more of one.
    pub range_error: Option<RangeError>,
}

/// Most frames whose views are compared at the end of a scan.
const MAX_VIEWS: usize = 60;

impl DepthCorrection {
    /// What the depth of the device gets wrong by a scan that was fused as corrected here, refined by how its views agree; `None`
    /// where they agree best without multipath, or show none.
    pub fn measure(&self, fusion: &Fusion) -> Option<MeasuredDepth> {
        let Settled {
            revised,
            search,
            evidence,
        } = self.settled(fusion, &|_| true);
        let fused_again = revised.as_ref().map_or(fusion, |revised| &revised.fusion);
        let white = revised
            .as_ref()
            .map_or(self.live, |revised| revised.known.white)?;
        let asked = || {
            let views = self.compared(fused_again, Some(white))?;
            self.evidence(&views, Some(white))
        };
        let shown = revised.as_ref().and_then(Revised::range_error);
        Some(MeasuredDepth {
            white,
            relative_sigma: search?.relative_sigma(white),
            evidence: evidence.or_else(asked)?,
            range_error: shown.map(|shown| match &self.range {
                Some(before) => before.plus(shown),
                None => shown.clone(),
            }),
        })
    }

    /// The views of a scan of a sensor with multipath that was fused with a white level.
    pub(super) fn compared(&self, fusion: &Fusion, white: Option<WhiteLevel>) -> Option<Compared> {
        let multipath = self.multipath.as_ref()?;
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
        Some(multipath.compare(&seen, white, |point| fusion.signed_distance(point)))
    }

    /// What views that were fused with a white level tell of it.
    pub(super) fn evidence(&self, views: &Compared, white: Option<WhiteLevel>) -> Option<Evidence> {
        let evidence = views.evidence()?;
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
