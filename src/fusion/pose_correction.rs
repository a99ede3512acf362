//! How far the poses of a scan are moved, as a function of time.

use super::fragments::Fragment;
use super::keyframes::Keyframe;
use crate::geometry::{Pose, between, of_unit_length};

/// A correction of poses that varies with time: known at some times, interpolated between them, constant beyond.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct PoseCorrection {
    /// Times in seconds of the device's clock, not decreasing, and what is multiplied from the left to a pose.
    knots: Vec<(f64, Pose)>,
}

impl PoseCorrection {
    /// The correction that is known at some times (seconds, not decreasing): what is multiplied from the left to a pose.
    pub fn of_knots(knots: Vec<(f64, Pose)>) -> Self {
        let knots = knots.into_iter();
        PoseCorrection {
            knots: knots
                .map(|(time_secs, by)| (time_secs, of_unit_length(&by)))
                .collect(),
        }
    }

    /// The correction that takes every fragment's anchor to its node (world from anchor); the first frame stays in place. No
    /// interpolation across a break of tracking.
    pub(super) fn of_fragments(
        frames: &[Keyframe],
        fragments: &[Fragment],
        nodes: &[Pose],
    ) -> Self {
        let mut knots = Vec::new();
        for (index, (fragment, node)) in fragments.iter().zip(nodes).enumerate() {
            let correction = node * frames[fragment.anchor].world_from_camera.inverse();
            let stretch = frames[fragment.anchor].stretch;
            let stands_alone = |other: Option<&Fragment>| {
                other.is_none_or(|other| frames[other.anchor].stretch != stretch)
            };
            let (first, last) = (fragment.frames.start, fragment.frames.end - 1);
            if stands_alone(index.checked_sub(1).map(|before| &fragments[before])) {
                knots.push((frames[first].time_secs, correction));
            }
            knots.push((frames[fragment.anchor].time_secs, correction));
            if stands_alone(fragments.get(index + 1)) {
                knots.push((frames[last].time_secs, correction));
            }
        }
        let corrected = PoseCorrection { knots };
        let to_first = corrected.at(frames[0].time_secs).inverse();
        let knots = corrected.knots.into_iter();
        Self::of_knots(knots.map(|(time, by)| (time, to_first * by)).collect())
    }

    /// What a pose of that time is multiplied by from the left.
    pub fn at(&self, time_secs: f64) -> Pose {
        let after = self.knots.partition_point(|(time, _)| *time < time_secs);
        match (
            after.checked_sub(1).map(|k| &self.knots[k]),
            self.knots.get(after),
        ) {
            (Some((start, a)), Some((end, b))) => {
                between(a, b, (time_secs - start) / (end - start))
            }
            (Some((_, only)), None) | (None, Some((_, only))) => only.to_owned(),
            (None, None) => Pose::identity(),
        }
    }

    /// The pose of that time, moved.
    pub fn apply(&self, time_secs: f64, world_from_camera: &Pose) -> Pose {
        of_unit_length(&(self.at(time_secs) * world_from_camera))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::{increment, motion_between};
    use nalgebra::Vector6;

    #[test]
    fn corrections_lie_between_their_neighbours_and_end_with_them() {
        let shift = |x: f64| Pose::translation(x, 0.0, 0.0);
        let correction = PoseCorrection {
            knots: vec![
                (1.0, shift(0.0)),
                (2.0, shift(0.1)),
                (2.0, shift(0.5)),
                (4.0, shift(0.7)),
            ],
        };
        let x_at = |time_secs| correction.at(time_secs).translation.vector.x;
        for (time_secs, x) in [(0.0, 0.0), (1.5, 0.05), (2.0, 0.1), (3.0, 0.6), (9.0, 0.7)] {
            assert!((x_at(time_secs) - x).abs() < 1e-12, "{time_secs}");
        }
        assert_eq!(PoseCorrection::default().at(3.0), Pose::identity());
    }

    #[test]
    fn corrections_of_corrected_poses_stay_rigid() {
        let off = Vector6::new(0.3, -0.5, 0.7, 0.1, 0.2, -0.4);
        let mut pose = increment(&off);
        for _ in 0..60 {
            // As a fragment is taken to its node.
            let node = increment(&(0.01 * off)) * pose;
            let correction = PoseCorrection::of_knots(vec![(0.0, node * pose.inverse())]);
            pose = correction.apply(0.0, &pose);
        }
        assert!((pose.rotation.norm() - 1.0).abs() < 1e-12);
        assert!(motion_between(&pose, &increment(&(1.6 * off))).rotation_rad < 1e-6);
    }
}
