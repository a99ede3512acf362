//! How fast a recording is played.

use std::{
    thread,
    time::{Duration, Instant},
};

use depth_camera::CameraError;

/// How fast a recording is played.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Pacing {
    /// Every call to `grab` returns at once.
    #[default]
    AsFastAsPossible,
    /// `grab` waits until as much time has passed since the first call as passed in the recording.
    Recorded,
}

/// Holds the moments of a recording back until they are due.
#[derive(Clone, Debug, Default)]
pub struct Pacer {
    pacing: Pacing,
    /// When the first moment that was asked for was played, and its time in the recording.
    start: Option<(Instant, f64)>,
}

impl Pacer {
    /// A pacer that has not seen a moment yet.
    pub fn new(pacing: Pacing) -> Self {
        Pacer {
            pacing,
            start: None,
        }
    }

    /// Sleeps until the recorded offset of a moment has passed, but for `timeout` at most.
    ///
    /// # Errors
    /// [`CameraError::NotDue`] if the moment is later.
    pub fn wait_until_due(&mut self, time_secs: f64, timeout: Duration) -> Result<(), CameraError> {
        if self.pacing == Pacing::AsFastAsPossible {
            return Ok(());
        }
        let (start, first_secs) = *self.start.get_or_insert((Instant::now(), time_secs));
        // A gap too long for the clock is waited for one timeout after the other; what is earlier than the first moment is due.
        let offset_secs = (time_secs - first_secs).max(0.0);
        let offset = Duration::try_from_secs_f64(offset_secs).unwrap_or(Duration::MAX);
        let remaining = offset.saturating_sub(start.elapsed());
        thread::sleep(remaining.min(timeout));
        if remaining > timeout {
            return Err(CameraError::NotDue);
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn moments_are_due_at_their_offset_and_those_before_the_first_at_once() {
        let mut pacer = Pacer::new(Pacing::Recorded);
        let mut wait = |time_secs| pacer.wait_until_due(time_secs, Duration::ZERO);
        assert_eq!(wait(100.0), Ok(()));
        assert_eq!(wait(1000.0), Err(CameraError::NotDue));
        assert_eq!(wait(1e300), Err(CameraError::NotDue));
        assert_eq!(wait(7.0), Ok(()));
    }
}
