//! `relief bench`: a recording through depth correction, tracking and fusion alone, and what each step of a frame costs.
//!
//! Processor time is that of the whole process, all threads together, which other work on the machine disturbs less than
//! wall time. Reading the recording is not measured. This is scoring: where the recording has measured poses, they are read.
//! The live mesh is brought up to the model after every tenth frame that is tracked, which is measured by itself.

mod report;

use super::{
    BenchArgs,
    processor_time::process_cpu_secs,
    run::{self, Verdict},
    stdout::Stdout,
};
use anyhow::Context;
use depth_camera::{CameraInfo, Frame, Image};
use relief::{
    capture::IrOffset,
    config::{self, CalibrationPlaces, Config, FoundCalibration},
    depth_correction::DepthCorrection,
    devices::open_recording,
    evaluate::{PosePair, trajectory_error},
    fusion::{DepthNoise, Fit, Fusion, FusionStep, InfraredOptics, LiveMesh, TrackingOutcome},
    geometry::CameraModel,
    pipeline::{GivenPoses, infrared_optics, peak_memory_bytes},
    robust,
    shading::Calibration,
};
use replay::Pacing;
use report::{Fitness, FrameTime, Frames, LiveMeshTime, Measured, Mesh, StepTime};
use std::{io::Write, path::Path, time::Instant};

/// The live mesh is looked at three times a second.
const LIVE_EVERY_FRAMES: usize = 10;

/// `relief bench`.
pub fn bench(args: &BenchArgs) -> anyhow::Result<Verdict> {
    let config = Config::layered(args.config.as_deref(), &args.overrides())?;
    let pacing = Pacing::AsFastAsPossible;
    let mut camera = open_recording(&args.session, &config.devices, pacing)?;
    run::tell_unknown_keys(&args.session);
    let n_threads = args.threads.unwrap_or_else(run::all_processors);
    let pool = rayon::ThreadPoolBuilder::new()
        .num_threads(n_threads.get())
        .build()?;
    let truth = measured_poses(&args.session)?;
    let calibration = found_calibration(args, camera.info())?.calibration;
    let ir_offset = IrOffset::nearest(calibration.ir_offset_px);
    let infrared = infrared_optics(&config.fusion, &calibration, camera.info());
    let mut run = Run::new(camera.info(), &config, &calibration, infrared);
    while let Some(frame) = run::next_frame(camera.as_mut(), &mut run.frames.damaged)? {
        let frame = pool.install(|| run.corrected(ir_offset.remove_from(frame)));
        if let Some(depth) = &frame.depth {
            if let Some(ir) = &frame.ir {
                run.fusion.see(ir);
            }
            pool.install(|| run.fuse(depth, frame.device_time_secs, truth.as_ref()));
        }
    }
    let mesh = pool.install(|| run.mesh());
    let measured = Measured {
        session: run::session_name(&args.session),
        voxel_size_m: config.fusion.voxel_size_m,
        depth_max_m: config.fusion.depth_max_m,
        threads: n_threads.get(),
        depth_correction_cpu_ms: median(&mut run.corrections_cpu_ms),
        cpu_ms: run.step_times(),
        frame: run.frame_time(),
        fitness: run.fitness(),
        model_bytes: run.fusion.memory_bytes(),
        refusal: run.fusion.refusal(),
        peak_memory_bytes: peak_memory_bytes(),
        mesh,
        live_mesh: run.live_mesh_time(),
        frames: run.frames,
        trajectory: truth.and_then(|_| trajectory_error(&run.pairs)),
    };
    match args.json {
        true => writeln!(Stdout, "{}", serde_json::to_string(&measured)?)?,
        false => measured.print()?,
    }
    Ok(Verdict::Done)
}

/// The calibration that a replay would take.
fn found_calibration(args: &BenchArgs, info: &CameraInfo) -> anyhow::Result<FoundCalibration> {
    let places = CalibrationPlaces {
        given: None,
        folder: &run::calibration_folder(None, args.config.as_deref()),
        session: Some(&args.session),
    };
    Ok(config::find_calibration(info, &places)?)
}

/// The measured poses that lie beside a recording, if there are any.
fn measured_poses(session: &Path) -> anyhow::Result<Option<GivenPoses>> {
    let path = config::session_folder(session).join("groundtruth.txt");
    if !path.exists() {
        return Ok(None);
    }
    let poses = replay::read_poses(&path).context("measured poses")?;
    Ok(Some(GivenPoses::new(&poses)))
}

/// What is in hand while frames are fused.
struct Run {
    correction: DepthCorrection,
    fusion: Fusion,
    frames: Frames,
    /// Processor time of every step of every frame that was fused, milliseconds.
    steps_cpu_ms: [Vec<f64>; FusionStep::ALL.len()],
    corrections_cpu_ms: Vec<f64>,
    frames_cpu_ms: Vec<f64>,
    frames_wall_ms: Vec<f64>,
    fits: Vec<Fit>,
    live_mesh: LiveMesh,
    refresh_cpu_ms: Vec<f64>,
    refresh_wall_ms: Vec<f64>,
    refresh_patches: Vec<f64>,
    pairs: Vec<PosePair>,
}

impl Run {
    fn new(
        info: &CameraInfo,
        config: &Config,
        calibration: &Calibration,
        infrared: Option<InfraredOptics>,
    ) -> Self {
        let model = CameraModel::new(info.intrinsics);
        let noise = DepthNoise::of_sensor(info.sensor);
        let fusion = Fusion::new(model, noise, config.fusion.clone()).by_turns();
        let has_multipath = config.multipath.enabled;
        Run {
            correction: DepthCorrection::new(info, calibration, has_multipath, &config.fusion),
            fusion: match infrared {
                Some(optics) => fusion.with_infrared(model, optics),
                None => fusion,
            },
            frames: Frames::default(),
            steps_cpu_ms: Default::default(),
            corrections_cpu_ms: Vec::new(),
            frames_cpu_ms: Vec::new(),
            frames_wall_ms: Vec::new(),
            fits: Vec::new(),
            live_mesh: LiveMesh::default(),
            refresh_cpu_ms: Vec::new(),
            refresh_wall_ms: Vec::new(),
            refresh_patches: Vec::new(),
            pairs: Vec::new(),
        }
    }

    /// A frame without the errors of its depth that are known.
    fn corrected(&mut self, frame: Frame) -> Frame {
        self.correction.thin_out(&self.fusion);
        let start_cpu_ms = process_cpu_ms();
        let Some(corrected) = self.correction.correct(&frame) else {
            return frame;
        };
        self.corrections_cpu_ms
            .push(process_cpu_ms() - start_cpu_ms);
        corrected
    }

    /// Fuses a frame; after some that are tracked the live mesh is refreshed. Those that are lost change nothing.
    fn fuse(&mut self, depth: &Image<f32>, time_secs: f64, truth: Option<&GivenPoses>) {
        let (start_cpu_ms, start) = (process_cpu_ms(), Instant::now());
        let mut last_ms = start_cpu_ms;
        let mut steps = [None; FusionStep::ALL.len()];
        let outcome = self.fusion.fuse_observed(depth, time_secs, &mut |step| {
            let now_ms = process_cpu_ms();
            // Distances are gone by twice where a frame does not lie where the motion leads.
            *steps[step as usize].get_or_insert(0.0) += now_ms - last_ms;
            last_ms = now_ms;
        });
        match outcome {
            TrackingOutcome::Tracked {
                world_from_camera,
                fit,
            } => {
                self.frames.tracked += 1;
                self.fits.extend(fit);
                for (all, of_frame) in self.steps_cpu_ms.iter_mut().zip(steps) {
                    all.extend(of_frame);
                }
                self.frames_cpu_ms.push(process_cpu_ms() - start_cpu_ms);
                self.frames_wall_ms
                    .push(1e3 * start.elapsed().as_secs_f64());
                let truth = truth.and_then(|poses| poses.at(time_secs));
                self.pairs.extend(truth.map(|truth| PosePair {
                    estimate: world_from_camera,
                    truth,
                }));
                if self.frames.tracked.is_multiple_of(LIVE_EVERY_FRAMES) {
                    self.refresh();
                }
            }
            TrackingOutcome::Lost(_) => self.frames.lost += 1,
            TrackingOutcome::NoDepth => self.frames.without_depth += 1,
        }
    }

    /// Brings the live mesh up to the model.
    fn refresh(&mut self) {
        let (start_cpu_ms, start) = (process_cpu_ms(), Instant::now());
        let changed = self.fusion.refresh(&mut self.live_mesh);
        self.refresh_cpu_ms.push(process_cpu_ms() - start_cpu_ms);
        self.refresh_wall_ms
            .push(1e3 * start.elapsed().as_secs_f64());
        self.refresh_patches.push(changed.len() as f64);
    }

    fn frame_time(&mut self) -> FrameTime {
        let wall_ms = robust::median(&mut self.frames_wall_ms);
        FrameTime {
            frame_mean_cpu_ms: mean(&self.frames_cpu_ms, self.frames.tracked),
            frame_cpu_ms: robust::median(&mut self.frames_cpu_ms),
            frame_wall_ms: wall_ms,
            fps: wall_ms.map(|wall_ms| 1e3 / wall_ms),
        }
    }

    fn live_mesh_time(&mut self) -> LiveMeshTime {
        LiveMeshTime {
            every_frames: LIVE_EVERY_FRAMES,
            cpu_ms: median(&mut self.refresh_cpu_ms),
            wall_ms: median(&mut self.refresh_wall_ms),
            patches: median(&mut self.refresh_patches) as usize,
        }
    }

    fn fitness(&self) -> Option<Fitness> {
        let least = |of: fn(&Fit) -> f64| self.fits.iter().map(of).min_by(f64::total_cmp);
        let mut fitness: Vec<f64> = self.fits.iter().map(|fit| fit.fitness).collect();
        Some(Fitness {
            least: least(|fit| fit.fitness)?,
            least_held_share: least(|fit| fit.held_share)?,
            median: median(&mut fitness),
        })
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

    fn step_times(&mut self) -> Vec<StepTime> {
        FusionStep::ALL
            .into_iter()
            .map(|step| {
                let of_step = &mut self.steps_cpu_ms[step as usize];
                StepTime {
                    step,
                    n_frames: of_step.len(),
                    mean_ms: mean(of_step, self.frames.tracked),
                    median_ms: robust::median(of_step),
                }
            })
            .collect()
    }
}

/// Of so many values, of which those that are not there are 0; `None` of none.
fn mean(values: &[f64], n: usize) -> Option<f64> {
    (n > 0).then(|| values.iter().sum::<f64>() / n as f64)
}

fn process_cpu_ms() -> f64 {
    1e3 * process_cpu_secs()
}

/// The median; 0 of nothing.
fn median(values: &mut [f64]) -> f64 {
    robust::median(values).unwrap_or(0.0)
}
