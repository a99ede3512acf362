//! SIGINT, SIGTERM and SIGHUP.

use std::io;
use tokio::signal::unix::{Signal, SignalKind, signal};

/// Exit code of a run that was interrupted: 128 and the number of SIGINT, as shells have it.
pub const EXIT_INTERRUPTED: u8 = 130;

/// What a signal asks a daemon for.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Ask {
    /// To end; with the signal's name.
    Stop(&'static str),
    /// To read its configuration anew.
    Reload,
}

/// The signals that ask to stop.
#[derive(Debug)]
pub struct Signals {
    interrupt: Signal,
    terminate: Signal,
}

impl Signals {
    /// Catches the signals from now on.
    ///
    /// # Errors
    /// If the system refuses.
    pub fn new() -> io::Result<Self> {
        Ok(Signals {
            interrupt: signal(SignalKind::interrupt())?,
            terminate: signal(SignalKind::terminate())?,
        })
    }

    /// Waits for the next signal and names it.
    pub async fn next(&mut self) -> &'static str {
        tokio::select! {
            _ = self.interrupt.recv() => "SIGINT",
            _ = self.terminate.recv() => "SIGTERM",
        }
    }
}

/// The signals that a daemon listens to.
#[derive(Debug)]
pub struct DaemonSignals {
    stop: Signals,
    hang_up: Signal,
}

impl DaemonSignals {
    /// Catches the signals from now on.
    ///
    /// # Errors
    /// If the system refuses.
    pub fn new() -> io::Result<Self> {
        Ok(DaemonSignals {
            stop: Signals::new()?,
            hang_up: signal(SignalKind::hangup())?,
        })
    }

    /// Waits for the next signal.
    pub async fn next(&mut self) -> Ask {
        tokio::select! {
            name = self.stop.next() => Ask::Stop(name),
            _ = self.hang_up.recv() => Ask::Reload,
        }
    }
}

/// Exits without waiting for anything; files stand whole or not at all.
pub(super) fn exit_at_once(name: &str) -> ! {
    tracing::error!("{name} again: exiting at once");
    std::process::exit(EXIT_INTERRUPTED.into());
}
