//! Under which conditions a scan goes on, frame by frame: from what tracking says, how fast the camera moves, and what the
//! images show, to the one thing that the operator should know.
//!
//! Pure: the same frames give the same states. What does not come with frames (a pause, a silent device, a full disk) is
//! laid over them by `standing.rs`.

use super::{
    depth_statistics::DepthStatistics,
    state::{Degradation, Loss, State},
};
use crate::{
    fusion::{Fit, FusionParams, LossReason, TrackingOutcome},
    geometry::{Pose, motion_between},
    snapshot::SnapshotParams,
};

/// Below this fitness the operator is told that tracking is weak.
pub const WEAK_FITNESS: f64 = 0.25;
/// Other reasons to be told hold for so many frames in a row before they are told, and before they are taken back.
const STEADY_FRAMES: usize = 5;
/// With less than this share of the pixels in range a frame shows (almost) nothing.
const LITTLE: f64 = 0.1;
/// What is too near or too far is most of what is measured from this share on.
const MOST: f64 = 0.5;
/// Where this share of the infrared image is at full scale and there is hardly any depth, something is right in front.
const GLARING: f64 = 0.2;
/// A camera is too fast from this share of what tracking would still believe; a walk round an object at 0.75 m in 7 s has
/// 0.24 of the turn and 0.35 of the speed.
const FAST_SHARE: f64 = 0.6;
/// A loss within this time after the camera was too fast is one of speed, seconds.
const AFTER_FAST_SECS: f64 = 0.3;

/// A frame as it bears on the state.
#[derive(Clone, Copy, Debug)]
pub struct Observed<'a> {
    /// The device's clock, seconds.
    pub time_secs: f64,
    /// What became of it; `None` where poses are given and none is near.
    pub outcome: Option<&'a TrackingOutcome>,
    /// Where its depth lies.
    pub depth: DepthStatistics,
    /// Share of its infrared image at full scale, if it has one.
    pub saturated_share: Option<f64>,
}

/// Follows the frames of a scan.
#[derive(Clone, Debug)]
pub struct Conditions {
    max_rotation_rad_per_s: f64,
    max_speed_m_per_s: f64,
    max_saturated_share: f64,
    state: State,
    /// What the last frames would have the operator told instead, and how many of them in a row.
    pending: (Option<Degradation>, usize),
    last: Option<(f64, Pose)>,
    last_fast_secs: Option<f64>,
    /// Why the camera was lost first, while it is, for reasons that are not in the operator's way.
    first_loss: Option<Loss>,
}

impl Conditions {
    /// The conditions before the first frame.
    pub fn new(fusion: &FusionParams, snapshot: &SnapshotParams) -> Self {
        Conditions {
            max_rotation_rad_per_s: FAST_SHARE * fusion.max_rotation_rad_per_s,
            max_speed_m_per_s: FAST_SHARE * fusion.max_speed_m_per_s,
            max_saturated_share: snapshot.max_saturated_share,
            state: State::Warming,
            pending: (None, 0),
            last: None,
            last_fast_secs: None,
            first_loss: None,
        }
    }

    /// Forgets how the camera moved, and why it was lost: the next frame may show another place.
    pub fn interrupt(&mut self) {
        self.last = None;
        self.last_fast_secs = None;
        self.first_loss = None;
    }

    /// The state after one more frame.
    pub fn observe(&mut self, observed: &Observed) -> State {
        self.state = match observed.outcome {
            Some(TrackingOutcome::Tracked {
                world_from_camera,
                fit,
            }) => {
                self.first_loss = None;
                let is_fast = self.moved(observed.time_secs, world_from_camera);
                self.tracked(observed, fit.as_ref(), is_fast)
            }
            Some(TrackingOutcome::Lost(LossReason::Unconfirmed)) => State::Relocalising,
            Some(TrackingOutcome::Lost(reason)) => State::Lost(self.loss(observed, reason)),
            Some(TrackingOutcome::NoDepth) => State::Lost(blind(observed)),
            None => State::Lost(Loss::Elsewhere),
        };
        self.state
    }

    /// Takes a pose in; whether the camera got there too fast.
    fn moved(&mut self, time_secs: f64, world_from_camera: &Pose) -> bool {
        let before = self.last.replace((time_secs, *world_from_camera));
        let is_fast = before.is_some_and(|(before_secs, pose)| {
            let elapsed = time_secs - before_secs;
            let motion = motion_between(&pose, world_from_camera);
            elapsed > 0.0
                && (motion.rotation_rad > self.max_rotation_rad_per_s * elapsed
                    || motion.translation_m > self.max_speed_m_per_s * elapsed)
        });
        if is_fast {
            self.last_fast_secs = Some(time_secs);
        }
        is_fast
    }

    fn tracked(&mut self, observed: &Observed, fit: Option<&Fit>, is_fast: bool) -> State {
        let degradation = self.degradation(observed, fit, is_fast);
        let is_weak = fit.is_some_and(|fit| fit.fitness < WEAK_FITNESS);
        let (pending, n_frames) = self.pending;
        let n_frames = if pending == degradation {
            n_frames + 1
        } else {
            1
        };
        self.pending = (degradation, n_frames);
        let is_steady = n_frames >= STEADY_FRAMES || is_weak;
        match (self.state, degradation) {
            (State::Degraded(_), Some(reason)) if is_steady => State::Degraded(reason),
            (State::Degraded(_), None) if is_steady => State::Tracking,
            (State::Degraded(told), _) => State::Degraded(told),
            (_, Some(reason)) if is_steady => State::Degraded(reason),
            _ => State::Tracking,
        }
    }

    /// What is not as it should be, the most urgent first.
    fn degradation(
        &self,
        observed: &Observed,
        fit: Option<&Fit>,
        is_fast: bool,
    ) -> Option<Degradation> {
        let depth = &observed.depth;
        let is_too_close = depth.near_share > depth.in_range_share.max(LITTLE);
        let is_too_far = depth.far_share > MOST && depth.in_range_share < LITTLE;
        let is_flat = fit.is_some_and(Fit::is_sliding);
        let is_weak = fit.is_some_and(|fit| fit.fitness < WEAK_FITNESS);
        let is_saturated = observed
            .saturated_share
            .is_some_and(|share| share > self.max_saturated_share);
        [
            (is_fast, Degradation::TooFast),
            (is_too_close, Degradation::TooClose),
            (is_flat, Degradation::FlatScene),
            (is_weak, Degradation::FewInliers),
            (is_too_far, Degradation::TooFar),
            (is_saturated, Degradation::SaturatedInfrared),
        ]
        .into_iter()
        .find_map(|(is_so, reason)| is_so.then_some(reason))
    }

    /// Why the camera is lost. While it is, the first reason holds unless it is in the operator's way now.
    fn loss(&mut self, observed: &Observed, reason: &LossReason) -> Loss {
        let depth = &observed.depth;
        if depth.near_share > depth.in_range_share.max(LITTLE) {
            return Loss::TooClose;
        }
        let was_fast = self
            .last_fast_secs
            .is_some_and(|fast| observed.time_secs - fast < AFTER_FAST_SECS);
        *self.first_loss.get_or_insert(match reason {
            LossReason::Jump { .. } => Loss::TooFast,
            LossReason::FlatScene { .. } => Loss::FlatScene,
            LossReason::Elsewhere | LossReason::SeeThrough { .. } => Loss::Elsewhere,
            _ if was_fast => Loss::TooFast,
            _ => Loss::FewInliers,
        })
    }
}

/// Why there is no depth in range.
fn blind(observed: &Observed) -> Loss {
    let is_glaring = observed
        .saturated_share
        .is_some_and(|share| share > GLARING);
    match observed.depth.near_share > LITTLE || is_glaring {
        true => Loss::TooClose,
        false => Loss::CoveredLens,
    }
}

#[cfg(test)]
mod tests;
