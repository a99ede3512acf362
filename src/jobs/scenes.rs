//! Scans for tests: folders of the right names with little in them.

use std::{
    fs,
    path::{Path, PathBuf},
};

/// A scan of that name in a data directory.
pub fn scan(data_dir: &Path, name: &str) -> PathBuf {
    let scan = data_dir.join("sessions").join(name);
    fs::create_dir_all(scan.join("snapshots/000")).unwrap();
    for (file, text) in [
        ("base.ply", "the base mesh"),
        ("trajectory.txt", "the poses"),
        ("snapshots/000/ir.png", "an image"),
        ("snapshots/000/meta.json", "{}"),
    ] {
        fs::write(scan.join(file), text).unwrap();
    }
    scan
}
