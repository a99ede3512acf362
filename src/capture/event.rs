//! What happened during a scan, one line of `events.jsonl` each.

use crate::geometry::Pose;
use serde::Serialize;

/// What tracking tells the recorder.
#[derive(Clone, Debug, PartialEq)]
pub enum Tracked {
    /// The camera's pose at a time of its own clock, seconds.
    Pose(f64, Pose),
    /// All poses of the camera with their times, seconds, that replace those told so far.
    Corrected(Vec<(f64, Pose)>),
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
        /// Why.
        reason: String,
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
    /// The frame gave the last exposure that a shading image needed.
    Snapshot {
        /// Shading images so far.
        n_snapshots: usize,
    },
}
