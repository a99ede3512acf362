//! Why a job cannot be taken, found or cancelled.

use super::{JobId, JobState};
use crate::atomic_file::is_passing;
use std::{io, path::PathBuf};

/// Why the spool or the worker refuses.
#[derive(Debug, thiserror::Error)]
pub enum JobError {
    /// Another process works on this spool.
    #[error("spool {} is in use by another process", .0.display())]
    InUse(PathBuf),
    /// The folder is no scan of this data directory.
    #[error("{} is no scan of {}", session.display(), sessions.display())]
    NoScan {
        /// What was given.
        session: PathBuf,
        /// Where scans lie.
        sessions: PathBuf,
    },
    /// The scan lacks what refinement is made from.
    #[error("the scan in {} cannot be refined: {what}", session.display())]
    NotRefinable {
        /// The scan.
        session: PathBuf,
        /// What is missing.
        what: String,
    },
    /// There is no such job.
    #[error("there is no job {0}")]
    Unknown(JobId),
    /// The job is over.
    #[error("job {id} is {} already", state.code())]
    Ended {
        /// The job.
        id: JobId,
        /// How it ended.
        state: JobState,
    },
    /// The worker has been told to stop.
    #[error("the worker is stopping")]
    Stopping,
    /// The system refused.
    #[error("cannot use {}: {source}", path.display())]
    Io {
        /// The file or folder.
        path: PathBuf,
        /// What the system said.
        source: io::Error,
    },
}

impl JobError {
    /// Whether the disk may do later what it refused: it was full, read-only or away.
    pub(super) fn is_passing(&self) -> bool {
        matches!(self, JobError::Io { source, .. } if is_passing(source))
    }

    /// Whether what was looked for is not there, and not that the disk does not say.
    pub(super) fn is_absence(&self) -> bool {
        match self {
            JobError::NotRefinable { .. } => true,
            JobError::Io { source, .. } => source.kind() == io::ErrorKind::NotFound,
            _ => false,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use rustix::io::Errno;

    #[test]
    fn a_full_disk_passes_and_a_folder_that_is_gone_does_not() {
        for (errno, is_passing) in [
            (Errno::NOSPC, true),
            (Errno::DQUOT, true),
            (Errno::ROFS, true),
            (Errno::NOENT, false),
            (Errno::ACCESS, false),
        ] {
            let error = JobError::Io {
                path: PathBuf::new(),
                source: errno.into(),
            };
            assert_eq!(error.is_passing(), is_passing, "{error}");
        }
        assert!(!JobError::Stopping.is_passing());
    }
}
