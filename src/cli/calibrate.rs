//! `relief calibrate`: what can be measured of a device, and what is asked for on the way.

mod depth;
mod findings;
mod offset;
mod page;
mod print;
mod targets;

use super::{
    run::{self, Verdict},
    stdout::Stdout,
    stopping::{Stopped, check_wanted},
    values::numbers,
};
use anyhow::{Context, ensure};
use clap::{Args, Subcommand};
use depth_camera::{CameraInfo, DepthCamera, Frame};
use relief::{
    calibrate::{BALL_RADII_M, NoEstimate},
    config::{
        self, CalibrationKey, Config, DeviceCalibration, MeasuredSession, MergeError, MergeReport,
    },
    control,
    devices::{content_hash, open_recording},
    shading::Calibration,
};
use replay::Pacing;
use std::{
    io::{self, Write},
    path::{Path, PathBuf},
    slice,
    str::FromStr,
    sync::atomic::AtomicBool,
};
use targets::Aim;

/// What to measure.
#[derive(Clone, Debug, Subcommand)]
pub enum CalibrateCommand {
    /// The exponent of the IR response, from a white sphere, better with a plain wall
    Response(TargetArgs),
    /// How lens and lobe darken the image, and the inverse square law, from a plain wall at several distances
    FlatField(TargetArgs),
    /// Where the light is, from sphere and wall together
    Light(TargetArgs),
    /// Where the IR image lies against the depth image, from silhouettes
    Offset(OffsetArgs),
    /// How strong the multipath of a Kinect II is, and what its range gets wrong, from a scan of an object on a table
    Depth(DepthArgs),
}

impl CalibrateCommand {
    /// Whether standard output is for one JSON object.
    pub fn prints_json(&self) -> bool {
        match self {
            CalibrateCommand::Response(args)
            | CalibrateCommand::FlatField(args)
            | CalibrateCommand::Light(args) => args.json,
            CalibrateCommand::Offset(_) | CalibrateCommand::Depth(_) => false,
        }
    }

    /// What it learns from.
    fn sessions(&self) -> &[PathBuf] {
        match self {
            CalibrateCommand::Response(args)
            | CalibrateCommand::FlatField(args)
            | CalibrateCommand::Light(args) => &args.sessions,
            CalibrateCommand::Offset(args) => slice::from_ref(&args.session),
            CalibrateCommand::Depth(args) => slice::from_ref(&args.session),
        }
    }
}

/// Runs a command; a signal ends it before it writes.
///
/// # Errors
/// For sessions that cannot be read or learnt from, and a file that is not to be changed; [`Stopped`].
pub fn calibrate(command: &CalibrateCommand) -> anyhow::Result<Verdict> {
    for session in command.sessions() {
        run::tell_unknown_keys(session);
    }
    let command = command.clone();
    control::until_stopped(move |stop| measure(&command, stop))?
}

fn measure(command: &CalibrateCommand, stop: &AtomicBool) -> anyhow::Result<Verdict> {
    match command {
        CalibrateCommand::Response(args) => targets::calibrate(Aim::Response, args, stop),
        CalibrateCommand::FlatField(args) => targets::calibrate(Aim::FlatField, args, stop),
        CalibrateCommand::Light(args) => targets::calibrate(Aim::Light, args, stop),
        CalibrateCommand::Offset(args) => offset::offset(args, stop),
        CalibrateCommand::Depth(args) => depth::depth(args, stop),
    }
}

/// A recording of any kind, as fast as it can be read; raw ones are decoded as the configuration says.
fn open(session: &Path, config: &Config) -> anyhow::Result<Box<dyn DepthCamera>> {
    Ok(open_recording(
        session,
        &config.devices,
        Pacing::AsFastAsPossible,
    )?)
}

/// A session as a measurement names it.
fn measured_session(name: String, session: &Path) -> anyhow::Result<MeasuredSession> {
    Ok(MeasuredSession {
        name,
        content: content_hash(session)?,
    })
}

/// The next frame of a recording that is not damaged, unless somebody has asked to stop; `None` at its end.
fn next_frame(camera: &mut dyn DepthCamera, stop: &AtomicBool) -> anyhow::Result<Option<Frame>> {
    check_wanted(stop)?;
    run::next_frame(camera, &mut 0)
}

/// Looks whether keys can be written before they are measured.
fn check_beforehand(
    path: &Path,
    device: &DeviceCalibration,
    keys: &[CalibrationKey],
    replace: bool,
) -> anyhow::Result<()> {
    config::check_merge(path, device, keys, replace).map_err(of_merging)
}

/// Writes what was measured of a device with a camera into its file.
fn merge(
    path: &Path,
    device: &DeviceCalibration,
    info: &CameraInfo,
    replace: bool,
) -> anyhow::Result<MergeReport> {
    let shipped = Calibration::shipped_for(info).map_err(anyhow::Error::msg)?;
    config::merge_into_file(path, device, &shipped, replace).map_err(of_merging)
}

/// Says where keys went, if they were to be written, after they were printed: what cannot be printed is written all the same, and what cannot be
/// written is printed.
fn conclude(
    keys: &[CalibrationKey],
    path: &Path,
    written: anyhow::Result<Option<MergeReport>>,
    printed: io::Result<()>,
) -> anyhow::Result<Verdict> {
    let written = written?;
    printed?;
    if let Some(report) = written {
        if let Some(kept) = &report.kept {
            writeln!(Stdout, "the file as it was: {}", kept.display())?;
        }
        let names: Vec<&str> = keys.iter().map(|key| key.name()).collect();
        writeln!(
            Stdout,
            "{} written to {}",
            names.join(" and "),
            path.display()
        )?;
    }
    Ok(Verdict::Done)
}

/// What is refused is bad usage, as in any file of the configuration; what cannot be written is a failure.
fn of_merging(error: MergeError) -> anyhow::Error {
    match error {
        MergeError::Refused(refused) => refused.into(),
        MergeError::Write { .. } => error.into(),
    }
}

/// What is refused is a failure; who asked to stop is told as everywhere.
fn of_fitting(error: NoEstimate) -> anyhow::Error {
    match error {
        NoEstimate::Refused(refusal) => refusal.into(),
        NoEstimate::Stopped => Stopped.into(),
    }
}

/// Where a measurement goes.
#[derive(Clone, Debug, Args)]
pub struct FileArgs {
    /// Folder of the calibrations named SERIAL.toml; "calibration" without it
    #[arg(long, value_name = "DIR")]
    pub calibration_dir: Option<PathBuf>,
    /// Serial number of the device; the session's without it
    #[arg(long, value_name = "SERIAL")]
    pub serial: Option<String>,
    /// Replace an older measurement; the file as it was is kept beside it
    #[arg(long)]
    pub replace: bool,
    /// Measure only
    #[arg(long)]
    pub dry_run: bool,
}

/// `relief calibrate response`, `flat-field` and `light`.
#[derive(Clone, Debug, Args)]
pub struct TargetArgs {
    /// Folders of the sessions, all of one device; what each shows is found out
    #[arg(required = true)]
    pub sessions: Vec<PathBuf>,
    /// Radius of the sphere, metres, if it was measured
    #[arg(long, value_name = "M")]
    pub radius: Option<RadiusArg>,
    /// Where to look for the light from, IR camera frame, metres; the session's statement without it
    #[arg(long, value_name = "X,Y,Z", allow_hyphen_values = true)]
    pub start: Option<PlaceArg>,
    /// Calibration to start from: a device's own file, or a complete one
    #[arg(long, value_name = "FILE")]
    pub calibration: Option<PathBuf>,
    /// File of the page; CALIBRATION_DIR/SERIAL.COMMAND.html without it
    #[arg(long, value_name = "FILE")]
    pub page: Option<PathBuf>,
    /// Print one JSON object on standard output
    #[arg(long)]
    pub json: bool,
    /// Where the measurement goes
    #[command(flatten)]
    pub file: FileArgs,
}

/// `relief calibrate offset`.
#[derive(Clone, Debug, Args)]
pub struct OffsetArgs {
    /// Folder of the session, as the device delivered it
    pub session: PathBuf,
    /// Where the measurement goes
    #[command(flatten)]
    pub file: FileArgs,
}

/// `relief calibrate depth`.
#[derive(Clone, Debug, Args)]
pub struct DepthArgs {
    /// Folder of the session: a matt object on a table, scanned from many sides
    pub session: PathBuf,
    /// Configuration; keys that it leaves out keep their values from the layers below
    #[arg(long, value_name = "FILE")]
    pub config: Option<PathBuf>,
    /// Where the measurement goes
    #[command(flatten)]
    pub file: FileArgs,
}

/// The radius of a sphere, metres.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct RadiusArg(pub f64);

impl FromStr for RadiusArg {
    type Err = anyhow::Error;

    fn from_str(text: &str) -> anyhow::Result<Self> {
        let radius: f64 = text
            .parse()
            .with_context(|| format!("\"{text}\" is no number"))?;
        ensure!(
            BALL_RADII_M.contains(&radius),
            "{radius} must be {} to {}",
            BALL_RADII_M.start(),
            BALL_RADII_M.end()
        );
        Ok(RadiusArg(radius))
    }
}

/// A place near the camera as three numbers, metres.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PlaceArg(pub [f64; 3]);

impl FromStr for PlaceArg {
    type Err = anyhow::Error;

    fn from_str(text: &str) -> anyhow::Result<Self> {
        let place = numbers(text)?;
        for value in place {
            ensure!(value.abs() <= 2.0, "{value} must be -2 to 2");
        }
        Ok(PlaceArg(place))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use simulated::SimulatedCamera;
    use std::sync::atomic::Ordering;

    #[test]
    fn a_measurement_that_is_told_to_stop_is_interrupted() {
        let mut camera = SimulatedCamera::kinect2_plaque(1, 0);
        let stop = AtomicBool::new(false);
        assert!(next_frame(&mut camera, &stop).unwrap().is_some());
        stop.store(true, Ordering::Relaxed);
        let of_frames = next_frame(&mut camera, &stop).err().unwrap();
        for error in [of_frames, of_fitting(NoEstimate::Stopped)] {
            assert_eq!(Verdict::of_error(&error), Verdict::Interrupted);
            assert_eq!(error.to_string(), "stopped before anything was written");
        }
    }

    #[test]
    fn places_and_radii_are_checked() {
        assert_eq!(
            "0.1, -0.07,0".parse::<PlaceArg>().unwrap().0,
            [0.1, -0.07, 0.0]
        );
        for (text, message) in [
            ("0.1,0.2", "2 numbers, must be 3"),
            ("0,0,3", "3 must be -2 to 2"),
            ("a,0,0", "\"a\" is no number"),
        ] {
            assert_eq!(text.parse::<PlaceArg>().unwrap_err().to_string(), message);
        }
        assert_eq!(
            "12".parse::<RadiusArg>().unwrap_err().to_string(),
            "12 must be 0.02 to 0.4"
        );
    }
}
