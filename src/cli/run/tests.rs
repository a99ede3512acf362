//! What the program's end is told as.

use super::*;
use relief::export::Report;
use std::io::ErrorKind;

#[test]
fn a_recording_of_the_program_is_named_by_the_folder_that_it_lies_in() {
    for (session, name) in [
        ("scans/vase/recording", "vase"),
        ("scans/vase/session/", "vase"),
        ("scans/vase", "vase"),
        ("recording", "recording"),
    ] {
        assert_eq!(session_name(Path::new(session)), name);
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
    for (kind, expected) in [
        (ErrorKind::StorageFull, Verdict::StorageFailed),
        (ErrorKind::PermissionDenied, Verdict::Failed),
    ] {
        let error = OutputFolderError::Io {
            folder: "out".into(),
            source: kind.into(),
        };
        assert_eq!(Verdict::of_error(&error.into()), expected);
    }
}
