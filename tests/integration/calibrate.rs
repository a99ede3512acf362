//! Measuring a device by the program, and what later runs make of it.

use crate::support::{PROGRAM, Workbench, assert_says, record};
use depth_camera::Sensor;
use nalgebra::center;
use relief::config::{CalibrationKey, DeviceCalibration};
use simulated::{Infrared, Scene, Setup, SimulatedCamera, Trajectory};
use std::{
    path::Path,
    process::{Command, Output},
};

/// A raw Kinect I, led round the plaque with three shading poses.
fn raw_kinect1() -> SimulatedCamera {
    let scene = Scene::plaque();
    let (low, high) = scene.object_bounds();
    SimulatedCamera::new(Setup {
        trajectory: Trajectory::hand_held(center(&low, &high), 24),
        scene,
        sensor: Sensor::Kinect1,
        infrared: Infrared {
            offset_px: [5.0, 4.0],
            ..Infrared::of_sensor(Sensor::Kinect1)
        },
        n_moving_frames: 4,
        shading_frames: vec![0, 1, 2],
        reduction: 1,
        seed: 7,
    })
    .unwrap()
}

fn measure(session: &Path, folder: &Path, arguments: &[&str]) -> Output {
    Command::new(PROGRAM)
        .args(["calibrate", "offset"])
        .arg(session)
        .arg("--calibration-dir")
        .arg(folder)
        .args(arguments)
        .output()
        .unwrap()
}

#[test]
fn the_offset_of_a_raw_kinect1_is_measured_into_its_file_and_used() {
    let root = tempfile::tempdir().unwrap();
    let (session, folder) = (root.path().join("raw"), root.path().join("calibration"));
    record(raw_kinect1(), &session);
    let file = folder.join("simulated-7.toml");

    assert_says(&measure(&session, &folder, &["--dry-run"]), 0, &[]);
    assert!(!file.exists());
    let output = measure(&session, &folder, &[]);
    assert_says(&output, 0, &[]);
    let said = String::from_utf8(output.stdout).unwrap();
    assert!(said.contains("a raw Kinect I has about (5, 4)"), "{said}");
    let device = DeviceCalibration::read(&file).unwrap();
    let [right, down] = device.ir_offset_px.unwrap();
    assert!(
        (right - 5.0).abs() < 0.5 && (down - 4.0).abs() < 0.5,
        "{said}"
    );
    let measurement = &device.measured[&CalibrationKey::IrOffset];
    assert_eq!(measurement.sessions[0].name, "raw");
    assert!(measurement.sessions[0].content.starts_with("sha256:"));

    let again = measure(&session, &folder, &[]);
    assert_says(&again, 2, &["ir_offset_px is there already", "--replace"]);
    assert_says(&measure(&session, &folder, &["--replace"]), 0, &[]);
    assert!(folder.join("simulated-7.1.toml").exists());

    let replay = Command::new(PROGRAM)
        .arg("replay")
        .arg(&session)
        .arg("--out")
        .arg(root.path().join("out"))
        .arg("--calibration-dir")
        .arg(&folder)
        .arg("--no-refine")
        .output()
        .unwrap();
    let lacks = "simulated-7.toml does not have gamma, flat_field, light.lobe_power, noise";
    assert_says(&replay, 0, &["ir_offset_px: measured 2", lacks]);
}

#[test]
fn a_session_without_silhouettes_is_refused() {
    let bench = Workbench::with_frames(1);
    let folder = bench.path("calibration");
    let output = measure(&bench.session(), &folder, &[]);
    assert_says(&output, 1, &["edges of depth are found", "at least 300"]);
    assert!(!folder.exists());
    let output = measure(&bench.session(), &folder, &["--serial", "../a"]);
    assert_says(&output, 2, &["\"../a\" must be a plain file name"]);
}
