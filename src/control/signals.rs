//! SIGINT, SIGTERM and SIGHUP.

use std::{
    fs, future,
    io::{self, IsTerminal},
};
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
    /// Where SIGHUP asks to stop, too, as when the terminal is closed, and nothing has asked before.
    hang_up: Option<Signal>,
}

impl Signals {
    /// Catches the signals from now on.
    ///
    /// # Errors
    /// If the system refuses.
    pub fn new() -> io::Result<Self> {
        let hang_up = match outlives_terminal() {
            true => None,
            false => Some(signal(SignalKind::hangup())?),
        };
        Self::with(hang_up)
    }

    fn with(hang_up: Option<Signal>) -> io::Result<Self> {
        Ok(Signals {
            interrupt: signal(SignalKind::interrupt())?,
            terminate: signal(SignalKind::terminate())?,
            hang_up,
        })
    }

    /// Waits for the next signal and names it.
    pub async fn next(&mut self) -> &'static str {
        let name = tokio::select! {
            _ = self.interrupt.recv() => "SIGINT",
            _ = self.terminate.recv() => "SIGTERM",
            () = received(&mut self.hang_up) => "SIGHUP",
        };
        // A terminal's end is told twice, by the shell and by the system: it is never the second signal, which exits at once.
        self.hang_up = None;
        name
    }
}

/// The signals that a daemon listens to.
#[derive(Debug)]
pub struct DaemonSignals {
    stop: Signals,
    /// SIGHUP, but for a daemon that ends with its terminal.
    reload: Option<Signal>,
}

impl DaemonSignals {
    /// Catches the signals from now on.
    ///
    /// # Errors
    /// If the system refuses.
    pub fn new() -> io::Result<Self> {
        // A terminal that was closed is none any more: it is looked for now.
        let ends_with_terminal = io::stderr().is_terminal() && !outlives_terminal();
        let hang_up = Some(signal(SignalKind::hangup())?);
        let (stop, reload) = match ends_with_terminal {
            true => (hang_up, None),
            false => (None, hang_up),
        };
        Ok(DaemonSignals {
            stop: Signals::with(stop)?,
            reload,
        })
    }

    /// Waits for the next signal.
    pub async fn next(&mut self) -> Ask {
        tokio::select! {
            name = self.stop.next() => Ask::Stop(name),
            () = received(&mut self.reload) => Ask::Reload,
        }
    }
}

/// Exits without waiting for anything; files stand whole or not at all.
pub(super) fn exit_at_once(name: &str) -> ! {
    tracing::error!("{name} again: exiting at once");
    std::process::exit(EXIT_INTERRUPTED.into());
}

/// Waits for a signal, for ever without one.
async fn received(signal: &mut Option<Signal>) {
    match signal {
        Some(signal) => _ = signal.recv().await,
        None => future::pending().await,
    }
}

/// Whether the program was started to go on when its terminal is closed, as by `nohup`. To be asked before SIGHUP is caught.
fn outlives_terminal() -> bool {
    fs::read_to_string("/proc/self/status").is_ok_and(|status| ignores_hang_up(&status))
}

/// Whether a process ignores SIGHUP, whose bit is the first, by its file of proc(5).
fn ignores_hang_up(status: &str) -> bool {
    let mask = status
        .lines()
        .find_map(|line| line.strip_prefix("SigIgn:"))
        .and_then(|mask| u64::from_str_radix(mask.trim(), 16).ok());
    mask.is_some_and(|mask| mask & 1 == 1)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_process_tells_whether_it_is_to_outlive_its_terminal() {
        // Rust ignores SIGPIPE, the thirteenth.
        for (mask, ignores) in [("0000000000001000", false), ("0000000000001001", true)] {
            let status = format!("SigBlk:\t0000000000000001\nSigIgn:\t{mask}\n");
            assert_eq!(ignores_hang_up(&status), ignores, "{mask}");
        }
    }
}
