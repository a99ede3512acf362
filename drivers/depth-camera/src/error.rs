//! Errors that a caller can act on.

use std::{error::Error, fmt, time::Duration};

/// Why a camera did not deliver.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum CameraError {
    /// The device is gone, or has fallen silent; it may come back under the same serial.
    Disconnected,
    /// Another process holds the device.
    Busy,
    /// The user may not open the device.
    PermissionDenied,
    /// No frame came in time.
    Timeout {
        /// How long the caller waited.
        waited: Duration,
    },
    /// A recording that is played at its own pace comes to its next frame later.
    NotDue,
    /// One frame cannot be used; the stream goes on.
    DamagedFrame {
        /// The frame that was lost.
        frame_id: u64,
        /// What is wrong with it, naming the file where there is one.
        reason: String,
    },
    /// The device is there and does not do what it must: what it was asked for, and for how long, are in the text. The
    /// stream is over; plugging the device in anew is what usually helps.
    Unresponsive(String),
    /// A recording or a device description that makes no sense: file, key, value and bound are in the text.
    Invalid(String),
}

impl CameraError {
    /// Whether the next call to `grab` may succeed.
    pub fn is_recoverable(&self) -> bool {
        matches!(
            self,
            CameraError::Timeout { .. } | CameraError::NotDue | CameraError::DamagedFrame { .. }
        )
    }
}

impl fmt::Display for CameraError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            CameraError::Disconnected => write!(f, "the device is disconnected"),
            CameraError::Busy => write!(f, "the device is held by another process"),
            CameraError::PermissionDenied => write!(
                f,
                "no permission to open the device; install the rules in udev/"
            ),
            CameraError::Timeout { waited } => {
                write!(f, "no frame within {:.3} s", waited.as_secs_f64())
            }
            CameraError::NotDue => write!(f, "the recording's next frame is not due yet"),
            CameraError::DamagedFrame { frame_id, reason } => {
                write!(f, "frame {frame_id} is damaged: {reason}")
            }
            CameraError::Unresponsive(what) => write!(f, "the device does not respond: {what}"),
            CameraError::Invalid(what) => f.write_str(what),
        }
    }
}

impl Error for CameraError {}
