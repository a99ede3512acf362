//! What `relief bench` measured, as text and as JSON.

use crate::cli::stdout::Stdout;
use relief::{evaluate::TrajectoryError, fusion::FusionStep};
use serde::Serialize;
use std::io::{self, Write};

/// What was measured.
#[derive(Serialize)]
pub(super) struct Measured {
    pub(super) session: String,
    pub(super) voxel_size_m: f64,
    pub(super) depth_max_m: f64,
    pub(super) threads: usize,
    pub(super) frames: Frames,
    /// Median processor time of what is taken off a frame's depth before it is tracked, not among its steps; 0 where that is nothing.
    pub(super) depth_correction_cpu_ms: f64,
    /// Processor time of each step of tracked frames, all threads together.
    pub(super) cpu_ms: Vec<StepTime>,
    #[serde(flatten)]
    pub(super) frame: FrameTime,
    /// Tracked frames by how far they were from being lost; `None` where none was.
    pub(super) fitness: Option<Fitness>,
    pub(super) model_bytes: usize,
    /// What was seen and found no place in the model, as a sentence; `None` if everything did.
    pub(super) refusal: Option<String>,
    /// Largest resident memory of the process, the recording's images among it; `None` where the system does not tell.
    pub(super) peak_memory_bytes: Option<u64>,
    pub(super) mesh: Mesh,
    pub(super) live_mesh: LiveMeshTime,
    /// `None` without measured poses.
    pub(super) trajectory: Option<TrajectoryError>,
}

#[derive(Default, Serialize)]
pub(super) struct Frames {
    pub(super) tracked: usize,
    pub(super) lost: usize,
    pub(super) without_depth: usize,
    pub(super) damaged: usize,
}

#[derive(Serialize)]
pub(super) struct StepTime {
    pub(super) step: FusionStep,
    /// Frames that took it.
    pub(super) n_frames: usize,
    /// Median over these; `None` where there are none.
    pub(super) median_ms: Option<f64>,
    /// Mean over all tracked frames; `None` where there are none.
    pub(super) mean_ms: Option<f64>,
}

/// What a whole frame takes that is tracked; `None` where none was.
#[derive(Serialize)]
pub(super) struct FrameTime {
    /// Median processor time, all threads together.
    pub(super) frame_cpu_ms: Option<f64>,
    /// Its mean.
    pub(super) frame_mean_cpu_ms: Option<f64>,
    /// Median wall time.
    pub(super) frame_wall_ms: Option<f64>,
    /// Frames a second that this wall time allows.
    pub(super) fps: Option<f64>,
}

#[derive(Serialize)]
pub(super) struct Mesh {
    pub(super) vertices: usize,
    pub(super) faces: usize,
    pub(super) cpu_ms: f64,
    pub(super) wall_ms: f64,
}

#[derive(Serialize)]
pub(super) struct Fitness {
    pub(super) median: f64,
    pub(super) least: f64,
    /// The least of how firmly the geometry held the camera: see [`Fit::held_share`](relief::fusion::Fit::held_share).
    pub(super) least_held_share: f64,
}

/// What it takes to bring the live mesh up to the model.
#[derive(Serialize)]
pub(super) struct LiveMeshTime {
    pub(super) every_frames: usize,
    /// Medians over the refreshes.
    pub(super) cpu_ms: f64,
    pub(super) wall_ms: f64,
    pub(super) patches: usize,
}

impl Measured {
    /// Prints it as text.
    pub(super) fn print(&self) -> io::Result<()> {
        let Frames {
            tracked,
            lost,
            without_depth,
            damaged,
        } = self.frames;
        writeln!(
            Stdout,
            "{}: voxels of {} mm, depth to {} m, {} thread{}",
            self.session,
            1e3 * self.voxel_size_m,
            self.depth_max_m,
            self.threads,
            if self.threads == 1 { "" } else { "s" }
        )?;
        writeln!(
            Stdout,
            "frames: {tracked} tracked, {lost} lost, {without_depth} without depth, {damaged} damaged"
        )?;
        writeln!(
            Stdout,
            "processor time a frame, all threads together, ms: median of those that take a step, mean of all"
        )?;
        writeln!(
            Stdout,
            "  {:<16}{:>6.2}, before it is tracked",
            "depth correction", self.depth_correction_cpu_ms
        )?;
        for time in &self.cpu_ms {
            if let (Some(median_ms), Some(mean_ms)) = (time.median_ms, time.mean_ms) {
                let step = in_words(time.step);
                writeln!(Stdout, "  {step:<14}{median_ms:>8.2}{mean_ms:>8.2}")?;
            }
        }
        let frame = &self.frame;
        if let (Some(median_ms), Some(mean_ms)) = (frame.frame_cpu_ms, frame.frame_mean_cpu_ms) {
            writeln!(Stdout, "  {:<14}{median_ms:>8.2}{mean_ms:>8.2}", "frame")?;
        }
        if let (Some(wall_ms), Some(fps)) = (frame.frame_wall_ms, frame.fps) {
            writeln!(
                Stdout,
                "wall time a frame: {wall_ms:.2} ms, {fps:.0} frames/s without depth correction"
            )?;
        }
        if let Some(fitness) = &self.fitness {
            writeln!(
                Stdout,
                "fitness: median {:.2}, least {:.2}; held by the geometry: {:.4} at least",
                fitness.median, fitness.least, fitness.least_held_share
            )?;
        }
        writeln!(Stdout, "model: {} MiB", self.model_bytes >> 20)?;
        if let Some(refusal) = &self.refusal {
            writeln!(Stdout, "{refusal}")?;
        }
        if let Some(bytes) = self.peak_memory_bytes {
            writeln!(Stdout, "largest resident memory: {} MiB", bytes >> 20)?;
        }
        let live = &self.live_mesh;
        writeln!(
            Stdout,
            "live mesh every {} frames: {} patches, {:.1} ms of processor time, {:.1} ms",
            live.every_frames, live.patches, live.cpu_ms, live.wall_ms
        )?;
        let mesh = &self.mesh;
        writeln!(
            Stdout,
            "mesh: {} vertices, {} faces, {:.1} ms of processor time, {:.1} ms",
            mesh.vertices, mesh.faces, mesh.cpu_ms, mesh.wall_ms
        )?;
        if let Some(error) = &self.trajectory {
            writeln!(
                Stdout,
                "trajectory while tracking, loops open: RMSE {:.2} mm, largest error {:.2} mm over {} poses",
                1e3 * error.rmse_m,
                1e3 * error.max_m,
                error.n_pairs
            )?;
        }
        Ok(())
    }
}

fn in_words(step: FusionStep) -> &'static str {
    match step {
        FusionStep::Preprocess => "preprocess",
        FusionStep::Icp => "ICP",
        FusionStep::SdfAlignment => "distances",
        FusionStep::Allocate => "band",
        FusionStep::Integrate => "integrate",
        FusionStep::Raycast => "raycast",
        FusionStep::Remember => "remember",
    }
}
