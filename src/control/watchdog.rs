//! Whether every stage moves, or has nothing to do: a daemon that hangs must not say that all is well.

use super::supervisor::{Scan, Supervisor};
use crate::pipeline::{DeviceHealth, Improvement, Phase, Status};
use std::{
    sync::Arc,
    time::{Duration, Instant},
};

/// How long a device may give nothing while it says that it streams, once it does, and fusion may take for a frame.
const CAPTURE_PATIENCE: Duration = Duration::from_secs(20);

/// How long meshes and reports may take, and a step of improving a scan; the largest take a few minutes.
const ENDING_PATIENCE: Duration = Duration::from_secs(900);

/// What moved last, and when.
#[derive(Debug, Default)]
pub struct Watchdog {
    last: Option<(Arc<Scan>, Progress, Instant)>,
}

/// Counters that rise while stages move.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
struct Progress {
    produced: u64,
    handled: u64,
    phase: Phase,
    improvement: Option<Improvement>,
}

impl Watchdog {
    /// Whether all is well now.
    pub fn is_well(&mut self, supervisor: &Supervisor) -> bool {
        let Some(scan) = supervisor.scan() else {
            self.last = None;
            return true;
        };
        let status = scan.watch.status();
        let progress = Progress {
            produced: status.frames.produced,
            handled: status.frames.handled(),
            phase: status.phase,
            improvement: status.improvement,
        };
        let since = match &self.last {
            Some((last, old, since))
                if Arc::ptr_eq(last, &scan) && has_not_moved(old, &progress, &status) =>
            {
                *since
            }
            _ => Instant::now(),
        };
        self.last = Some((scan, progress, since));
        since.elapsed() < patience(status.phase)
    }
}

/// Whether a stage that has something to do has not done it.
fn has_not_moved(old: &Progress, new: &Progress, status: &Status) -> bool {
    if old.phase != new.phase || old.improvement != new.improvement {
        return false;
    }
    if new.phase != Phase::Capturing {
        // The disk is waited for, for as long as it takes.
        return !status.waits_for_room();
    }
    // Until its first frame a device is not said to be silent; the device thread gives it up after `capture.max_silence_secs`.
    let streams = new.produced > 0 && status.device == DeviceHealth::Streaming;
    let device_hangs = new.produced == old.produced && streams;
    let fusion_hangs = new.handled == old.handled && status.frames.in_flight > 0;
    device_hangs || fusion_hangs
}

fn patience(phase: Phase) -> Duration {
    match phase {
        Phase::Capturing => CAPTURE_PATIENCE,
        Phase::Meshing | Phase::Refining | Phase::Exporting => ENDING_PATIENCE,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::pipeline::{FrameAccounts, Work};

    fn progress(produced: u64, handled: u64) -> Progress {
        Progress {
            produced,
            handled,
            phase: Phase::Capturing,
            improvement: None,
        }
    }

    fn status(in_flight: u64, device: DeviceHealth) -> Status {
        Status {
            frames: FrameAccounts {
                in_flight,
                ..FrameAccounts::default()
            },
            device,
            ..Status::default()
        }
    }

    #[test]
    fn a_stage_hangs_that_has_something_to_do_and_does_not() {
        let streaming = status(0, DeviceHealth::Streaming);
        let busy = status(2, DeviceHealth::Streaming);
        let gone = status(0, DeviceHealth::Gone);
        assert!(!has_not_moved(&progress(5, 4), &progress(6, 5), &busy));
        assert!(has_not_moved(&progress(5, 5), &progress(5, 5), &streaming));
        assert!(!has_not_moved(&progress(5, 5), &progress(5, 5), &gone));
        // The first frame is awaited for as long as the configuration says.
        assert!(!has_not_moved(&progress(0, 0), &progress(0, 0), &streaming));
        assert!(has_not_moved(&progress(5, 4), &progress(9, 4), &busy));
        let waiting = Status {
            phase: Phase::Exporting,
            unwritten: [("base.ply".to_owned(), "full".to_owned())].into(),
            ..Status::default()
        };
        let unheard = Status {
            unwritten: [("events.jsonl".to_owned(), "full".to_owned())].into(),
            ..waiting.clone()
        };
        let exporting = Progress {
            phase: Phase::Exporting,
            ..progress(5, 5)
        };
        assert!(has_not_moved(&exporting, &exporting, &gone));
        assert!(!has_not_moved(&exporting, &exporting, &waiting));
        assert!(has_not_moved(&exporting, &exporting, &unheard));
        let at = |phase, work: Work, n_done| Progress {
            phase,
            improvement: Some(work.at(n_done, 100)),
            ..progress(5, 4)
        };
        let closing = |n_done| at(Phase::Meshing, Work::CloseLoops, n_done);
        assert!(has_not_moved(&closing(7), &closing(7), &gone));
        assert!(!has_not_moved(&closing(7), &closing(8), &gone));
        // Frames wait while others are taken back.
        let taking_back = |n_done| at(Phase::Capturing, Work::TakeBack, n_done);
        assert!(has_not_moved(&taking_back(7), &taking_back(7), &busy));
        assert!(!has_not_moved(&taking_back(7), &taking_back(8), &busy));
    }
}
