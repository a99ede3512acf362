//! `relief bench`: a recording through tracking and fusion alone, and what each step of a frame costs.
//!
//! Processor time is that of the whole process, all threads together, which other work on the machine disturbs less than
//! wall time. Reading the recording is not measured. This is scoring: where the recording has measured poses, they are read.

use super::{
    BenchArgs,
    run::{self, Verdict},
};
use anyhow::Context;
use depth_camera::{DepthCamera, Image};
use relief::{
    config::Config,
    evaluate::{PosePair, TrajectoryError, trajectory_error},
    fusion::{DepthNoise, Fusion, FusionStep, TrackingOutcome},
    geometry::CameraModel,
    pipeline::GivenPoses,
};
use replay::ReplayCamera;
use rustix::time::{ClockId, clock_gettime};
use serde::Serialize;
use std::{
    path::Path,
    time::{Duration, Instant},
};

/// What was measured.
#[derive(Serialize)]
struct Measured {
    session: String,
    voxel_size_m: f64,
    depth_max_m: f64,
    threads: usize,
    frames: Frames,
    /// Median processor time of each step and of a whole frame, all threads together.
    cpu_ms: Vec<StepTime>,
    frame_cpu_ms: f64,
    /// Median wall time of a frame.
    frame_wall_ms: f64,
    /// Frames a second that this wall time allows.
    fps: f64,
    model_bytes: usize,
    mesh: Mesh,
    /// `None` without measured poses.
    trajectory: Option<TrajectoryError>,
}

#[derive(Default, Serialize)]
struct Frames {
    tracked: usize,
    lost: usize,
    without_depth: usize,
}

#[derive(Serialize)]
struct StepTime {
    step: FusionStep,
    median_ms: f64,
}

#[derive(Serialize)]
struct Mesh {
    vertices: usize,
    faces: usize,
    cpu_ms: f64,
    wall_ms: f64,
}

/// `relief bench`.
pub fn bench(args: &BenchArgs) -> anyhow::Result<Verdict> {
    let config = Config::layered(args.config.as_deref(), &args.overrides())?;
    let mut camera = ReplayCamera::open(&args.session)?;
    let n_threads = args.threads.unwrap_or_else(run::all_processors);
    let pool = rayon::ThreadPoolBuilder::new()
        .num_threads(n_threads.get())
        .build()?;
    let truth = measured_poses(&args.session)?;
    let mut run = Run::new(&camera, &config);
    while let Some(frame) = camera.grab(Duration::ZERO)? {
        if let Some(depth) = &frame.depth {
            pool.install(|| run.fuse(depth, frame.device_time_secs, truth.as_ref()));
        }
    }
    let mesh = pool.install(|| run.mesh());
    let measured = Measured {
        session: run::session_name(&args.session),
        voxel_size_m: config.fusion.voxel_size_m,
        depth_max_m: config.fusion.depth_max_m,
        threads: n_threads.get(),
        cpu_ms: run.step_medians(),
        frame_cpu_ms: median(&mut run.frames_cpu_ms),
        frame_wall_ms: median(&mut run.frames_wall_ms),
        fps: 1e3 / median(&mut run.frames_wall_ms),
        frames: run.frames,
        model_bytes: run.fusion.memory_bytes(),
        mesh,
        trajectory: truth.and_then(|_| trajectory_error(&run.pairs)),
    };
    match args.json {
        true => println!("{}", serde_json::to_string(&measured)?),
        false => print_text(&measured),
    }
    Ok(Verdict::Done)
}

/// The measured poses that lie beside a recording, if there are any.
fn measured_poses(session: &Path) -> anyhow::Result<Option<GivenPoses>> {
    let path = session.join("groundtruth.txt");
    if !path.exists() {
        return Ok(None);
    }
    let poses = replay::read_poses(&path).context("measured poses")?;
    Ok(Some(GivenPoses::new(&poses)))
}

/// What is in hand while frames are fused.
struct Run {
    fusion: Fusion,
    frames: Frames,
    /// Processor time of every step of every frame that was fused, milliseconds.
    steps_cpu_ms: [Vec<f64>; FusionStep::ALL.len()],
    frames_cpu_ms: Vec<f64>,
    frames_wall_ms: Vec<f64>,
    pairs: Vec<PosePair>,
}

impl Run {
    fn new(camera: &ReplayCamera, config: &Config) -> Self {
        let info = camera.info();
        Run {
            fusion: Fusion::new(
                CameraModel::new(info.intrinsics),
                DepthNoise::of_sensor(info.sensor),
                config.fusion.clone(),
            ),
            frames: Frames::default(),
            steps_cpu_ms: Default::default(),
            frames_cpu_ms: Vec::new(),
            frames_wall_ms: Vec::new(),
            pairs: Vec::new(),
        }
    }

    fn fuse(&mut self, depth: &Image<f32>, time_secs: f64, truth: Option<&GivenPoses>) {
        let (start_cpu_ms, start) = (process_cpu_ms(), Instant::now());
        let mut last_ms = start_cpu_ms;
        let steps = &mut self.steps_cpu_ms;
        let outcome = self.fusion.fuse_observed(depth, time_secs, &mut |step| {
            let now_ms = process_cpu_ms();
            steps[step as usize].push(now_ms - last_ms);
            last_ms = now_ms;
        });
        match outcome {
            TrackingOutcome::Tracked {
                world_from_camera, ..
            } => {
                self.frames.tracked += 1;
                self.frames_cpu_ms.push(process_cpu_ms() - start_cpu_ms);
                self.frames_wall_ms
                    .push(1e3 * start.elapsed().as_secs_f64());
                let truth = truth.and_then(|poses| poses.at(time_secs));
                self.pairs.extend(truth.map(|truth| PosePair {
                    estimate: world_from_camera,
                    truth,
                }));
            }
            TrackingOutcome::Lost(_) => self.frames.lost += 1,
            TrackingOutcome::NoDepth => self.frames.without_depth += 1,
        }
    }

    fn mesh(&self) -> Mesh {
        let (start_cpu_ms, start) = (process_cpu_ms(), Instant::now());
        let mesh = self.fusion.mesh();
        Mesh {
            vertices: mesh.vertices.len(),
            faces: mesh.faces.len(),
            cpu_ms: process_cpu_ms() - start_cpu_ms,
            wall_ms: 1e3 * start.elapsed().as_secs_f64(),
        }
    }

    fn step_medians(&mut self) -> Vec<StepTime> {
        FusionStep::ALL
            .into_iter()
            .map(|step| StepTime {
                step,
                median_ms: median(&mut self.steps_cpu_ms[step as usize]),
            })
            .collect()
    }
}

/// Processor time of this process so far, all threads together.
fn process_cpu_ms() -> f64 {
    let time = clock_gettime(ClockId::ProcessCPUTime);
    1e3 * time.tv_sec as f64 + 1e-6 * time.tv_nsec as f64
}

/// The median; 0 of nothing.
fn median(values: &mut [f64]) -> f64 {
    if values.is_empty() {
        return 0.0;
    }
    let middle = values.len() / 2;
    *values.select_nth_unstable_by(middle, f64::total_cmp).1
}

fn print_text(measured: &Measured) {
    let Frames {
        tracked,
        lost,
        without_depth,
    } = measured.frames;
    println!(
        "{}: voxels of {} mm, depth to {} m, {} threads",
        measured.session,
        1e3 * measured.voxel_size_m,
        measured.depth_max_m,
        measured.threads
    );
    println!("frames: {tracked} tracked, {lost} lost, {without_depth} without depth");
    println!("processor time a frame, all threads together, median ms:");
    for time in &measured.cpu_ms {
        println!(
            "  {:<14}{:>8.2}",
            format!("{:?}", time.step),
            time.median_ms
        );
    }
    println!("  {:<14}{:>8.2}", "frame", measured.frame_cpu_ms);
    println!(
        "wall time a frame: {:.2} ms, {:.0} frames/s",
        measured.frame_wall_ms, measured.fps
    );
    println!("model: {} MiB", measured.model_bytes >> 20);
    let mesh = &measured.mesh;
    println!(
        "mesh: {} vertices, {} faces, {:.1} ms of processor time, {:.1} ms",
        mesh.vertices, mesh.faces, mesh.cpu_ms, mesh.wall_ms
    );
    if let Some(error) = &measured.trajectory {
        println!(
            "trajectory: RMSE {:.2} mm, largest error {:.2} mm over {} poses",
            1e3 * error.rmse_m,
            1e3 * error.max_m,
            error.n_pairs
        );
    }
}
