//! The device thread's loop: takes frames from a camera until it ends, fails, or is told to stop.

use super::{CaptureParams, Event, EventKind};
use depth_camera::{CameraError, DepthCamera, Frame};
use std::{
    sync::{
        Arc,
        atomic::{AtomicBool, Ordering},
    },
    time::{Duration, Instant},
};

/// What the device thread hands on.
#[derive(Clone, Debug)]
pub enum Delivery {
    /// A frame.
    Frame(Arc<Frame>),
    /// Something that happened, never to be dropped.
    Event(Event),
}

/// How the stream ended.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum CaptureEnd {
    /// The stream came to its end.
    EndOfStream,
    /// Somebody asked to stop.
    Stopped,
    /// The consumer of the frames is gone.
    Unwanted,
    /// The camera failed for good.
    Failed(CameraError),
}

/// What the device delivered.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct CaptureSummary {
    /// Frames that came or were announced, damaged ones too.
    pub n_frames: u64,
    /// Frames that came damaged.
    pub n_damaged: u64,
    /// Waits for a frame that were in vain.
    pub n_timeouts: u64,
    /// What is wrong with the first damaged frame.
    pub first_damage: Option<String>,
    /// How the stream ended.
    pub end: CaptureEnd,
}

/// Runs a camera to the end of its stream, until `stop` is set, or until `deliver` returns false: nobody wants frames.
pub fn run_device(
    camera: &mut dyn DepthCamera,
    params: &CaptureParams,
    stop: &AtomicBool,
    mut deliver: impl FnMut(Delivery) -> bool,
) -> CaptureSummary {
    let mut device = Device {
        params,
        summary: CaptureSummary {
            n_frames: 0,
            n_damaged: 0,
            n_timeouts: 0,
            first_damage: None,
            end: CaptureEnd::Stopped,
        },
        last_heard: Instant::now(),
    };
    while !stop.load(Ordering::Relaxed) {
        let grabbed = camera.grab(params.grab_timeout());
        if let Some(end) = device.handle(grabbed, &mut deliver) {
            device.summary.end = end;
            break;
        }
    }
    let summary = device.summary;
    tracing::debug!(
        n_frames = summary.n_frames,
        n_damaged = summary.n_damaged,
        n_timeouts = summary.n_timeouts,
        end = ?summary.end,
        "capture ended"
    );
    summary
}

struct Device<'a> {
    params: &'a CaptureParams,
    summary: CaptureSummary,
    last_heard: Instant,
}

impl Device<'_> {
    /// Handles what a call to `grab` gave; returns how the stream ended, if it did.
    fn handle(
        &mut self,
        grabbed: Result<Option<Frame>, CameraError>,
        deliver: &mut impl FnMut(Delivery) -> bool,
    ) -> Option<CaptureEnd> {
        match grabbed {
            Ok(None) => Some(CaptureEnd::EndOfStream),
            Ok(Some(frame)) => {
                self.last_heard = Instant::now();
                self.summary.n_frames += 1;
                let is_wanted = deliver(Delivery::Frame(Arc::new(frame)));
                (!is_wanted).then_some(CaptureEnd::Unwanted)
            }
            Err(CameraError::DamagedFrame { frame_id, reason }) => {
                self.last_heard = Instant::now();
                let is_wanted = deliver(self.damaged(frame_id, reason));
                (!is_wanted).then_some(CaptureEnd::Unwanted)
            }
            Err(CameraError::Timeout { .. }) => self.timed_out(),
            Err(error) => {
                tracing::error!(%error, "the camera failed");
                Some(CaptureEnd::Failed(error))
            }
        }
    }

    fn damaged(&mut self, frame_id: u64, reason: String) -> Delivery {
        tracing::warn!(frame_id, reason, "damaged frame skipped");
        self.summary.n_frames += 1;
        self.summary.n_damaged += 1;
        self.summary
            .first_damage
            .get_or_insert_with(|| reason.clone());
        Delivery::Event(Event {
            frame_id,
            device_time_secs: None,
            kind: EventKind::Damaged { reason },
        })
    }

    fn timed_out(&mut self) -> Option<CaptureEnd> {
        self.summary.n_timeouts += 1;
        let waited: Duration = self.last_heard.elapsed();
        if waited < self.params.max_silence() {
            return None;
        }
        let error = CameraError::Timeout { waited };
        tracing::error!(%error, "the camera is silent");
        Some(CaptureEnd::Failed(error))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use depth_camera::{CameraInfo, Image};
    use simulated::SimulatedCamera;
    use std::collections::VecDeque;

    struct Script {
        info: CameraInfo,
        answers: VecDeque<Result<Option<Frame>, CameraError>>,
    }

    impl DepthCamera for Script {
        fn info(&self) -> &CameraInfo {
            &self.info
        }

        fn grab(&mut self, timeout: Duration) -> Result<Option<Frame>, CameraError> {
            let silence = Err(CameraError::Timeout { waited: timeout });
            self.answers.pop_front().unwrap_or(silence)
        }
    }

    #[derive(Default)]
    struct Sink {
        frames: Vec<u64>,
        events: Vec<Event>,
    }

    fn frame(frame_id: u64) -> Result<Option<Frame>, CameraError> {
        Ok(Some(Frame {
            frame_id,
            device_time_secs: frame_id as f64,
            host_time: Instant::now(),
            depth: Some(Image::filled(1, 1, 1.0)),
            ir: None,
        }))
    }

    fn run(answers: Vec<Result<Option<Frame>, CameraError>>) -> (CaptureSummary, Sink) {
        let mut camera = Script {
            info: SimulatedCamera::kinect2_plaque(1, 0).info().clone(),
            answers: answers.into(),
        };
        let params = CaptureParams {
            max_silence_secs: 0.0,
            ..CaptureParams::default()
        };
        let mut sink = Sink::default();
        let stop = AtomicBool::new(false);
        let summary = run_device(&mut camera, &params, &stop, |delivery| {
            match delivery {
                Delivery::Frame(frame) => sink.frames.push(frame.frame_id),
                Delivery::Event(event) => sink.events.push(event),
            }
            true
        });
        (summary, sink)
    }

    #[test]
    fn a_damaged_frame_is_counted_and_told_and_the_stream_goes_on() {
        let damage = CameraError::DamagedFrame {
            frame_id: 1,
            reason: "torn".into(),
        };
        let (summary, sink) = run(vec![frame(0), Err(damage), frame(2), Ok(None)]);
        assert_eq!((summary.n_frames, summary.n_damaged), (3, 1));
        assert_eq!(summary.end, CaptureEnd::EndOfStream);
        assert_eq!(sink.frames, [0, 2]);
        assert_eq!(sink.events.len(), 1);
    }

    #[test]
    fn a_camera_that_is_gone_or_silent_ends_the_stream() {
        let (summary, _) = run(vec![frame(0), Err(CameraError::Disconnected)]);
        assert_eq!(summary.end, CaptureEnd::Failed(CameraError::Disconnected));
        let (summary, sink) = run(vec![frame(0)]);
        assert_eq!(summary.n_timeouts, 1);
        assert!(matches!(
            summary.end,
            CaptureEnd::Failed(CameraError::Timeout { .. })
        ));
        assert_eq!(sink.frames, [0]);
    }
}
