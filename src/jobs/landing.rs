//! How the outputs of a refinement come into the scan's folder: one by one, each whole, the mesh before what tells of it.

use super::{JobError, spool};
use crate::{
    atomic_file::{sync_folder_of, write_atomically},
    pipeline::{REFINED_GLB, REFINED_PLY, REPORT_HTML, REPORT_JSON},
};
use std::{
    fs::{self, File},
    io,
    path::Path,
};

/// What is delivered. All else in the attempt's folder is in the scan's folder already, but for the masks of what refinement could
/// use: a job is named by the shading images with their masks, so that the scan keeps those of where there is depth.
const DELIVERED: [&str; 4] = [REFINED_GLB, REFINED_PLY, REPORT_HTML, REPORT_JSON];
/// The reports of the scan itself, which those of its refinement replace, are kept under their names with this before them.
const KEPT: &str = "capture-";

/// Moves the outputs; what else is in the attempt's folder stays there. A move that was begun before is ended; base mesh, poses and
/// shading images are not touched.
///
/// # Errors
/// If the system refuses; the move may be begun again.
pub fn land(out: &Path, scan: &Path) -> Result<(), JobError> {
    for name in [REPORT_HTML, REPORT_JSON] {
        // Once it has moved, what has its name in the scan's folder is no more the scan's own.
        if out.join(name).is_file() {
            keep(scan, name)?;
        }
    }
    for name in DELIVERED {
        let from = out.join(name);
        if from.is_file() {
            fs::rename(&from, scan.join(name)).map_err(spool::at(&from))?;
        }
    }
    sync_folder_of(&scan.join(REPORT_JSON));
    Ok(())
}

/// Gives a file a second name, which it keeps when another takes its first.
fn keep(scan: &Path, name: &str) -> Result<(), JobError> {
    let (from, kept) = (scan.join(name), scan.join(format!("{KEPT}{name}")));
    match fs::hard_link(&from, &kept) {
        Ok(()) => Ok(()),
        // There is none, or it was kept before.
        Err(error)
            if matches!(
                error.kind(),
                io::ErrorKind::NotFound | io::ErrorKind::AlreadyExists
            ) =>
        {
            Ok(())
        }
        // Not every file system knows second names: exFAT and some of the network do not.
        Err(_) => keep_copy(&from, &kept).map_err(spool::at(&from)),
    }
}

/// Copies a file that was not kept before, whole or not at all.
fn keep_copy(from: &Path, kept: &Path) -> io::Result<()> {
    if kept.exists() {
        return Ok(());
    }
    let mut file = File::open(from)?;
    write_atomically(kept, |copy| io::copy(&mut file, copy).map(|_| ()))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::jobs::scenes::scan;

    #[test]
    fn a_landing_that_was_cut_off_anywhere_is_ended() {
        for n_moved in 0..=DELIVERED.len() {
            let root = tempfile::tempdir().unwrap();
            let scan = scan(root.path(), "a");
            fs::write(scan.join(REPORT_JSON), "of the scan").unwrap();
            let out = scan.join("refined-1");
            fs::create_dir(&out).unwrap();
            for name in DELIVERED.iter().chain(&["base.ply"]) {
                fs::write(out.join(name), "of the refinement").unwrap();
            }
            keep(&scan, REPORT_JSON).unwrap();
            for name in &DELIVERED[..n_moved] {
                fs::rename(out.join(name), scan.join(name)).unwrap();
            }
            land(&out, &scan).unwrap();
            let read = |name: &str| fs::read_to_string(scan.join(name)).unwrap();
            for name in DELIVERED {
                assert_eq!(read(name), "of the refinement", "{name}");
            }
            assert_eq!(read("base.ply"), "the base mesh");
            assert_eq!(read("capture-report.json"), "of the scan");
            assert!(!scan.join("capture-report.html").exists(), "it had none");
            assert!(DELIVERED.iter().all(|name| !out.join(name).exists()));
        }
    }

    #[test]
    fn a_report_is_copied_once_where_a_file_has_one_name() {
        let root = tempfile::tempdir().unwrap();
        let scan = scan(root.path(), "a");
        let (report, kept) = (scan.join(REPORT_JSON), scan.join("capture-report.json"));
        for text in ["of the scan", "of the refinement"] {
            fs::write(&report, text).unwrap();
            keep_copy(&report, &kept).unwrap();
            assert_eq!(fs::read_to_string(&kept).unwrap(), "of the scan");
        }
        assert!(!scan.join(".capture-report.json.partial").exists());
    }
}
