//! Recordings of MCAP segments whose files, and messages whose bytes, are anything: they are refused, or read to their end, and what
//! was repaired is whole.
#![no_main]

use std::{cell::OnceCell, fs, path::Path, time::Duration};

use depth_camera::{CameraError, DepthCamera};
use libfuzzer_sys::fuzz_target;
use mcap_session::{
    McapCamera, SESSION_FILE_NAME, SessionRecord,
    messages::{CameraInfoMessage, ImageMessage, PoseMessage, decode_string, stamp_of},
    repair, verify,
};

thread_local! {
    static FOLDER: OnceCell<tempfile::TempDir> = const { OnceCell::new() };
}

/// A recording that its process left open.
const SESSION: &str = r#"{"format":1,"state":"open","sensor":"kinect2","serial":"A","depth_units_per_metre":1000.0,
    "started_unix_ms":0,"program":"relief","counters":{}}"#;

fuzz_target!(|bytes: &[u8]| {
    let Some((which, content)) = bytes.split_first() else { return };
    FOLDER.with(|folder| {
        let folder = folder.get_or_init(|| tempfile::tempdir().expect("a folder")).path();
        match which % 4 {
            0 => segment(folder, content),
            1 => session(folder, content),
            2 => messages(content),
            _ => bag(folder, content),
        }
    });
});

fn write(folder: &Path, session: &[u8], segment: &[u8]) {
    let _ = fs::remove_file(folder.join("open.lock"));
    fs::write(folder.join(SESSION_FILE_NAME), session).expect("a folder takes files");
    fs::write(folder.join("segment-0000.mcap"), segment).expect("a folder takes files");
}

/// A segment of a recording that was left open: verified, repaired, and whole after that.
fn segment(folder: &Path, content: &[u8]) {
    write(folder, SESSION.as_bytes(), content);
    verify(folder).expect("a file that can be read can be verified");
    if repair(folder).is_ok() {
        let reports = verify(folder).expect("a file that can be read can be verified");
        assert!(reports.iter().all(|report| report.problems.is_empty()), "{reports:?}");
    }
    play(McapCamera::open(folder));
}

fn session(folder: &Path, content: &[u8]) {
    write(folder, content, b"\x89MCAP0\r\n");
    // What it says is kept when it is written again.
    if let Ok(record) = SessionRecord::read(folder) {
        record.write(folder).expect("a record can be written");
        let again = SessionRecord::read(folder).expect("what was written can be read");
        assert_eq!(format!("{again:?}"), format!("{record:?}"));
    }
}

/// The messages of ROS 2 in CDR.
fn messages(content: &[u8]) {
    let _ = stamp_of(content);
    let _ = decode_string(content);
    if let Ok(image) = ImageMessage::decode(content) {
        let _ = (image.u16_pixels(), image.f32_pixels());
    }
    if let Ok(info) = CameraInfoMessage::decode(content) {
        let again = CameraInfoMessage::decode(&info.encode()).expect("what was encoded can be decoded");
        assert_eq!(format!("{again:?}"), format!("{info:?}"));
    }
    if let Ok(pose) = PoseMessage::decode(content) {
        let again = PoseMessage::decode(&pose.encode()).expect("what was encoded can be decoded");
        assert_eq!(format!("{again:?}"), format!("{pose:?}"));
    }
}

/// A bag of another program: one file.
fn bag(folder: &Path, content: &[u8]) {
    let path = folder.join("bag.mcap");
    fs::write(&path, content).expect("a folder takes files");
    play(McapCamera::open(&path));
    fs::remove_file(path).expect("the file is there");
}

fn play(opened: Result<McapCamera, CameraError>) {
    let Ok(mut camera) = opened else { return };
    // Each frame and each damage takes bytes of the file, which is short.
    for _ in 0..100_000 {
        match camera.grab(Duration::ZERO) {
            Ok(Some(_)) => {}
            Ok(None) => return,
            Err(error) if error.is_recoverable() => {}
            Err(_) => return,
        }
    }
    panic!("it does not end");
}
