//! What the sub-commands do: configure, build, wait, sum up.

use super::{DemoArgs, ReplayArgs, SimulateArgs, summary};
use anyhow::{Context, bail};
use depth_camera::{DepthCamera, Sensor};
use relief::{
    config::{self, CalibrationSource, Config, ConfigError},
    control::{self, EXIT_INTERRUPTED, Progress},
    pipeline::{Ending, GivenPoses, Outcome, OutputFolder, Pipeline, PipelineParams, WhenFull},
};
use replay::{Pacing, ReplayCamera, SessionWriter};
use simulated::SimulatedCamera;
use std::{
    num::NonZeroUsize,
    path::{Path, PathBuf},
    process::ExitCode,
    thread,
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
}

impl Verdict {
    /// What an error means for the exit code.
    pub fn of_error(error: &anyhow::Error) -> Self {
        match error.is::<ConfigError>() {
            true => Verdict::BadUsage,
            false => Verdict::Failed,
        }
    }

    fn of_outcome(outcome: &Outcome) -> Self {
        match outcome.ending {
            Ending::Stopped => Verdict::Interrupted,
            Ending::Complete if outcome.failures.is_empty() => Verdict::Done,
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
        })
    }
}

/// `relief replay`.
pub fn replay(args: &ReplayArgs, progress: &Progress) -> anyhow::Result<Verdict> {
    let config = Config::layered(args.config.as_deref(), &args.overrides())?;
    let camera = ReplayCamera::open(&args.session)?.with_pacing(match args.realtime {
        true => Pacing::Recorded,
        false => Pacing::AsFastAsPossible,
    });
    let params = pipeline_params(args, config, &camera)?;
    let folder = OutputFolder::claim(&args.out)?;
    let outcome = control::operate(
        || Pipeline::spawn(Box::new(camera), params, folder),
        progress,
    )?;
    match args.json {
        true => summary::print_json(&outcome)?,
        false => summary::print_text(&outcome),
    }
    Ok(Verdict::of_outcome(&outcome))
}

fn pipeline_params(
    args: &ReplayArgs,
    config: Config,
    camera: &ReplayCamera,
) -> anyhow::Result<PipelineParams> {
    let config_folder = args.config.as_deref().and_then(Path::parent);
    let given = args.calibration.as_deref();
    let (calibration, source) = config::find_calibration(camera.info(), given, config_folder)?;
    let poses = args.poses.as_deref().map(replay::read_poses).transpose()?;
    Ok(PipelineParams {
        session: session_name(&args.session),
        capture: config.capture,
        fusion: config.fusion,
        snapshot: config.snapshot,
        refine: (!args.no_refine).then_some(config.refine),
        warnings: calibration_warning(&source, camera).into_iter().collect(),
        calibration,
        calibration_source: source.to_string(),
        roi: args.roi.map(|roi| roi.0),
        poses: poses.map(|poses| GivenPoses::new(&poses)),
        n_threads: args.threads.unwrap_or_else(all_processors),
        when_full: match args.realtime {
            true => WhenFull::Drop,
            false => WhenFull::Block,
        },
        record: args.record,
    })
}

/// `relief demo`.
pub fn demo(args: &DemoArgs, progress: &Progress) -> anyhow::Result<Verdict> {
    let out = args.out.clone().unwrap_or_else(new_demo_folder);
    let args = ReplayArgs {
        session: demo_session()?,
        out,
        config: None,
        roi: None,
        voxel_size: None,
        depth_max: None,
        poses: None,
        calibration: None,
        max_snapshots: None,
        threads: None,
        realtime: false,
        record: false,
        no_refine: false,
        json: false,
    };
    replay(&args, progress)
}

/// The recording that comes with the program.
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
    println!("{n_written} frames recorded in {}", args.out.display());
    Ok(Verdict::Done)
}

fn calibration_warning(source: &CalibrationSource, camera: &ReplayCamera) -> Option<String> {
    let CalibrationSource::Shipped(sensor) = source else {
        return None;
    };
    // Without IR there is nothing to calibrate.
    camera.info().ir_full_scale?;
    let warning = format!(
        "no calibration of the device {} is known, the one shipped for every {} is used",
        camera.info().serial,
        sensor.name()
    );
    tracing::warn!("{warning}");
    Some(warning)
}

/// The name of the session's folder.
pub(super) fn session_name(session: &Path) -> String {
    let absolute = session.canonicalize();
    let path = absolute.as_deref().unwrap_or(session);
    let name = path.file_name().unwrap_or(path.as_os_str());
    name.to_string_lossy().into_owned()
}

pub(super) fn all_processors() -> NonZeroUsize {
    thread::available_parallelism().unwrap_or(NonZeroUsize::MIN)
}
