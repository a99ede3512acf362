//! Frames that are fused again with their rows put right, or without an error of range, lie elsewhere, and carry those after them
//! along; where tracking broke, and the camera was found in another place, those near it do.

use super::revision::TRACKED_ANEW_REACH;
use crate::geometry::{Pose, motion_between, of_unit_length};

/// How far frames were moved, in order of time.
#[derive(Default)]
pub(super) struct Carry(Vec<Moved>);

/// A frame that was moved.
struct Moved {
    /// Which stretch of unbroken tracking it belongs to.
    stretch: usize,
    /// Where it lay.
    before: Pose,
    /// What that was multiplied by from the left.
    by: Pose,
}

impl Carry {
    /// What the pose of the next frame is multiplied by from the left: what the last one was or, if that is of another stretch, the
    /// one that lay nearest.
    pub(super) fn to(&self, stretch: usize, before: &Pose) -> Pose {
        let last = self.0.last().filter(|last| last.stretch == stretch);
        let nearest = || {
            let frames = self.0.iter();
            frames.min_by(|a, b| a.apart(before).total_cmp(&b.apart(before)))
        };
        last.or_else(nearest)
            .map_or_else(Pose::identity, |moved| moved.by)
    }

    /// Notes where a frame was fused again.
    pub(super) fn note(&mut self, stretch: usize, before: Pose, after: &Pose) {
        self.0.push(Moved {
            stretch,
            before,
            by: of_unit_length(&(after * before.inverse())),
        });
    }
}

impl Moved {
    /// How far a pose is from where it lay, in reaches of its alignment.
    fn apart(&self, pose: &Pose) -> f64 {
        let motion = motion_between(&self.before, pose);
        motion.rotation_rad / TRACKED_ANEW_REACH.rotation_rad
            + motion.translation_m / TRACKED_ANEW_REACH.translation_m
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_stretch_begins_as_the_frame_nearest_to_it_was_moved_and_goes_on_as_the_one_before() {
        let at = |x_m: f64| Pose::translation(x_m, 0.0, 0.0);
        let mut carry = Carry::default();
        assert_eq!(carry.to(0, &at(0.0)), Pose::identity());
        // Each is moved 10 mm farther than the one before.
        for x_m in [0.0, 0.3, 0.6, 0.9] {
            carry.note(0, at(x_m), &at(x_m * 31.0 / 30.0));
        }
        let is_moved = |carry: &Carry, stretch: usize, x_m: f64, by_m: f64| {
            (carry.to(stretch, &at(x_m)).translation.x - by_m).abs() < 1e-12
        };
        assert!(is_moved(&carry, 0, 0.0, 0.03), "as the one before");
        assert!(is_moved(&carry, 7, 0.32, 0.01), "as the nearest");
        carry.note(7, at(0.32), &at(0.335));
        assert!(is_moved(&carry, 7, 0.9, 0.015), "as the one before");
    }
}
