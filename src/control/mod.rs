//! The operator's side of a running pipeline: signals in, progress out.
//!
//! tokio lives here and in `main`. Handlers look at the pipeline through a [`Watch`] and return at once; the pipeline's own
//! threads never wait for them.

mod progress;
mod signals;

pub use progress::{Progress, ProgressStyle};
pub use signals::{EXIT_INTERRUPTED, Signals};

use crate::pipeline::{Handle, Outcome};
use std::{io, time::Duration};
use tokio::{task, time};

/// How often progress is shown.
const REFRESH: Duration = Duration::from_millis(200);

/// Accompanies a pipeline to its end: the first signal stops it in order, the second ends the process at once.
///
/// # Errors
/// If the thread that waits for the pipeline cannot be started or panics.
pub async fn accompany(
    handle: Handle,
    signals: &mut Signals,
    progress: &Progress,
) -> io::Result<Outcome> {
    let watch = handle.watch();
    let mut joined = task::spawn_blocking(|| handle.join());
    let mut refresh = time::interval(REFRESH);
    let mut is_stopping = false;
    loop {
        tokio::select! {
            outcome = &mut joined => {
                progress.finish();
                return outcome.map_err(io::Error::other);
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
