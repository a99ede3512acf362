//! The one state that the operator is told: what the frames say, under what does not come with frames.

use super::{
    state::{Degradation, Fault, Loss, State},
    status::Status,
};
use crate::capture::DeviceHealth;

/// What the fusion thread knows beside the frames.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Circumstances {
    /// Whether the operator paused the scan.
    pub is_paused: bool,
    /// Whether a shading image is being taken.
    pub is_snapshotting: bool,
}

/// The state to tell, the gravest first: what stops the scan, what makes it useless, what could be better.
pub fn standing(of_frames: State, around: Circumstances, status: &Status) -> State {
    let recording = &status.recording;
    let has_little_room = recording
        .disk_free_bytes
        .is_some_and(|free| free < recording.disk_floor_bytes);
    // A recording that ended for want of room is not begun again, whatever room there is by now.
    let has_ended_in_order = recording.reason.is_some() && !recording.has_failed;
    match (status.device, of_frames) {
        _ if status.has_fault => State::Fault(Fault::Program),
        (DeviceHealth::Gone, _) => State::Fault(Fault::DeviceGone),
        (DeviceHealth::Stalled, _) => State::Lost(Loss::DeviceStalled),
        _ if around.is_paused => State::Paused,
        // Whoever covers a projector to take a picture is not lost.
        (_, State::Lost(Loss::CoveredLens)) if around.is_snapshotting => State::Snapshotting,
        (_, State::Warming | State::Lost(_) | State::Relocalising) => of_frames,
        _ if recording.has_failed || !status.unwritten.is_empty() => {
            State::Fault(Fault::StorageFailed)
        }
        _ if around.is_snapshotting => State::Snapshotting,
        // That the disk is low may hold for the rest of the scan: what the operator mends by the camera comes first.
        (_, State::Degraded(_)) => of_frames,
        _ if has_little_room || has_ended_in_order => State::Degraded(Degradation::DiskLow),
        _ => of_frames,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::pipeline::status::RecordingStatus;

    #[test]
    fn the_gravest_is_told() {
        let calm = Circumstances::default();
        let paused = Circumstances {
            is_paused: true,
            ..calm
        };
        let taking = Circumstances {
            is_snapshotting: true,
            ..calm
        };
        let fine = Status::default();
        let full = Status {
            recording: RecordingStatus {
                disk_free_bytes: Some(1),
                disk_floor_bytes: 2,
                ..RecordingStatus::default()
            },
            ..Status::default()
        };
        let ended = Status {
            recording: RecordingStatus {
                disk_free_bytes: Some(3),
                reason: Some("recording stops below 2 bytes".to_owned()),
                ..full.recording.clone()
            },
            ..Status::default()
        };
        let gone = Status {
            device: DeviceHealth::Gone,
            ..full.clone()
        };
        let broken = Status {
            recording: RecordingStatus {
                has_failed: true,
                ..ended.recording.clone()
            },
            ..Status::default()
        };
        let waiting = Status {
            unwritten: [("events.jsonl".to_owned(), "full".to_owned())].into(),
            ..Status::default()
        };
        let lost = State::Lost(Loss::TooFast);
        let covered = State::Lost(Loss::CoveredLens);
        let low = State::Degraded(Degradation::DiskLow);
        let fast = State::Degraded(Degradation::TooFast);
        for (of_frames, around, status, expected) in [
            (State::Tracking, calm, &fine, State::Tracking),
            (State::Tracking, calm, &full, low),
            (State::Tracking, calm, &ended, low),
            (fast, calm, &ended, fast),
            (lost, calm, &full, lost),
            (
                State::Tracking,
                calm,
                &broken,
                State::Fault(Fault::StorageFailed),
            ),
            (
                State::Tracking,
                calm,
                &waiting,
                State::Fault(Fault::StorageFailed),
            ),
            (State::Tracking, taking, &fine, State::Snapshotting),
            (covered, taking, &fine, State::Snapshotting),
            (covered, calm, &fine, covered),
            (lost, taking, &fine, lost),
            (lost, paused, &fine, State::Paused),
            (lost, paused, &gone, State::Fault(Fault::DeviceGone)),
        ] {
            assert_eq!(standing(of_frames, around, status), expected);
        }
    }
}
