//! What a refinement is made from, and the name that follows from it.

use super::{JobError, JobId, spool};
use crate::pipeline::{BASE_PLY, CALIBRATION, SCENE_PLY, SNAPSHOTS, TRAJECTORY};
use sha2::{Digest, Sha256};
use std::{
    fs::{self, File, FileType},
    io::{self, Read},
    path::{Path, PathBuf},
};

/// The version that jobs asked of this program are named by.
pub const VERSION: &str = env!("CARGO_PKG_VERSION");
/// Files are read in pieces of so many bytes.
const PIECE_BYTES: usize = 1 << 16;

/// Names the refinement of a scan with those settings by that version of the program: base mesh and scene, poses, shading images
/// with all that stands beside them, calibration, settings, version. Two scans of the same contents have different names.
///
/// # Errors
/// If the scan lacks one of these, or cannot be read.
pub fn job_id(scan: &Path, settings: &str, version: &str) -> Result<JobId, JobError> {
    let lacks = |what: &str| JobError::NotRefinable {
        session: scan.to_owned(),
        what: format!("there is no {what}"),
    };
    let mut hash = Sha256::new();
    part(&mut hash, "version", version.as_bytes());
    part(&mut hash, "settings", settings.as_bytes());
    let name = scan.file_name().unwrap_or_default();
    part(&mut hash, "scan", name.as_encoded_bytes());
    for name in [BASE_PLY, TRAJECTORY] {
        let path = scan.join(name);
        if !is_file(&path)? {
            return Err(lacks(name));
        }
        file(&mut hash, name, &path)?;
    }
    // Without these what was fused is the base mesh, and the calibration that of the device.
    for name in [SCENE_PLY, CALIBRATION] {
        let path = scan.join(name);
        if is_file(&path)? {
            file(&mut hash, name, &path)?;
        }
    }
    let snapshots = scan.join(SNAPSHOTS);
    let files = match kind_of(&snapshots)? {
        Some(kind) if kind.is_dir() => files_in(&snapshots).map_err(spool::at(&snapshots))?,
        _ => Vec::new(),
    };
    if files.is_empty() {
        return Err(lacks("shading image"));
    }
    for path in files {
        let name = path.strip_prefix(scan).unwrap_or(&path);
        file(&mut hash, &name.to_string_lossy(), &path)?;
    }
    let digits = spool::hex(&hash.finalize());
    digits.parse().map_err(|what| JobError::NotRefinable {
        session: scan.to_owned(),
        what,
    })
}

/// Whether a file is there; where the disk does not say, that is an error, and the file is not missing.
fn is_file(path: &Path) -> Result<bool, JobError> {
    kind_of(path).map(|kind| kind.is_some_and(|kind| kind.is_file()))
}

/// What lies at a path, if anything does.
fn kind_of(path: &Path) -> Result<Option<FileType>, JobError> {
    match fs::metadata(path) {
        Ok(found) => Ok(Some(found.file_type())),
        Err(error)
            if matches!(
                error.kind(),
                io::ErrorKind::NotFound | io::ErrorKind::NotADirectory
            ) =>
        {
            Ok(None)
        }
        Err(error) => Err(spool::at(path)(error)),
    }
}

/// Adds a named piece, framed by its lengths so that no two lists of pieces read the same.
fn part(hash: &mut Sha256, name: &str, bytes: &[u8]) {
    frame(hash, name, bytes.len() as u64);
    hash.update(bytes);
}

fn frame(hash: &mut Sha256, name: &str, n_bytes: u64) {
    hash.update((name.len() as u64).to_le_bytes());
    hash.update(name);
    hash.update(n_bytes.to_le_bytes());
}

fn file(hash: &mut Sha256, name: &str, path: &Path) -> Result<(), JobError> {
    let mut add = || -> io::Result<()> {
        let mut file = File::open(path)?;
        frame(hash, name, file.metadata()?.len());
        let mut piece = vec![0; PIECE_BYTES];
        loop {
            match file.read(&mut piece)? {
                0 => return Ok(()),
                n_bytes => hash.update(&piece[..n_bytes]),
            }
        }
    };
    add().map_err(spool::at(path))
}

/// All files under a folder, by path; partial ones are not there yet.
fn files_in(folder: &Path) -> io::Result<Vec<PathBuf>> {
    let mut found = Vec::new();
    for entry in fs::read_dir(folder)? {
        let path = entry?.path();
        match path.is_dir() {
            true => found.extend(files_in(&path)?),
            false if path.extension().is_some_and(|kind| kind == "partial") => {}
            false => found.push(path),
        }
    }
    found.sort();
    Ok(found)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::jobs::scenes::scan;
    use std::os::unix::fs::symlink;

    #[test]
    fn a_name_follows_from_every_input_and_from_nothing_else() {
        let root = tempfile::tempdir().unwrap();
        let scan = scan(root.path(), "a");
        let name = || job_id(&scan, "x = 1", VERSION).unwrap();
        let first = name();
        fs::write(scan.join("report.json"), "{}").unwrap();
        fs::write(scan.join("refined.ply"), "ply").unwrap();
        fs::write(scan.join("snapshots/000/.ir.png.partial"), "").unwrap();
        assert_eq!(name(), first);
        assert_ne!(job_id(&scan, "x = 2", VERSION).unwrap(), first);
        assert_ne!(job_id(&scan, "x = 1", "another").unwrap(), first);
        let mut seen = vec![first];
        for changed in [
            "base.ply",
            "trajectory.txt",
            "scene.ply",
            "calibration.toml",
            "snapshots/000/meta.json",
            "snapshots/000/ir.png",
            "snapshots/001/ir.png",
        ] {
            let path = scan.join(changed);
            fs::create_dir_all(path.parent().unwrap()).unwrap();
            fs::write(path, "changed").unwrap();
            let now = name();
            assert!(!seen.contains(&now), "{changed}");
            seen.push(now);
        }
    }

    #[test]
    fn a_file_that_cannot_be_looked_at_is_not_one_that_is_missing() {
        for name in ["base.ply", "scene.ply", "snapshots"] {
            let root = tempfile::tempdir().unwrap();
            let scan = scan(root.path(), "a");
            let path = scan.join(name);
            if path.exists() {
                fs::rename(&path, root.path().join("aside")).unwrap();
            }
            // A link to itself leads nowhere, and the system says so.
            symlink(name, &path).unwrap();
            let error = job_id(&scan, "", VERSION).unwrap_err();
            assert!(matches!(error, JobError::Io { .. }), "{name}: {error}");
        }
    }

    #[test]
    fn a_scan_that_lacks_something_is_told_what() {
        for (missing, said) in [
            ("base.ply", "there is no base.ply"),
            ("trajectory.txt", "there is no trajectory.txt"),
            ("snapshots", "there is no shading image"),
        ] {
            let root = tempfile::tempdir().unwrap();
            let scan = scan(root.path(), "a");
            let path = scan.join(missing);
            match path.is_dir() {
                true => fs::remove_dir_all(path).unwrap(),
                false => fs::remove_file(path).unwrap(),
            }
            let error = job_id(&scan, "", VERSION).unwrap_err().to_string();
            assert!(error.ends_with(said), "{error}");
        }
    }
}
