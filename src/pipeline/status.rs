//! What the pipeline is doing, newest only, and the token that stops it.

use std::sync::{
    Arc, Mutex, PoisonError,
    atomic::{AtomicBool, Ordering},
};

/// What the pipeline is busy with.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Phase {
    /// Frames are coming and being fused.
    #[default]
    Capturing,
    /// The base mesh is being taken out of the volume.
    Meshing,
    /// The surface is being refined.
    Refining,
    /// The outputs are being written.
    Exporting,
}

/// What the pipeline is doing.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Status {
    /// What it is busy with.
    pub phase: Phase,
    /// Frames that will come, where that is known.
    pub n_announced: Option<usize>,
    /// Frames handled by fusion, whatever became of them.
    pub n_handled: u64,
    /// Frames in the model.
    pub n_fused: u64,
    /// Frames during which tracking was lost.
    pub n_lost: u64,
    /// Whether tracking is lost now.
    pub is_lost: bool,
    /// How far the last frame was from being lost, 0 to 1; `None` where nothing was tracked, as at given poses.
    pub fitness: Option<f64>,
    /// Shading images so far.
    pub n_snapshots: usize,
    /// Outer rounds of refinement begun, of how many.
    pub rounds: (usize, usize),
    /// Steps of refinement made.
    pub n_steps: usize,
    /// Energy of the last step, share of the first.
    pub energy_share: f64,
}

/// Where the stages leave their status and everybody reads the newest.
#[derive(Clone, Debug, Default)]
pub struct StatusSlot(Arc<Mutex<Status>>);

impl StatusSlot {
    /// The newest status.
    pub fn get(&self) -> Status {
        // A status is a plain value: one that a panic left behind is as good as any.
        *self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Changes the status.
    pub fn update(&self, change: impl FnOnce(&mut Status)) {
        change(&mut self.0.lock().unwrap_or_else(PoisonError::into_inner));
    }
}

/// Set once by whoever wants the pipeline to stop; every long loop looks at it.
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
