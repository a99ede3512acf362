//! A full disk is waited for: what a scan leaves behind exists nowhere else.

use super::status::{StatusSlot, StopToken};
use crate::export::ExportError;
use std::{
    thread,
    time::{Duration, Instant},
};

/// After the disk has refused a file it is tried again so much later.
const AFTER_REFUSAL: Duration = Duration::from_secs(5);

/// How often it is looked meanwhile whether somebody asks to stop.
const LOOK: Duration = Duration::from_millis(100);

/// Waits for room on the disk until somebody asks to stop.
#[derive(Debug)]
pub struct Patience {
    status: StatusSlot,
    stop: StopToken,
    pause: Duration,
}

impl Patience {
    /// Tells in a status what waits, and ends with a token.
    pub fn new(status: &StatusSlot, stop: &StopToken) -> Self {
        Patience {
            status: status.clone(),
            stop: stop.clone(),
            pause: AFTER_REFUSAL,
        }
    }

    /// Writes a file, again and again where the disk may take it later; once more after somebody has asked to stop.
    ///
    /// # Errors
    /// As `attempt`, if waiting helps nothing or somebody has asked to stop.
    pub fn write<T>(
        &self,
        name: &str,
        attempt: impl Fn() -> Result<T, ExportError>,
    ) -> Result<T, ExportError> {
        let refusal = match attempt() {
            Err(error) if error.is_passing() => error.to_string(),
            ended => return ended,
        };
        tracing::error!("{refusal}; it is tried again until there is room");
        self.tell(name, Some(refusal));
        let ended = loop {
            self.rest();
            let is_last = self.stop.is_stopped();
            match attempt() {
                Err(error) if error.is_passing() && !is_last => {}
                ended => break ended,
            }
        };
        self.tell(name, None);
        if ended.is_ok() {
            tracing::info!(file = name, "there is room again, and the file is written");
        }
        ended
    }

    fn tell(&self, name: &str, refusal: Option<String>) {
        self.status
            .update(|status| status.note_unwritten(name, refusal));
    }

    fn rest(&self) {
        let until = Instant::now() + self.pause;
        while !self.stop.is_stopped() && Instant::now() < until {
            thread::sleep(LOOK.min(self.pause));
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::pipeline::{
        state::{Fault, State},
        status::Phase,
    };
    use std::{cell::Cell, io};

    fn patience() -> Patience {
        let status = StatusSlot::default();
        status.update(|status| status.phase = Phase::Exporting);
        Patience {
            pause: Duration::from_millis(1),
            ..Patience::new(&status, &StopToken::default())
        }
    }

    fn refused(kind: io::ErrorKind) -> Result<(), ExportError> {
        Err(ExportError::Write {
            path: "sessions/a/base.ply".into(),
            cause: kind.into(),
        })
    }

    #[test]
    fn a_file_without_room_is_told_of_and_written_when_there_is_some() {
        let patience = patience();
        let n_attempts = Cell::new(0);
        let written = patience.write("base.ply", || {
            n_attempts.set(n_attempts.get() + 1);
            let status = patience.status.get();
            match n_attempts.get() {
                1 => refused(io::ErrorKind::StorageFull),
                2 => {
                    assert_eq!(status.state, State::Fault(Fault::StorageFailed));
                    let told = &status.unwritten["base.ply"];
                    assert!(told.contains("sessions/a/base.ply"), "{told}");
                    refused(io::ErrorKind::QuotaExceeded)
                }
                _ => Ok(()),
            }
        });
        assert!(written.is_ok());
        assert_eq!(n_attempts.get(), 3);
        let status = patience.status.get();
        assert_eq!(status.state, State::Draining);
        assert!(status.unwritten.is_empty());
    }

    #[test]
    fn nobody_waits_after_a_stop_or_for_what_waiting_does_not_mend() {
        for (kind, is_stopped, expected) in [
            (io::ErrorKind::StorageFull, true, 2),
            (io::ErrorKind::PermissionDenied, false, 1),
        ] {
            let patience = patience();
            if is_stopped {
                patience.stop.stop();
            }
            let n_attempts = Cell::new(0);
            let written = patience.write("base.ply", || {
                n_attempts.set(n_attempts.get() + 1);
                refused(kind)
            });
            assert!(written.is_err());
            assert_eq!(n_attempts.get(), expected, "{kind}");
            assert!(patience.status.get().unwritten.is_empty());
        }
    }
}
