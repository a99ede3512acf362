//! Fusing at poses that were measured elsewhere, by a rig, a turntable or a robot, and polishing these on what is already fused.
//!
//! The given pose is the start of the frame's alignment, and what the result is held against: one that goes farther than
//! such poses err is a slide or a false fit, and the given pose is the better one. Frames do not drift off with the model,
//! since each of them is held by its own pose, however often it is fused anew.

use super::{
    Fit, Fusion, FusionStep, Keyframe, LossReason, OnStep, TrackingOutcome,
    align::{Beside, align},
    gates,
};
use crate::geometry::{Motion, Pose, motion_between};
use depth_camera::Image;
use serde::{Deserialize, Serialize};

/// Whether given poses are polished, and how far they may err.
#[derive(Clone, Debug, PartialEq, Deserialize, Serialize)]
#[serde(default, deny_unknown_fields)]
pub struct PolishParams {
    /// Whether frames are aligned to the model from their given poses; otherwise these are taken as they are.
    pub enabled: bool,
    /// A larger turn is not believed, radians. Calibrated arms and turntables err by a few mrad, corners of a board by 10.
    pub max_rotation_rad: f64,
    /// A larger move is not believed, metres: the same at half a metre.
    pub max_translation_m: f64,
}

impl Default for PolishParams {
    fn default() -> Self {
        PolishParams {
            enabled: false,
            max_rotation_rad: 0.03,
            max_translation_m: 0.015,
        }
    }
}

impl PolishParams {
    /// How far given poses may err.
    fn reach(&self) -> Motion {
        Motion {
            rotation_rad: self.max_rotation_rad,
            translation_m: self.max_translation_m,
        }
    }

    /// Checks every value against its bound by `within(key, value, low, high)`.
    pub(super) fn validate(
        &self,
        within: impl Fn(&str, f64, f64, f64) -> Result<(), String>,
    ) -> Result<(), String> {
        within("polish.max_rotation_rad", self.max_rotation_rad, 1e-4, 0.5)?;
        // Beyond the reach of the coarsest alignment nothing is found.
        within(
            "polish.max_translation_m",
            self.max_translation_m,
            1e-4,
            0.1,
        )
    }
}

/// Where a frame is looked for.
struct Near<'a> {
    /// Where its alignment starts.
    start: &'a Pose,
    /// What the result is held against, and what stands if it is not believed.
    given: &'a Pose,
    /// How far the result may lie from there; as far as given poses err where it does not say.
    reach: Option<Motion>,
}

impl Fusion {
    /// Whether a depth image (m) shows any surface, so that the camera was not covered.
    pub fn sees_depth(&mut self, depth: &Image<f32>) -> bool {
        self.eye.take(depth)
    }

    /// Fuses one depth image at a pose that is known, and keeps it.
    pub fn fuse_at(
        &mut self,
        depth: &Image<f32>,
        time_secs: f64,
        world_from_camera: &Pose,
    ) -> TrackingOutcome {
        if !self.eye.take(depth) {
            return TrackingOutcome::NoDepth;
        }
        let outcome = self.fuse_as_given(time_secs, world_from_camera);
        self.stand_at(world_from_camera);
        outcome
    }

    /// Fuses a frame of another model once more at a pose that is known, with its depth (m) corrected otherwise, and keeps it. The
    /// model is not looked at.
    pub fn fuse_anew_at(
        &mut self,
        depth: &Image<f32>,
        frame: &Keyframe,
        world_from_camera: &Pose,
    ) -> TrackingOutcome {
        self.eye.take_kept(depth, frame.n_frames);
        self.stretch = frame.stretch;
        self.fuse_as_given(frame.time_secs, world_from_camera)
    }

    /// Whether frames were fused at, or near, poses that are known.
    pub fn is_at_given_poses(&self) -> bool {
        self.is_given
    }

    /// Fuses one depth image (metres, 0 is none) where it lies best on the model near a pose that is known, or at that pose:
    /// then the outcome's fit is `None`, and the frame is counted in [`Self::n_unpolished`].
    pub fn fuse_near(
        &mut self,
        depth: &Image<f32>,
        time_secs: f64,
        world_from_camera: &Pose,
    ) -> TrackingOutcome {
        if !self.eye.take(depth) {
            return TrackingOutcome::NoDepth;
        }
        let near = Near {
            start: world_from_camera,
            given: world_from_camera,
            reach: None,
        };
        let (pose, fit) = self.fuse_polished(time_secs, &near);
        self.keep_polished(fit.as_ref(), world_from_camera);
        self.stand_at(&pose);
        TrackingOutcome::Tracked {
            world_from_camera: pose,
            fit,
        }
    }

    /// Fuses a frame of another model once more, with its depth (m) corrected otherwise, where it lies best on this one near
    /// where it is now known to lie, `reach` of that at most, or there, and keeps it for closing loops as if it had been tracked.
    /// Without a `reach` of its own it may go as far as given poses err. A frame whose pose was given is held by that one all the
    /// same, and kept as given. The model is not looked at for what comes next, which brings its own pose.
    pub fn fuse_anew(
        &mut self,
        depth: &Image<f32>,
        frame: &Keyframe,
        world_from_camera: &Pose,
        reach: Option<Motion>,
    ) -> TrackingOutcome {
        self.stretch = frame.stretch;
        self.eye.take_kept(depth, frame.n_frames);
        let near = Near {
            start: world_from_camera,
            given: frame.given.as_ref().unwrap_or(world_from_camera),
            reach,
        };
        let (pose, fit) = self.fuse_polished(frame.time_secs, &near);
        match &frame.given {
            Some(given) => self.keep_polished(fit.as_ref(), given),
            None => self.remember(fit.as_ref()),
        }
        TrackingOutcome::Tracked {
            world_from_camera: pose,
            fit,
        }
    }

    /// Keeps a frame that was to be polished, and counts it if its given pose stands.
    fn keep_polished(&mut self, fit: Option<&Fit>, given: &Pose) {
        // Before the first frame there is nothing to lie on.
        self.n_unpolished += usize::from(fit.is_none() && self.n_fused > 1);
        self.keep_as_given(given);
    }

    /// Keeps the frame that was just fused at, or near, a pose that was given.
    fn keep_as_given(&mut self, given: &Pose) {
        self.is_given = true;
        self.keep(Some(*given));
    }

    /// Fuses the frame in hand at a pose that is known, and keeps it.
    fn fuse_as_given(&mut self, time_secs: f64, world_from_camera: &Pose) -> TrackingOutcome {
        self.take_in(*world_from_camera, time_secs, &mut |_| {});
        self.keep_as_given(world_from_camera);
        TrackingOutcome::Tracked {
            world_from_camera: *world_from_camera,
            fit: None,
        }
    }

    /// Fuses the frame in hand where it lies best near a pose that is known, or there; gives the pose, and how it lies.
    fn fuse_polished(&mut self, time_secs: f64, near: &Near) -> (Pose, Option<Fit>) {
        let on_step: &mut OnStep = &mut |_: FusionStep| {};
        let (pose, fit) = match self.polish(near, on_step) {
            Ok((pose, fit)) => (pose, Some(fit)),
            Err(_) => (*near.given, None),
        };
        self.take_in(pose, time_secs, on_step);
        (pose, fit)
    }

    /// Frames that were fused at their given pose, because none near it was believed.
    pub fn n_unpolished(&self) -> usize {
        self.n_unpolished
    }

    /// Aligns the frame in hand to the model as seen from where it starts, and judges the result.
    fn polish(&mut self, near: &Near, on_step: &mut OnStep) -> Result<(Pose, Fit), LossReason> {
        let Near {
            start,
            given,
            reach,
        } = *near;
        // Given views may lie far apart: what the last one saw may not be in this one at all.
        self.stand_at(start);
        self.look();
        let (eye, volume, params) = (&self.eye, &self.fused.volume, &self.params);
        let nothing = LossReason::FewInliers { inlier_share: 0.0 };
        let model = self.seen.as_ref().ok_or(nothing)?.model();
        let (pose, fit) = align(
            eye,
            &model,
            volume,
            start,
            params,
            Beside::default(),
            on_step,
        )
        .ok_or(nothing)?;
        let judged = gates::judge_fit(&fit, &eye.frame, &eye.noise, params);
        let is_on_it = matches!(judged, Ok(()) | Err(LossReason::FlatScene { .. }));
        // What its own normals show to be flat does not say where it lies: images may have held it where it is.
        if is_on_it && fit.is_sliding() {
            self.n_unpolished += 1;
            return Ok((*start, fit));
        }
        judged?;
        let motion = motion_between(given, &pose);
        let bound = reach.unwrap_or_else(|| params.polish.reach());
        if motion.rotation_rad > bound.rotation_rad || motion.translation_m > bound.translation_m {
            return Err(LossReason::Jump {
                rotation_rad: motion.rotation_rad,
                translation_m: motion.translation_m,
            });
        }
        Ok((pose, fit))
    }
}

#[cfg(test)]
mod tests;
