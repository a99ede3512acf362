//! What the pipeline is doing, newest only, and the tokens that stop it.

use super::{
    accounts::FrameAccounts,
    state::{Fault, State},
};
use crate::{
    capture::{DeviceHealth, EVENTS_FILE},
    fusion::Improvement,
    lock::lock,
    snapshot::{Guidance, SequenceStep},
};
use std::{
    collections::BTreeMap,
    sync::{
        Arc, Mutex,
        atomic::{AtomicBool, Ordering},
    },
};

/// What the pipeline is busy with.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Phase {
    /// Frames are coming and being fused.
    #[default]
    Capturing,
    /// The scan is improved as a whole, and the base mesh taken out of the volume.
    Meshing,
    /// The surface is being refined.
    Refining,
    /// The outputs are being written.
    Exporting,
}

impl Phase {
    /// The phase's stable name.
    pub fn code(self) -> &'static str {
        match self {
            Phase::Capturing => "capturing",
            Phase::Meshing => "meshing",
            Phase::Refining => "refining",
            Phase::Exporting => "exporting",
        }
    }
}

/// What the pipeline is doing.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Status {
    /// What it is busy with.
    pub phase: Phase,
    /// What the operator is told.
    pub state: State,
    /// Frames that will come, where that is known.
    pub n_announced: Option<usize>,
    /// What became of the frames so far.
    pub frames: FrameAccounts,
    /// Frames that were fused and not taken back.
    pub n_in_model: usize,
    /// Frames that fusion has handled a second, over the last second or so, paused ones too.
    pub fps: f64,
    /// How far the last frame was from being lost, 0 to 1; `None` where nothing was tracked, as at given poses.
    pub fitness: Option<f64>,
    /// Share of the newest infrared image at full scale; `None` without infrared images.
    pub ir_saturated_share: Option<f64>,
    /// Whether the operator asked for a shading image that is not taken yet.
    pub is_snapshotting: bool,
    /// Shading images.
    pub snapshots: SnapshotCounts,
    /// Kinect I: how far the guided sequence of the next shading image is; `None` with other sensors.
    pub kinect1_sequence: Option<SequenceStatus>,
    /// What is done to the scan at its end before its mesh is taken out of the volume, or while frames are taken back, and how far
    /// that is.
    pub improvement: Option<Improvement>,
    /// How far refinement in this process is.
    pub refinement: RefinementProgress,
    /// What is being recorded.
    pub recording: RecordingStatus,
    /// Files that wait for room on the disk, by name, each with the reason why it cannot be written.
    pub unwritten: BTreeMap<String, String>,
    /// The live mesh as it was extracted last; `None` as long as nobody looks.
    pub mesh: Option<MeshStatus>,
    /// Whether a part of the program ended by a fault of its own.
    pub has_fault: bool,
    /// How the device is doing.
    pub device: DeviceHealth,
    /// How often it stopped delivering and began again: frames before and after may show different places.
    pub n_device_gaps: u64,
}

impl Status {
    /// Notes why a file waits for room on the disk, or with `None` that it does not any more.
    pub(super) fn note_unwritten(&mut self, name: &str, refusal: Option<String>) {
        match refusal {
            Some(refusal) => drop(self.unwritten.insert(name.to_owned(), refusal)),
            None => drop(self.unwritten.remove(name)),
        }
        // While frames come the state follows from them.
        if self.phase != Phase::Capturing && !self.has_fault {
            self.state = match self.unwritten.is_empty() {
                true => State::Draining,
                false => State::Fault(Fault::StorageFailed),
            };
        }
    }

    /// Whether capture has ended and a file that it left waits for room on the disk, and all behind it with it. Events that wait hold
    /// nothing up.
    pub fn waits_for_room(&self) -> bool {
        let mut files = self.unwritten.keys();
        self.phase != Phase::Capturing && files.any(|name| name != EVENTS_FILE)
    }
}

impl From<Guidance> for SequenceStatus {
    fn from(guidance: Guidance) -> Self {
        SequenceStatus {
            step: guidance.step,
            speckle: guidance.speckle,
            speckle_limit: guidance.speckle_limit,
        }
    }
}

/// Shading images so far.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct SnapshotCounts {
    /// Images that are kept at present.
    pub accepted: usize,
    /// Infrared frames that were considered and are not among them.
    pub rejected: usize,
    /// Images that a scan keeps at most; 0 if the camera gives none.
    pub wanted: usize,
}

/// The guided sequence of a Kinect I.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SequenceStatus {
    /// What the operator is to do next.
    pub step: SequenceStep,
    /// Speckle energy of the newest infrared image, share of the local mean.
    pub speckle: f64,
    /// From this energy on an image shows the projector's speckle.
    pub speckle_limit: f64,
}

/// How far refinement is.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct RefinementProgress {
    /// Outer rounds begun, of how many.
    pub rounds: (usize, usize),
    /// Steps made.
    pub n_steps: usize,
    /// Energy of the last step, share of the first.
    pub energy_share: f64,
}

/// What is being recorded beside the scan.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct RecordingStatus {
    /// Whether frames are being recorded now.
    pub active: bool,
    /// Bytes written.
    pub bytes: u64,
    /// Frames recorded.
    pub recorded: u64,
    /// Frames recorded without their infrared image.
    pub dropped_ir: u64,
    /// Frames not recorded because the disk was too slow.
    pub dropped_frames: u64,
    /// Room on the disk; `None` where that was not asked.
    pub disk_free_bytes: Option<u64>,
    /// Below this room recording stops.
    pub disk_floor_bytes: u64,
    /// Why recording stopped before the scan did; `None` as long as it goes on.
    pub reason: Option<String>,
    /// Whether it is not whole, because something could not be written.
    pub has_failed: bool,
}

/// The size of a mesh.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct MeshStatus {
    /// Rises with every change.
    pub revision: u32,
    /// How many vertices.
    pub vertices: usize,
    /// How many faces.
    pub faces: usize,
}

/// Where the stages leave their status and everybody reads the newest.
#[derive(Clone, Debug, Default)]
pub struct StatusSlot(Arc<Mutex<Status>>);

impl StatusSlot {
    /// The newest status.
    pub fn get(&self) -> Status {
        lock(&self.0).clone()
    }

    /// Changes the status.
    pub fn update(&self, change: impl FnOnce(&mut Status)) {
        change(&mut lock(&self.0));
    }
}

/// Set once by whoever wants something to stop; every long loop looks at it.
#[derive(Clone, Debug, Default)]
pub struct StopToken(Arc<AtomicBool>);

impl StopToken {
    /// Asks to stop.
    pub fn stop(&self) {
        self.0.store(true, Ordering::Relaxed);
    }

    /// Whether somebody asked to stop.
    pub fn is_stopped(&self) -> bool {
        self.0.load(Ordering::Relaxed)
    }

    /// The flag itself, for loops that know no token.
    pub fn flag(&self) -> &AtomicBool {
        &self.0
    }
}
