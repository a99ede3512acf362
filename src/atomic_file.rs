//! Files that are whole or absent: written under a temporary name, synced, then renamed.

use std::{
    ffi::OsString,
    fs::{self, File},
    io::{self, BufWriter},
    path::{Path, PathBuf},
};

/// Writes a file through `.NAME.partial` in the same folder, syncs it to the disk and renames it to its final name.
///
/// An older file of that name stays until the moment of the rename. The temporary name is fixed, so that a crash leaves at
/// most one partial file, which the next write replaces; two writers of one path must not run at the same time.
///
/// # Errors
/// If the system or `write` itself fails, without the path; the partial file is then removed.
pub fn write_atomically(
    path: &Path,
    write: impl FnOnce(&mut BufWriter<File>) -> io::Result<()>,
) -> io::Result<()> {
    let partial = partial_path(path)?;
    let written = write_and_sync(&partial, write).and_then(|()| fs::rename(&partial, path));
    if let Err(cause) = written {
        // The first error is the one to tell; a partial file that stays is recognised by its name.
        let _ = fs::remove_file(&partial);
        return Err(cause);
    }
    sync_folder_of(path);
    Ok(())
}

/// Whether the disk may do later what it refused: it was full, read-only or away.
pub fn is_passing(error: &io::Error) -> bool {
    matches!(
        error.kind(),
        io::ErrorKind::StorageFull
            | io::ErrorKind::QuotaExceeded
            | io::ErrorKind::ReadOnlyFilesystem
            | io::ErrorKind::StaleNetworkFileHandle
            | io::ErrorKind::TimedOut
    )
}

/// `.NAME.partial` beside `NAME`.
fn partial_path(path: &Path) -> io::Result<PathBuf> {
    let name = path
        .file_name()
        .ok_or_else(|| io::Error::new(io::ErrorKind::InvalidInput, "the path names no file"))?;
    let mut partial = OsString::from(".");
    partial.push(name);
    partial.push(".partial");
    Ok(path.with_file_name(partial))
}

fn write_and_sync(
    partial: &Path,
    write: impl FnOnce(&mut BufWriter<File>) -> io::Result<()>,
) -> io::Result<()> {
    let mut writer = BufWriter::new(File::create(partial)?);
    write(&mut writer)?;
    let file = writer.into_inner().map_err(|error| error.into_error())?;
    file.sync_all()
}

/// Puts the entries of the folder around a path on the disk, so that a rename survives a power cut, where the file system can.
///
/// Some network file systems cannot sync a folder. The file is whole either way, so that this is no failure.
pub fn sync_folder_of(path: &Path) {
    let folder = match path.parent() {
        Some(parent) if !parent.as_os_str().is_empty() => parent,
        _ => Path::new("."),
    };
    let _ = File::open(folder).and_then(|folder| folder.sync_all());
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::io::Write;

    fn names_in(folder: &Path) -> Vec<String> {
        let mut names: Vec<String> = fs::read_dir(folder)
            .unwrap()
            .map(|entry| entry.unwrap().file_name().into_string().unwrap())
            .collect();
        names.sort();
        names
    }

    #[test]
    fn a_failed_write_leaves_the_old_file_and_nothing_else() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("mesh.ply");
        write_atomically(&path, |file| file.write_all(b"whole")).unwrap();
        let error = write_atomically(&path, |file| {
            file.write_all(b"hal")?;
            Err(io::Error::other("the disk is full"))
        })
        .unwrap_err();
        assert_eq!(fs::read(&path).unwrap(), b"whole");
        assert_eq!(names_in(folder.path()), ["mesh.ply"]);
        assert_eq!(error.to_string(), "the disk is full");
    }

    #[test]
    fn the_file_is_partial_until_it_is_whole() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.txt");
        write_atomically(&path, |file| {
            assert_eq!(names_in(folder.path()), [".a.txt.partial"]);
            file.write_all(b"text")
        })
        .unwrap();
        assert_eq!(names_in(folder.path()), ["a.txt"]);
    }

    #[test]
    fn a_missing_folder_and_a_path_without_a_name_are_errors() {
        let folder = tempfile::tempdir().unwrap();
        assert!(write_atomically(&folder.path().join("none/a"), |_| Ok(())).is_err());
        assert!(write_atomically(Path::new("/"), |_| Ok(())).is_err());
    }
}
