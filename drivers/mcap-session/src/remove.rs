//! Removes a recording.

use std::{fs, path::Path};

use crate::{
    bag_metadata,
    error::{RecordingError, io_error},
    folder::segments,
    open_lock::OpenLock,
    session::{self, SessionRecord},
};

/// Removes the files of a recording of Relief and then its folder, unless that holds anything else.
///
/// # Errors
/// [`RecordingError::InUse`] while it is being recorded; if the folder is a link, which would be left over, or holds no recording;
/// if the system refuses.
pub fn remove(folder: &Path) -> Result<(), RecordingError> {
    // With a slash behind it a link is what it leads to.
    let named = folder.components().as_path();
    if named.is_symlink() {
        let what = "is a link, name the folder that it leads to";
        return Err(RecordingError::invalid(named, what));
    }
    SessionRecord::read(folder)?;
    let (mut lock, _) = OpenLock::take_over(folder)?;
    let beside = [bag_metadata::FILE_NAME, "calibration.toml"].map(|name| folder.join(name));
    for path in segments(folder).into_iter().chain(beside) {
        if path.exists() {
            fs::remove_file(&path).map_err(io_error(&path))?;
        }
    }
    // Last, so that a removal that is interrupted can be done again.
    lock.remove()?;
    let description = folder.join(session::FILE_NAME);
    fs::remove_file(&description).map_err(io_error(&description))?;
    let is_empty = fs::read_dir(folder)
        .map_err(io_error(folder))?
        .next()
        .is_none();
    match is_empty {
        true => fs::remove_dir(folder).map_err(io_error(folder)),
        false => Ok(()),
    }
}
