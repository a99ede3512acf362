//! A camera that answers by a script.

use super::*;
use depth_camera::{CameraInfo, Image};
use simulated::SimulatedCamera;
use std::collections::VecDeque;

struct Script {
    info: CameraInfo,
    answers: VecDeque<Result<Option<Frame>, CameraError>>,
    n_grabs: u64,
}

impl DepthCamera for Script {
    fn info(&self) -> &CameraInfo {
        &self.info
    }

    fn grab(&mut self, timeout: Duration) -> Result<Option<Frame>, CameraError> {
        self.n_grabs += 1;
        let silence = Err(CameraError::Timeout { waited: timeout });
        self.answers.pop_front().unwrap_or(silence)
    }

    /// Ten with each call.
    fn n_missed(&self) -> u64 {
        10 * self.n_grabs
    }
}

#[derive(Default)]
struct Sink {
    frames: Vec<u64>,
    events: Vec<Event>,
    health: Vec<DeviceHealth>,
    missed: Vec<u64>,
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
        n_grabs: 0,
    };
    let mut sink = Sink::default();
    let stop = AtomicBool::new(false);
    let summary = run_device(&mut camera, params, &stop, |delivery| {
        match delivery {
            Delivery::Frame(frame) => sink.frames.push(frame.frame_id),
            Delivery::Event(event) => sink.events.push(event),
            Delivery::Health(health) => sink.health.push(health),
            Delivery::Missed(total) => sink.missed.push(total),
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

#[test]
fn a_recording_at_its_own_pace_waits_through_its_gaps() {
    use DeviceHealth::{Stalled, Streaming};
    let not_due = || Err(CameraError::NotDue);
    let answers = || vec![frame(0), not_due(), not_due(), frame(1), Ok(None)];
    let patient = CaptureParams::default();
    let impatient = CaptureParams {
        max_silence_secs: 0.0,
        reconnect_secs: 0.0,
        ..CaptureParams::default()
    };
    // One that is repeated does not know how many frames will come.
    for n_frames in [Some(2), None] {
        for (params, health) in [(&patient, &[][..]), (&impatient, &[Stalled, Streaming])] {
            let (summary, sink) = run_with(params, n_frames, answers());
            assert_eq!(summary.end, CaptureEnd::EndOfStream);
            assert_eq!((summary.n_timeouts, sink.frames), (0, vec![0, 1]));
            assert_eq!(sink.health, health);
        }
    }
}

/// Parameters that await a live device for so long.
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
        frame(6),
        timeout(),
        timeout(),
        frame(7),
        Err(CameraError::Disconnected),
        timeout(),
        Err(CameraError::PermissionDenied),
        frame(0),
        frame(1),
        Ok(None),
    ];
    let (summary, sink) = run_with(&patient(1000.0), None, answers);
    assert_eq!(summary.end, CaptureEnd::EndOfStream);
    assert_eq!(summary.n_frames, 5);
    assert_eq!(sink.frames, [5, 6, 7, 8, 9], "numbers go on");
    assert_eq!(sink.health, [Stalled, Streaming, Gone, Streaming]);
}

#[test]
fn what_the_driver_misses_is_counted_while_frames_are_waited_for() {
    let gone = || Err(CameraError::Disconnected);
    let answers = vec![
        timeout(),
        frame(0),
        frame(1),
        timeout(),
        gone(),
        timeout(),
        frame(2),
        frame(3),
        Ok(None),
    ];
    let (summary, sink) = run_with(&patient(1000.0), None, answers);
    // Three calls after the first frame, until it is told to be gone, and two after the first one that is back.
    assert_eq!(summary.n_missed, 50);
    // Of the first three it is told on the way, and of all at the end.
    assert!(sink.missed.contains(&30), "{:?}", sink.missed);
    assert_eq!(sink.missed.last(), Some(&50));
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
