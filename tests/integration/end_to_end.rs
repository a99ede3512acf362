//! A recording with known truth through the real pipeline.

use crate::support::{record, small_camera};
use nalgebra::Isometry3;
use relief::{
    capture::CaptureParams,
    export::{read_ply, read_trajectory},
    fusion::FusionParams,
    geometry::motion_between,
    pipeline::{Ending, Outcome, OutputFolder, Pipeline, PipelineParams, WhenFull},
    refine::RefineParams,
    shading::Calibration,
    snapshot::SnapshotParams,
};
use replay::ReplayCamera;
use std::{fs, num::NonZeroUsize, path::Path};

const N_FRAMES: usize = 12;

fn params(n_threads: usize) -> PipelineParams {
    PipelineParams {
        session: "plaque".to_owned(),
        capture: CaptureParams::default(),
        fusion: FusionParams {
            voxel_size_m: 0.003,
            ..FusionParams::default()
        },
        snapshot: SnapshotParams::default(),
        refine: Some(RefineParams {
            edge_length_m: 0.003,
            n_rounds: 2,
            max_steps: 2,
            ..RefineParams::default()
        }),
        calibration: Calibration::shipped(depth_camera::Sensor::Kinect2).unwrap(),
        calibration_source: "shipped".to_owned(),
        roi: None,
        poses: None,
        n_threads: NonZeroUsize::new(n_threads).unwrap(),
        when_full: WhenFull::Block,
        record: true,
        warnings: Vec::new(),
    }
}

fn run(session: &Path, out: &Path, n_threads: usize) -> Outcome {
    let camera = ReplayCamera::open(session).unwrap();
    let folder = OutputFolder::claim(out).unwrap();
    let outcome = Pipeline::spawn(Box::new(camera), params(n_threads), folder)
        .unwrap()
        .join();
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
    let outcome = run(&session, &two, 2);

    let frames = outcome.report.frames;
    assert_eq!((frames.total, frames.fused), (12, 12));
    for name in [
        "base.ply",
        "refined.ply",
        "refined.glb",
        "trajectory.txt",
        "events.jsonl",
        "snapshots/000/ir.png",
        "session/depth.txt",
        "session/calibration.toml",
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

    run(&session, &one, 1);
    for name in ["base.ply", "refined.ply", "trajectory.txt"] {
        let same = fs::read(one.join(name)).unwrap() == fs::read(two.join(name)).unwrap();
        assert!(same, "{name} depends on the number of threads");
    }
}
