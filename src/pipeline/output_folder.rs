//! The folder that one run writes into, and nobody else meanwhile.

use std::{
    fs::{self, OpenOptions},
    io::{self, Write},
    path::{Path, PathBuf},
};

/// The file that says that a folder is in use.
const LOCK_NAME: &str = ".relief.lock";

/// Why a folder cannot be written into.
#[derive(Debug, thiserror::Error)]
pub enum OutputFolderError {
    /// Another run writes into it.
    #[error("output folder {} is in use by another run, as {} says; name a new folder", folder.display(), lock.display())]
    InUse {
        /// The folder.
        folder: PathBuf,
        /// The file that the other run made.
        lock: PathBuf,
    },
    /// It holds something already.
    #[error("output folder {} is not empty; name a new one", .0.display())]
    NotEmpty(PathBuf),
    /// The system refused.
    #[error("cannot use output folder {}: {source}", folder.display())]
    Io {
        /// The folder.
        folder: PathBuf,
        /// What the system said.
        source: io::Error,
    },
}

/// An output folder held by this run: empty at first, freed when this is dropped.
#[derive(Debug)]
pub struct OutputFolder {
    path: PathBuf,
    named: PathBuf,
    waits_for_room: bool,
}

impl OutputFolder {
    /// Takes hold of a folder, which is created if it is missing and must be empty otherwise.
    ///
    /// # Errors
    /// If another run holds it, it holds something, or the system refuses; a folder that was created is then removed again.
    pub fn claim(path: &Path) -> Result<Self, OutputFolderError> {
        let is_missing = !path.exists();
        let claimed = Self::claim_or_create(path);
        if claimed.is_err() && is_missing {
            // It is empty, or somebody else's by now.
            let _ = fs::remove_dir(path);
        }
        claimed
    }

    fn claim_or_create(path: &Path) -> Result<Self, OutputFolderError> {
        let io_error = |source| OutputFolderError::Io {
            folder: path.to_owned(),
            source,
        };
        fs::create_dir_all(path).map_err(io_error)?;
        create_lock(path)?;
        // From here on the lock is ours, and goes again if the folder cannot be used.
        let folder = OutputFolder {
            path: path.to_owned(),
            named: path.to_owned(),
            waits_for_room: false,
        };
        for entry in fs::read_dir(path).map_err(io_error)? {
            if entry.map_err(io_error)?.file_name() != LOCK_NAME {
                return Err(OutputFolderError::NotEmpty(path.to_owned()));
            }
        }
        Ok(folder)
    }

    /// The same folder, whose outputs somebody will move into another: they are told of as lying there.
    pub fn named(self, folder: &Path) -> Self {
        let mut named = self;
        named.named = folder.to_owned();
        named
    }

    /// The same folder, for outputs that wait where the disk is full instead of being lost, until the run is told to stop.
    pub fn waiting_for_room(self) -> Self {
        let mut waiting = self;
        waiting.waits_for_room = true;
        waiting
    }

    /// Whether outputs wait where the disk is full.
    pub fn waits_for_room(&self) -> bool {
        self.waits_for_room
    }

    /// The folder.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// The folder as the report names it.
    pub fn name(&self) -> &Path {
        &self.named
    }
}

impl Drop for OutputFolder {
    fn drop(&mut self) {
        // A lock that stays makes the next run name the folder, which is not empty by now.
        let _ = fs::remove_file(self.path.join(LOCK_NAME));
    }
}

fn create_lock(folder: &Path) -> Result<(), OutputFolderError> {
    let lock = folder.join(LOCK_NAME);
    let created = OpenOptions::new().write(true).create_new(true).open(&lock);
    let written = match created {
        Err(error) if error.kind() == io::ErrorKind::AlreadyExists => {
            return Err(OutputFolderError::InUse {
                folder: folder.to_owned(),
                lock,
            });
        }
        Err(error) => Err(error),
        Ok(mut file) => writeln!(file, "process {}", std::process::id()).inspect_err(|_| {
            // Ours, and nobody's without its line.
            let _ = fs::remove_file(&lock);
        }),
    };
    written.map_err(|source| OutputFolderError::Io {
        folder: folder.to_owned(),
        source,
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_folder_is_held_by_one_run_and_then_freed() {
        let root = tempfile::tempdir().unwrap();
        let path = root.path().join("a/b");
        let held = OutputFolder::claim(&path).unwrap();
        let error = OutputFolder::claim(&path).unwrap_err();
        assert!(matches!(error, OutputFolderError::InUse { .. }));
        drop(held);
        drop(OutputFolder::claim(&path).unwrap());

        fs::write(path.join("x"), "x").unwrap();
        let error = OutputFolder::claim(&path).unwrap_err();
        assert!(error.to_string().ends_with("is not empty; name a new one"));
        assert!(!path.join(LOCK_NAME).exists());
    }
}
