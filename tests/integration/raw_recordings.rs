//! Every command that takes a session takes recordings of raw disparity. Those of packets: `raw_packets`.

use crate::{
    raw_kinect1::{offset_kinect1, raw_frames, record_raw},
    support::{PROGRAM, assert_says, summary},
};
use relief::config::{CalibrationKey, DeviceCalibration};
use std::{
    path::Path,
    process::{Command, Output},
};

fn relief(arguments: &[&str], paths: &[&Path]) -> Output {
    let mut command = Command::new(PROGRAM);
    command.args(arguments).args(paths).output().unwrap()
}

#[test]
fn disparity_is_benched_calibrated_converted_and_replayed() {
    let root = tempfile::tempdir().unwrap();
    let path = |name: &str| root.path().join(name);
    let raw = path("raw");
    record_raw(&raw_frames(offset_kinect1()), "raw-7", &raw);

    let benched = relief(&["bench", "--json", "--voxel-size", "0.005"], &[&raw]);
    assert_says(&benched, 0, &[]);
    let frames = summary(&benched)["frames"].clone();
    // Four frames on the move, the twelve exposures of three poses with nothing for depth.
    assert_eq!(
        (&frames["tracked"], &frames["lost"]),
        (&4.into(), &0.into())
    );

    let folder = path("calibration");
    let into = [
        "calibrate",
        "offset",
        "--calibration-dir",
        folder.to_str().unwrap(),
    ];
    let measured = relief(&into, &[&raw]);
    assert_says(&measured, 0, &[]);
    let device = DeviceCalibration::read(&folder.join("raw-7.toml")).unwrap();
    let [right, down] = device.ir_offset_px.unwrap();
    assert!(
        (right - 5.0).abs() < 0.5 && (down - 4.0).abs() < 0.5,
        "{right} {down}"
    );
    let session = &device.measured[&CalibrationKey::IrOffset].sessions[0];
    assert_eq!(session.name, "raw");
    let moved = path("moved");
    std::fs::rename(&raw, &moved).unwrap();
    let again = relief(&[&into, ["--replace"].as_slice()].concat(), &[&moved]);
    assert_says(&again, 0, &[]);
    let again = DeviceCalibration::read(&folder.join("raw-7.toml")).unwrap();
    let elsewhere = &again.measured[&CalibrationKey::IrOffset].sessions[0];
    assert_eq!(elsewhere.content, session.content, "wherever it lies");

    for (what, out) in [("export", path("images")), ("import", path("mcap"))] {
        let converted = relief(
            &["session", what, "--json", "--out", out.to_str().unwrap()],
            &[&moved],
        );
        assert_says(&converted, 0, &[]);
        let n_frames = 4 + 12;
        assert_eq!(summary(&converted)["frames"], n_frames);
        let benched = relief(&["bench", "--json", "--voxel-size", "0.005"], &[&out]);
        assert_says(&benched, 0, &[]);
        assert_eq!(summary(&benched)["frames"], frames, "{what}");
    }
}
