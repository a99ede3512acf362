//! A recording of any kind, begun anew whenever it ends.

use std::time::Duration;

use depth_camera::{CameraError, CameraInfo, DepthCamera, Frame};

/// Opens the recording from its start.
pub type Open = Box<dyn FnMut() -> Result<Box<dyn DepthCamera>, CameraError> + Send>;

/// A recording without an end: numbers and times of frames go on rising.
pub struct RepeatingCamera {
    open: Open,
    camera: Box<dyn DepthCamera>,
    info: CameraInfo,
    /// Where this play begins.
    start: Place,
    play: Play,
}

/// What is added to the numbers and times of a play.
#[derive(Clone, Copy, Debug, Default)]
struct Place {
    frame_id: u64,
    time_secs: f64,
}

/// What came in one play.
#[derive(Clone, Copy, Debug, Default)]
struct Play {
    /// One beyond the last frame's number.
    n_frames: u64,
    n_timed: u64,
    first_secs: f64,
    last_secs: f64,
}

/// A single frame says nothing of its rate; this is a Kinect's, seconds.
const KINECT_INTERVAL_SECS: f64 = 1.0 / 30.0;

impl RepeatingCamera {
    /// Opens the recording for the first time.
    ///
    /// # Errors
    /// As `open`.
    pub fn new(mut open: Open) -> Result<Self, CameraError> {
        let camera = open()?;
        let info = CameraInfo {
            n_frames: None,
            ..camera.info().clone()
        };
        Ok(RepeatingCamera {
            open,
            camera,
            info,
            start: Place::default(),
            play: Play::default(),
        })
    }

    fn begin_anew(&mut self) -> Result<(), CameraError> {
        self.camera = (self.open)()?;
        let play = std::mem::take(&mut self.play);
        self.start.frame_id += play.n_frames;
        self.start.time_secs += play.period_secs();
        Ok(())
    }
}

impl Play {
    fn note(&mut self, frame: &Frame) {
        if self.n_timed == 0 {
            self.first_secs = frame.device_time_secs;
        }
        self.n_timed += 1;
        self.last_secs = frame.device_time_secs;
        self.count(frame.frame_id);
    }

    fn count(&mut self, frame_id: u64) {
        self.n_frames = self.n_frames.max(frame_id + 1);
    }

    /// From one beginning to the next: the length, and one mean interval between the last frame and the first.
    fn period_secs(&self) -> f64 {
        let length = self.last_secs - self.first_secs;
        match self.n_timed {
            0 | 1 => KINECT_INTERVAL_SECS,
            n => length + length / (n - 1) as f64,
        }
    }
}

impl DepthCamera for RepeatingCamera {
    fn info(&self) -> &CameraInfo {
        &self.info
    }

    fn grab(&mut self, timeout: Duration) -> Result<Option<Frame>, CameraError> {
        let grabbed = match self.camera.grab(timeout) {
            // Without a frame it would begin anew for ever.
            Ok(None) if self.play.n_frames > 0 => {
                self.begin_anew()?;
                self.camera.grab(timeout)
            }
            grabbed => grabbed,
        };
        match grabbed {
            Ok(Some(mut frame)) => {
                self.play.note(&frame);
                frame.frame_id += self.start.frame_id;
                frame.device_time_secs += self.start.time_secs;
                Ok(Some(frame))
            }
            Err(CameraError::DamagedFrame { frame_id, reason }) => {
                self.play.count(frame_id);
                Err(CameraError::DamagedFrame {
                    frame_id: frame_id + self.start.frame_id,
                    reason,
                })
            }
            other => other,
        }
    }
}
