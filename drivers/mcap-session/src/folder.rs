//! Which files of a folder belong to its recording.

use std::{
    fs::{self, File},
    io,
    path::{Path, PathBuf},
};

use crate::{
    error::{RecordingError, io_error},
    session,
};

/// The name of a segment by its number.
pub fn segment_name(number: usize) -> String {
    format!("segment-{number:04}.mcap")
}

/// Whether a path is a recording of this kind: its folder, or a file that ends in `.mcap`.
pub fn is_recording(path: &Path) -> bool {
    match path.is_dir() {
        true => path.join(session::FILE_NAME).is_file() || !mcap_files(path).is_empty(),
        false => is_mcap(path),
    }
}

/// The files of a recording in the order in which they were written, or of somebody else's bag in the order of their names.
///
/// # Errors
/// If there is none, or the system refuses.
pub fn files(path: &Path) -> Result<Vec<PathBuf>, RecordingError> {
    fs::metadata(path).map_err(io_error(path))?;
    if !path.is_dir() {
        return Ok(vec![path.to_owned()]);
    }
    let files = match path.join(session::FILE_NAME).is_file() {
        true => segments(path),
        false => mcap_files(path),
    };
    match files.is_empty() {
        true => Err(RecordingError::invalid(path, "holds no .mcap file")),
        false => Ok(files),
    }
}

/// How deep recordings are looked for: `sessions/<id>/recording` of a data directory.
const DEPTH: usize = 3;

/// The folders of all recordings of Relief in a folder and a few levels beneath it, by path; links are not followed. A folder beneath
/// it that cannot be read may be one, or hold some, and is among them: whoever reads it is told why that fails.
///
/// # Errors
/// If the folder itself cannot be read.
pub fn recordings_in(folder: &Path) -> Result<Vec<PathBuf>, RecordingError> {
    let mut found = Vec::new();
    look_in(folder, DEPTH, &mut found).map_err(io_error(folder))?;
    found.sort();
    Ok(found)
}

fn look_in(folder: &Path, depth: usize, found: &mut Vec<PathBuf>) -> io::Result<()> {
    if folder.join(session::FILE_NAME).is_file() {
        found.push(folder.to_owned());
        return Ok(());
    }
    if depth == 0 {
        return Ok(());
    }
    for entry in fs::read_dir(folder)? {
        let entry = entry?;
        if !entry.file_type().is_ok_and(|kind| kind.is_dir()) {
            continue;
        }
        match look_in(&entry.path(), depth - 1, found) {
            Ok(()) => {}
            // It was removed meanwhile.
            Err(error) if error.kind() == io::ErrorKind::NotFound => {}
            Err(_) => found.push(entry.path()),
        }
    }
    Ok(())
}

/// The segments of a recording of our own, in order; where one is missing, those behind it all the same.
pub fn segments(folder: &Path) -> Vec<PathBuf> {
    let mut numbered: Vec<(usize, PathBuf)> = mcap_files(folder)
        .into_iter()
        .filter_map(|path| Some((segment_number(&path)?, path)))
        .collect();
    numbered.sort();
    numbered.into_iter().map(|(_, path)| path).collect()
}

/// The number of a segment by its name.
fn segment_number(path: &Path) -> Option<usize> {
    let name = path.file_name()?.to_str()?;
    let digits = name.strip_prefix("segment-")?.strip_suffix(".mcap")?;
    let number = digits.parse().ok()?;
    (segment_name(number) == name).then_some(number)
}

/// Whether a file is a segment of a recording of our own: `session.json` lies beside it.
pub fn is_segment(path: &Path) -> bool {
    path.with_file_name(session::FILE_NAME).is_file()
}

/// Hands the names in a folder to the disk.
///
/// # Errors
/// What the system says.
pub fn sync_folder(folder: &Path) -> Result<(), RecordingError> {
    File::open(folder)
        .and_then(|folder| folder.sync_all())
        .map_err(io_error(folder))
}

/// The folder's `.mcap` files by name, as one counts: ROS writes `bag_2.mcap` before `bag_10.mcap`.
fn mcap_files(folder: &Path) -> Vec<PathBuf> {
    let Ok(entries) = fs::read_dir(folder) else {
        return Vec::new();
    };
    let paths = entries.filter_map(|entry| entry.ok().map(|entry| entry.path()));
    let mut files: Vec<PathBuf> = paths
        .filter(|path| is_mcap(path) && path.is_file())
        .collect();
    files.sort_by_cached_key(|path| {
        let name = path.file_name().unwrap_or_default();
        (counted(&name.to_string_lossy()), name.to_owned())
    });
    files
}

/// A name as pieces of text, each with the number behind it.
fn counted(name: &str) -> Vec<(String, u64)> {
    let mut pieces = Vec::new();
    let mut rest = name;
    while !rest.is_empty() {
        let is_digit = |c: char| c.is_ascii_digit();
        let digits_at = rest.find(is_digit).unwrap_or(rest.len());
        let (text, tail) = rest.split_at(digits_at);
        let behind = tail.find(|c| !is_digit(c)).unwrap_or(tail.len());
        let (digits, tail) = tail.split_at(behind);
        pieces.push((text.to_owned(), digits.parse().unwrap_or(u64::MAX)));
        rest = tail;
    }
    pieces
}

fn is_mcap(path: &Path) -> bool {
    path.extension()
        .is_some_and(|extension| extension == "mcap")
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::repair;
    use std::os::unix::fs::PermissionsExt;

    #[test]
    fn a_folder_that_cannot_be_read_hides_no_other() {
        let folder = tempfile::tempdir().unwrap();
        let [closed, recording] = ["closed", "recording"].map(|name| folder.path().join(name));
        for path in [&closed, &recording] {
            fs::create_dir(path).unwrap();
        }
        fs::write(recording.join(session::FILE_NAME), "").unwrap();
        let none = fs::Permissions::from_mode(0o0);
        fs::set_permissions(&closed, none).unwrap();
        if fs::read_dir(&closed).is_ok() {
            println!("skipped: this user may read every folder");
            return;
        }
        let found = recordings_in(folder.path()).unwrap();
        assert_eq!(found, [closed.clone(), recording]);
        let error = recordings_in(&closed).unwrap_err().to_string();
        assert!(error.contains("closed"), "{error}");
        assert!(
            repair::abandoned_in(folder.path())
                .unwrap()
                .contains(&closed)
        );
        assert!(repair::repair(&closed).is_err());
    }

    #[test]
    fn files_of_a_bag_are_in_the_order_in_which_they_were_written() {
        let folder = tempfile::tempdir().unwrap();
        let written = (0..12).map(|k| format!("bag_{k}.mcap"));
        let written: Vec<String> = written.chain(["later.mcap".to_owned()]).collect();
        for name in written.iter().rev() {
            fs::write(folder.path().join(name), "").unwrap();
        }
        let found = files(folder.path()).unwrap();
        let names = found.iter().map(|path| path.file_name().unwrap());
        assert!(names.eq(written.iter().map(|name| name.as_str())));
    }
}
