//! `relief record`: a live device into a folder, decoded or raw.

use super::{
    run::{Verdict, calibrations},
    stdout::Stdout,
    summary::with_causes,
};
use anyhow::{Context, ensure};
use clap::Args;
use depth_camera::{CameraError, DepthCamera, Frame};
use mcap_session::RecordingError;
use relief::{
    config::{self, CalibrationPlaces, Config, Overrides},
    control::{self, Stderr},
    devices::{self, LiveCamera, RecordedCamera},
};
use replay::{SessionWriter, WriteError};
use serde::Serialize;
use std::{
    io::Write,
    path::{self, Path, PathBuf},
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
    /// End after so many seconds; else at SIGINT, SIGTERM or SIGHUP
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

/// How often it is looked how much room the disk has.
const LOOK: Duration = Duration::from_millis(500);

/// What was recorded.
#[derive(Clone, Debug, Default, Serialize)]
struct Summary {
    /// `complete` or `failed`.
    status: &'static str,
    /// What ended it before it was to end.
    failures: Vec<String>,
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
    let limits = Limits {
        duration: args.seconds.map(Duration::from_secs_f64),
        folder: args.out.clone(),
        floor_bytes: config.capture.min_free_bytes(),
    };
    limits.check_room()?;
    let camera = devices::connect(&args.device, &params)?;
    // What the driver was told of it is of use only to the kind of device that it is for, which is known by now.
    let found = config::find_calibration(camera.info(), &places)?;
    if let Some(warning) = found.of_another(camera.info()) {
        tracing::warn!("{warning}");
    }
    let sink = Sink::create(
        camera,
        &args.out,
        args.raw,
        config.capture.record_depth_units_per_metre,
    )
    .context("cannot record")?;
    let (summary, verdict) = control::until_stopped(move |stop| run(sink, &limits, stop))?;
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
    for failure in &summary.failures {
        writeln!(Stderr, "error: {failure}")?;
    }
    Ok(verdict)
}

/// What the ends of a recording mean for the exit code.
fn verdict_of(errors: &[anyhow::Error]) -> Verdict {
    let lacks_room = |error: &anyhow::Error| Verdict::of_error(error) == Verdict::StorageFailed;
    match errors {
        [] => Verdict::Done,
        errors if errors.iter().all(lacks_room) => Verdict::StorageFailed,
        _ => Verdict::Failed,
    }
}

/// Where a recording ends, unless somebody stops it.
struct Limits {
    duration: Option<Duration>,
    /// Where it lies.
    folder: PathBuf,
    /// Room that is left on that disk.
    floor_bytes: u64,
}

impl Limits {
    /// Looks whether the disk has room. The folder may not be there yet.
    fn check_room(&self) -> anyhow::Result<()> {
        let folder = path::absolute(&self.folder)?;
        let present = folder.ancestors().find(|folder| folder.exists());
        let free_bytes = mcap_session::free_bytes(present.unwrap_or(&folder))?;
        if free_bytes >= self.floor_bytes {
            return Ok(());
        }
        let error = RecordingError::DiskFloor {
            folder,
            free_bytes,
            floor_bytes: self.floor_bytes,
        };
        Err(anyhow::Error::new(error).context("no room to record (capture.min_free_disk_mb)"))
    }
}

/// The camera, and where its frames go.
enum Sink {
    Frames {
        camera: LiveCamera,
        writer: SessionWriter,
        n_written: usize,
    },
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
        Ok(Sink::Frames {
            camera,
            writer,
            n_written: 0,
        })
    }

    fn camera(&mut self) -> &mut dyn DepthCamera {
        match self {
            Sink::Frames { camera, .. } => camera,
            Sink::Raw(camera) => camera,
        }
    }

    /// Writes a frame that was grabbed; says whether the recording goes on.
    fn write(&mut self, frame: &Frame) -> Result<bool, WriteError> {
        match self {
            Sink::Raw(camera) => Ok(camera.is_recording()),
            Sink::Frames {
                writer, n_written, ..
            } => match writer.write(frame) {
                Err(error @ WriteError::Frame { .. }) => {
                    tracing::warn!(%error, "not recorded");
                    Ok(true)
                }
                written => {
                    written?;
                    *n_written += 1;
                    Ok(true)
                }
            },
        }
    }

    fn n_written(&self) -> usize {
        match self {
            Sink::Frames { n_written, .. } => *n_written,
            Sink::Raw(camera) => camera.n_recorded(),
        }
    }

    fn finish(self) -> Result<(), WriteError> {
        match self {
            Sink::Frames { writer, .. } => writer.finish().map(|_| ()),
            Sink::Raw(camera) => camera.finish(),
        }
    }
}

/// Records up to a limit, until the flag is set, or something fails.
fn run(mut sink: Sink, limits: &Limits, stop: &AtomicBool) -> (Summary, Verdict) {
    let start = Instant::now();
    let mut summary = Summary {
        status: "complete",
        serial: sink.camera().info().serial.clone(),
        ..Summary::default()
    };
    let ended = take_frames(&mut sink, limits, &mut summary, stop);
    summary.seconds = start.elapsed().as_secs_f64();
    summary.recorded = sink.n_written();
    let finished = sink.finish().map_err(anyhow::Error::from);
    let ends = [ended, finished].into_iter();
    let errors: Vec<anyhow::Error> = ends.filter_map(Result::err).collect();
    if !errors.is_empty() {
        summary.status = "failed";
    }
    summary.failures = errors.iter().map(with_causes).collect();
    (summary, verdict_of(&errors))
}

/// Writes frames until the time is over, the flag is set, the disk is nearly full, or the device fails in another way than by
/// being unplugged.
fn take_frames(
    sink: &mut Sink,
    limits: &Limits,
    summary: &mut Summary,
    stop: &AtomicBool,
) -> anyhow::Result<()> {
    let start = Instant::now();
    let mut looked = start;
    let mut next_id = None;
    let is_over = || {
        let is_late = |duration| start.elapsed() >= duration;
        stop.load(Ordering::Relaxed) || limits.duration.is_some_and(is_late)
    };
    while !is_over() {
        if looked.elapsed() >= LOOK {
            limits.check_room()?;
            looked = Instant::now();
        }
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
                tracing::warn!("unplugged, or silent: plug it in again and recording goes on");
                summary.unplugged += 1;
                continue;
            }
            Err(error) => return Err(error.into()),
        };
        summary.missed += frame_id - next_id.unwrap_or(frame_id);
        next_id = Some(frame_id + 1);
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::io::ErrorKind;

    #[test]
    fn a_disk_without_room_is_told_of_before_there_is_a_folder() {
        let root = tempfile::tempdir().unwrap();
        let check = |floor_bytes| {
            let limits = Limits {
                duration: None,
                folder: root.path().join("new/recording"),
                floor_bytes,
            };
            limits.check_room()
        };
        assert!(check(0).is_ok());
        let error = check(u64::MAX).unwrap_err();
        let told = with_causes(&error);
        assert!(told.contains("capture.min_free_disk_mb"), "{told}");
        assert!(told.contains("bytes are free on the disk of"), "{told}");
        assert_eq!(Verdict::of_error(&error), Verdict::StorageFailed);
    }

    #[test]
    fn a_recording_that_only_lacks_room_has_a_code_of_its_own() {
        let refused = |kind: ErrorKind| {
            anyhow::Error::from(WriteError::Io {
                path: "out/depth/00001.png".into(),
                source: kind.into(),
            })
        };
        let verdict = |kinds: &[ErrorKind]| {
            let errors: Vec<_> = kinds.iter().copied().map(refused).collect();
            verdict_of(&errors)
        };
        let (full, missing) = (ErrorKind::StorageFull, ErrorKind::NotFound);
        assert_eq!(verdict(&[]), Verdict::Done);
        assert_eq!(verdict(&[full]), Verdict::StorageFailed);
        assert_eq!(verdict(&[missing]), Verdict::Failed);
        assert_eq!(verdict(&[full, missing]), Verdict::Failed);
    }
}
