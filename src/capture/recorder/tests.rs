//! A few frames of a simulated sensor, recorded and read back.

use super::*;
use crate::capture::{InfraredRate, RecordFormat};
use depth_camera::{DepthCamera, Sensor};
use mcap_session::{MessageReader, Step, messages::decode_string, open_session, streams::Stream};
use replay::Pacing;
use simulated::{Infrared, Scene, Setup, SimulatedCamera, Trajectory};
use std::{fs, sync::Arc, time::Duration};

fn small_camera(n_frames: usize) -> SimulatedCamera {
    SimulatedCamera::new(Setup {
        scene: Scene::plaque(),
        trajectory: Trajectory::hand_held(nalgebra::Point3::origin(), n_frames),
        sensor: Sensor::Kinect2,
        infrared: Infrared::of_sensor(Sensor::Kinect2),
        n_moving_frames: n_frames,
        shading_frames: Vec::new(),
        reduction: 4,
        seed: 1,
    })
    .unwrap()
}

fn params(record_format: RecordFormat) -> CaptureParams {
    CaptureParams {
        record_format,
        min_free_disk_mb: 0,
        ..CaptureParams::default()
    }
}

fn event(frame_id: u64, kind: EventKind) -> Event {
    Event {
        frame_id,
        device_time_secs: Some(100.5),
        kind,
    }
}

#[test]
fn frames_and_events_are_read_back_from_either_format() {
    for format in [RecordFormat::Mcap, RecordFormat::Folder] {
        let folder = tempfile::tempdir().unwrap();
        let mut camera = small_camera(2);
        let mut recorder = Recorder::new(folder.path())
            .unwrap()
            .with_frames(camera.info(), &params(format), 0.0)
            .unwrap()
            .with_text("note.txt", "by lamplight")
            .unwrap();
        assert!(recorder.standing().unwrap().active);
        while let Some(frame) = camera.grab(Duration::ZERO).unwrap() {
            recorder.frame(&DeliveredFrame::unmoved(Arc::new(frame)));
        }
        recorder.tracked(Tracked::Event(event(1, EventKind::Found)));
        recorder.tick();
        let summary = recorder.finish();
        assert_eq!((summary.n_recorded, summary.failures.len()), (2, 0));
        let recording = folder.path().join(format.folder_name());
        let mut replayed = open_session(&recording, Pacing::AsFastAsPossible).unwrap();
        assert_eq!(replayed.camera.info().n_frames, Some(2));
        let mut n_frames = 0;
        while replayed.camera.grab(Duration::ZERO).unwrap().is_some() {
            n_frames += 1;
        }
        assert_eq!(n_frames, 2);
        let note = fs::read_to_string(recording.join("note.txt")).unwrap();
        assert_eq!(note, "by lamplight");
        let lines = fs::read_to_string(folder.path().join("events.jsonl")).unwrap();
        let expected = "{\"frame_id\":1,\"device_time_secs\":100.5,\"event\":\"found\"}\n";
        assert_eq!(lines, expected);
    }
}

/// The texts of a stream of a recording.
fn texts(recording: &Path, wanted: Stream) -> Vec<String> {
    let mut reader = MessageReader::new(&mcap_session::files(recording).unwrap());
    let mut texts = Vec::new();
    while reader
        .step(|channel, message| {
            if Stream::of_topic(&channel.topic) == Some(wanted) {
                texts.push(decode_string(message.data).unwrap().to_owned());
            }
        })
        .unwrap()
        != Step::End
    {}
    texts
}

#[test]
fn infrared_is_recorded_around_candidates_and_events_with_the_frames() {
    let folder = tempfile::tempdir().unwrap();
    let mut camera = small_camera(60);
    let snapshots_only = CaptureParams {
        record_ir: InfraredRate::Snapshots,
        ..params(RecordFormat::Mcap)
    };
    let mut recorder = Recorder::new(folder.path())
        .unwrap()
        .with_frames(camera.info(), &snapshots_only, 0.0)
        .unwrap();
    while let Some(frame) = camera.grab(Duration::ZERO).unwrap() {
        let frame_id = frame.frame_id;
        recorder.frame(&DeliveredFrame::unmoved(Arc::new(frame)));
        if frame_id == 33 {
            recorder.tracked(Tracked::Candidate(30));
            let taken = EventKind::Snapshot { n_snapshots: 1 };
            recorder.tracked(Tracked::Event(event(33, taken)));
        }
    }
    assert_eq!(recorder.finish().n_recorded, 60);
    let recording = folder.path().join("recording");
    let mut replayed = open_session(&recording, Pacing::AsFastAsPossible).unwrap();
    let mut with_ir = Vec::new();
    while let Some(frame) = replayed.camera.grab(Duration::ZERO).unwrap() {
        assert!(frame.depth.is_some());
        if frame.ir.is_some() {
            with_ir.push(frame.frame_id);
        }
    }
    assert_eq!(with_ir, (15..=45).collect::<Vec<_>>());
    let events = texts(&recording, Stream::Events);
    assert_eq!(events.len(), 1);
    assert!(events[0].contains("\"event\":\"snapshot\""), "{events:?}");
}

#[test]
fn a_disk_that_fills_up_stops_the_recording_and_is_told_of() {
    let folder = tempfile::tempdir().unwrap();
    let mut camera = small_camera(3);
    let mut recorder = Recorder::new(folder.path())
        .unwrap()
        .with_frames(camera.info(), &params(RecordFormat::Folder), 0.0)
        .unwrap();
    let mut next = || {
        let frame = camera.grab(Duration::ZERO).unwrap().unwrap();
        DeliveredFrame::unmoved(Arc::new(frame))
    };
    recorder.frame(&next());
    assert!(recorder.take_events().is_empty());
    let recording = recorder.frames.as_mut().unwrap();
    recording.standing.disk_floor_bytes = u64::MAX;
    recorder.tick();
    let standing = recorder.standing().unwrap().clone();
    assert!(!standing.active);
    let reason = standing.reason.unwrap();
    assert!(reason.contains("recording stops below"), "{reason}");
    let told = recorder.take_events();
    assert_eq!(told[0].kind, EventKind::RecordingStopped { reason });
    assert!(!recorder.has_failed(), "what was recorded is in order");
    // The scan goes on, and so do its events.
    recorder.frame(&next());
    recorder.tracked(Tracked::Event(event(1, EventKind::Found)));
    let summary = recorder.finish();
    assert_eq!((summary.n_recorded, summary.failures.len()), (1, 0));
    assert!(
        summary.warnings[0].contains("recording stops below"),
        "{summary:?}"
    );
    let lines = fs::read_to_string(folder.path().join("events.jsonl")).unwrap();
    assert_eq!(lines.lines().count(), 2, "{lines}");
}
