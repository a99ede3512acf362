//! Poses that were measured elsewhere, found by time: interpolated between two neighbours, else the nearest.

use crate::geometry::{Pose, between};
use nalgebra::{Quaternion, Translation3, UnitQuaternion};
use replay::TimedPose;

/// A pose further away in time belongs to another frame, seconds: frames are 33 ms apart.
const MAX_APART_SECS: f64 = 0.020;
/// Times that are no further apart are the same, seconds: files keep six decimals.
const SAME_SECS: f64 = 1.5e-6;

/// Poses of the camera by device time.
#[derive(Clone, Debug, PartialEq)]
pub struct GivenPoses(Vec<(f64, Pose)>);

impl GivenPoses {
    /// Poses whose times increase, as [`replay::read_poses`] gives them.
    pub fn new(poses: &[TimedPose]) -> Self {
        let pose = |timed: &TimedPose| {
            let [x, y, z, w] = timed.rotation_xyzw;
            let [tx, ty, tz] = timed.translation_m;
            let rotation = UnitQuaternion::from_quaternion(Quaternion::new(w, x, y, z));
            (
                timed.time_secs,
                Pose::from_parts(Translation3::new(tx, ty, tz), rotation),
            )
        };
        GivenPoses(poses.iter().map(pose).collect())
    }

    /// Whether all of them lie within so far of the world's origin along each axis, metres.
    pub fn are_within(&self, reach_m: f64) -> bool {
        self.0.iter().all(|(_, pose)| is_within(pose, reach_m))
    }

    /// The pose of that time, if it lies farther than that.
    pub fn at_beyond(&self, time_secs: f64, reach_m: f64) -> Option<Pose> {
        self.at(time_secs).filter(|pose| !is_within(pose, reach_m))
    }

    /// The pose of that time, if one was measured within 20 ms: that one where the times are the same, else between its
    /// neighbours where they are 40 ms apart at most, else the nearest.
    pub fn at(&self, time_secs: f64) -> Option<Pose> {
        let after = self.0.partition_point(|(time, _)| *time < time_secs);
        let neighbours = &self.0[after.saturating_sub(1)..(after + 1).min(self.0.len())];
        let apart_secs = |pose: &(f64, Pose)| (pose.0 - time_secs).abs();
        let nearest = neighbours
            .iter()
            .min_by(|a, b| apart_secs(a).total_cmp(&apart_secs(b)))?;
        if let [(start_secs, start), (end_secs, end)] = neighbours
            && apart_secs(nearest) > SAME_SECS
            && end_secs - start_secs <= 2.0 * MAX_APART_SECS + SAME_SECS
        {
            let share = (time_secs - start_secs) / (end_secs - start_secs);
            return Some(between(start, end, share));
        }
        (apart_secs(nearest) <= MAX_APART_SECS).then_some(nearest.1)
    }
}

fn is_within(pose: &Pose, reach_m: f64) -> bool {
    pose.translation.vector.amax() <= reach_m
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Poses of these times, each as far along x (m) as its time says.
    fn poses_at(times_secs: &[f64]) -> GivenPoses {
        let pose = |time_secs: &f64| TimedPose {
            time_secs: *time_secs,
            translation_m: [*time_secs, 0.0, 0.0],
            rotation_xyzw: [0.0, 0.0, 0.0, 1.0],
        };
        let poses: Vec<TimedPose> = times_secs.iter().map(pose).collect();
        GivenPoses::new(&poses)
    }

    fn x_at(poses: &GivenPoses, time_secs: f64) -> Option<f64> {
        poses.at(time_secs).map(|pose| pose.translation.vector.x)
    }

    #[test]
    fn alone_the_nearest_pose_is_taken_and_none_that_is_far() {
        let poses = poses_at(&[1.0, 1.05, 2.0]);
        let expected = [
            (0.97, None),
            (0.99, Some(1.0)),
            (1.015, Some(1.0)),
            (1.025, None),
            (1.035, Some(1.05)),
            (1.08, None),
            (2.019, Some(2.0)),
        ];
        for (time_secs, x) in expected {
            assert_eq!(x_at(&poses, time_secs), x, "{time_secs}");
        }
        assert_eq!(x_at(&poses_at(&[]), 1.0), None);
    }

    #[test]
    fn poses_lie_within_reach_along_each_axis() {
        let poses = poses_at(&[-3.0, 1.0, 2.0]);
        assert!(poses.are_within(3.0) && !poses.are_within(2.9));
        assert!(poses.at_beyond(-3.0, 2.9).is_some());
        assert_eq!(poses.at_beyond(2.0, 2.9), None);
    }

    #[test]
    fn between_neighbours_poses_are_interpolated_and_at_their_own_times_as_they_are() {
        let poses = poses_at(&[1.0, 1.03, 1.07]);
        for time_secs in [1.014, 1.05, 1.069] {
            let x = x_at(&poses, time_secs).expect("between two");
            assert!((x - time_secs).abs() < 1e-12, "{x}");
        }
        for off_secs in [-1e-6, 0.0, 1e-6] {
            assert_eq!(x_at(&poses, 1.03 + off_secs), Some(1.03));
        }
    }
}
