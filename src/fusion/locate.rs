//! Where a frame was taken: carried on from the frame before, or from near it, or in the whole model.

use super::align::{Beside, align};
use super::icp::CastModel;
use super::model_view::ModelView;
use super::outcome::{Fit, LossReason};
use super::steps::{FusionStep, OnStep};
use super::track::{MAX_PREDICTION_SECS, STEADY_SECS, Track};
use super::{Fusion, MODEL_LEVEL, gates, relocalise};
use crate::geometry::{Motion, Pose, increment_about, motion_between};
use nalgebra::{Vector3, Vector6};

/// After an interruption longer absence does not entitle to a longer jump, seconds.
const MAX_INTERRUPTED_SECS: f64 = 0.1;
/// After an interruption the camera is looked for so far round what it sees, radians: as far as alignment reaches, which then
/// reaches twice as far.
const SWING_RAD: f64 = 0.06;
/// Poses that are not farther apart are the same, and looked at once; arbitrary, within what the next frame makes up for.
const SAME: Motion = Motion {
    rotation_rad: 0.005,
    translation_m: 0.003,
};
/// One pose is better than another if more pixels agree with the model there by this share: alignments to the same place differ
/// by up to about 0.001, and to one beside it by 0.003 and more.
const CLEARLY: f64 = 0.002;
/// Share of a frame's points on the model above which it is not asked whether the camera has slid away: every frame of the recorded sessions
/// has more, of every second one 0.79 and more; where the real desk was lost and fitted all the same 0.5 to 0.6 had.
const WELL_PLACED: f64 = 0.8;

/// What became of the frame before.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) enum Before {
    /// It was tracked, or there was none.
    Tracked,
    /// It showed no depth, or frames are known to be missing, or it was too long ago.
    Missing,
    /// It was not found.
    Lost,
}

impl Fusion {
    /// Where the frame in hand was taken, with how well it fits; the first frame is the origin.
    pub(super) fn find(
        &mut self,
        time_secs: f64,
        on_step: &mut OnStep,
    ) -> Result<(Pose, Option<Fit>), LossReason> {
        if let Some((pose, fit)) = self.carry_on(time_secs, on_step) {
            return Ok((pose, Some(fit)));
        }
        if self.look() {
            on_step(FusionStep::Raycast);
        }
        let Some(model) = self.seen.as_ref().map(ModelView::model) else {
            return Ok((Pose::identity(), None));
        };
        // A single frame, with its holes and its noise, is no model to compare poses on.
        let is_single = self.n_fused < 2 || self.keyframes.frames().len() == 1;
        let found = if self.track.is_moving() || self.before == Before::Lost || is_single {
            self.locate_carried_on(&model, time_secs, on_step)
                .and_then(|found| self.check(found, time_secs))
        } else {
            self.locate_round(&model, time_secs, on_step)
        };
        found
            .or_else(|reason| self.confirm(time_secs).ok_or(reason))
            .map(|(pose, fit)| (pose, Some(fit)))
    }

    /// Aligns the frame in hand from where its motion carries the camera; if that fails and it had time to, from where it was.
    fn locate_carried_on(
        &self,
        model: &CastModel,
        time_secs: f64,
        on_step: &mut OnStep,
    ) -> Result<(Pose, Fit), LossReason> {
        let track = &self.track;
        let predicted = track.predict(time_secs);
        let found = self.locate(model, track, &predicted, time_secs, on_step);
        match found {
            Err(reason) if track.is_moving() && self.is_after_gap(time_secs) => {
                let at_rest = &track.world_from_camera;
                self.locate(model, track, at_rest, time_secs, &mut |_| {})
                    .or(Err(reason))
            }
            found => found,
        }
    }

    /// Aligns the frame in hand from where the camera was, from all round it and from where its last known step leads, since how
    /// it moved is not known, as after a hand covered the projector. Alignment reaches about 3°; from farther it ends between the
    /// teeth of a gear, and fits well enough there to be believed. So the pose is taken from which the model shows most of what
    /// the frame shows.
    fn locate_round(
        &self,
        model: &CastModel,
        time_secs: f64,
        on_step: &mut OnStep,
    ) -> Result<(Pose, Fit), LossReason> {
        let at_rest = &self.track.world_from_camera;
        let first = self.locate(model, &self.track, at_rest, time_secs, on_step);
        let reason = first.as_ref().err().copied();
        let mut found: Vec<(Pose, Fit)> = first.into_iter().collect();
        let swings = swings(f64::from(self.eye.frame.median_depth_m()));
        let all_round = swings.map(|swing| at_rest * swing);
        let once_more = self.track.carried_on(time_secs);
        for guess in all_round.into_iter().chain([once_more]) {
            let other = self.locate(model, &self.track, &guess, time_secs, &mut |_| {});
            let is_new = |other: &(Pose, Fit)| {
                let is_same =
                    |(pose, _): &(Pose, Fit)| motion_between(pose, &other.0).is_within(&SAME);
                !found.iter().any(is_same)
            };
            found.extend(other.ok().filter(is_new));
        }
        let believed = found.into_iter().filter_map(|(pose, fit)| {
            let seen = relocalise::believe(&pose, &fit, &self.eye, &self.fused.volume)?;
            Some((seen.agreeing_share, (pose, fit)))
        });
        let best = believed.reduce(|best, other| match other.0 > best.0 + CLEARLY {
            true => other,
            false => best,
        });
        best.map(|(_, found)| found)
            .ok_or(reason.unwrap_or(LossReason::Elsewhere))
    }

    /// Whether frames are missing between the last one and the one in hand, so that the camera may have done anything.
    pub(super) fn is_after_gap(&self, time_secs: f64) -> bool {
        time_secs - self.track.time_secs > STEADY_SECS
    }

    /// Aligns the frame in hand, which may have been taken near `guess`, to the model as seen from the pose of a track, and
    /// judges the result.
    fn locate(
        &self,
        model: &CastModel,
        track: &Track,
        guess: &Pose,
        time_secs: f64,
        on_step: &mut OnStep,
    ) -> Result<(Pose, Fit), LossReason> {
        let eye = &self.eye;
        let beside = Beside {
            common: self.common.as_ref(),
            infrared: self.infrared.as_ref(),
        };
        let (volume, params) = (&self.fused.volume, &self.params);
        let (pose, fit) = align(eye, model, volume, guess, params, beside, on_step)
            .ok_or(LossReason::FewInliers { inlier_share: 0.0 })?;
        gates::judge_fit(&fit, &eye.frame, &eye.noise, &self.params)?;
        self.judge_motion(track, &pose, time_secs)?;
        Ok((pose, fit))
    }

    /// Judges whether the camera of a track can have come to a pose.
    pub(super) fn judge_motion(
        &self,
        track: &Track,
        pose: &Pose,
        time_secs: f64,
    ) -> Result<(), LossReason> {
        let motion = motion_between(&track.world_from_camera, pose);
        let max_secs = match self.before {
            Before::Tracked => MAX_PREDICTION_SECS,
            Before::Missing | Before::Lost => MAX_INTERRUPTED_SECS,
        };
        let deviation = track.deviation(pose, time_secs);
        let elapsed_secs = (time_secs - track.time_secs).min(max_secs);
        gates::judge_motion(&motion, &deviation, elapsed_secs, &self.params)
    }

    /// After an interruption or a gap the camera may be elsewhere: a pose is then believed as one that was searched for. Where on the way
    /// much of a frame finds no place on the model, it may show what was not seen before, a hand or a thing that was moved; but where the
    /// camera does not go on as before it may have slid away.
    fn check(&self, (pose, fit): (Pose, Fit), time_secs: f64) -> Result<(Pose, Fit), LossReason> {
        let (eye, volume) = (&self.eye, &self.fused.volume);
        let may_be_elsewhere = self.before != Before::Tracked || self.is_after_gap(time_secs);
        let is_believed = if may_be_elsewhere {
            relocalise::believe(&pose, &fit, eye, volume).is_some()
        } else {
            let goes_on_as_before = || {
                let deviation = self.track.deviation(&pose, time_secs);
                let elapsed_secs = time_secs - self.track.time_secs;
                gates::is_as_before(&deviation, elapsed_secs, &self.params)
            };
            fit.inlier_share > WELL_PLACED
                || goes_on_as_before()
                || !relocalise::has_slid(&pose, eye, volume)
        };
        is_believed
            .then_some((pose, fit))
            .ok_or(LossReason::Elsewhere)
    }

    /// Tracks from the place that the frame before was found at, if there is one.
    fn confirm(&mut self, time_secs: f64) -> Option<(Pose, Fit)> {
        let (hypothesis, track) = self.hypothesis.take()?;
        let guess = track.predict(time_secs);
        let model = CastModel {
            map: &hypothesis.model,
            lens: &self.eye.level(MODEL_LEVEL).lens,
            world_from_camera: &track.world_from_camera,
        };
        let found = self
            .locate(&model, &track, &guess, time_secs, &mut |_| {})
            .ok()?;
        self.n_relocalised += 1;
        // The new stretch of path is no motion from where tracking was lost.
        self.track = track;
        Some(found)
    }

    /// Looks for a lost frame in the whole model; tells why it is not fused.
    pub(super) fn search(&mut self, time_secs: f64, reason: LossReason) -> LossReason {
        self.track.stop();
        self.common = None;
        self.stretch = self.n_fused;
        self.before = Before::Lost;
        let found = self
            .places
            .relocalise(&self.eye, &self.fused.volume, &self.params);
        self.hypothesis = found.map(|hypothesis| {
            let track = Track::at(hypothesis.world_from_camera, time_secs);
            (hypothesis, track)
        });
        match self.hypothesis {
            Some(_) => LossReason::Unconfirmed,
            None => reason,
        }
    }
}

/// To either side, up and down, and about the line of sight, round a point so far ahead of the camera, metres.
fn swings(distance_m: f64) -> [Pose; 6] {
    let ahead = Vector3::new(0.0, 0.0, distance_m);
    std::array::from_fn(|k| {
        let mut turn = Vector6::zeros();
        turn[k / 2] = if k % 2 == 0 { SWING_RAD } else { -SWING_RAD };
        increment_about(&ahead, &turn)
    })
}

#[cfg(test)]
mod tests {
    use super::super::tests::{frames, small_params};
    use super::super::{DepthNoise, TrackingOutcome};
    use super::*;
    use crate::geometry::{CameraModel, RayGrid};
    use depth_camera::{Image, Sensor};
    use nalgebra::Point3;

    /// A wheel of 24 ridges among humps on a table, from straight above; the camera turned about its line of sight.
    fn wheel(camera: CameraModel, turned_deg: f32) -> Image<f32> {
        let (sin, cos) = turned_deg.to_radians().sin_cos();
        let height_m = |x: f32, y: f32| {
            let ridge = 0.5 + 0.5 * (24.0 * y.atan2(x)).cos();
            let hump = |angle: f32| {
                let (x, y) = (x - 0.3 * angle.cos(), y - 0.3 * angle.sin());
                0.06 * (-(x * x + y * y) / 0.02f32.powi(2)).exp()
            };
            let humps: f32 = [0.0, 1.0, 2.3, 3.9, 4.7].map(hump).iter().sum();
            0.012 * ridge * (-((x.hypot(y) - 0.12) / 0.04).powi(4)).exp() + humps
        };
        RayGrid::new(camera).rays().map(|&[x, y]| {
            let (x, y) = (cos * x - sin * y, sin * x + cos * y);
            let table_m = 0.7;
            (0..20).fold(table_m, |z, _| table_m - height_m(z * x, z * y))
        })
    }

    #[test]
    fn after_an_interruption_or_a_pause_a_wheel_is_not_found_a_ridge_off() {
        let (_, _, camera) = frames(0);
        let noise = DepthNoise::of_sensor(Sensor::Kinect2);
        let mut fusion = Fusion::new(camera, noise, small_params());
        let at_rest = wheel(camera, 0.0);
        for time_secs in [0.0, 0.03, 0.06] {
            fusion.fuse(&at_rest, time_secs);
        }
        let mut covered = fusion.clone();
        let dark = at_rest.map(|_| 0.0);
        assert_eq!(covered.fuse(&dark, 0.1), TrackingOutcome::NoDepth);
        let turned_deg = 9.0;
        let turned = wheel(camera, turned_deg);
        // Covered, or without any depth image for a second.
        for mut fusion in [covered, fusion] {
            let outcome = fusion.fuse(&turned, 1.2);
            let TrackingOutcome::Tracked {
                world_from_camera, ..
            } = outcome
            else {
                panic!("{outcome:?}");
            };
            let turn = world_from_camera.rotation.scaled_axis();
            assert!(
                (turn.z.to_degrees() - f64::from(turned_deg)).abs() < 0.3,
                "{turn:?}"
            );
        }
    }

    #[test]
    fn a_swing_turns_the_camera_round_what_it_sees() {
        let ahead = Point3::new(0.0, 0.0, 0.8);
        for swing in swings(ahead.z) {
            assert!((swing * ahead - ahead).norm() < 1e-12, "{swing}");
            assert!((swing.rotation.angle() - SWING_RAD).abs() < 1e-12);
        }
    }
}
