//! Kinect I: what the operator is to do next for a shading image, from what the images show.

use super::SequenceStep;
use super::speckle::{SPECKLED, Texture};
use crate::geometry::{Pose, motion_between};

/// A hand is still as long as it stays this near, metres and radians: the tracker's noise is a third of it.
const STILL_M: f64 = 0.004;
const STILL_RAD: f64 = 0.01;
/// Who has been still for so long is about to take a picture, seconds of the device's clock.
const STOPPED_SECS: f64 = 0.25;
/// ... and for so long can cover the projector.
const HELD_SECS: f64 = 1.0;

/// How far the operator is in the sequence.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Guidance {
    /// What to do next.
    pub step: SequenceStep,
    /// Speckle energy of the newest infrared image, share of the local mean.
    pub speckle: f64,
    /// From this energy on an image shows the projector's speckle.
    pub speckle_limit: f64,
}

/// Follows the operator.
#[derive(Clone, Debug, Default)]
pub(super) struct Guide {
    step: SequenceStep,
    speckle: f64,
    /// Where the camera has been since when.
    held: Option<(Pose, f64)>,
}

impl Guide {
    pub(super) fn guidance(&self) -> Guidance {
        Guidance {
            step: self.step,
            speckle: self.speckle,
            speckle_limit: SPECKLED,
        }
    }

    /// The camera stands here, its projector free.
    pub(super) fn tracked(&mut self, world_from_camera: &Pose, time_secs: f64) {
        let is_there = |(place, _): &(Pose, f64)| {
            let motion = motion_between(place, world_from_camera);
            motion.translation_m < STILL_M && motion.rotation_rad < STILL_RAD
        };
        self.held = self.held.filter(is_there);
        let (_, since) = *self.held.get_or_insert((*world_from_camera, time_secs));
        self.step = match time_secs - since {
            held if held >= HELD_SECS => SequenceStep::CoverProjector,
            held if held >= STOPPED_SECS => SequenceStep::HoldStill,
            _ => SequenceStep::Track,
        };
    }

    /// The camera's place is not known, its projector free.
    pub(super) fn lost(&mut self) {
        self.held = None;
        self.step = SequenceStep::Track;
    }

    /// There is no depth; so many exposures were taken of those that are needed.
    pub(super) fn covered(&mut self, texture: &Texture, n_exposures: usize, n_needed: usize) {
        self.step = if texture.is_speckled() {
            SequenceStep::CoverProjector
        } else if n_exposures >= n_needed {
            SequenceStep::Uncover
        } else {
            SequenceStep::LampOn
        };
    }

    pub(super) fn saw(&mut self, texture: &Texture) {
        self.speckle = texture.speckle_energy;
    }
}
