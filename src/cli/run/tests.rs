//! What the program's end is told as.

use super::*;
use relief::export::Report;
use std::{fs, io::ErrorKind};

#[test]
fn the_recording_of_a_scan_is_named_by_the_scan_and_any_other_folder_by_itself() {
    let root = tempfile::tempdir().unwrap();
    let path = |name: &str| root.path().join(name);
    for folder in ["vase/recording", "vase/session", "out/session"] {
        fs::create_dir_all(path(folder)).unwrap();
    }
    fs::write(path("vase/events.jsonl"), "").unwrap();
    for (session, name) in [
        ("vase/recording", "vase"),
        ("vase/session/", "vase"),
        ("vase", "vase"),
        ("out/session", "session"),
        ("none/recording", "recording"),
    ] {
        assert_eq!(session_name(&path(session)), name);
    }
}

#[test]
fn a_disk_that_may_take_the_outputs_later_has_a_code_of_its_own() {
    let outcome = |n_failures: usize, n_passing| Outcome {
        ending: Ending::Complete,
        report: Report::default(),
        failures: vec!["cannot write".to_owned(); n_failures],
        n_passing,
    };
    for (n_failures, n_passing, expected) in [
        (0, 0, Verdict::Done),
        (2, 2, Verdict::StorageFailed),
        (2, 1, Verdict::Failed),
    ] {
        let outcome = outcome(n_failures, n_passing);
        assert_eq!(Verdict::of_outcome(&outcome), expected);
    }
    let of_recorder = |error: RecordingError| {
        let error = ControlError::from(SpawnError::from(error));
        Verdict::of_error(&error.into())
    };
    for (kind, expected) in [
        (ErrorKind::StorageFull, Verdict::StorageFailed),
        (ErrorKind::PermissionDenied, Verdict::Failed),
    ] {
        let error = OutputFolderError::Io {
            folder: "out".into(),
            source: kind.into(),
        };
        assert_eq!(Verdict::of_error(&error.into()), expected);
        let source = WriteError::Io {
            path: "out/events.jsonl".into(),
            source: kind.into(),
        };
        assert_eq!(of_recorder(source.into()), expected);
    }
    let floor = RecordingError::DiskFloor {
        folder: "out/recording".into(),
        free_bytes: 1,
        floor_bytes: 2,
    };
    assert_eq!(of_recorder(floor), Verdict::StorageFailed);
}
