//! Every few frames of a Kinect II become a shading image.

use super::ShadingSnapshot;
use crate::fusion::{ModelMap, TrackingOutcome};
use depth_camera::{CameraInfo, Frame, LightKind};
use serde::{Deserialize, Serialize};
use std::fmt;

/// What the selection of shading images needs to know.
#[derive(Clone, Debug, PartialEq, Deserialize, Serialize)]
#[serde(default, deny_unknown_fields)]
pub struct SnapshotParams {
    /// Shading images at most.
    pub max_snapshots: usize,
}

impl Default for SnapshotParams {
    fn default() -> Self {
        SnapshotParams { max_snapshots: 24 }
    }
}

impl SnapshotParams {
    /// Checks every value against its bound.
    ///
    /// # Errors
    /// Names the key, its value and the bound.
    pub fn validate(&self) -> Result<(), String> {
        if (1..=64).contains(&self.max_snapshots) {
            return Ok(());
        }
        Err(format!(
            "snapshot.max_snapshots is {}, must be 1 to 64",
            self.max_snapshots
        ))
    }
}

/// A frame and what became of it.
pub struct TrackedFrame<'a> {
    /// The frame.
    pub frame: &'a Frame,
    /// What became of it.
    pub outcome: &'a TrackingOutcome,
    /// The model as the camera saw it.
    pub model: Option<&'a ModelMap>,
}

/// Why a frame is no shading image.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum RejectReason {
    /// Others show the same.
    Surplus,
}

impl fmt::Display for RejectReason {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("others show the same")
    }
}

/// A frame that was not taken.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Rejection {
    /// The frame.
    pub frame_id: u64,
    /// Why.
    pub reason: RejectReason,
}

/// What was selected.
#[derive(Clone, Debug, Default)]
pub struct SnapshotSelection {
    /// The shading images.
    pub accepted: Vec<ShadingSnapshot>,
    /// What was not taken.
    pub rejected: Vec<Rejection>,
}

/// Selects shading images from tracked frames.
pub struct SnapshotSelector {
    params: SnapshotParams,
    accepted: Vec<ShadingSnapshot>,
    every: u64,
}

impl SnapshotSelector {
    /// `None` for a camera without IR.
    pub fn new(info: &CameraInfo, params: SnapshotParams) -> Option<Self> {
        let light = info.light?;
        let n_frames = info.n_frames.unwrap_or(600).max(1);
        (light.kind == LightKind::Emitter).then(|| SnapshotSelector {
            every: n_frames.div_ceil(params.max_snapshots) as u64,
            params,
            accepted: Vec::new(),
        })
    }

    /// Looks at one frame.
    pub fn observe(&mut self, tracked: &TrackedFrame) {
        let TrackingOutcome::Tracked {
            world_from_camera, ..
        } = tracked.outcome
        else {
            return;
        };
        let frame = tracked.frame;
        let is_due = frame.frame_id.is_multiple_of(self.every)
            && self.accepted.len() < self.params.max_snapshots
            && tracked.model.is_some();
        let (true, Some(ir), Some(depth)) = (is_due, &frame.ir, &frame.depth) else {
            return;
        };
        self.accepted.push(ShadingSnapshot {
            frame_id: frame.frame_id,
            device_time_secs: frame.device_time_secs,
            n_exposures: 1,
            ir_counts: ir.map(|&counts| f32::from(counts)),
            depth_m: depth.clone(),
            world_from_camera: *world_from_camera,
        });
    }

    /// How many shading images there are so far.
    pub fn n_accepted(&self) -> usize {
        self.accepted.len()
    }

    /// The selection.
    pub fn finish(self) -> SnapshotSelection {
        SnapshotSelection {
            accepted: self.accepted,
            rejected: Vec::new(),
        }
    }
}
