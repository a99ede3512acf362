//! How much space is left.

use std::{io, path::Path};

use crate::error::{RecordingError, io_error};

/// Bytes that are free for this user on the disk that holds `path`.
///
/// # Errors
/// What the system says.
pub fn free_bytes(path: &Path) -> Result<u64, RecordingError> {
    let disk = rustix::fs::statvfs(path)
        .map_err(io::Error::from)
        .map_err(io_error(path))?;
    Ok(disk.f_bavail.saturating_mul(disk.f_frsize))
}
