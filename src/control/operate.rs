//! One run, accompanied from its start to its end.

use super::{
    Progress,
    signals::{self, Signals},
};
use crate::pipeline::{Handle, Outcome, SpawnError};
use std::{
    io,
    sync::{
        Arc,
        atomic::{AtomicBool, Ordering},
    },
    time::Duration,
};
use tokio::{
    runtime::{self, Runtime},
    task, time,
};

/// How often progress is shown.
const REFRESH: Duration = Duration::from_millis(200);

/// Why a pipeline could not be accompanied to its end.
#[derive(Debug, thiserror::Error)]
pub enum ControlError {
    /// The system refuses what the control plane needs.
    #[error("cannot listen for signals: {0}")]
    Signals(#[from] io::Error),
    /// The pipeline did not start.
    #[error(transparent)]
    Spawn(#[from] SpawnError),
    /// The thread that waits for the pipeline ended by a fault of the program.
    #[error("the run ended by a fault of the program: {0}")]
    Join(#[from] task::JoinError),
}

/// Starts a pipeline and accompanies it to its end: the first signal stops it in order, the second ends the process at once.
///
/// # Errors
/// If the pipeline does not start, or the system refuses.
pub fn operate(
    start: impl FnOnce() -> Result<Handle, SpawnError>,
    progress: &Progress,
) -> Result<Outcome, ControlError> {
    runtime()?.block_on(async {
        // Before the first thread starts: from now on a signal finds somebody who listens.
        let mut signals = Signals::new()?;
        accompany(start()?, &mut signals, progress).await
    })
}

/// Does work that ends by itself, or soon after its flag is set: the first signal sets it, the second ends the process at once.
///
/// # Errors
/// If the system refuses, or the work panics.
pub fn until_stopped<T: Send + 'static>(
    work: impl FnOnce(&AtomicBool) -> T + Send + 'static,
) -> Result<T, ControlError> {
    runtime()?.block_on(async {
        let mut signals = Signals::new()?;
        let stop = Arc::new(AtomicBool::new(false));
        let flag = stop.clone();
        let mut done = task::spawn_blocking(move || work(&flag));
        loop {
            tokio::select! {
                result = &mut done => return Ok(result?),
                name = signals.next() => {
                    if stop.swap(true, Ordering::Relaxed) {
                        signals::exit_at_once(name);
                    }
                    tracing::info!("{name}: stopping");
                }
            }
        }
    })
}

/// The runtime of one command: this thread, with timers and signals.
fn runtime() -> io::Result<Runtime> {
    runtime::Builder::new_current_thread().enable_all().build()
}

async fn accompany(
    handle: Handle,
    signals: &mut Signals,
    progress: &Progress,
) -> Result<Outcome, ControlError> {
    let watch = handle.watch();
    let mut joined = task::spawn_blocking(|| handle.join());
    let mut refresh = time::interval(REFRESH);
    let mut is_stopping = false;
    loop {
        tokio::select! {
            outcome = &mut joined => {
                progress.finish();
                return Ok(outcome?);
            }
            name = signals.next() => {
                if is_stopping {
                    signals::exit_at_once(name);
                }
                is_stopping = true;
                tracing::warn!("{name}: stopping; base mesh and report are still written, once more to exit at once");
                watch.stop();
            }
            _ = refresh.tick() => progress.show(&watch.status()),
        }
    }
}
