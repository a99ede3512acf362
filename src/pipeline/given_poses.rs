//! Poses that were measured elsewhere, found by time.

use crate::geometry::Pose;
use nalgebra::{Quaternion, Translation3, UnitQuaternion};
use replay::TimedPose;

/// A pose further away in time belongs to another frame, seconds: frames are 33 ms apart.
const MAX_APART_SECS: f64 = 0.020;

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

    /// The pose of the nearest time, if it is within 20 ms.
    pub fn at(&self, time_secs: f64) -> Option<Pose> {
        let after = self.0.partition_point(|(time, _)| *time < time_secs);
        let neighbours = &self.0[after.saturating_sub(1)..(after + 1).min(self.0.len())];
        neighbours
            .iter()
            .map(|(time, pose)| ((time - time_secs).abs(), pose))
            .filter(|(apart_secs, _)| *apart_secs <= MAX_APART_SECS)
            .min_by(|a, b| a.0.total_cmp(&b.0))
            .map(|(_, pose)| *pose)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_nearest_pose_is_taken_and_none_that_is_far() {
        let poses = [1.0, 1.03, 2.0].map(|time_secs| TimedPose {
            time_secs,
            translation_m: [time_secs, 0.0, 0.0],
            rotation_xyzw: [0.0, 0.0, 0.0, 1.0],
        });
        let poses = GivenPoses::new(&poses);
        let x_at = |time_secs| poses.at(time_secs).map(|pose| pose.translation.vector.x);
        assert_eq!(x_at(0.99), Some(1.0));
        assert_eq!(x_at(1.014), Some(1.0));
        assert_eq!(x_at(1.016), Some(1.03));
        assert_eq!(x_at(1.06), None);
        assert_eq!(x_at(2.019), Some(2.0));
        assert_eq!(x_at(0.9), None);
    }
}
