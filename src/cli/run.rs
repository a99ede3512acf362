//! What the sub-commands do: configure, build, wait, sum up.

use super::{
    DemoArgs, RefineArgs, ReplayArgs, SimulateArgs, daemon, found_scan::FoundScan, stdout::Stdout,
    stopping::Stopped, summary,
};
use anyhow::{Context, bail};
use depth_camera::{CameraInfo, DepthCamera, Frame, Sensor};
use mcap_session::RecordingError;
pub(super) use relief::control::all_processors;
use relief::{
    atomic_file::is_passing,
    capture::RecordFormat,
    config::{self, CalibrationPlaces, Config, ConfigError},
    control::{self, ControlError, DaemonError, EXIT_INTERRUPTED, Progress},
    devices::open_recording,
    pipeline::{
        EVENTS_FILE, Ending, GivenPoses, Outcome, OutputFolder, OutputFolderError, Pipeline,
        PipelineParams, SpawnError, WhenFull,
    },
};
use replay::{Pacing, SessionWriter, WriteError};
use simulated::SimulatedCamera;
use std::{
    io::Write,
    path::{Path, PathBuf},
    process::ExitCode,
    time::Duration,
};

/// How the program ends.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Verdict {
    /// All is done.
    Done,
    /// Something went wrong.
    Failed,
    /// What was asked for makes no sense.
    BadUsage,
    /// Somebody asked to stop.
    Interrupted,
    /// The daemon's configuration makes no sense.
    BadConfiguration,
    /// The daemon's camera does not answer.
    NoDevice,
    /// The daemon's data directory cannot be used, or a disk does not take what is to be written now and may later.
    StorageFailed,
    /// The system refuses what the daemon needs.
    Internal,
}

impl Verdict {
    /// What an error means for the exit code.
    pub fn of_error(error: &anyhow::Error) -> Self {
        match error.downcast_ref::<DaemonError>() {
            Some(error) => daemon::verdict_of(error),
            None if error.is::<ConfigError>() => Verdict::BadUsage,
            None if error.is::<Stopped>() => Verdict::Interrupted,
            None if lacks_room(error) => Verdict::StorageFailed,
            None => Verdict::Failed,
        }
    }

    fn of_outcome(outcome: &Outcome) -> Self {
        match outcome.ending {
            Ending::Stopped => Verdict::Interrupted,
            Ending::Complete if outcome.failures.is_empty() => Verdict::Done,
            Ending::Complete if outcome.only_lacks_room() => Verdict::StorageFailed,
            Ending::Complete => Verdict::Failed,
        }
    }
}

impl From<Verdict> for ExitCode {
    fn from(verdict: Verdict) -> ExitCode {
        ExitCode::from(match verdict {
            Verdict::Done => 0,
            Verdict::Failed => 1,
            Verdict::BadUsage => 2,
            Verdict::Interrupted => EXIT_INTERRUPTED,
            Verdict::BadConfiguration => 3,
            Verdict::NoDevice => 4,
            Verdict::StorageFailed => 5,
            Verdict::Internal => 70,
        })
    }
}

/// Whether something cannot be written for what the disk may do later.
fn lacks_room(error: &anyhow::Error) -> bool {
    if let Some(OutputFolderError::Io { source, .. }) = error.downcast_ref::<OutputFolderError>() {
        return is_passing(source);
    }
    let of_recording = match error.downcast_ref::<ControlError>() {
        Some(ControlError::Spawn(SpawnError::Recorder(error))) => Some(error),
        _ => error.downcast_ref::<RecordingError>(),
    };
    let of_writing = match of_recording {
        Some(RecordingError::DiskFloor { .. }) => return true,
        Some(RecordingError::Write(error)) => Some(error),
        _ => error.downcast_ref::<WriteError>(),
    };
    matches!(of_writing, Some(WriteError::Io { source, .. }) if is_passing(source))
}

/// `relief replay`.
pub fn replay(args: &ReplayArgs, progress: &Progress) -> anyhow::Result<Verdict> {
    let config = Config::layered(args.config.as_deref(), &args.overrides())?;
    let pacing = match args.realtime {
        true => Pacing::Recorded,
        false => Pacing::AsFastAsPossible,
    };
    let camera = open_recording(&args.session, &config.devices, pacing)?;
    let params = pipeline_params(args, config, camera.info())?;
    let folder = OutputFolder::claim(&args.out)?;
    let outcome = control::operate(|| Pipeline::spawn(camera, params, folder), progress)?;
    let printed = match args.json {
        true => summary::print_json(&outcome),
        false => summary::print_scan(&outcome).map_err(Into::into),
    };
    verdict_when_told(&outcome, printed)
}

/// `relief refine`.
pub fn refine(args: &RefineArgs, progress: &Progress) -> anyhow::Result<Verdict> {
    let limits = args.child.limits();
    limits
        .impose()
        .with_context(|| format!("cannot impose {limits:?} on this process"))?;
    let FoundScan {
        config,
        recorded,
        found,
        too_late,
    } = match args.child.config_alone {
        true => FoundScan::read_alone(&args.scan)?,
        false => FoundScan::read(&args.scan)?,
    };
    let recorded = match args.single_view {
        Some(frame_id) => recorded.single_view(frame_id, &found.calibration)?,
        None => recorded,
    };
    let session = session_name(&args.scan.output);
    let mut params = PipelineParams {
        roi: args.scan.roi.map(|roi| roi.0),
        n_threads: args.scan.threads.unwrap_or_else(all_processors),
        ..control::params_of_run(session, config, found, &recorded.info)
    };
    params.warnings.extend(too_late);
    let folder = OutputFolder::claim(&args.out)?;
    let folder = match &args.child.deliver_to {
        Some(place) => folder.named(place),
        None => folder,
    };
    let outcome = control::operate(
        || Pipeline::spawn_refinement(recorded, params, folder),
        progress,
    )?;
    let printed = match args.json || args.progress_json {
        true => summary::print_json(&outcome),
        false => summary::print_refinement(&outcome).map_err(Into::into),
    };
    verdict_when_told(&outcome, printed)
}

/// The verdict of what was told of; an interruption may be that nobody reads any more, as where a terminal was closed.
fn verdict_when_told(outcome: &Outcome, printed: anyhow::Result<()>) -> anyhow::Result<Verdict> {
    let verdict = Verdict::of_outcome(outcome);
    if verdict != Verdict::Interrupted {
        printed?;
    }
    Ok(verdict)
}

fn pipeline_params(
    args: &ReplayArgs,
    config: Config,
    info: &CameraInfo,
) -> anyhow::Result<PipelineParams> {
    let folder = calibrations(args.calibration_dir.as_deref(), args.config.as_deref())?;
    let places = CalibrationPlaces {
        given: args.calibration.as_deref(),
        folder: &folder,
        session: Some(&args.session),
    };
    let found = config::find_calibration(info, &places)?;
    let poses = match &args.poses {
        Some(path) => Some(given_poses(path, &args.session, &config)?),
        None => None,
    };
    let common = control::params_of_run(session_name(&args.session), config, found, info);
    Ok(PipelineParams {
        is_refined: !args.no_refine,
        warnings: [common.warnings, tell_unknown_keys(&args.session)].concat(),
        roi: args.roi.map(|roi| roi.0),
        poses,
        n_threads: args.threads.unwrap_or_else(all_processors),
        when_full: match args.realtime {
            true => WhenFull::Drop,
            false => WhenFull::Block,
        },
        record: args.record,
        ..common
    })
}

/// The poses of a file, for the frames of a session. Those that no frame is fused at may lie anywhere, as where they were measured on
/// the way to the scene; where some lie beyond the volume the recording tells, played once, whether they matter.
fn given_poses(path: &Path, session: &Path, config: &Config) -> anyhow::Result<GivenPoses> {
    let poses = GivenPoses::new(&replay::read_poses(path)?);
    // From farther off no frame sees anything of the volume.
    let reach_m = config.fusion.reach_m() + config.fusion.depth_max_m;
    if poses.are_within(reach_m) {
        return Ok(poses);
    }
    tracing::info!(poses = %path.display(), "some poses lie beyond the volume: looking whether frames use them");
    let mut camera = open_recording(session, &config.devices, Pacing::AsFastAsPossible)?;
    let mut n_damaged = 0;
    while let Some(frame) = next_frame(camera.as_mut(), &mut n_damaged)? {
        let time_secs = frame.device_time_secs;
        let beyond = poses.at_beyond(time_secs, reach_m);
        if let Some(pose) = beyond.filter(|_| frame.depth.is_some()) {
            let at = pose.translation.vector;
            bail!(
                "{}: the pose at {time_secs:.6} s lies at {:.3} {:.3} {:.3} m, each must be within {reach_m:.3} m of 0, as far as voxels \
                 of {} m reach (fusion.voxel_size_m) and depth beyond them (fusion.depth_max_m): shift the poses so that the scene lies near the origin",
                path.display(),
                at.x,
                at.y,
                at.z,
                config.fusion.voxel_size_m
            );
        }
    }
    Ok(poses)
}

/// `relief demo`.
pub fn demo(args: &DemoArgs, progress: &Progress) -> anyhow::Result<Verdict> {
    let out = args.out.clone().unwrap_or_else(new_demo_folder);
    let args = ReplayArgs {
        session: demo_session()?,
        out,
        config: None,
        roi: None,
        crop: None,
        watertight: false,
        voxel_size: None,
        depth_max: None,
        poses: None,
        polish_poses: false,
        calibration: None,
        calibration_dir: None,
        max_snapshots: None,
        threads: None,
        realtime: false,
        record: false,
        no_refine: false,
        json: false,
    };
    replay(&args, progress)
}

/// The recording that comes with the source.
fn demo_session() -> anyhow::Result<PathBuf> {
    let place = Path::new("tests/data/demo");
    let places = [
        Path::new(env!("CARGO_MANIFEST_DIR")).join(place),
        place.to_owned(),
    ];
    let found = places.iter().find(|place| place.is_dir());
    found.cloned().with_context(|| {
        let [own, here] = &places;
        format!(
            "the demo's recording lies neither in {} nor in {}",
            own.display(),
            here.display()
        )
    })
}

/// `out/demo`, or the first of `out/demo-2`, `out/demo-3`, … that does not exist.
fn new_demo_folder() -> PathBuf {
    let numbered = (2..).map(|number| PathBuf::from(format!("out/demo-{number}")));
    std::iter::once(PathBuf::from("out/demo"))
        .chain(numbered)
        .find(|path| !path.exists())
        .expect("numbers do not end before folders do")
}

/// `relief simulate`.
pub fn simulate(args: &SimulateArgs) -> anyhow::Result<Verdict> {
    let n_frames = args.frames as usize;
    let mut camera = match Sensor::from(args.sensor) {
        Sensor::Kinect1 => SimulatedCamera::kinect1_plaque(n_frames, args.seed),
        Sensor::Kinect2 => SimulatedCamera::kinect2_plaque(n_frames, args.seed),
    };
    let units = f64::from(args.depth_units);
    let mut writer = SessionWriter::create(&args.out, camera.info(), units)?;
    while let Some(frame) = camera.grab(Duration::ZERO)? {
        writer.write(&frame)?;
    }
    let n_written = writer.finish()?;
    if n_written == 0 {
        bail!("the simulation gave no frame");
    }
    writeln!(
        Stdout,
        "{n_written} frames recorded in {}",
        args.out.display()
    )?;
    Ok(Verdict::Done)
}

/// The folder of calibrations named by serial number.
pub fn calibration_folder(given: Option<&Path>, config: Option<&Path>) -> PathBuf {
    match (given, config.and_then(Path::parent)) {
        (Some(given), _) => given.to_owned(),
        (None, Some(folder)) => folder.join("calibration"),
        (None, None) => PathBuf::from("calibration"),
    }
}

/// Looks whether a folder that a flag names, to be read from, is there.
pub(super) fn require_folder(flag: &str, folder: &Path) -> Result<(), ConfigError> {
    match folder.is_dir() {
        true => Ok(()),
        false => Err(ConfigError {
            origin: flag.to_owned(),
            what: format!("{} is no folder", folder.display()),
        }),
    }
}

/// As [`calibration_folder`], to be read from: one that is given must be there.
pub(super) fn calibrations(
    given: Option<&Path>,
    config: Option<&Path>,
) -> Result<PathBuf, ConfigError> {
    if let Some(folder) = given {
        require_folder("--calibration-dir", folder)?;
    }
    Ok(calibration_folder(given, config))
}

/// Warns of the keys of a session's description that nobody reads, and returns what was said.
pub(super) fn tell_unknown_keys(session: &Path) -> Vec<String> {
    let unknown_keys = replay::unknown_keys(session);
    for unknown in &unknown_keys {
        tracing::warn!("{unknown}");
    }
    unknown_keys
}

/// The next frame of a recording that is not damaged; `None` at its end. Those that are damaged are counted.
pub(super) fn next_frame(
    camera: &mut dyn DepthCamera,
    n_damaged: &mut usize,
) -> anyhow::Result<Option<Frame>> {
    loop {
        match camera.grab(Duration::ZERO) {
            Err(error) if error.is_recoverable() => {
                tracing::warn!(%error, "frame skipped");
                *n_damaged += 1;
            }
            other => return Ok(other?),
        }
    }
}

/// The name of the session's folder; that of the scan's folder where it is the recording in one, since those are all called the same.
pub fn session_name(session: &Path) -> String {
    let absolute = session.canonicalize();
    let path = absolute.as_deref().unwrap_or(session);
    let scan = path.parent().filter(|above| is_recording_of(path, above));
    let named_by = scan.unwrap_or(path);
    let name = named_by.file_name().unwrap_or(named_by.as_os_str());
    name.to_string_lossy().into_owned()
}

/// Whether a folder is the recording of a scan, whose events are then beside it.
fn is_recording_of(folder: &Path, scan: &Path) -> bool {
    let mut formats = [RecordFormat::Mcap, RecordFormat::Folder].into_iter();
    let has_its_name = formats.any(|format| folder.ends_with(format.folder_name()));
    has_its_name && scan.join(EVENTS_FILE).is_file()
}

#[cfg(test)]
mod tests;
