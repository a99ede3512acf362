//! The camera's recent motion, carried on to guess where the next frame was taken.

use crate::geometry::{Motion, Pose, increment, increment_of, motion_between};
use nalgebra::Vector6;

/// Over gaps up to this long the camera goes on as it did; over longer ones it may have turned back, or be elsewhere.
pub const STEADY_SECS: f64 = 0.12;
/// The motion of the last frames is carried on over gaps up to this long; longer ones are interruptions. Arbitrary, a hand sweeps
/// to and fro in about a second.
pub const MAX_PREDICTION_SECS: f64 = 0.4;

/// Frames whose stamps are closer than this were stamped as they arrived, in a burst: no sensor is faster, and so much is taken to have
/// passed.
pub const LEAST_INTERVAL_SECS: f64 = 1.0 / 60.0;

/// The camera's recent motion.
#[derive(Clone, Copy, Debug)]
pub struct Track {
    /// Where the last frame was taken.
    pub world_from_camera: Pose,
    /// When it was taken, on the device's clock, seconds.
    pub time_secs: f64,
    /// Turn and move per second in the camera frame.
    velocity: Vector6<f64>,
    /// The last turn and move from one frame to the next that is known, in the camera frame.
    last_step: Vector6<f64>,
}

impl Track {
    /// A camera at rest.
    pub fn at(world_from_camera: Pose, time_secs: f64) -> Self {
        Track {
            world_from_camera,
            time_secs,
            velocity: Vector6::zeros(),
            last_step: Vector6::zeros(),
        }
    }

    /// Where the camera will be if it goes on moving.
    pub fn predict(&self, time_secs: f64) -> Pose {
        let elapsed = (time_secs - self.time_secs).clamp(0.0, MAX_PREDICTION_SECS);
        self.world_from_camera * increment(&(self.velocity * elapsed))
    }

    /// How far a pose is from where the motion leads.
    pub fn deviation(&self, pose: &Pose, time_secs: f64) -> Motion {
        motion_between(&self.carried_on(time_secs), pose)
    }

    /// Where the camera will be if it goes on moving or, where that is not known, with its last known step: a hand that was held
    /// still often goes on with what it did.
    pub fn carried_on(&self, time_secs: f64) -> Pose {
        if self.is_moving() {
            self.predict(time_secs)
        } else {
            self.world_from_camera * increment(&self.last_step)
        }
    }

    /// Whether the camera is known to move.
    pub fn is_moving(&self) -> bool {
        self.velocity != Vector6::zeros()
    }

    /// Whether the last frame was so long ago that nothing tells how the camera has moved since.
    pub fn is_outdated(&self, time_secs: f64) -> bool {
        time_secs - self.time_secs > MAX_PREDICTION_SECS
    }

    /// Forgets how the camera moved.
    pub fn stop(&mut self) {
        self.velocity = Vector6::zeros();
    }

    /// The track after one more frame; the first one is no motion.
    pub fn moved_to(&self, world_from_camera: Pose, time_secs: f64, has_moved: bool) -> Self {
        let elapsed = time_secs - self.time_secs;
        let (velocity, last_step) = if has_moved && elapsed > 0.0 && elapsed < MAX_PREDICTION_SECS {
            let step = increment_of(&(self.world_from_camera.inverse() * world_from_camera));
            (step / elapsed.max(LEAST_INTERVAL_SECS), step)
        } else {
            (Vector6::zeros(), self.last_step)
        };
        Track {
            world_from_camera,
            time_secs,
            velocity,
            last_step,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_camera_that_stopped_goes_on_with_its_last_step_and_one_in_motion_at_its_speed() {
        let shifted = |x_m: f64| Pose::translation(x_m, 0.0, 0.0);
        let track = Track::at(Pose::identity(), 0.0).moved_to(shifted(0.03), 0.1, true);
        let x_of = |pose: Pose| pose.translation.x;
        assert!((x_of(track.carried_on(0.3)) - 0.09).abs() < 1e-12);
        let mut held = track;
        held.stop();
        assert!((x_of(held.carried_on(0.3)) - 0.06).abs() < 1e-12);
        // Too long after to be a step: the one before is remembered.
        let later = held.moved_to(shifted(0.04), 1.1, true);
        assert!(!later.is_moving());
        assert!((x_of(later.carried_on(1.2)) - 0.07).abs() < 1e-12);
        assert!(!track.is_outdated(0.4) && track.is_outdated(0.6));
    }

    #[test]
    fn stamps_in_a_burst_make_no_great_speed() {
        let ahead = Pose::translation(0.01, 0.0, 0.0);
        let track = Track::at(Pose::identity(), 0.0).moved_to(ahead, 0.001, true);
        // 0.6 m/s, and not 10.
        assert!((track.predict(0.101).translation.x - 0.07).abs() < 1e-12);
    }
}
