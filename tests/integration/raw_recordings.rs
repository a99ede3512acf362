//! Every command that takes a session takes recordings of raw disparity. Those of packets: `raw_packets`.

use crate::{
    raw_kinect1::{offset_kinect1, raw_frames, record_raw, stamp_secs},
    support::{PROGRAM, assert_says, summary},
};
use depth_camera::{Frame, Image, Sensor};
use freenect1::assembly::RawFrame;
use nalgebra::{Isometry3, Point3};
use relief::{
    capture::IrOffset,
    config::{CalibrationKey, DeviceCalibration},
};
use serde_json::Value;
use simulated::{Infrared, Scene, Setup, Shape, SimulatedCamera, Solid, Trajectory};
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

/// A plain wall from several distances under the lamp.
fn walls() -> Vec<RawFrame> {
    let half_size = [2.5, 2.5];
    let plain = Solid::new(Shape::Table { half_size }, Isometry3::identity(), 0.7);
    let plain = Scene::new(vec![plain], 0);
    let frames = [0.6, 0.9, 1.3].into_iter().flat_map(|distance_m| {
        let eye = Point3::new(0.02, -0.06 * distance_m, distance_m);
        let camera = SimulatedCamera::new(Setup {
            trajectory: Trajectory::still(eye, Point3::origin()),
            scene: plain.clone(),
            sensor: Sensor::Kinect1,
            infrared: Infrared {
                offset_px: [9.0, 6.0],
                ..Infrared::of_sensor(Sensor::Kinect1)
            },
            n_moving_frames: 2,
            shading_frames: vec![0],
            reduction: 1,
            seed: 3,
        });
        raw_frames(camera.unwrap())
    });
    frames
        .enumerate()
        .map(|(number, frame)| RawFrame {
            device_time_secs: stamp_secs(number),
            ..frame
        })
        .collect()
}

/// The same with IR where depth is.
fn straightened(frame: &RawFrame) -> RawFrame {
    let ir = frame.ir.as_ref().unwrap();
    let shown = Frame {
        frame_id: frame.frame_id,
        device_time_secs: frame.device_time_secs,
        host_time: frame.host_time,
        depth: None,
        ir: Some(ir.clone().top_rows(480)),
    };
    let moved = IrOffset::nearest([9.0, 6.0]).remove_from(shown).ir.unwrap();
    let mut ir = Image::filled(640, 488, 0);
    ir.data_mut()[..640 * 480].copy_from_slice(moved.data());
    RawFrame {
        disparity: frame.disparity.clone(),
        ir: Some(ir),
        ..*frame
    }
}

/// What a device whose IR lies elsewhere shows is what one shows whose IR lies where depth is.
#[test]
fn light_is_measured_from_disparity_with_infrared_moved_to_its_place() {
    let root = tempfile::tempdir().unwrap();
    let measure = |name: &str, frames: &[RawFrame], offset_px: &str| -> Value {
        let folder = root.path().join(name);
        let session = folder.join("wall");
        std::fs::create_dir(&folder).unwrap();
        record_raw(frames, "W1", &session);
        let calibration = format!(
            "version = 1\nserial = \"W1\"\nsensor = \"kinect1\"\nir_offset_px = {offset_px}\n"
        );
        std::fs::write(folder.join("W1.toml"), calibration).unwrap();
        let arguments = ["calibrate", "flat-field", "--json", "--dry-run"];
        let into = ["--calibration-dir", folder.to_str().unwrap()];
        let output = relief(&[arguments.as_slice(), &into].concat(), &[&session]);
        assert_says(&output, 0, &["gathered session=\"wall\" images=3"]);
        summary(&output)
    };
    let offset = walls();
    let straight: Vec<_> = offset.iter().map(straightened).collect();
    let elsewhere = measure("offset", &offset, "[9.0, 6.0]");
    assert_eq!(elsewhere, measure("straight", &straight, "[0.0, 0.0]"));
    let unheeded = measure("unheeded", &offset, "[0.0, 0.0]");
    assert_ne!(elsewhere, unheeded, "the offset matters");
}
