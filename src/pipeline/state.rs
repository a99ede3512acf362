//! What the operator is told of a scan that goes on: a state, why it is not the best one, and what helps.
//!
//! Codes are stable: programs compare them, sentences may change.

/// What a running pipeline is doing, as the operator sees it.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum State {
    /// No frame has been fused yet.
    #[default]
    Warming,
    /// Frames are tracked and fused.
    Tracking,
    /// Frames are fused, but not as well as they could be, or not for much longer.
    Degraded(Degradation),
    /// The camera's pose is not known: nothing is fused.
    Lost(Loss),
    /// The pose was lost, a place was found, and the next frame has to confirm it.
    Relocalising,
    /// The operator paused the scan: frames come and are not used.
    Paused,
    /// The operator asked for a shading image and the next good frame becomes one.
    Snapshotting,
    /// Capture has ended; what was captured is being made use of.
    Draining,
    /// Something is broken that the program cannot mend.
    Fault(Fault),
}

/// What is not as it should be while frames are still fused.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Degradation {
    /// The camera moves faster than is good.
    TooFast,
    /// Most of what is seen is nearer than the working range.
    TooClose,
    /// Little of what is seen lies within the working range, and the rest beyond it.
    TooFar,
    /// The shape of the scene hardly holds the camera.
    FlatScene,
    /// Tracking is about to be lost: little of the frame lies on the model.
    FewInliers,
    /// Much of the infrared image is at full scale.
    SaturatedInfrared,
    /// The disk is nearly full; recording stops, the scan goes on.
    DiskLow,
}

/// Why the pose is not known.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Loss {
    /// The camera moved faster than tracking follows.
    TooFast,
    /// The scene is nearer than the working range.
    TooClose,
    /// The shape of the scene does not hold the camera.
    FlatScene,
    /// There is no depth at all: something covers the lens or the projector.
    CoveredLens,
    /// The camera shows another place than the model.
    Elsewhere,
    /// Too little of the frame lies on the model.
    FewInliers,
    /// No frames come from the device.
    DeviceStalled,
}

/// What is broken.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Fault {
    /// The device is not there any more; it is waited for.
    DeviceGone,
    /// What should be kept cannot be written.
    StorageFailed,
    /// A part of the program ended by a fault of its own.
    Program,
}

impl State {
    /// The state's stable name.
    pub fn code(self) -> &'static str {
        match self {
            State::Warming => "warming",
            State::Tracking => "tracking",
            State::Degraded(_) => "degraded",
            State::Lost(_) => "lost",
            State::Relocalising => "relocalising",
            State::Paused => "paused",
            State::Snapshotting => "snapshotting",
            State::Draining => "draining",
            State::Fault(_) => "fault",
        }
    }

    /// The reason's stable name, for the states that have reasons.
    pub fn reason(self) -> Option<&'static str> {
        match self {
            State::Degraded(reason) => Some(reason.code()),
            State::Lost(reason) => Some(reason.code()),
            State::Fault(reason) => Some(reason.code()),
            _ => None,
        }
    }

    /// What the operator can do, as a sentence.
    pub fn advice(self) -> &'static str {
        match self {
            State::Warming => "Point the camera at the object and hold it still for a moment.",
            State::Tracking => "All is well: move slowly round the object.",
            State::Degraded(reason) => reason.advice(),
            State::Lost(reason) => reason.advice(),
            State::Relocalising => "A place was recognised: hold still for a moment.",
            State::Paused => "The scan is paused: resume when the camera sees the object again.",
            State::Snapshotting => "Hold still until the picture is taken.",
            State::Draining => "The scan has ended: its meshes are being written.",
            State::Fault(reason) => reason.advice(),
        }
    }
}

impl Degradation {
    /// The reason's stable name.
    pub fn code(self) -> &'static str {
        match self {
            Degradation::TooFast => "too_fast",
            Degradation::TooClose => "too_close",
            Degradation::TooFar => "too_far",
            Degradation::FlatScene => "flat_scene",
            Degradation::FewInliers => "few_inliers",
            Degradation::SaturatedInfrared => "saturated_infrared",
            Degradation::DiskLow => "disk_low",
        }
    }

    /// What the operator can do, as a sentence.
    pub fn advice(self) -> &'static str {
        match self {
            Degradation::TooFast => "Move and turn the camera more slowly.",
            Degradation::TooClose => {
                "Step back: most of the scene is nearer than the camera can measure."
            }
            Degradation::TooFar => "Go nearer: most of the scene is beyond the working range.",
            Degradation::FlatScene => {
                "Bring an edge, a corner or another object into view: a flat or round scene lets the camera slide."
            }
            Degradation::FewInliers => {
                "Go back slowly to where the model is known: tracking is about to be lost."
            }
            Degradation::SaturatedInfrared => {
                "Go farther away or tilt the camera: the infrared image is overexposed and cannot be used for shading."
            }
            Degradation::DiskLow => {
                "Free space on the disk: recording has stopped, the scan itself goes on."
            }
        }
    }
}

impl Loss {
    /// The reason's stable name.
    pub fn code(self) -> &'static str {
        match self {
            Loss::TooFast => "too_fast",
            Loss::TooClose => "too_close",
            Loss::FlatScene => "flat_scene",
            Loss::CoveredLens => "covered_lens",
            Loss::Elsewhere => "elsewhere",
            Loss::FewInliers => "few_inliers",
            Loss::DeviceStalled => "device_stalled",
        }
    }

    /// What the operator can do, as a sentence.
    pub fn advice(self) -> &'static str {
        match self {
            Loss::TooFast => "Go back to the last good pose and move more slowly.",
            Loss::TooClose => {
                "Step back until the object is within range, near the last good pose."
            }
            Loss::FlatScene => {
                "Point the camera at something with more shape, near the last good pose."
            }
            Loss::CoveredLens => "Uncover the camera, or point it at something within range.",
            Loss::Elsewhere => "Point the camera at a part of the object that was scanned already.",
            Loss::FewInliers => "Go back to the last good pose.",
            Loss::DeviceStalled => "No frames come from the camera: check its cable and power.",
        }
    }
}

impl Fault {
    /// The reason's stable name.
    pub fn code(self) -> &'static str {
        match self {
            Fault::DeviceGone => "device_gone",
            Fault::StorageFailed => "storage_failed",
            Fault::Program => "program",
        }
    }

    /// What the operator can do, as a sentence.
    pub fn advice(self) -> &'static str {
        match self {
            Fault::DeviceGone => "The camera is gone: plug it in again and the scan goes on.",
            Fault::StorageFailed => {
                "Something cannot be written: make room on the disk; what waits for it is tried again, and the log names the file."
            }
            Fault::Program => {
                "A part of the program failed: finish the scan to keep what there is, and see the log."
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::collections::BTreeSet;

    #[test]
    fn every_state_has_a_name_of_its_own_and_says_what_helps() {
        let degradations = [
            Degradation::TooFast,
            Degradation::TooClose,
            Degradation::TooFar,
            Degradation::FlatScene,
            Degradation::FewInliers,
            Degradation::SaturatedInfrared,
            Degradation::DiskLow,
        ];
        let losses = [
            Loss::TooFast,
            Loss::TooClose,
            Loss::FlatScene,
            Loss::CoveredLens,
            Loss::Elsewhere,
            Loss::FewInliers,
            Loss::DeviceStalled,
        ];
        let faults = [Fault::DeviceGone, Fault::StorageFailed, Fault::Program];
        let others = [
            State::Warming,
            State::Tracking,
            State::Relocalising,
            State::Paused,
            State::Snapshotting,
            State::Draining,
        ];
        let states: Vec<State> = others
            .into_iter()
            .chain(degradations.map(State::Degraded))
            .chain(losses.map(State::Lost))
            .chain(faults.map(State::Fault))
            .collect();
        let names: BTreeSet<_> = states.iter().map(|s| (s.code(), s.reason())).collect();
        assert_eq!(names.len(), states.len());
        let advice: BTreeSet<_> = states.iter().map(|state| state.advice()).collect();
        assert_eq!(advice.len(), states.len());
        assert!(advice.iter().all(|sentence| sentence.ends_with('.')));
    }
}
