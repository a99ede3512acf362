//! The device thread's loop: takes frames from a camera until it ends, fails, or is told to stop.
//!
//! A live device, which does not know how many frames will come, may be unplugged or fall silent: once it has delivered a
//! frame it is awaited, and the stream goes on when it is back. A recording ends at its end.

use super::{CaptureParams, Event, EventKind, continuity::Continuity};
use depth_camera::{CameraError, DepthCamera, Frame};
use serde::Serialize;
use std::{
    sync::{
        Arc,
        atomic::{AtomicBool, Ordering},
    },
    thread,
    time::{Duration, Instant},
};

/// What the device thread hands on.
#[derive(Clone, Debug)]
pub enum Delivery {
    /// A frame.
    Frame(Arc<Frame>),
    /// Something that happened, never to be dropped.
    Event(Event),
    /// The device is doing otherwise than before. After a gap this comes before the first frame.
    Health(DeviceHealth),
}

/// How a live device is doing.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum DeviceHealth {
    /// Frames come.
    #[default]
    Streaming,
    /// It is there, and no frames come.
    Stalled,
    /// It is not there, or silent for long; it is waited for.
    Gone,
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
        is_live: camera.info().n_frames.is_none(),
        health: DeviceHealth::default(),
        continuity: Continuity::default(),
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
    /// Whether it may come back.
    is_live: bool,
    health: DeviceHealth,
    continuity: Continuity,
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
                self.heard(deliver);
                self.summary.n_frames += 1;
                let frame = self.continuity.carry_on(frame);
                let is_wanted = deliver(Delivery::Frame(Arc::new(frame)));
                (!is_wanted).then_some(CaptureEnd::Unwanted)
            }
            Err(CameraError::DamagedFrame { frame_id, reason }) => {
                self.heard(deliver);
                let frame_id = self.continuity.number(frame_id);
                let is_wanted = deliver(self.damaged(frame_id, reason));
                (!is_wanted).then_some(CaptureEnd::Unwanted)
            }
            Err(CameraError::Timeout { .. }) => self.timed_out(deliver),
            Err(error) if self.may_return(&error) => self.gone(error, deliver),
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

    fn timed_out(&mut self, deliver: &mut impl FnMut(Delivery) -> bool) -> Option<CaptureEnd> {
        self.summary.n_timeouts += 1;
        let waited: Duration = self.last_heard.elapsed();
        let error = CameraError::Timeout { waited };
        if waited >= self.params.max_silence() {
            return self.gone(error, deliver);
        }
        if self.health == DeviceHealth::Streaming && self.is_awaited() {
            self.turn(DeviceHealth::Stalled, deliver);
        }
        None
    }

    /// Whether the device may be waited for: it is a live one, and did stream.
    fn is_awaited(&self) -> bool {
        self.is_live && self.summary.n_frames > 0
    }

    /// Whether a device with this error may come back: what was unplugged may at first be refused to us.
    fn may_return(&self, error: &CameraError) -> bool {
        let is_gone = self.health == DeviceHealth::Gone;
        match error {
            CameraError::Disconnected => self.is_awaited(),
            CameraError::Busy | CameraError::PermissionDenied => self.is_awaited() && is_gone,
            _ => false,
        }
    }

    /// Waits for a device that is not there, unless that has taken too long.
    fn gone(
        &mut self,
        error: CameraError,
        deliver: &mut impl FnMut(Delivery) -> bool,
    ) -> Option<CaptureEnd> {
        let patience = match self.is_awaited() {
            true => self.params.max_silence().max(self.params.reconnect()),
            false => Duration::ZERO,
        };
        if self.last_heard.elapsed() >= patience {
            tracing::error!(%error, "the camera is given up");
            return Some(CaptureEnd::Failed(error));
        }
        if self.health != DeviceHealth::Gone {
            tracing::warn!(%error, "the camera is gone; waiting for it");
            self.turn(DeviceHealth::Gone, deliver);
        }
        // A camera may say at once that it is not there.
        if !matches!(error, CameraError::Timeout { .. }) {
            thread::sleep(self.params.grab_timeout());
        }
        None
    }

    /// The device has delivered something.
    fn heard(&mut self, deliver: &mut impl FnMut(Delivery) -> bool) {
        self.last_heard = Instant::now();
        if self.health != DeviceHealth::Streaming {
            tracing::info!("the camera is back");
            self.turn(DeviceHealth::Streaming, deliver);
        }
    }

    fn turn(&mut self, health: DeviceHealth, deliver: &mut impl FnMut(Delivery) -> bool) {
        self.health = health;
        self.continuity.interrupt();
        // Whether frames are wanted shows when there is one.
        deliver(Delivery::Health(health));
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
        health: Vec<DeviceHealth>,
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
        let params = CaptureParams {
            max_silence_secs: 0.0,
            ..CaptureParams::default()
        };
        run_with(&params, Some(1), answers)
    }

    /// A live camera is one that announces no number of frames.
    fn run_with(
        params: &CaptureParams,
        n_frames: Option<usize>,
        answers: Vec<Result<Option<Frame>, CameraError>>,
    ) -> (CaptureSummary, Sink) {
        let mut camera = Script {
            info: CameraInfo {
                n_frames,
                ..SimulatedCamera::kinect2_plaque(1, 0).info().clone()
            },
            answers: answers.into(),
        };
        let mut sink = Sink::default();
        let stop = AtomicBool::new(false);
        let summary = run_device(&mut camera, params, &stop, |delivery| {
            match delivery {
                Delivery::Frame(frame) => sink.frames.push(frame.frame_id),
                Delivery::Event(event) => sink.events.push(event),
                Delivery::Health(health) => sink.health.push(health),
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

    /// A live device's parameters: it is away after three timeouts or so, and awaited for `reconnect_secs`.
    fn patient(reconnect_secs: f64) -> CaptureParams {
        CaptureParams {
            grab_timeout_secs: 0.001,
            max_silence_secs: 1000.0,
            reconnect_secs,
            ..CaptureParams::default()
        }
    }

    fn timeout() -> Result<Option<Frame>, CameraError> {
        Err(CameraError::Timeout {
            waited: Duration::ZERO,
        })
    }

    #[test]
    fn a_live_camera_that_was_unplugged_is_awaited_and_carries_on() {
        use DeviceHealth::{Gone, Stalled, Streaming};
        let answers = vec![
            frame(5),
            timeout(),
            timeout(),
            frame(6),
            Err(CameraError::Disconnected),
            timeout(),
            Err(CameraError::PermissionDenied),
            frame(0),
            frame(1),
            Ok(None),
        ];
        let (summary, sink) = run_with(&patient(1000.0), None, answers);
        assert_eq!(summary.end, CaptureEnd::EndOfStream);
        assert_eq!(summary.n_frames, 4);
        assert_eq!(sink.frames, [5, 6, 7, 8], "numbers go on");
        assert_eq!(sink.health, [Stalled, Streaming, Gone, Streaming]);
    }

    #[test]
    fn a_live_camera_is_given_up_in_the_end_or_if_it_never_came() {
        let gone = || Err(CameraError::Disconnected);
        let impatient = CaptureParams {
            max_silence_secs: 0.0,
            ..patient(0.0)
        };
        let (summary, sink) = run_with(&impatient, None, vec![frame(0), gone(), frame(1)]);
        assert_eq!(summary.end, CaptureEnd::Failed(CameraError::Disconnected));
        assert_eq!(
            (sink.frames.as_slice(), sink.health.len()),
            ([0].as_slice(), 0)
        );
        let (summary, sink) = run_with(&patient(1000.0), None, vec![gone(), frame(0)]);
        assert_eq!(summary.end, CaptureEnd::Failed(CameraError::Disconnected));
        assert!(sink.health.is_empty());
        let denied = Err(CameraError::PermissionDenied);
        let (summary, _) = run_with(&patient(1000.0), None, vec![frame(0), denied]);
        let failed = CaptureEnd::Failed(CameraError::PermissionDenied);
        assert_eq!(summary.end, failed, "it was not unplugged");
    }
}
