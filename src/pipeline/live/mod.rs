//! What somebody who looks on sees of a scan: newest only, and made only while somebody looks.
//!
//! Every slot holds its newest value; who reads shares it and never makes anybody wait. Reading a slot says that somebody
//! looks: the fusion thread fills it for the next two seconds.

pub(super) mod next_view;
pub(super) mod preview;
pub(super) mod snapshot_list;
pub(super) mod surface;

use crate::geometry::Pose;
pub(super) use handover::Slot;
use std::{path::PathBuf, sync::Arc};

/// An image of 8 bits a pixel, for the eye.
#[derive(Clone, Debug, PartialEq)]
pub struct Preview {
    /// The frame.
    pub frame_id: u64,
    /// Columns, 256 at most.
    pub width: u16,
    /// Rows.
    pub height: u16,
    /// What 1 stands for, metres or counts.
    pub low: f32,
    /// What 254 stands for, metres or counts.
    pub high: f32,
    /// Row by row: 0 is none, 1 to 254 are `low` to `high`, and 255 is saturated.
    pub pixels: Vec<u8>,
}

/// Where the camera is.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct LivePose {
    /// The frame.
    pub frame_id: u64,
    /// The newest pose that is known.
    pub world_from_camera: Pose,
    /// Where the camera was tracked well last: not about to be lost.
    pub last_good: Pose,
    /// Whether the camera is elsewhere by now.
    pub is_lost: bool,
}

/// The surface so far, world frame.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct LiveSurface {
    /// Rises with every change.
    pub revision: u32,
    /// Metres.
    pub positions: Vec<[f32; 3]>,
    /// Unit normals out of the surface, times 127; zero where there is none.
    pub normals: Vec<[i8; 3]>,
    /// How well the views so far tell the tilt of the surface, for each vertex: 0 not at all, 255 well enough.
    pub coverage: Vec<u8>,
    /// Counter-clockwise seen from outside.
    pub faces: Vec<[u32; 3]>,
}

/// From where a next view would tell most.
#[derive(Clone, Debug, PartialEq)]
pub struct NextView {
    /// Where to hold the camera.
    pub world_from_camera: Pose,
    /// Why, for the operator.
    pub why: String,
}

/// An infrared image that is, or is not, a shading image.
#[derive(Clone, Debug, PartialEq)]
pub struct LiveSnapshot {
    /// The name under which its picture is asked for: the frame's number.
    pub index: u64,
    /// The frame.
    pub frame_id: u64,
    /// Whether it is kept.
    pub accepted: bool,
    /// Stable name of the reason why it is not.
    pub code: Option<&'static str>,
    /// Why it is not, with figures.
    pub reason: Option<String>,
    /// What helps.
    pub advice: Option<&'static str>,
    /// The infrared image, 128 pixels wide at most.
    pub thumbnail: Option<Arc<Preview>>,
}

/// A scan as it was written down on the way, to be refined.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct InterimScan {
    /// Counts up.
    pub number: u32,
    /// Base mesh, trajectory and shading images lie here, as in the folder of a whole scan.
    pub folder: PathBuf,
}

/// The newest of everything that can be looked at.
#[derive(Clone, Debug, Default)]
pub struct Live {
    pub(super) depth: Slot<Preview>,
    pub(super) infrared: Slot<Preview>,
    pub(super) pose: Slot<LivePose>,
    pub(super) path: Slot<Vec<Pose>>,
    pub(super) surface: Slot<LiveSurface>,
    pub(super) next_view: Slot<NextView>,
    pub(super) snapshots: Slot<Vec<LiveSnapshot>>,
    pub(super) interim: Slot<InterimScan>,
}

impl Live {
    /// The newest depth image.
    pub fn depth(&self) -> Option<Arc<Preview>> {
        self.depth.read()
    }

    /// The newest infrared image.
    pub fn infrared(&self) -> Option<Arc<Preview>> {
        self.infrared.read()
    }

    /// Where the camera is.
    pub fn pose(&self) -> Option<Arc<LivePose>> {
        self.pose.read()
    }

    /// Where it has been, thinned out to 2000 poses at most.
    pub fn path(&self) -> Option<Arc<Vec<Pose>>> {
        self.path.read()
    }

    /// The surface so far.
    pub fn surface(&self) -> Option<Arc<LiveSurface>> {
        self.surface.read()
    }

    /// From where a next view would tell most; `None` if nothing is missing, or nothing known yet.
    pub fn next_view(&self) -> Option<Arc<NextView>> {
        self.next_view.read()
    }

    /// Shading images and those that are none, newest last.
    pub fn snapshots(&self) -> Option<Arc<Vec<LiveSnapshot>>> {
        self.snapshots.read()
    }

    /// The scan as it was written down last by [`Command::Refine`](super::Command::Refine).
    pub fn interim(&self) -> Option<Arc<InterimScan>> {
        self.interim.read()
    }
}
