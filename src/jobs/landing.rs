//! How the outputs of a refinement come into the scan's folder: one by one, each whole, the mesh before what tells of it.

use super::{JobError, spool};
use crate::pipeline::{REFINED_GLB, REFINED_PLY, REPORT_HTML, REPORT_JSON};
use std::{
    fs::{self, File},
    io,
    path::Path,
};

/// What is delivered; all else in the attempt's folder is in the scan's folder already.
const DELIVERED: [&str; 4] = [REFINED_GLB, REFINED_PLY, REPORT_HTML, REPORT_JSON];
/// The reports of the scan itself, which those of its refinement replace, are kept under their names with this before them.
const KEPT: &str = "capture-";

/// Moves the outputs, and removes the attempt's folder. A move that was begun before is ended; base mesh, poses and shading
/// images are not touched.
///
/// # Errors
/// If the system refuses; the move may be begun again.
pub fn land(out: &Path, scan: &Path) -> Result<(), JobError> {
    for name in [REPORT_HTML, REPORT_JSON] {
        keep(scan, name)?;
    }
    for name in DELIVERED {
        let from = out.join(name);
        if from.is_file() {
            fs::rename(&from, scan.join(name)).map_err(spool::at(&from))?;
        }
    }
    sync(scan)?;
    match fs::remove_dir_all(out) {
        Err(error) if error.kind() == io::ErrorKind::NotFound => Ok(()),
        removed => removed.map_err(spool::at(out)),
    }
}

/// Gives a file a second name, which it keeps when another takes its first.
fn keep(scan: &Path, name: &str) -> Result<(), JobError> {
    let from = scan.join(name);
    match fs::hard_link(&from, scan.join(format!("{KEPT}{name}"))) {
        // There is none, or it was kept before.
        Err(error)
            if matches!(
                error.kind(),
                io::ErrorKind::NotFound | io::ErrorKind::AlreadyExists
            ) =>
        {
            Ok(())
        }
        linked => linked.map_err(spool::at(&from)),
    }
}

fn sync(folder: &Path) -> Result<(), JobError> {
    File::open(folder)
        .and_then(|folder| folder.sync_all())
        .map_err(spool::at(folder))
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
            assert!(!out.exists());
        }
    }
}
