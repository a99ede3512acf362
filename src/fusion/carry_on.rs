//! A frame that lies where the camera's motion leads: from there the distances alone tell its pose.
//!
//! Most frames do. What comes before, a cast of the model and alignment to that, is for those that do not: it reaches farther, and by it
//! is told what the camera would look through. A frame is carried on only if nearly all of its points lie on the model where the motion
//! leads and where they end, and if the shape of what is seen holds the camera; else the frame is located as if this had not been tried.
//! What a thing that is taken away uncovers lies on the model too, if it was seen from elsewhere: such a frame is in its place, and fused.

use super::align::AlignedPose;
use super::degeneracy::{Degeneracy, HARDLY_HELD_SHARE};
use super::locate::Before;
use super::outcome::Fit;
use super::pyramid::N_REDUCED;
use super::sdf_alignment::{self, Slopes};
use super::steps::{FusionStep, OnStep};
use super::{Fusion, gates};
use crate::geometry::{Motion, Pose};

/// Share of a frame's points that lie on the model. By the default of `max_see_through_share` what does not would, looked through,
/// lower the fitness by nothing.
const NEARLY_ALL: f64 = 0.925;
/// What a frame may deviate from where the motion leads: as far as distances surely reach. Arbitrary, half of the desk's frames deviate by
/// less than 6 mrad and 3 mm.
const STEADY: Motion = Motion {
    rotation_rad: 0.01,
    translation_m: 0.005,
};
/// A model of fewer frames is young, its distances noisy; counted since the camera was found last, or frames were taken back.
const GROWN_FRAMES: usize = 8;
/// Steps on the coarsest level by the frame's own normals, before those by the gradients of the distances.
const FIRST_STEPS: usize = 2;

impl Fusion {
    /// Where the frame in hand was taken, if that is where the motion of the camera leads; with how well it fits.
    pub(super) fn carry_on(&self, time_secs: f64, on_step: &mut OnStep) -> Option<(Pose, Fit)> {
        let is_on_its_way = self.before == Before::Tracked
            && self.track.is_moving()
            && !self.is_after_gap(time_secs)
            && self.n_fused.saturating_sub(self.stretch) >= GROWN_FRAMES;
        if !is_on_its_way {
            return None;
        }
        let found = self.on_the_way(time_secs);
        on_step(FusionStep::SdfAlignment);
        found
    }

    // A symbol of its own, by which tests/bench/instructions.sh counts.
    #[inline(never)]
    fn on_the_way(&self, time_secs: f64) -> Option<(Pose, Fit)> {
        let (eye, volume, params) = (&self.eye, &self.fused.volume, &self.params);
        let (arch, noise, levels) = (eye.arch, &eye.noise, &eye.frame.reduced);
        let start = self.first_steps(time_secs)?;
        let iterations = params.icp.sdf_iterations;
        let (pose, equations) =
            sdf_alignment::align(arch, levels, volume, &start, noise, iterations)?;
        let deviation = self.track.deviation(&pose, time_secs);
        if equations.inlier_share() < NEARLY_ALL || !deviation.is_within(&STEADY) {
            return None;
        }
        let share_beside = 1.0 - equations.inlier_share();
        let degeneracy = Degeneracy::of(eye, self.common.as_ref(), &pose)?;
        let aligned = AlignedPose::new(pose, equations);
        let fit = aligned.fit(eye, params, share_beside, &degeneracy);
        let is_believed = fit.held_share >= HARDLY_HELD_SHARE
            && gates::judge_fit(&fit, &eye.frame, noise, params).is_ok()
            && self.judge_motion(&self.track, &pose, time_secs).is_ok();
        is_believed.then_some((pose, fit))
    }

    /// From where the motion leads towards the model, if the frame lies on it there.
    fn first_steps(&self, time_secs: f64) -> Option<Pose> {
        let (eye, volume) = (&self.eye, &self.fused.volume);
        let coarsest = &eye.frame.reduced[N_REDUCED - 1];
        let mut pose = self.track.predict(time_secs);
        for _ in 0..FIRST_STEPS {
            let slopes = Slopes::Frame;
            let equations =
                sdf_alignment::equations(eye.arch, coarsest, volume, &pose, &eye.noise, slopes);
            if equations.inlier_share() < NEARLY_ALL {
                return None;
            }
            pose = equations.solve(&pose.translation.vector)? * pose;
        }
        Some(pose)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::fusion::TrackingOutcome;
    use crate::fusion::tests::{frames_of, fusion};
    use crate::geometry::{CameraModel, increment, motion_between};
    use depth_camera::{Frame, Sensor};
    use nalgebra::{Point3, Vector6};
    use simulated::{Infrared, Scene, Setup, Shape, SimulatedCamera, Solid, Trajectory};

    /// Frames of three crates that lie about on a table, where each was taken from, by the first, and their camera.
    fn frames(n_frames: usize) -> (Vec<Frame>, Vec<Pose>, CameraModel) {
        let table = Shape::Table {
            half_size: [0.5, 0.5],
        };
        let crate_of = |size: f64, place: [f64; 3], turn: [f64; 3]| {
            let shape = Shape::RoundedBox {
                half_size: [size, 0.7 * size, 0.9 * size],
                radius: 0.004,
            };
            let [x, y, z] = place;
            let [a, b, c] = turn;
            Solid::new(shape, increment(&Vector6::new(a, b, c, x, y, z)), 0.6)
        };
        let solids = vec![
            Solid::new(table, Pose::identity(), 0.5),
            crate_of(0.06, [0.0, 0.0, 0.05], [0.3, 0.1, 0.4]),
            crate_of(0.05, [-0.14, -0.03, 0.05], [-0.2, 0.5, -0.6]),
            crate_of(0.07, [0.13, 0.05, 0.06], [0.5, -0.3, 1.0]),
        ];
        let camera = SimulatedCamera::new(Setup {
            scene: Scene::new(solids, 1),
            trajectory: Trajectory::hand_held(Point3::new(0.0, 0.0, 0.05), n_frames),
            sensor: Sensor::Kinect2,
            infrared: Infrared::of_sensor(Sensor::Kinect2),
            n_moving_frames: n_frames,
            shading_frames: Vec::new(),
            reduction: 1,
            seed: 5,
        });
        frames_of(camera.expect("full size"), n_frames)
    }

    /// Where a frame is found to have been taken, and whether the model was cast for it.
    fn fuse(fusion: &mut Fusion, frame: &Frame) -> (Pose, bool) {
        let depth = frame.depth.as_ref().expect("Kinect II");
        let mut casts = false;
        let outcome = fusion.fuse_observed(depth, frame.device_time_secs, &mut |step| {
            casts |= step == FusionStep::Raycast;
        });
        match outcome {
            TrackingOutcome::Tracked {
                world_from_camera, ..
            } => (world_from_camera, casts),
            other => panic!("{other:?}"),
        }
    }

    #[test]
    fn a_camera_that_goes_on_needs_no_cast_and_one_that_turns_off_does() {
        let (seen, truth, camera) = frames(20);
        let mut fusion = fusion(camera);
        let found: Vec<(Pose, bool)> = seen.iter().map(|frame| fuse(&mut fusion, frame)).collect();
        let (young, grown) = found.split_at(GROWN_FRAMES);
        assert!(young[1..].iter().all(|(_, casts)| *casts));
        assert!(grown.iter().all(|(_, casts)| !casts), "{grown:?}");
        for (k, ((pose, _), truth)) in found.iter().zip(&truth).enumerate() {
            let off = motion_between(pose, truth);
            assert!(off.translation_m < 0.004, "{k}: {off:?}");
        }
        // Back where it was the frame before.
        let mut back = seen[18].clone();
        back.device_time_secs = seen[19].device_time_secs + 1.0 / 30.0;
        let (pose, casts) = fuse(&mut fusion, &back);
        assert!(casts);
        let off = motion_between(&pose, &truth[18]);
        assert!(off.translation_m < 0.004, "{off:?}");
    }

    #[test]
    fn whether_somebody_looked_at_the_model_before_changes_nothing() {
        let (seen, _, camera) = frames(14);
        let mut unseen = fusion(camera);
        for frame in &seen[..13] {
            fuse(&mut unseen, frame);
        }
        let mut looked_at = unseen.clone();
        let map = looked_at.model().expect("frames were fused").clone();
        assert!(map.normals.data().iter().any(|normal| normal.norm() > 0.9));
        // Too late for where the motion leads: the model is needed, and cast, if nobody has asked for it, with another frame in hand.
        let mut late = seen[13].clone();
        late.device_time_secs += 0.1;
        let (by_then, casts) = fuse(&mut unseen, &late);
        assert!(casts);
        let (before, casts) = fuse(&mut looked_at, &late);
        assert!(!casts, "it was");
        assert_eq!(by_then, before);
    }
}
