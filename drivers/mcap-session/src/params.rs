//! What a recording needs to know, and what it tells while it goes on.

use std::time::Duration;

use crate::session::Counters;

/// What a recording needs to know.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct RecordingParams {
    /// Depth is stored in steps of 1 / this many metres; ROS takes `16UC1` for millimetres, which 1000 gives.
    pub depth_units_per_metre: f64,
    /// Recording ends before fewer bytes than these are free on the disk.
    pub min_free_bytes: u64,
    /// A process that is killed loses what came in this time, and what waits in the recorder's queue.
    pub flush_every: Duration,
    /// A machine that loses power loses what came in this time.
    pub sync_every: Duration,
    /// A segment ends after so much time.
    pub max_segment: Duration,
    /// A segment ends after so many bytes.
    pub max_segment_bytes: u64,
}

impl Default for RecordingParams {
    fn default() -> Self {
        RecordingParams {
            depth_units_per_metre: 5000.0,
            min_free_bytes: 1 << 30,
            flush_every: Duration::from_millis(250),
            sync_every: Duration::from_secs(1),
            max_segment: Duration::from_secs(60),
            max_segment_bytes: 512 << 20,
        }
    }
}

/// Frames and events that never reached the recorder because it was busy.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Dropped {
    /// Frames.
    pub frames: u64,
    /// IR images of frames that were recorded without.
    pub infrared: u64,
}

/// How far a recording came.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Progress {
    /// What was recorded.
    pub counters: Counters,
    /// Bytes that are free on the disk.
    pub disk_free_bytes: u64,
}
