//! Measuring a device by the program, and what later runs make of it.

use crate::{
    raw_kinect1::offset_kinect1,
    support::{PROGRAM, Workbench, assert_says, demo, record},
};
use depth_camera::{DepthCamera, Sensor};
use nalgebra::{Isometry3, Point3, Vector3, center};
use relief::config::{CalibrationKey, DeviceCalibration};
use replay::SessionWriter;
use simulated::{Infrared, Scene, Setup, Shape, SimulatedCamera, Solid, Trajectory};
use std::{
    io::{BufRead, BufReader},
    path::Path,
    process::{Command, Output, Stdio},
    time::Duration,
};

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
    record(offset_kinect1(), &session);
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

#[test]
fn the_offset_of_a_kinect2_is_known_and_not_written() {
    let folder = tempfile::tempdir().unwrap();
    let output = measure(&demo(), folder.path(), &[]);
    assert_says(&output, 0, &[]);
    let said = String::from_utf8(output.stdout).unwrap();
    assert!(said.contains("nothing is written"), "{said}");
    assert_eq!(folder.path().read_dir().unwrap().count(), 0);
}

/// A Kinect II with a response of its own, which stays at one place after the other.
fn strange_kinect2(scene: &Scene, eyes: &[Point3<f64>], target: Point3<f64>, folder: &Path) {
    let mut writer: Option<SessionWriter> = None;
    for (moment, eye) in eyes.iter().enumerate() {
        let mut camera = SimulatedCamera::new(Setup {
            trajectory: Trajectory::still(*eye, target),
            scene: scene.clone(),
            sensor: Sensor::Kinect2,
            infrared: Infrared {
                gamma: 0.79,
                lens_power: 1.5,
                lobe_power: 1.2,
                ..Infrared::of_sensor(Sensor::Kinect2)
            },
            n_moving_frames: 1,
            shading_frames: Vec::new(),
            reduction: 1,
            seed: 3,
        })
        .unwrap();
        let writer = writer
            .get_or_insert_with(|| SessionWriter::create(folder, camera.info(), 5000.0).unwrap());
        let mut frame = camera.grab(Duration::ZERO).unwrap().unwrap();
        frame.frame_id = moment as u64;
        frame.device_time_secs = moment as f64 / 30.0;
        writer.write(&frame).unwrap();
    }
    writer.unwrap().finish().unwrap();
}

/// A plain wall, seen from so far away, metres.
fn strange_wall(distances_m: &[f64], folder: &Path) {
    let half_size = [2.5, 2.5];
    let plain = Solid::new(Shape::Table { half_size }, Isometry3::identity(), 0.7);
    let plain = Scene::new(vec![plain], 0);
    let away = |&distance_m: &f64| Point3::new(0.02, -0.06 * distance_m, distance_m);
    let eyes: Vec<_> = distances_m.iter().map(away).collect();
    strange_kinect2(&plain, &eyes, Point3::origin(), folder);
}

fn calibrate(what: &str, sessions: &[&Path], folder: &Path) -> Output {
    Command::new(PROGRAM)
        .args(["calibrate", what])
        .args(sessions)
        .arg("--calibration-dir")
        .arg(folder)
        .output()
        .unwrap()
}

#[test]
fn a_response_is_measured_from_sphere_and_wall_into_its_file() {
    let root = tempfile::tempdir().unwrap();
    let (sphere, wall) = (root.path().join("sphere"), root.path().join("wall"));
    let folder = root.path().join("calibration");
    let ball = Scene::sphere();
    let (low, high) = ball.object_bounds();
    let middle = center(&low, &high);
    let eyes: Vec<_> = [0.0, 0.01, 0.02]
        .map(|aside| middle + Vector3::new(aside, -0.52, 0.25))
        .into();
    strange_kinect2(&ball, &eyes, middle, &sphere);
    strange_wall(&[0.55, 0.7, 0.85, 1.0, 1.2, 1.4], &wall);

    let output = calibrate("response", &[&sphere, &wall], &folder);
    assert_says(&output, 0, &["calibration written", "page written"]);
    let device = DeviceCalibration::read(&folder.join("simulated-3.toml")).unwrap();
    let gamma = device.gamma.unwrap();
    assert!((gamma - 0.79).abs() < 0.01, "{gamma}");
    let page = std::fs::read_to_string(folder.join("simulated-3.response.html")).unwrap();
    assert!(page.contains("Kinect II") && !page.contains("http"));

    let again = calibrate("response", &[&sphere, &wall], &folder);
    assert_says(&again, 2, &["gamma is there already", "--replace"]);
    // The README's order: one command after the other into one file.
    for what in ["flat-field", "light"] {
        let output = calibrate(what, &[&sphere, &wall], &folder);
        assert_says(&output, 0, &["calibration written", "page written"]);
    }
    let device = DeviceCalibration::read(&folder.join("simulated-3.toml")).unwrap();
    let [x, y, z] = device.light.position_m.unwrap();
    assert!((x - 0.052).hypot(y).hypot(z - 0.004) < 0.006, "{x} {y} {z}");
    assert!(device.flat_field.is_some() && device.gamma == Some(gamma));
    // A complete calibration beside the recording does not say that its lobe was measured.
    let complete = include_str!("../../config/calibration-kinect2.toml");
    std::fs::write(sphere.join("calibration.toml"), complete).unwrap();
    let fresh = root.path().join("fresh");
    assert_says(&calibrate("light", &[&sphere, &wall], &fresh), 0, &[]);
    let device = DeviceCalibration::read(&fresh.join("simulated-3.toml")).unwrap();
    let measured: Vec<CalibrationKey> = device.keys().collect();
    assert_eq!(
        measured,
        [
            CalibrationKey::LightLobePower,
            CalibrationKey::LightPosition
        ]
    );
    // A folder stands where the page is to be: what was found is told, and that it failed, once.
    let output = Command::new(PROGRAM)
        .args(["calibrate", "light", "--dry-run", "--json"])
        .args([&sphere, &wall])
        .args([Path::new("--calibration-dir"), &folder])
        .args([Path::new("--page"), &folder])
        .output()
        .unwrap();
    assert_says(&output, 1, &["calibration"]);
    let told: serde_json::Value = serde_json::from_slice(&output.stdout).unwrap();
    assert_eq!(told["status"], "failed");
    assert_eq!(told["failures"].as_array().unwrap().len(), 1);
    assert!(told["gamma"]["value"].is_number(), "{told}");
    let elsewhere = root.path().join("elsewhere");
    // Nothing is measured before there is a folder for the page.
    let output = Command::new(PROGRAM)
        .args(["calibrate", "light", "--page"])
        .args([&elsewhere.join("page.html"), &wall])
        .output()
        .unwrap();
    let place = format!("--page: {} is no folder", elsewhere.display());
    assert_says(&output, 2, &[&place]);
    let walls_only = calibrate("response", &[&wall], &elsewhere);
    assert_says(&walls_only, 1, &["no session shows a sphere"]);
    let a_ball_is_expected = Command::new(PROGRAM)
        .args(["calibrate", "light", "--radius", "0.08", "--dry-run"])
        .arg(&wall)
        .output()
        .unwrap();
    let shares = [
        "wall: a plane holds",
        "the best sphere shows 0 % of its front",
    ];
    assert_says(
        &a_ball_is_expected,
        1,
        &["whose radius is given", shares[0], shares[1]],
    );
    let spheres_only = calibrate("flat-field", &[&sphere], &elsewhere);
    assert_says(&spheres_only, 1, &["no session shows a plain wall"]);
}

#[test]
fn a_fit_that_is_told_to_stop_is_not_made_to_its_end() {
    const N_SESSIONS: usize = 20;
    let root = tempfile::tempdir().unwrap();
    let (wall, folder) = (root.path().join("wall"), root.path().join("calibration"));
    strange_wall(&[0.55, 0.85, 1.2], &wall);
    // Often enough the same, on one thread, that the fit takes far longer than to be told.
    let mut child = Command::new(PROGRAM)
        .args(["calibrate", "flat-field"])
        .args([&wall; N_SESSIONS])
        .arg("--calibration-dir")
        .arg(&folder)
        .env("RAYON_NUM_THREADS", "1")
        .stdout(Stdio::null())
        .stderr(Stdio::piped())
        .spawn()
        .unwrap();
    let said = BufReader::new(child.stderr.take().unwrap());
    let mut lines = said.lines().map(|line| line.unwrap());
    let gathered = lines.by_ref().filter(|line| line.contains("gathered"));
    assert_eq!(gathered.take(N_SESSIONS).count(), N_SESSIONS);
    let pid = child.id().to_string();
    let killed = Command::new("kill").args(["-TERM", &pid]).status().unwrap();
    assert!(killed.success());
    let rest: Vec<String> = lines.collect();
    // At its end it is refused with 1: three images show no law of distance.
    assert_eq!(child.wait().unwrap().code(), Some(130), "{rest:?}");
    let told = rest.last().unwrap();
    assert!(
        told.ends_with("stopped before anything was written"),
        "{rest:?}"
    );
    assert!(!folder.exists());
}

#[test]
fn a_session_without_sphere_or_wall_is_refused_with_what_was_found() {
    let bench = Workbench::with_frames(3);
    let folder = bench.path("calibration");
    let output = calibrate("response", &[&bench.session()], &folder);
    assert_says(
        &output,
        1,
        &["neither a wall", "nor a sphere is in view", "35 %"],
    );
    assert!(!folder.exists());
}
