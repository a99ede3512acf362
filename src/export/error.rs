//! Why a file could not be written or read.

use crate::atomic_file::is_passing;
use std::{
    io,
    path::{Path, PathBuf},
};
use thiserror::Error;

/// Why a file could not be written or read; the text names the path and the cause.
#[derive(Debug, Error)]
pub enum ExportError {
    /// The file system refused to take the file: full, read-only, not permitted, no such folder.
    #[error("cannot write {}: {cause}", path.display())]
    Write {
        /// The final name of the file.
        path: PathBuf,
        /// What the system said.
        cause: io::Error,
    },
    /// The file system refused to give the file.
    #[error("cannot read {}: {cause}", path.display())]
    Read {
        /// The file.
        path: PathBuf,
        /// What the system said.
        cause: io::Error,
    },
    /// The file was read, but is not what it should be.
    #[error("{} is malformed: {reason}", path.display())]
    Malformed {
        /// The file.
        path: PathBuf,
        /// What is wrong, and where.
        reason: String,
    },
    /// The data cannot be said in this file format; nothing was written.
    #[error("cannot write {}: {reason}", path.display())]
    Unfit {
        /// The final name of the file.
        path: PathBuf,
        /// Which value does not fit, and its limit.
        reason: String,
    },
}

impl ExportError {
    /// Whether the disk may take later what it refused: it was full, read-only or away.
    pub fn is_passing(&self) -> bool {
        matches!(self, ExportError::Write { cause, .. } if is_passing(cause))
    }

    /// A failed write of `path`.
    pub(super) fn write(path: &Path, cause: io::Error) -> Self {
        ExportError::Write {
            path: path.to_owned(),
            cause,
        }
    }

    /// A failed read of `path`.
    pub(super) fn read(path: &Path, cause: io::Error) -> Self {
        ExportError::Read {
            path: path.to_owned(),
            cause,
        }
    }

    /// A file that does not make sense.
    pub(super) fn malformed(path: &Path, reason: String) -> Self {
        ExportError::Malformed {
            path: path.to_owned(),
            reason,
        }
    }

    /// Data that the format of `path` cannot hold.
    pub(super) fn unfit(path: &Path, reason: String) -> Self {
        ExportError::Unfit {
            path: path.to_owned(),
            reason,
        }
    }
}
