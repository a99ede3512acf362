//! What the recorder could not write.

use mcap_session::RecordingError;
use replay::WriteError;
use std::io;

/// Data that could not be written.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Unrecorded {
    /// What is missing and why, in a sentence for the operator.
    pub what: String,
    /// What the system said; `None` where it was not the system that refused.
    pub cause: Option<io::ErrorKind>,
}

impl Unrecorded {
    /// What a recording lost by an error.
    pub(super) fn by(error: &RecordingError, what: String) -> Self {
        let cause = match error {
            RecordingError::Write(WriteError::Io { source, .. }) => Some(source.kind()),
            _ => None,
        };
        Unrecorded { what, cause }
    }
}
