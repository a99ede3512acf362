//! What happened during a scan, one line of `events.jsonl` each.

use super::DeviceHealth;
use crate::geometry::Pose;
use serde::Serialize;

/// What tracking tells the recorder.
#[derive(Clone, Debug, PartialEq)]
pub enum Tracked {
    /// The camera's pose at a time of its own clock, seconds.
    Pose(f64, Pose),
    /// At the end all poses of the fused frames with their times, seconds, as they are known then.
    Trajectory(Vec<(f64, Pose)>),
    /// This frame is a candidate for a shading image.
    Candidate(u64),
    /// Something happened.
    Event(Event),
}

/// Something that happened at a frame.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Event {
    /// The frame.
    pub frame_id: u64,
    /// Device time of the frame, seconds; `None` for a frame that never came.
    pub device_time_secs: Option<f64>,
    /// What happened.
    #[serde(flatten)]
    pub kind: EventKind,
}

/// What happened.
#[derive(Clone, Debug, PartialEq, Serialize)]
#[serde(tag = "event", rename_all = "snake_case")]
pub enum EventKind {
    /// The frame came damaged and was skipped.
    Damaged {
        /// What is wrong with it.
        reason: String,
    },
    /// Tracking was lost at this frame.
    Lost {
        /// Why, with figures.
        reason: String,
        /// Stable name of the reason that the operator is told.
        code: &'static str,
    },
    /// Tracking is about to be lost at this frame.
    Weak {
        /// How far it is from that, 0 to 1.
        fitness: f64,
    },
    /// Tracking has found back at this frame.
    Found,
    /// The frame shows no depth, unlike the one before.
    NoDepth,
    /// There are more shading images than before this frame, fewer, or others. Of a Kinect I it is the first frame with depth after the
    /// exposures.
    Snapshot {
        /// Shading images so far.
        n_snapshots: usize,
    },
    /// What the operator is told has changed.
    State {
        /// Stable name of the state.
        state: &'static str,
        /// Stable name of its reason, if it has one.
        reason: Option<&'static str>,
    },
    /// The device is doing otherwise than before.
    Device {
        /// How it is doing.
        health: DeviceHealth,
    },
    /// The operator paused the scan.
    Paused,
    /// The operator ended the pause.
    Resumed,
    /// The operator took the last frames back.
    Undone {
        /// How many of them were in the model.
        n_frames: usize,
    },
    /// The operator began anew.
    Reset,
    /// The camera has come back, and drift was taken back: model and poses have moved.
    LoopsClosed {
        /// How far the camera's last pose was moved, metres.
        moved_m: f64,
    },
    /// What the operator asked for could not be done.
    Refused {
        /// What was asked for.
        command: &'static str,
        /// Why not.
        reason: String,
    },
    /// Frames are no longer recorded; the scan goes on.
    RecordingStopped {
        /// Why.
        reason: String,
    },
    /// The scan as it is was written down, to be refined.
    Interim {
        /// Counts up over the scan.
        number: u32,
    },
}
