//! Why a recording cannot be written, read or repaired.

use std::{
    fmt, io,
    path::{Path, PathBuf},
};

use depth_camera::CameraError;
use replay::WriteError;

/// Why a recording cannot be written, read or repaired.
#[derive(Debug, thiserror::Error)]
pub enum RecordingError {
    /// The system refused, the folder is not empty, or a frame does not belong into the recording.
    #[error(transparent)]
    Write(#[from] WriteError),
    /// The disk is about to be full. The recording was ended in order.
    #[error("{free_bytes} bytes are free on the disk of {}, recording stops below {floor_bytes}", folder.display())]
    DiskFloor {
        /// The recording's folder.
        folder: PathBuf,
        /// Bytes that are free.
        free_bytes: u64,
        /// Bytes that recording leaves free.
        floor_bytes: u64,
    },
    /// The recording ended before, for a reason that was told then.
    #[error("the recording in {} has ended", .0.display())]
    Ended(PathBuf),
    /// Another process is writing the recording.
    #[error("{} is being recorded by another process", .0.display())]
    InUse(PathBuf),
    /// A file that makes no sense: file, value and bound are in the text.
    #[error("{}: {what}", path.display())]
    Invalid {
        /// The file.
        path: PathBuf,
        /// What is wrong with it.
        what: String,
    },
}

impl RecordingError {
    /// A file that makes no sense.
    pub fn invalid(path: &Path, what: impl fmt::Display) -> Self {
        RecordingError::Invalid {
            path: path.to_owned(),
            what: what.to_string(),
        }
    }
}

impl From<RecordingError> for CameraError {
    fn from(error: RecordingError) -> Self {
        match error {
            RecordingError::InUse(_) => CameraError::Busy,
            RecordingError::Write(WriteError::Camera(error)) => error,
            other => CameraError::Invalid(other.to_string()),
        }
    }
}

/// What the system said of a file.
pub fn io_error(path: &Path) -> impl Fn(io::Error) -> RecordingError + '_ {
    move |source| {
        RecordingError::Write(WriteError::Io {
            path: path.to_owned(),
            source,
        })
    }
}
