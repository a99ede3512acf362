//! Threads with names, which tell of their panic, and pools of them.

use super::{
    state::{Fault, State},
    status::StatusSlot,
};
use rayon::{ThreadPool, ThreadPoolBuildError, ThreadPoolBuilder};
use std::{
    io,
    num::NonZeroUsize,
    thread::{self, JoinHandle},
};

/// Starts a thread; names have 15 bytes at most, which is what the system shows. A panic is told of at once.
pub fn spawn<T: Send + 'static>(
    name: &str,
    status: &StatusSlot,
    body: impl FnOnce() -> T + Send + 'static,
) -> io::Result<JoinHandle<T>> {
    let alarm = Alarm(status.clone());
    thread::Builder::new().name(name.to_owned()).spawn(move || {
        let _alarm = alarm;
        body()
    })
}

/// Tells of the panic of the thread that holds it.
struct Alarm(StatusSlot);

impl Drop for Alarm {
    fn drop(&mut self) {
        if thread::panicking() {
            self.0.update(|status| {
                status.has_fault = true;
                status.state = State::Fault(Fault::Program);
            });
        }
    }
}

/// A pool of so many threads.
pub fn pool(
    name: &'static str,
    n_threads: NonZeroUsize,
) -> Result<ThreadPool, ThreadPoolBuildError> {
    builder(name, n_threads).build()
}

/// A pool of so many threads that yield to all others.
pub fn idle_pool(
    name: &'static str,
    n_threads: NonZeroUsize,
) -> Result<ThreadPool, ThreadPoolBuildError> {
    let yields = move |_| {
        if let Err(error) = idle_class::enter() {
            tracing::debug!(%error, name, "not in the idle class");
        }
    };
    builder(name, n_threads).start_handler(yields).build()
}

fn builder(name: &'static str, n_threads: NonZeroUsize) -> ThreadPoolBuilder {
    ThreadPoolBuilder::new()
        .num_threads(n_threads.get())
        .thread_name(move |index| format!("{name}-{index}"))
}
