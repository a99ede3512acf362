//! How many frames a second are handled, and when it is time to look after the accounts.

use std::time::{Duration, Instant};

/// Over so long frames are counted, and so often accounts are checked.
const PERIOD: Duration = Duration::from_secs(1);

/// Counts frames.
#[derive(Debug)]
pub(super) struct Pulse {
    since: Instant,
    n_frames: u32,
    checked: Instant,
    /// Whether accounts that do not add up were told of.
    pub(super) is_told: bool,
}

impl Default for Pulse {
    fn default() -> Self {
        let now = Instant::now();
        Pulse {
            since: now,
            n_frames: 0,
            checked: now,
            is_told: false,
        }
    }
}

impl Pulse {
    /// One more frame; the rate (frames a second) once a period is over.
    pub(super) fn beat(&mut self) -> Option<f64> {
        self.n_frames += 1;
        self.rest()
    }

    /// No frame; the rate once a period is over.
    pub(super) fn rest(&mut self) -> Option<f64> {
        let elapsed = self.since.elapsed();
        if elapsed < PERIOD {
            return None;
        }
        let rate = f64::from(self.n_frames) / elapsed.as_secs_f64();
        (self.since, self.n_frames) = (Instant::now(), 0);
        Some(rate)
    }

    /// Whether the accounts are to be checked now.
    pub(super) fn is_check_due(&mut self) -> bool {
        let is_due = self.checked.elapsed() >= PERIOD;
        if is_due {
            self.checked = Instant::now();
        }
        is_due
    }
}
