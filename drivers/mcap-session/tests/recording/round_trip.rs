//! What is recorded replays to the bit.

use std::{fs, time::Duration};

use depth_camera::{CameraError, DepthCamera, Frame, Sensor};
use mcap_session::{
    McapCamera, MessageReader, RecordingParams, SegmentWriter, SessionRecord, State, files,
    is_recording,
    messages::{PoseMessage, decode_string},
    remove,
    streams::Stream,
    verify,
};
use replay::{SessionWriter, WriteError};
use simulated::SimulatedCamera;

use crate::support::{assert_as_recorded, assert_same, camera_info, frame, params, play, record};

#[test]
fn a_closed_recording_replays_to_the_bit() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a");
    let info = camera_info(20, 16);
    record(&path, &info, 30, 7);

    assert!(is_recording(&path));
    let camera = McapCamera::open(&path).unwrap();
    assert_eq!(camera.info().n_frames, Some(30));
    assert_eq!(
        camera.info(),
        &depth_camera::CameraInfo {
            n_frames: Some(30),
            ..info.clone()
        }
    );
    let played = play(&path).unwrap();
    assert_eq!((played.frames.len(), played.damages.len()), (30, 0));
    assert_as_recorded(&info, &played.frames);

    let record = SessionRecord::read(&path).unwrap();
    assert_eq!(record.state, State::Closed);
    assert_eq!((record.counters.frames, record.counters.infrared), (30, 30));
    for report in verify(&path).unwrap() {
        assert_eq!(report.problems, Vec::<String>::new());
        assert_eq!(report.n_frames, 30);
    }
    // One file alone is a recording too.
    let segment = files(&path).unwrap().remove(0);
    assert_eq!(play(&segment).unwrap().frames.len(), 30);
}

#[test]
fn a_link_to_a_recording_is_not_removed_nor_what_it_leads_to() {
    let root = tempfile::tempdir().unwrap();
    let (path, link) = (root.path().join("a"), root.path().join("link"));
    record(&path, &camera_info(20, 16), 3, 3);
    std::os::unix::fs::symlink(&path, &link).unwrap();
    for named in [link.clone(), link.join("")] {
        let error = remove(&named).unwrap_err().to_string();
        assert!(error.contains("link: is a link"), "{error}");
        assert_eq!(play(&path).unwrap().frames.len(), 3);
    }
    remove(&path.join("")).unwrap();
    assert!(!path.exists());
}

#[test]
fn a_long_recording_goes_on_in_the_next_segment() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a");
    let info = camera_info(20, 16);
    let short = RecordingParams {
        max_segment_bytes: 20_000,
        ..params()
    };
    let mut writer = SegmentWriter::create(&path, &info, short).unwrap();
    for frame_id in 0..60 {
        writer.write(&frame(&info, frame_id)).unwrap();
    }
    let counters = writer.finish().unwrap();
    assert!(files(&path).unwrap().len() >= 2, "{:?}", files(&path));
    let played = play(&path).unwrap();
    assert_eq!(played.frames.len(), 60);
    assert_as_recorded(&info, &played.frames);
    let n_bytes: u64 = files(&path)
        .unwrap()
        .iter()
        .map(|path| fs::metadata(path).unwrap().len())
        .sum();
    assert_eq!(counters.bytes, n_bytes);
    let metadata = fs::read_to_string(path.join("metadata.yaml")).unwrap();
    for file in files(&path).unwrap() {
        let name = file.file_name().unwrap().to_str().unwrap();
        assert!(metadata.contains(&format!("    - {name}\n")), "{metadata}");
    }
}

#[test]
fn infrared_that_comes_late_finds_its_frame() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a");
    let info = camera_info(20, 16);
    let mut writer = SegmentWriter::create(&path, &info, params()).unwrap();
    let without_ir = |frame_id| Frame {
        ir: None,
        ..frame(&info, frame_id)
    };
    for frame_id in 0..40 {
        let frame = frame(&info, frame_id);
        match frame_id % 6 {
            0 => writer.write(&frame).unwrap(),
            _ => writer.write_with_infrared(&frame, None).unwrap(),
        }
    }
    let late = (15..35).filter(|frame_id| frame_id % 6 != 0);
    for frame_id in late {
        writer.write_infrared(&frame(&info, frame_id)).unwrap();
    }
    for frame_id in 40..44 {
        writer.write(&frame(&info, frame_id)).unwrap();
    }
    writer.finish().unwrap();
    let played = play(&path).unwrap();
    assert_eq!(played.frames.len(), 44);
    for found in &played.frames {
        let id = found.frame_id;
        let has_ir = (15..35).contains(&id) || id >= 40 || id % 6 == 0;
        match has_ir {
            true => assert_same(found, &frame(&info, found.frame_id)),
            false => assert_same(found, &without_ir(found.frame_id)),
        }
    }
}

#[test]
fn images_of_two_frames_within_ten_milliseconds_stay_apart() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a");
    let info = camera_info(20, 16);
    let apart = [
        Frame {
            ir: None,
            ..frame(&info, 0)
        },
        // Depth is stopped, and infrared goes by the host's clock.
        Frame {
            depth: None,
            device_time_secs: 1000.004,
            ..frame(&info, 1)
        },
        frame(&info, 2),
    ];
    let mut writer = SegmentWriter::create(&path, &info, params()).unwrap();
    for frame in &apart {
        writer.write(frame).unwrap();
    }
    writer.finish().unwrap();
    let played = play(&path).unwrap();
    assert_eq!(played.damages, Vec::<String>::new());
    assert_eq!(played.frames.len(), 3);
    for (found, expected) in played.frames.iter().zip(&apart) {
        assert_same(found, expected);
    }
}

#[test]
fn a_recording_and_the_folder_it_was_made_from_replay_the_same() {
    for sensor in [Sensor::Kinect1, Sensor::Kinect2] {
        let folder = tempfile::tempdir().unwrap();
        let images = folder.path().join("images");
        let mut source = match sensor {
            Sensor::Kinect1 => SimulatedCamera::kinect1_plaque(4, 1),
            Sensor::Kinect2 => SimulatedCamera::kinect2_plaque(4, 1),
        };
        let mut writer = SessionWriter::create(&images, source.info(), 1000.0).unwrap();
        while let Some(frame) = source.grab(Duration::ZERO).unwrap() {
            writer.write(&frame).unwrap();
        }
        writer.finish().unwrap();

        let mut camera = replay::ReplayCamera::open(&images).unwrap();
        let recording = folder.path().join("recording");
        let same_units = RecordingParams {
            depth_units_per_metre: camera.depth_scale().units_per_metre,
            ..params()
        };
        let mut writer = SegmentWriter::create(&recording, camera.info(), same_units).unwrap();
        let mut expected = Vec::new();
        while let Some(frame) = camera.grab(Duration::ZERO).unwrap() {
            writer.write(&frame).unwrap();
            expected.push(frame);
        }
        writer.finish().unwrap();

        let played = play(&recording).unwrap();
        assert_eq!(played.frames.len(), expected.len());
        for (found, expected) in played.frames.iter().zip(&expected) {
            assert_same(found, expected);
        }
        let opened = McapCamera::open(&recording).unwrap();
        assert_eq!(opened.info(), camera.info());
        assert_eq!(opened.depth_scale(), camera.depth_scale());
    }
}

#[test]
fn poses_and_events_are_messages() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a");
    let info = camera_info(20, 16);
    let mut writer = SegmentWriter::create(&path, &info, params()).unwrap();
    writer.write(&frame(&info, 0)).unwrap();
    writer
        .pose(1000.0, [0.1, 0.2, 0.3], [0.0, 0.0, 0.6, 0.8])
        .unwrap();
    writer.event(Some(1000.0), "{\"event\":\"found\"}").unwrap();
    writer.finish().unwrap();

    let mut reader = MessageReader::new(&files(&path).unwrap());
    let (mut poses, mut events, mut stats) = (Vec::new(), Vec::new(), Vec::new());
    while reader
        .step(|channel, message| match Stream::of_topic(&channel.topic) {
            Some(Stream::Pose) => poses.push(PoseMessage::decode(message.data).unwrap()),
            Some(Stream::Events) => events.push(decode_string(message.data).unwrap().to_owned()),
            Some(Stream::Stats) => stats.push(decode_string(message.data).unwrap().to_owned()),
            _ => {}
        })
        .unwrap()
        != mcap_session::Step::End
    {}
    assert_eq!(poses.len(), 1);
    assert_eq!(poses[0].position_m, [0.1, 0.2, 0.3]);
    assert_eq!(poses[0].header.stamp.secs(), 1000.0);
    assert_eq!(events, ["{\"event\":\"found\"}"]);
    let stats: serde_json::Value = serde_json::from_str(&stats[0]).unwrap();
    assert_eq!(stats["frames"], 0);
}

#[test]
fn frames_that_do_not_belong_are_refused_and_the_next_is_recorded() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a");
    let info = camera_info(20, 16);
    let mut writer = SegmentWriter::create(&path, &info, params()).unwrap();
    writer.write(&frame(&info, 5)).unwrap();
    let beyond = Frame {
        device_time_secs: 3e9,
        ..frame(&info, 6)
    };
    for (wrong, expected) in [
        (
            frame(&camera_info(10, 16), 6),
            "frame 6 cannot be recorded: depth is 10×16, must be 20×16",
        ),
        (
            frame(&info, 4),
            "frame 4 cannot be recorded: its time 1000.133332000 s follows 1000.166665000 s, must be later",
        ),
        (
            beyond,
            "frame 6 cannot be recorded: its time is 3000000000 s, must fit 32 bits of whole seconds",
        ),
    ] {
        let error = writer.write(&wrong).unwrap_err();
        assert!(
            matches!(
                error,
                mcap_session::RecordingError::Write(WriteError::Frame { .. })
            ),
            "{error}"
        );
        assert_eq!(error.to_string(), expected);
    }
    writer.write(&frame(&info, 6)).unwrap();
    assert_eq!(writer.finish().unwrap().frames, 2);
}

#[test]
fn a_recording_that_is_being_written_is_not_opened() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a");
    let info = camera_info(20, 16);
    let mut writer = SegmentWriter::create(&path, &info, params()).unwrap();
    writer.write(&frame(&info, 0)).unwrap();
    assert_eq!(
        McapCamera::open(&path).err(),
        Some(CameraError::Busy),
        "while it is open"
    );
    assert!(matches!(
        mcap_session::repair(&path),
        Err(mcap_session::RecordingError::InUse(_))
    ));
    writer.finish().unwrap();
    assert_eq!(play(&path).unwrap().frames.len(), 1);
}
