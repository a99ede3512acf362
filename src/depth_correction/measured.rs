//! What a device's depth gets wrong, as the views of a scan tell it.

use super::DepthCorrection;
use super::ray_order::WrongRays;
use super::revision::{Revised, Settled, together};
use crate::{
    fusion::{Fusion, GoesOn, Keyframe},
    geometry::{Pose, RangeError},
    interreflection::WhiteLevel,
    multipath::{Evidence, RangeBias, Seen},
};
use depth_camera::Image;
use rayon::prelude::*;

/// What one scan tells of a device's depth.
#[derive(Clone, Debug)]
pub struct MeasuredDepth {
    /// How bright white is; `None` where views agree best without multipath, or show none.
    pub white: Option<MeasuredWhite>,
    /// The error by range alone: what was known of it and what the scan shows beside; `None` if there is neither.
    pub range_error: Option<RangeError>,
    /// How much of what the scan shows of it is the same at all ranges, metres.
    pub constant_m: f64,
    /// How the scan's depth was computed, where that was not by the rays of its pixels; what was measured is of depth put right.
    pub wrong_rays: Option<WrongRays>,
}

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
/// Most frames that are asked for the white level that is plausible; arbitrary.
const MAX_ASKED_WHITE: usize = 40;

impl DepthCorrection {
    /// What the depth of the device gets wrong by a scan that was fused as corrected here, refined by how its views agree. As soon as
    /// `goes_on` says no, what was fused again in whole by then counts.
    pub fn measure(&self, fusion: &Fusion, goes_on: &GoesOn) -> MeasuredDepth {
        let settled = self.settled(fusion, goes_on);
        let shown = settled.revised.as_ref().and_then(Revised::range_error);
        let range_error = together(self.range.as_ref(), shown, RangeError::plus);
        let revised = settled.revised.as_ref();
        MeasuredDepth {
            constant_m: revised.map_or(0.0, Revised::constant_m),
            wrong_rays: revised.and_then(Revised::wrong_rays),
            white: self.settled_white(fusion, settled),
            range_error,
        }
    }

    /// The white level that revising a scan came to.
    fn settled_white(&self, fusion: &Fusion, settled: Settled) -> Option<MeasuredWhite> {
        let revised = settled.revised.as_ref();
        let fused_again = revised.map_or(fusion, |revised| &revised.fusion);
        let white = revised.map_or(self.live, |revised| revised.known.white)?;
        let asked = || self.evidence(fused_again, Some(white));
        Some(MeasuredWhite {
            white,
            relative_sigma: settled.search?.relative_sigma(white),
            evidence: settled.evidence.or_else(asked)?,
        })
    }

    /// What is plausible for some frames of a scan together.
    pub(super) fn plausible_white(&self, fusion: &Fusion) -> Option<WhiteLevel> {
        let multipath = self.multipath.as_ref()?;
        let of_frame = |frame: &Keyframe| {
            let nearest = self.predictions.near(frame.time_secs)?;
            multipath.plausible_white(&frame.depth_m(), nearest.prediction)
        };
        let frames = fusion.keyframes();
        let every = frames.len().div_ceil(MAX_ASKED_WHITE).max(1);
        let asked = frames.par_iter().step_by(every).with_max_len(1);
        WhiteLevel::of_one_light(asked.filter_map(of_frame).collect())
    }

    /// What the views of a scan of a sensor with multipath tell that was fused with a white level.
    pub(super) fn evidence(&self, fusion: &Fusion, white: Option<WhiteLevel>) -> Option<Evidence> {
        let multipath = self.multipath.as_ref()?;
        let frames = fusion.keyframes();
        let every = frames.len().div_ceil(MAX_VIEWS).max(1);
        let views: Vec<(Image<f32>, &Pose, RangeBias)> = frames
            .par_iter()
            .step_by(every)
            .with_max_len(1)
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
