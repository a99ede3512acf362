//! Commands that write at their end alone: a signal ends them before.

use std::sync::atomic::{AtomicBool, Ordering};

/// Somebody asked to stop before anything was written.
#[derive(Debug, thiserror::Error)]
#[error("stopped before anything was written")]
pub struct Stopped;

/// Looks whether somebody has asked to stop.
pub fn check_wanted(stop: &AtomicBool) -> Result<(), Stopped> {
    match stop.load(Ordering::Relaxed) {
        true => Err(Stopped),
        false => Ok(()),
    }
}
