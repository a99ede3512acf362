//! The ways in which the spool changes the disk, each whole or not at all, and on the disk when it returns, where the file system can
//! sync a folder.

use crate::atomic_file::{sync_folder_of, write_atomically};
use serde::Serialize;
use std::{
    fs,
    io::{self, Write},
    path::Path,
};

/// Writes a file as JSON through a partial one.
pub fn write_json(path: &Path, value: &impl Serialize) -> io::Result<()> {
    let text = serde_json::to_vec_pretty(value)?;
    write(path, &text)
}

/// Writes a file through a partial one.
pub fn write(path: &Path, bytes: &[u8]) -> io::Result<()> {
    interruption::point()?;
    interruption::room()?;
    write_atomically(path, |file| file.write_all(bytes))
}

/// Moves a file or folder; what stands under the new name is replaced.
pub fn rename(from: &Path, to: &Path) -> io::Result<()> {
    interruption::point()?;
    fs::rename(from, to)?;
    sync_folder_of(to);
    sync_folder_of(from);
    Ok(())
}

/// Removes a file.
pub fn remove(path: &Path) -> io::Result<()> {
    interruption::point()?;
    fs::remove_file(path)?;
    sync_folder_of(path);
    Ok(())
}

/// Removes a folder and all that is in it, if it exists.
pub fn remove_folder(path: &Path) -> io::Result<()> {
    interruption::point()?;
    match fs::remove_dir_all(path) {
        Err(error) if error.kind() == io::ErrorKind::NotFound => Ok(()),
        removed => removed,
    }
}

#[cfg(not(test))]
mod interruption {
    /// Where a test may end the process; nothing otherwise.
    pub fn point() -> std::io::Result<()> {
        Ok(())
    }

    /// Where a test may let the disk be full; nothing otherwise.
    pub fn room() -> std::io::Result<()> {
        Ok(())
    }
}

/// Ends the work of the spool before a chosen change of the disk, as the end of the process would.
#[cfg(test)]
pub mod interruption {
    use std::{cell::Cell, io};

    thread_local! {
        static LEFT: Cell<Option<u32>> = const { Cell::new(None) };
        static IS_FULL: Cell<bool> = const { Cell::new(false) };
    }

    /// So many changes are still made on this thread, then none; `None` takes that back.
    pub fn after(n_changes: Option<u32>) {
        LEFT.set(n_changes);
    }

    /// From now on the disk has no room for a file on this thread, or has room again.
    pub fn fill(is_full: bool) {
        IS_FULL.set(is_full);
    }

    /// Whether there is room for a file.
    pub fn room() -> io::Result<()> {
        match IS_FULL.get() {
            true => Err(io::ErrorKind::StorageFull.into()),
            false => Ok(()),
        }
    }

    /// Whether a change may be made.
    pub fn point() -> io::Result<()> {
        match LEFT.get() {
            Some(0) => Err(io::Error::other("the process has ended")),
            left => {
                LEFT.set(left.map(|n| n - 1));
                Ok(())
            }
        }
    }
}
