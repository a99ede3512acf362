//! A recording with known truth through the real pipeline.

use crate::support::{record, record_as, small_camera};
use depth_camera::{DepthCamera, Image};
use mcap_session::open_session;
use nalgebra::Isometry3;
use relief::{
    capture::CaptureParams,
    export::{read_ply, read_trajectory},
    fusion::FusionParams,
    geometry::motion_between,
    multipath::MultipathParams,
    pipeline::{Ending, Outcome, OutputFolder, Pipeline, PipelineParams, WhenFull},
    refine::{ObjectParams, RefineParams},
    shading::Calibration,
    snapshot::SnapshotParams,
};
use replay::{Pacing, SessionWriter};
use serde_json::Value;
use simulated::SimulatedCamera;
use std::{fs, num::NonZeroUsize, path::Path, time::Duration};

const N_FRAMES: usize = 12;

/// The simulated camera sees no multipath; that of its shifted images would differ at the border.
pub fn params(n_threads: usize, calibration: Calibration) -> PipelineParams {
    PipelineParams {
        session: "plaque".to_owned(),
        capture: CaptureParams {
            min_free_disk_mb: 0,
            ..CaptureParams::default()
        },
        multipath: MultipathParams { enabled: false },
        fusion: FusionParams {
            voxel_size_m: 0.003,
            ..FusionParams::default()
        },
        snapshot: SnapshotParams::default(),
        object: ObjectParams::default(),
        refine: RefineParams {
            edge_length_m: 0.003,
            n_rounds: 2,
            max_steps: 2,
            ..RefineParams::default()
        },
        is_refined: true,
        calibration,
        calibration_source: "shipped".to_owned(),
        roi: None,
        poses: None,
        n_threads: NonZeroUsize::new(n_threads).unwrap(),
        when_full: WhenFull::Block,
        record: true,
        warnings: Vec::new(),
    }
}

fn shipped() -> Calibration {
    Calibration::shipped(depth_camera::Sensor::Kinect2).unwrap()
}

fn run(session: &Path, out: &Path, n_threads: usize, calibration: Calibration) -> Outcome {
    run_with(session, out, params(n_threads, calibration))
}

fn run_with(session: &Path, out: &Path, params: PipelineParams) -> Outcome {
    let camera = open_session(session, Pacing::AsFastAsPossible)
        .unwrap()
        .camera;
    let folder = OutputFolder::claim(out).unwrap();
    let outcome = Pipeline::spawn(camera, params, folder).unwrap().join();
    assert_eq!(outcome.failures, Vec::<String>::new());
    assert_eq!(outcome.ending, Ending::Complete);
    outcome
}

/// Largest distance (m) and angle (rad) between tracked and true poses, both relative to the first camera.
fn trajectory_errors(path: &Path) -> (f64, f64) {
    let camera = small_camera(N_FRAMES, 1);
    let first: Isometry3<f64> = camera.true_world_from_camera(0);
    let mut largest = (0.0_f64, 0.0_f64);
    let tracked = read_trajectory(path).unwrap();
    assert_eq!(tracked.len(), N_FRAMES);
    for (frame, (_, pose)) in tracked.iter().enumerate() {
        let truth = first.inverse() * camera.true_world_from_camera(frame);
        let error = motion_between(&truth, pose);
        largest.0 = largest.0.max(error.translation_m);
        largest.1 = largest.1.max(error.rotation_rad);
    }
    largest
}

#[test]
fn a_recording_becomes_meshes_and_a_report_the_same_on_any_number_of_threads() {
    let root = tempfile::tempdir().unwrap();
    let session = root.path().join("plaque");
    record(small_camera(N_FRAMES, 1), &session);
    let (two, one) = (root.path().join("two"), root.path().join("one"));
    let outcome = run(&session, &two, 2, shipped());

    let frames = outcome.report.frames;
    assert_eq!((frames.total, frames.fused), (12, 12));
    for name in [
        "base.ply",
        "refined.ply",
        "refined.glb",
        "trajectory.txt",
        "events.jsonl",
        "snapshots/000/ir.png",
        "recording/segment-0000.mcap",
        "recording/calibration.toml",
        "report.html",
        "report.json",
    ] {
        assert!(two.join(name).is_file(), "{name}");
    }
    assert!(!two.join(".relief.lock").exists());
    let base = read_ply(&two.join("base.ply")).unwrap();
    assert_eq!(base.faces.len(), outcome.report.base_mesh.faces);
    assert!(base.area_m2() > 0.1, "{}", base.area_m2());

    // The error of the first pose, to which all are relative, weighs on every other one: twice what is seen.
    let (distance_m, angle_rad) = trajectory_errors(&two.join("trajectory.txt"));
    assert!(distance_m < 0.003, "{distance_m}");
    assert!(angle_rad < 0.8_f64.to_radians(), "{angle_rad}");

    run(&session, &one, 1, shipped());
    for name in ["base.ply", "refined.ply", "trajectory.txt"] {
        let same = fs::read(one.join(name)).unwrap() == fs::read(two.join(name)).unwrap();
        assert!(same, "{name} depends on the number of threads");
    }
}

#[test]
fn depth_is_corrected_by_what_the_images_say_of_the_response_whether_the_scan_is_refined_or_not() {
    let root = tempfile::tempdir().unwrap();
    let session = root.path().join("plaque");
    record(small_camera(N_FRAMES, 1), &session);
    let wrong = Calibration {
        gamma: 1.5 * shipped().gamma,
        ..shipped()
    };
    let base = |name: &str, is_asked: bool, is_refined: bool| {
        let mut params = PipelineParams {
            multipath: MultipathParams { enabled: true },
            is_refined,
            ..params(2, wrong.clone())
        };
        params.refine.self_calibration.enabled = is_asked;
        let out = root.path().join(name);
        let outcome = run_with(&session, &out, params);
        (fs::read(out.join("base.ply")).unwrap(), outcome)
    };
    let (refined, outcome) = base("refined", true, true);
    let told = &outcome.report.warnings;
    assert!(told.iter().any(|told| told.contains("gamma")), "{told:?}");
    assert!(base("fused", true, false).0 == refined);
    assert!(base("believed", false, false).0 != refined);
}

#[test]
fn a_focal_length_that_the_scan_tells_goes_with_its_images_and_into_the_report() {
    let root = tempfile::tempdir().unwrap();
    let [session, out] = ["plaque", "out"].map(|name| root.path().join(name));
    let mut camera = SimulatedCamera::kinect1_plaque(30, 1);
    let truth = camera.info().intrinsics;
    let mut said = camera.info().clone();
    said.intrinsics.fx *= 0.974;
    said.intrinsics.fy *= 0.974;
    record_as(&said, &mut camera, &session);
    let outcome = run_with(
        &session,
        &out,
        params(2, Calibration::shipped_for(&said).unwrap()),
    );
    let told = &outcome.report.warnings;
    let is_told = told.iter().any(|told| told.contains("% longer"));
    assert!(is_told, "{told:?}");
    let images = fs::read_dir(out.join("snapshots")).unwrap();
    let metas = images.map(|image| fs::read(image.unwrap().path().join("meta.json")).unwrap());
    let metas: Vec<Value> = metas
        .map(|meta| serde_json::from_slice(&meta).unwrap())
        .collect();
    assert!(!metas.is_empty());
    for meta in metas {
        for (key, truth) in [("fx", truth.fx), ("fy", truth.fy)] {
            let found = meta["intrinsics"][key].as_f64().unwrap();
            assert!((found / truth - 1.0).abs() < 0.012, "{key}: {found}");
        }
    }
}

/// The recording again, with the IR image's content moved right and down.
fn record_with_shifted_infrared(session: &Path, [right, down]: [usize; 2]) {
    let mut camera = small_camera(N_FRAMES, 2);
    let mut writer = SessionWriter::create(session, camera.info(), 5000.0).unwrap();
    while let Some(mut frame) = camera.grab(Duration::ZERO).unwrap() {
        let ir = frame.ir.take().unwrap();
        let mut shifted = Image::filled(ir.width(), ir.height(), 0);
        for v in down..ir.height() {
            let row = &mut shifted.data_mut()[v * ir.width()..(v + 1) * ir.width()];
            row[right..].copy_from_slice(&ir.row(v - down)[..ir.width() - right]);
        }
        frame.ir = Some(shifted);
        writer.write(&frame).unwrap();
    }
    writer.finish().unwrap();
}

#[test]
fn a_known_offset_of_the_infrared_image_changes_nothing_but_its_border() {
    let root = tempfile::tempdir().unwrap();
    let offset = Calibration {
        ir_offset_px: [5.0, 4.0],
        ..shipped()
    };
    let mut meshes = Vec::new();
    for (name, shift, calibration) in [("still", [0, 0], shipped()), ("shifted", [5, 4], offset)] {
        let session = root.path().join(name);
        record_with_shifted_infrared(&session, shift);
        let out = root.path().join(format!("{name}-out"));
        run(&session, &out, 2, calibration.clone());
        // A recording keeps what the camera delivered, and what it takes to make the same of it again.
        let again = root.path().join(format!("{name}-again"));
        run(&out.join("recording"), &again, 2, calibration.clone());
        let recorded = fs::read_to_string(out.join("recording/calibration.toml")).unwrap();
        assert_eq!(Calibration::from_toml(&recorded), Ok(calibration));
        for name in ["base.ply", "refined.ply"] {
            let same = fs::read(out.join(name)).unwrap() == fs::read(again.join(name)).unwrap();
            assert!(same, "{name} of the recording differs");
        }
        meshes.push(read_ply(&out.join("refined.ply")).unwrap());
    }
    let [still, shifted] = &meshes[..] else {
        panic!("two meshes");
    };
    assert_eq!(still.vertices.len(), shifted.vertices.len());
    let pairs = still.vertices.iter().zip(&shifted.vertices);
    let largest_m = pairs.map(|(a, b)| (a - b).norm()).fold(0.0, f64::max);
    assert!(largest_m < 1e-4, "{largest_m}");
}
