//! `relief record`: a live device into a folder, decoded or raw.

use super::{
    run::{Verdict, calibrations},
    stdout::Stdout,
};
use anyhow::{Context, ensure};
use clap::Args;
use depth_camera::{CameraError, DepthCamera, Frame};
use relief::{
    config::{self, CalibrationPlaces, Config, Overrides},
    control,
    devices::{self, LiveCamera, RecordedCamera},
};
use replay::{SessionWriter, WriteError};
use serde::Serialize;
use std::{
    io::Write,
    path::{Path, PathBuf},
    sync::atomic::{AtomicBool, Ordering},
    time::{Duration, Instant},
};

/// `relief record`.
#[derive(Debug, Args)]
pub struct RecordArgs {
    /// Serial number of the device, as `relief devices` lists it
    #[arg(long, value_name = "SERIAL")]
    pub device: String,
    /// Folder for the recording, new or empty
    #[arg(long, value_name = "DIR")]
    pub out: PathBuf,
    /// Record what the device sends, nothing decoded: disparity of a Kinect I, packets of a Kinect II (90 MB/s)
    #[arg(long)]
    pub raw: bool,
    /// End after so many seconds; else at SIGINT or SIGTERM
    #[arg(long, value_name = "N", value_parser = seconds)]
    pub seconds: Option<f64>,
    /// Configuration; keys that it leaves out keep their values from the layers below
    #[arg(long, value_name = "FILE")]
    pub config: Option<PathBuf>,
    /// Calibration of the IR image: a device's own file, or a complete one
    #[arg(long, value_name = "FILE")]
    pub calibration: Option<PathBuf>,
    /// Folder of the calibrations named SERIAL.toml; "calibration" beside the --config file, or here, without it
    #[arg(long, value_name = "DIR")]
    pub calibration_dir: Option<PathBuf>,
    /// Print one JSON object on standard output
    #[arg(long)]
    pub json: bool,
}

/// A duration that makes sense.
fn seconds(text: &str) -> anyhow::Result<f64> {
    let secs: f64 = text
        .parse()
        .with_context(|| format!("\"{text}\" is no number"))?;
    ensure!(
        (0.1..=1e6).contains(&secs),
        "{secs} s, must be 0.1 to 1000000"
    );
    Ok(secs)
}

/// How long one wait for a frame lasts, after which it is looked whether to stop.
const GRAB_TIMEOUT: Duration = Duration::from_millis(200);

/// What was recorded.
#[derive(Clone, Debug, Default, Serialize)]
struct Summary {
    status: &'static str,
    serial: String,
    recorded: usize,
    /// Frames that came damaged.
    damaged: u64,
    /// Frames that the driver counted and nobody could fetch in time, or that were lost on the way.
    missed: u64,
    /// How often the device was unplugged meanwhile.
    unplugged: u64,
    seconds: f64,
}

/// `relief record`.
pub fn record(args: &RecordArgs) -> anyhow::Result<Verdict> {
    let config = Config::layered(args.config.as_deref(), &Overrides::default())?;
    let folder = calibrations(args.calibration_dir.as_deref(), args.config.as_deref())?;
    let places = CalibrationPlaces {
        given: args.calibration.as_deref(),
        folder: &folder,
        session: None,
    };
    let params = config::params_for_device(&args.device, &places, &config.devices)?;
    let camera = devices::connect(&args.device, &params)?;
    let sink = Sink::create(
        camera,
        &args.out,
        args.raw,
        config.capture.record_depth_units_per_metre,
    )
    .context("cannot record")?;
    let limit = args.seconds.map(Duration::from_secs_f64);
    let summary = control::until_stopped(move |stop| run(sink, limit, stop))??;
    match args.json {
        true => writeln!(Stdout, "{}", serde_json::to_string(&summary)?)?,
        false => writeln!(
            Stdout,
            "{} frames of {} recorded in {} ({:.1} s, {} damaged, {} missed)",
            summary.recorded,
            summary.serial,
            args.out.display(),
            summary.seconds,
            summary.damaged,
            summary.missed
        )?,
    }
    Ok(Verdict::Done)
}

/// The camera, and where its frames go.
enum Sink {
    Frames(LiveCamera, SessionWriter),
    Raw(RecordedCamera),
}

impl Sink {
    fn create(
        camera: LiveCamera,
        folder: &Path,
        raw: bool,
        depth_units_per_metre: f64,
    ) -> Result<Self, WriteError> {
        if raw {
            return RecordedCamera::create(camera, folder).map(Sink::Raw);
        }
        let writer = SessionWriter::create(folder, camera.info(), depth_units_per_metre)?;
        Ok(Sink::Frames(camera, writer))
    }

    fn camera(&mut self) -> &mut dyn DepthCamera {
        match self {
            Sink::Frames(camera, _) => camera,
            Sink::Raw(camera) => camera,
        }
    }

    /// Writes a frame that was grabbed; says whether the recording goes on.
    fn write(&mut self, frame: &Frame) -> Result<bool, WriteError> {
        match self {
            Sink::Raw(camera) => Ok(camera.is_recording()),
            Sink::Frames(_, writer) => match writer.write(frame) {
                Err(error @ WriteError::Frame { .. }) => {
                    tracing::warn!(%error, "not recorded");
                    Ok(true)
                }
                written => written.map(|()| true),
            },
        }
    }

    fn finish(self) -> Result<usize, WriteError> {
        match self {
            Sink::Frames(_, writer) => writer.finish(),
            Sink::Raw(camera) => camera.finish(),
        }
    }
}

/// Records until the time is over, the flag is set, or the device fails in another way than by being unplugged.
fn run(mut sink: Sink, limit: Option<Duration>, stop: &AtomicBool) -> anyhow::Result<Summary> {
    let start = Instant::now();
    let mut summary = Summary {
        status: "complete",
        serial: sink.camera().info().serial.clone(),
        ..Summary::default()
    };
    let mut next_id = None;
    let is_over = || stop.load(Ordering::Relaxed) || limit.is_some_and(|l| start.elapsed() >= l);
    while !is_over() {
        let frame_id = match sink.camera().grab(GRAB_TIMEOUT) {
            Ok(None) => break,
            Ok(Some(frame)) => {
                if !sink.write(&frame)? {
                    break;
                }
                frame.frame_id
            }
            Err(CameraError::DamagedFrame { frame_id, reason }) => {
                tracing::warn!(frame_id, reason, "damaged frame");
                summary.damaged += 1;
                frame_id
            }
            Err(CameraError::Timeout { .. } | CameraError::NotDue) => continue,
            Err(CameraError::Disconnected) => {
                tracing::warn!("unplugged: plug it in again and recording goes on");
                summary.unplugged += 1;
                continue;
            }
            Err(error) => {
                // What there is stays a whole recording.
                sink.finish()?;
                return Err(error.into());
            }
        };
        summary.missed += frame_id - next_id.unwrap_or(frame_id);
        next_id = Some(frame_id + 1);
    }
    summary.seconds = start.elapsed().as_secs_f64();
    summary.recorded = sink.finish()?;
    Ok(summary)
}
