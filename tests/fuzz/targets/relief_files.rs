//! What people and other programs give to relief, as any bytes: meshes, configurations, calibrations, trajectories, and what a page
//! says to the daemon.
#![no_main]

use std::{cell::OnceCell, fs, path::Path};

use libfuzzer_sys::fuzz_target;
use relief::{
    config::{Config, DeviceCalibration},
    control::Wish,
    export::{read_ply, read_trajectory},
    jobs::ProgressLine,
    shading::Calibration,
};

thread_local! {
    static FOLDER: OnceCell<tempfile::TempDir> = const { OnceCell::new() };
}

fuzz_target!(|bytes: &[u8]| {
    let Some((which, content)) = bytes.split_first() else { return };
    let text = String::from_utf8_lossy(content);
    FOLDER.with(|folder| {
        let folder = folder.get_or_init(|| tempfile::tempdir().expect("a folder")).path();
        match which % 6 {
            0 => mesh(folder, content),
            1 => config(&text),
            2 => calibration(&text),
            3 => trajectory(folder, content),
            4 => drop(Wish::parse(&text)),
            _ => drop(serde_json::from_str::<ProgressLine>(&text)),
        }
    });
});

/// Every corner of a face that is read is a vertex that was read.
fn mesh(folder: &Path, content: &[u8]) {
    let path = folder.join("mesh.ply");
    fs::write(&path, content).expect("a folder takes files");
    if let Ok(mesh) = read_ply(&path) {
        let n_vertices = mesh.vertices.len();
        assert!(mesh.faces.iter().flatten().all(|&corner| (corner as usize) < n_vertices));
    }
}

/// What is valid stays so when it is written and read again.
fn config(text: &str) {
    let Ok(config) = toml::from_str::<Config>(text) else { return };
    if config.validate().is_ok() {
        let written = toml::to_string(&config).expect("a valid configuration can be written");
        let again: Config = toml::from_str(&written).expect("what was written can be read");
        assert!(again.validate().is_ok());
    }
}

fn calibration(text: &str) {
    let _ = toml::from_str::<DeviceCalibration>(text);
    if let Ok(calibration) = toml::from_str::<Calibration>(text) {
        let _ = calibration.to_toml();
    }
}

fn trajectory(folder: &Path, content: &[u8]) {
    let path = folder.join("trajectory.txt");
    fs::write(&path, content).expect("a folder takes files");
    let _ = read_trajectory(&path);
}
