//! The first frames of a scan that begins in motion: they are aligned to a model of one or two frames from a guess of no motion, and
//! may slide by centimetres along what is nearly flat. At the end the model is whole and the motion known, backwards from later frames.

use super::relocalise::align_closely;
use super::track::{STEADY_SECS, Track};
use super::{Fit, Fusion, Keyframe, PoseCorrection, gates};
use crate::geometry::{Motion, Pose, motion_between};
use std::cmp::Ordering;

/// So many frames are looked at, or as many as come before a stop, but for the last [`N_AFTER`] of them.
const N_FRAMES: usize = 6;
/// By the motion of so many after each.
const N_AFTER: usize = 2;
/// All of them together.
pub(super) const N_FIRST: usize = N_FRAMES + N_AFTER;
/// A frame that would move by less stays: settling and refinement reach as far.
const WORTH: Motion = Motion {
    rotation_rad: 0.003,
    translation_m: 0.003,
};

impl Fusion {
    /// Looks for the first frames on the finished model, where the motion of those after them would have them; the poses handed
    /// out are then to be moved by the correction, and [`Self::complete`] fuses all frames where they lie. `None` if they lie where they
    /// were tracked, or poses were given.
    pub fn settle_beginning(&mut self) -> Option<PoseCorrection> {
        let frames = self.keyframes.frames().get(..N_FIRST)?;
        // Where many frames between two of them are not kept the motion is not known: a Kinect I may stop for an image by then.
        let follows = |pair: &[Keyframe]| {
            pair[0].stretch == pair[1].stretch
                && pair[1].time_secs - pair[0].time_secs <= STEADY_SECS
        };
        let n_steady = 1 + frames.windows(2).take_while(|pair| follows(pair)).count();
        if self.is_given || n_steady <= N_AFTER {
            return None;
        }
        let frames = frames[..n_steady].to_vec();
        let mut poses: Vec<Pose> = frames.iter().map(|f| f.world_from_camera).collect();
        let mut has_moved = false;
        for k in (0..n_steady - N_AFTER).rev() {
            // Time runs backwards.
            let at = |k: usize| Track::at(poses[k], -frames[k].time_secs);
            let later = at(k + 2).moved_to(poses[k + 1], at(k + 1).time_secs, true);
            let guess = later.predict(-frames[k].time_secs);
            if let Some(pose) = self.found_again(&frames[k], &guess) {
                (poses[k], has_moved) = (pose, true);
            }
        }
        let knots = frames.iter().zip(&poses).map(|(frame, pose)| {
            let tracked = &frame.world_from_camera;
            let correction = match pose == tracked {
                true => Pose::identity(),
                false => pose * tracked.inverse(),
            };
            (frame.time_secs, correction)
        });
        let correction = PoseCorrection::of_knots(knots.collect());
        has_moved.then(|| {
            self.keyframes.correct(&correction);
            self.is_outdated = true;
            correction
        })
    }

    /// Where a frame lies better than where it was tracked, if that is worth while.
    fn found_again(&mut self, frame: &Keyframe, guess: &Pose) -> Option<Pose> {
        self.eye.take_kept(&frame.depth_m(), frame.n_frames);
        let (eye, volume, params) = (&self.eye, &self.fused.volume, &self.params);
        let tracked = &frame.world_from_camera;
        let candidates = [tracked, guess].map(|from| align_closely(from, eye, volume, params));
        let (pose, fit) = candidates.into_iter().flatten().min_by(better)?;
        gates::judge_fit(&fit, &eye.frame, &eye.noise, params).ok()?;
        let is_near = motion_between(tracked, &pose).is_within(&WORTH);
        // What its own normals show to be flat does not say where it lies.
        (!is_near && !fit.is_sliding()).then_some(pose)
    }
}

/// The one that lies closer, and with more of its points.
fn better(a: &(Pose, Fit), b: &(Pose, Fit)) -> Ordering {
    let misfit = |fit: &Fit| fit.rmse_m / fit.inlier_share.max(1e-6);
    misfit(&a.1).total_cmp(&misfit(&b.1))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::fusion::tests::{frames, small_params};
    use crate::fusion::{DepthNoise, TrackingOutcome};
    use depth_camera::Sensor;

    fn scanned(n_frames: usize) -> (Fusion, Vec<Pose>) {
        let (frames, truth, camera) = frames(n_frames);
        let noise = DepthNoise::of_sensor(Sensor::Kinect2);
        let mut fusion = Fusion::new(camera, noise, small_params());
        for frame in &frames {
            let depth = frame.depth.as_ref().expect("Kinect II");
            let outcome = fusion.fuse(depth, frame.device_time_secs);
            assert!(matches!(outcome, TrackingOutcome::Tracked { .. }));
        }
        (fusion, truth)
    }

    /// How far every frame is off, metres.
    fn off_m(fusion: &Fusion, truth: &[Pose]) -> Vec<f64> {
        let pairs = fusion.keyframes().iter().zip(truth);
        let off = pairs.map(|(frame, truth)| motion_between(truth, &frame.world_from_camera));
        off.map(|motion| motion.translation_m).collect()
    }

    /// Moves the first frame, and tells the times of all.
    fn slide_first(fusion: &mut Fusion) -> Vec<f64> {
        let times: Vec<f64> = fusion.keyframes().iter().map(|f| f.time_secs).collect();
        let slide = Pose::translation(0.015, 0.004, 0.0);
        fusion.keyframes.correct(&PoseCorrection::of_knots(vec![
            (times[0], slide),
            (times[1], Pose::identity()),
        ]));
        times
    }

    #[test]
    fn a_first_frame_that_slid_is_put_back_and_none_gets_worse() {
        let (mut fusion, truth) = scanned(16);
        let tracked_m = off_m(&fusion, &truth);
        let times = slide_first(&mut fusion);
        let before = fusion.keyframes().to_vec();
        let correction = fusion.settle_beginning().expect("it slid");
        // A voxel has 4 mm.
        for (k, (now_m, tracked_m)) in off_m(&fusion, &truth).iter().zip(&tracked_m).enumerate() {
            assert!(*now_m < tracked_m + 0.002, "{k}: {tracked_m} -> {now_m}");
        }
        for (before, after) in before.iter().zip(fusion.keyframes()) {
            let moved = correction.apply(before.time_secs, &before.world_from_camera);
            assert_eq!(moved, after.world_from_camera);
        }
        assert_eq!(correction.at(times[N_FRAMES]), Pose::identity());
    }

    #[test]
    fn of_a_beginning_that_stops_soon_the_first_frames_are_put_back_and_fused_there() {
        for n_steady in [2, 5] {
            let (mut fusion, truth) = scanned(16);
            fusion.keyframes.break_after(n_steady);
            let tracked_m = off_m(&fusion, &truth);
            let times = slide_first(&mut fusion);
            assert!(!fusion.complete(&|_| true));
            let Some(correction) = fusion.settle_beginning() else {
                assert_eq!(n_steady, 2);
                continue;
            };
            assert_eq!(n_steady, 5);
            assert!(off_m(&fusion, &truth)[0] < tracked_m[0] + 0.002);
            assert_eq!(correction.at(times[n_steady - N_AFTER]), Pose::identity());
            assert!(fusion.complete(&|_| true) && !fusion.complete(&|_| true));
        }
    }

    #[test]
    fn few_frames_tell_nothing() {
        assert!(scanned(5).0.settle_beginning().is_none());
    }
}
