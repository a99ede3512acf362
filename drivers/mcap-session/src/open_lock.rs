//! The file that is there while a recording is open: held by its process, telling how many frames it was given, and keeping
//! room on the disk for the repair of a recording that filled it.

use std::{
    fs::{self, File, OpenOptions, TryLockError},
    io::Read,
    os::unix::fs::FileExt,
    path::{Path, PathBuf},
};

use crate::error::{RecordingError, io_error};

const FILE_NAME: &str = "open.lock";
/// Digits of the number of frames: the file never changes its length.
const DIGITS: usize = 20;
/// Room for the summary of a segment, and for what the folder says of itself.
const RESERVE_BYTES: usize = 256 << 10;

/// An open recording, held by this process until it ends or the lock is removed.
#[derive(Debug)]
pub struct OpenLock {
    path: PathBuf,
    file: File,
    n_frames: u64,
}

impl OpenLock {
    /// Marks a new recording as open.
    ///
    /// # Errors
    /// What the system says, also if the recording is marked already.
    pub fn create(folder: &Path) -> Result<Self, RecordingError> {
        let path = folder.join(FILE_NAME);
        let created = || {
            let file = File::create_new(&path)?;
            file.lock()?;
            file.write_all_at(text(0).as_bytes(), 0)?;
            file.write_all_at(&vec![b'\n'; RESERVE_BYTES], DIGITS as u64)?;
            Ok(file)
        };
        let file = created().map_err(io_error(&path))?;
        Ok(OpenLock {
            path,
            file,
            n_frames: 0,
        })
    }

    /// Takes over the mark of a recording whose process is gone; makes it where it is missing.
    ///
    /// # Errors
    /// [`RecordingError::InUse`] if the process lives; what the system says.
    pub fn take_over(folder: &Path) -> Result<(Self, Option<u64>), RecordingError> {
        let path = folder.join(FILE_NAME);
        let open = OpenOptions::new()
            .read(true)
            .write(true)
            .create(true)
            .truncate(false)
            .open(&path);
        let mut file = open.map_err(io_error(&path))?;
        match file.try_lock() {
            Ok(()) => {}
            Err(TryLockError::WouldBlock) => return Err(RecordingError::InUse(folder.to_owned())),
            Err(TryLockError::Error(error)) => return Err(io_error(&path)(error)),
        }
        let mut told = String::new();
        // A file that cannot be read tells nothing.
        let _ = (&mut file).take(DIGITS as u64).read_to_string(&mut told);
        let n_frames = told.trim().parse().ok();
        let lock = OpenLock {
            path,
            file,
            n_frames: n_frames.unwrap_or(0),
        };
        lock.release_reserve();
        Ok((lock, n_frames))
    }

    /// Whether a process holds the recording open now.
    pub fn is_held(folder: &Path) -> bool {
        let Ok(file) = File::open(folder.join(FILE_NAME)) else {
            return false;
        };
        matches!(file.try_lock_shared(), Err(TryLockError::WouldBlock))
    }

    /// Frames that were given to the recorder.
    pub fn n_frames(&self) -> u64 {
        self.n_frames
    }

    /// Gives the room that was kept back to the disk.
    pub fn release_reserve(&self) {
        // Without it the repair of a recording that filled its disk may fail, and says so itself.
        let _ = self.file.set_len(DIGITS as u64);
    }

    /// Counts a frame that was given to the recorder, where a process that is killed leaves it.
    pub fn count_frame(&mut self) {
        self.n_frames += 1;
        // Without the number repair tells less; the recording is none the worse.
        let _ = self.file.write_all_at(text(self.n_frames).as_bytes(), 0);
    }

    /// Takes the mark away.
    ///
    /// # Errors
    /// What the system says.
    pub fn remove(&mut self) -> Result<(), RecordingError> {
        fs::remove_file(&self.path).map_err(io_error(&self.path))
    }
}

fn text(n_frames: u64) -> String {
    format!("{n_frames:0DIGITS$}")
}
