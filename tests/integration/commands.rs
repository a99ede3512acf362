//! Commands around a scan, each run once: coarsely, for what they measure is tested beside the code.

use crate::support::{COARSE, PROGRAM, Workbench, assert_says, demo, fuse, summary};
use depth_camera::Sensor;
use mcap_session::open_session;
use relief::{
    config::DeviceCalibration,
    export::{read_ply, write_ply},
    geometry::TriMesh,
};
use replay::Pacing;
use serde_json::Value;
use std::{
    fs,
    os::unix::fs::symlink,
    path::Path,
    process::{Command, Output},
    time::Duration,
};

fn relief(arguments: &[&str], paths: &[&Path]) -> Output {
    let mut command = Command::new(PROGRAM);
    command.args(arguments).args(paths).output().unwrap()
}

#[test]
fn a_scan_is_evaluated_with_all_ablations_against_a_truth_and_refined_from_one_view() {
    let bench = Workbench::empty();
    let config = bench.write("coarse.toml", COARSE);
    let config = config.to_str().unwrap();
    let scan = bench.path("scan");
    fuse(&demo(), &scan, &["--config", config]);
    let base = scan.join("base.ply");
    let truth = base.to_str().unwrap();

    let evaluation = bench.path("evaluation");
    let out = evaluation.to_str().unwrap();
    let no_mesh = [
        "evaluate", "--config", config, "--out", out, "--truth", config,
    ];
    assert_says(&relief(&no_mesh, &[&scan]), 1, &["coarse.toml"]);
    let points = TriMesh {
        faces: Vec::new(),
        ..read_ply(&base).unwrap()
    };
    let mut millimetres = read_ply(&base).unwrap();
    let vertices = millimetres.vertices.iter_mut();
    vertices.for_each(|vertex| vertex.coords *= 1000.0);
    for (name, mesh, piece) in [
        (
            "points.ply",
            points,
            "points.ply has no faces: a mesh is needed",
        ),
        ("millimetres.ply", millimetres, "m wide: is it in metres"),
    ] {
        let path = bench.path(name);
        write_ply(&path, &mesh, &mesh.vertex_normals(), None).unwrap();
        let with_it = ["evaluate", "--config", config, "--out", out, "--truth"];
        assert_says(&relief(&with_it, &[&path, &scan]), 1, &[piece]);
    }
    assert!(!evaluation.exists());
    let fixed = ["evaluate", "--config", config, "--out", out, "--json"];
    let more = ["--folds", "2", "--truth", truth, "--ablations"];
    let evaluated = relief(&[&fixed[..], &more].concat(), &[&scan]);
    assert_says(&evaluated, 0, &[]);
    let report = summary(&evaluated);
    assert_eq!(report["not_judged_reason"], Value::Null);
    assert_eq!(report["views"].as_array().unwrap().len(), 6);
    let ablations = report["ablations"].as_array().unwrap();
    assert!(ablations.len() > 10, "{} ablations", ablations.len());
    for ablation in ablations {
        assert!(ablation["figures"].is_object(), "{ablation}");
    }
    // The base mesh is the truth itself, and the refined one is another.
    let rms_mm = |mesh: &str| report["truth"][mesh]["rms_mm"].as_f64().unwrap();
    assert!(rms_mm("base") < 1e-6 && rms_mm("refined") > 1e-3);
    for name in ["evaluation.md", "evaluation.json"] {
        assert!(evaluation.join(name).is_file(), "{name}");
    }

    let one_view = bench.path("one-view");
    let out = one_view.to_str().unwrap();
    let first = fs::read(scan.join("snapshots/000/meta.json")).unwrap();
    let first: Value = serde_json::from_slice(&first).unwrap();
    let frame = first["frame_id"].to_string();
    let fixed = ["refine", "--config", config, "--out", out];
    let more = ["--single-view", frame.as_str()];
    let refined = relief(&[&fixed[..], &more].concat(), &[&scan]);
    assert_says(&refined, 0, &[]);
    let mesh = read_ply(&one_view.join("refined.ply")).unwrap();
    assert!(mesh.faces.len() > 100);
    let told = String::from_utf8_lossy(&refined.stdout);
    for line in ["base mesh:", "refined mesh:", "report:"] {
        assert!(told.contains(line), "{told}");
    }
}

/// So many frames of the demo.
fn beginning_of_demo(n_frames: usize, folder: &Path) {
    fs::create_dir(folder).unwrap();
    for name in ["session.toml", "calibration.toml"] {
        fs::copy(demo().join(name), folder.join(name)).unwrap();
    }
    for kind in ["depth", "ir"] {
        symlink(demo().join(kind), folder.join(kind)).unwrap();
        let list = format!("{kind}.txt");
        let text = fs::read_to_string(demo().join(&list)).unwrap();
        let frames = text.lines().filter(|line| !line.starts_with('#'));
        let frames: Vec<&str> = frames.take(n_frames).collect();
        fs::write(folder.join(list), frames.join("\n") + "\n").unwrap();
    }
}

#[test]
fn the_strength_of_multipath_is_measured_into_its_file() {
    let bench = Workbench::empty();
    beginning_of_demo(12, &bench.session());
    let config = bench.write("coarse.toml", COARSE);
    let folder = bench.path("calibration");
    let arguments = [
        "calibrate",
        "depth",
        "--config",
        config.to_str().unwrap(),
        "--calibration-dir",
        folder.to_str().unwrap(),
    ];
    let measured = relief(&arguments, &[&bench.session()]);
    assert_says(&measured, 0, &[]);
    let device = DeviceCalibration::read(&folder.join("simulated-1.toml")).unwrap();
    assert!(device.light.white_level.is_some());
    // The demo's sensor has no error by range.
    assert_eq!(device.range_error_m, None);
}

#[test]
fn what_is_simulated_is_a_session() {
    let bench = Workbench::empty();
    let simulated = relief(&["simulate", "--frames", "2"], &[&bench.session()]);
    assert_says(&simulated, 0, &[]);
    let opened = open_session(&bench.session(), Pacing::AsFastAsPossible);
    let mut camera = opened.unwrap().camera;
    assert_eq!(camera.info().sensor, Sensor::Kinect2);
    let mut n_frames = 0;
    while let Some(frame) = camera.grab(Duration::ZERO).unwrap() {
        assert!(frame.depth.is_some() && frame.ir.is_some());
        n_frames += 1;
    }
    assert_eq!(n_frames, 2);
}
