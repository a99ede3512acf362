//! What a driver had to let go, of which no frame and no event tells.

use depth_camera::DepthCamera;
use std::time::{Duration, Instant};

/// How often a driver is asked.
const ASKED_EVERY: Duration = Duration::from_secs(1);

/// Counts what a driver misses while its frames are waited for.
///
/// Before the first frame, and while the device is gone, nobody takes what it sends: that is no loss.
#[derive(Debug, Default)]
pub(super) struct Missed {
    total: u64,
    /// What the driver had missed when it was asked last, and when that was; `None` while nothing counts.
    newest: Option<(u64, Instant)>,
    /// So many the log was told of.
    n_told: u64,
}

impl Missed {
    /// Frames, and infrared images that frames lack.
    pub(super) fn total(&self) -> u64 {
        self.total
    }

    /// What is missed from now on counts.
    pub(super) fn follow(&mut self, camera: &dyn DepthCamera) {
        match self.newest {
            Some((_, asked)) if asked.elapsed() < ASKED_EVERY => {}
            Some((before, _)) => self.count(before, camera),
            None => self.newest = Some((camera.n_missed(), Instant::now())),
        }
    }

    /// What is missed from now on does not count.
    pub(super) fn pause(&mut self, camera: &dyn DepthCamera) {
        if let Some((before, _)) = self.newest {
            self.count(before, camera);
        }
        self.newest = None;
    }

    fn count(&mut self, before: u64, camera: &dyn DepthCamera) {
        let n_missed = camera.n_missed();
        self.newest = Some((n_missed, Instant::now()));
        self.total += n_missed.saturating_sub(before);
        // A driver that never keeps up is told of each time when it is twice as many.
        if self.total > 2 * self.n_told {
            self.n_told = self.total;
            tracing::warn!(
                n_missed = self.total,
                "frames or infrared images were missed by the driver"
            );
        }
    }
}
