//! The command line: what can be asked for here, how it is done in [`run`], [`daemon`] and [`bench`], what is said in
//! the end in [`summary`].

pub mod bench;
pub mod calibrate;
pub mod config;
pub mod daemon;
pub mod devices;
pub mod evaluate;
pub mod found_scan;
pub mod logging;
pub mod package;
pub mod processor_time;
pub mod record;
pub mod run;
pub mod session;
pub mod stdout;
pub mod stopping;
pub mod summary;
pub mod values;

use calibrate::CalibrateCommand;
use clap::{Args, Parser, Subcommand};
use config::ConfigCommand;
use daemon::RunArgs;
use devices::{DevicesArgs, DoctorArgs};
use logging::LogFormat;
use package::{CompletionsArgs, ManArgs};
use record::RecordArgs;
use relief::{config::Overrides, control::ProgressStyle, jobs::Limits};
use session::SessionCommand;
use std::{num::NonZeroUsize, path::PathBuf};
use values::{CropArg, PoseArg, RoiArg, SensorArg, folds};

/// Turns a hand-held Kinect scan into a mesh with detail below the depth sensor's noise, from infrared shading.
#[derive(Debug, Parser)]
#[command(
    name = "relief",
    version,
    after_help = "Exit codes: 0 done, 1 failed, 2 bad usage or configuration, 5 no room on the disk, 130 interrupted;\n\
                  of the daemon also 3 bad configuration, 4 no such recording, 5 no data folder, 70 refused by the system.\n\
                  Logs go to standard error; RUST_LOG sets their level."
)]
pub struct Cli {
    /// How log lines are written
    #[arg(long, value_enum, global = true, default_value_t)]
    pub log_format: LogFormat,
    /// What to do.
    #[command(subcommand)]
    pub command: Command,
}

/// What to do.
#[derive(Debug, Subcommand)]
pub enum Command {
    /// Scan for hours, seen and steered from a browser
    Run(RunArgs),
    /// Fuse and refine a recorded session
    Replay(Box<ReplayArgs>),
    /// Refine the base mesh of an output folder again
    Refine(RefineArgs),
    /// Record a session of a simulated sensor
    Simulate(SimulateArgs),
    /// Fuse and refine the recording that comes with the source
    Demo(DemoArgs),
    /// Measure tracking and fusion on a recorded session
    Bench(BenchArgs),
    /// Measure how well refinement explains images that it was not made from
    Evaluate(EvaluateArgs),
    /// Measure what the program has to know of a device
    #[command(subcommand)]
    Calibrate(CalibrateCommand),
    /// List, check, mend and convert recordings
    #[command(subcommand)]
    Session(SessionCommand),
    /// List the Kinects that are plugged in
    Devices(DevicesArgs),
    /// Look for what keeps a Kinect from working, and say what mends it
    Doctor(DoctorArgs),
    /// Record a live device
    Record(RecordArgs),
    /// Show and check the configuration
    #[command(subcommand)]
    Config(ConfigCommand),
    /// Print the completions of a shell
    Completions(CompletionsArgs),
    /// Write the man pages
    Man(ManArgs),
}

impl Command {
    /// How progress is shown.
    pub fn progress_style(&self) -> ProgressStyle {
        match self {
            Command::Refine(args) if args.progress_json => ProgressStyle::JsonLines,
            _ if self.prints_json() => ProgressStyle::Silent,
            Command::Replay(_) | Command::Refine(_) | Command::Demo(_) => {
                ProgressStyle::of_stderr()
            }
            // A bar that nothing moves would stand below every line of the log.
            _ => ProgressStyle::Silent,
        }
    }

    /// Whether standard output is for one JSON object.
    pub fn prints_json(&self) -> bool {
        match self {
            Command::Replay(args) => args.json,
            Command::Refine(args) => args.json || args.progress_json,
            Command::Bench(args) => args.json,
            Command::Evaluate(args) => args.json,
            Command::Calibrate(command) => command.prints_json(),
            Command::Session(command) => command.prints_json(),
            Command::Devices(args) => args.json,
            Command::Doctor(args) => args.json,
            Command::Record(args) => args.json,
            Command::Config(command) => command.prints_json(),
            Command::Run(_)
            | Command::Simulate(_)
            | Command::Demo(_)
            | Command::Completions(_)
            | Command::Man(_) => false,
        }
    }
}

/// `relief replay`.
#[derive(Debug, Args)]
pub struct ReplayArgs {
    /// Folder of the session, or an .mcap file
    pub session: PathBuf,
    /// Folder for the outputs, new or empty
    #[arg(long, value_name = "DIR")]
    pub out: PathBuf,
    /// Configuration; keys that it leaves out keep their values from the layers below
    #[arg(long, value_name = "FILE")]
    pub config: Option<PathBuf>,
    /// Box of the object in the world frame, metres; found without it
    #[arg(
        long,
        value_name = "XMIN,YMIN,ZMIN,XMAX,YMAX,ZMAX",
        allow_hyphen_values = true
    )]
    pub roi: Option<RoiArg>,
    /// What base.ply and the refined mesh are of: "object" above the plane found under it, the largest component in
    /// "box=XMIN,YMIN,ZMIN,XMAX,YMAX,ZMAX", or everything with "none"
    #[arg(
        long,
        value_name = "none|object|box=...",
        allow_hyphen_values = true,
        conflicts_with = "roi"
    )]
    pub crop: Option<CropArg>,
    /// Fill the holes of the meshes: every edge gets two faces
    #[arg(long)]
    pub watertight: bool,
    /// Distance between voxels, metres
    #[arg(long, value_name = "M")]
    pub voxel_size: Option<f64>,
    /// Depth beyond this is ignored, metres
    #[arg(long, value_name = "M")]
    pub depth_max: Option<f64>,
    /// Fuse at the poses of this file (TUM: timestamp tx ty tz qx qy qz qw) instead of tracking
    #[arg(long, value_name = "FILE")]
    pub poses: Option<PathBuf>,
    /// Align every frame to the model from its pose in the file of --poses, and keep the result where it is believed
    #[arg(long, requires = "poses")]
    pub polish_poses: bool,
    /// Calibration of the IR image: a device's own file, or a complete one
    #[arg(long, value_name = "FILE")]
    pub calibration: Option<PathBuf>,
    /// Folder of the calibrations named SERIAL.toml; "calibration" beside the --config file, or here, without it
    #[arg(long, value_name = "DIR")]
    pub calibration_dir: Option<PathBuf>,
    /// Shading images at most
    #[arg(long, value_name = "N")]
    pub max_snapshots: Option<usize>,
    /// Threads of each pool; all processors without it
    #[arg(long, value_name = "N", value_parser = values::threads)]
    pub threads: Option<NonZeroUsize>,
    /// Play at the recorded pace and drop frames rather than wait for fusion
    #[arg(long)]
    pub realtime: bool,
    /// Record the frames beneath the output folder, as [capture] of the configuration says
    #[arg(long)]
    pub record: bool,
    /// Fuse only
    #[arg(long)]
    pub no_refine: bool,
    /// Print one JSON object on standard output, and no progress
    #[arg(long)]
    pub json: bool,
}

impl ReplayArgs {
    /// What the flags override in the configuration.
    pub fn overrides(&self) -> Overrides {
        Overrides {
            voxel_size_m: self.voxel_size,
            depth_max_m: self.depth_max,
            max_snapshots: self.max_snapshots,
            polish_poses: self.polish_poses.then_some(true),
            crop: self.crop.map(|crop| crop.0),
            watertight: self.watertight.then_some(true),
        }
    }
}

/// A scan in an output folder, and how it is read.
#[derive(Clone, Debug, Args)]
pub struct RecordedScanArgs {
    /// Output folder of `relief replay`: base.ply (scene.ply where there is one), trajectory.txt and
    /// snapshots are read
    pub output: PathBuf,
    /// Configuration; keys that it leaves out keep their values from the layers below
    #[arg(long, value_name = "FILE")]
    pub config: Option<PathBuf>,
    /// Box of the object in the world frame, metres; found without it
    #[arg(
        long,
        value_name = "XMIN,YMIN,ZMIN,XMAX,YMAX,ZMAX",
        allow_hyphen_values = true
    )]
    pub roi: Option<RoiArg>,
    /// Calibration of the IR image: a device's own file, or a complete one
    #[arg(long, value_name = "FILE")]
    pub calibration: Option<PathBuf>,
    /// Folder of the calibrations named SERIAL.toml; "calibration" beside the --config file, or here, without it
    #[arg(long, value_name = "DIR")]
    pub calibration_dir: Option<PathBuf>,
    /// Threads; all processors without it
    #[arg(long, value_name = "N", value_parser = values::threads)]
    pub threads: Option<NonZeroUsize>,
}

/// `relief refine`.
#[derive(Debug, Args)]
pub struct RefineArgs {
    /// The scan, and what is to be known of it
    #[command(flatten)]
    pub scan: RecordedScanArgs,
    /// Refine the depth map of this frame, one of the shading images, from its own infrared image alone
    #[arg(long, value_name = "FRAME")]
    pub single_view: Option<u64>,
    /// Folder for the outputs, new or empty
    #[arg(long, value_name = "DIR")]
    pub out: PathBuf,
    /// Print one JSON object on standard output, and no progress
    #[arg(long)]
    pub json: bool,
    /// Print progress on standard output, a JSON object a line, then the object of --json
    #[arg(long)]
    pub progress_json: bool,
    /// Of the daemon's worker
    #[command(flatten)]
    pub child: ChildArgs,
}

/// What the daemon's worker asks of its child.
#[derive(Debug, Args)]
pub struct ChildArgs {
    /// Folder that the outputs will be moved into, as the report is to name it
    #[arg(long, value_name = "DIR", hide = true)]
    pub deliver_to: Option<PathBuf>,
    /// Take the file of --config alone, and nothing of this machine
    #[arg(long, hide = true)]
    pub config_alone: bool,
    /// Take the turns of processor and disk that nobody else wants
    #[arg(long, hide = true)]
    pub idle: bool,
    /// Niceness to add
    #[arg(long, value_name = "N", hide = true, value_parser = clap::value_parser!(i32).range(0..=19))]
    pub nice: Option<i32>,
    /// Address space, MiB
    #[arg(long, value_name = "MIB", hide = true)]
    pub max_memory_mb: Option<u64>,
    /// Processor time, seconds
    #[arg(long, value_name = "SECS", hide = true)]
    pub max_cpu_secs: Option<u64>,
    /// Process that this one must not outlive
    #[arg(long, value_name = "PID", hide = true)]
    pub parent: Option<u32>,
}

impl ChildArgs {
    /// What the process imposes on itself.
    pub fn limits(&self) -> Limits {
        Limits {
            idle: self.idle,
            nice: self.nice,
            max_memory_mb: self.max_memory_mb,
            max_cpu_secs: self.max_cpu_secs,
            parent: self.parent,
        }
    }
}

/// `relief simulate`.
#[derive(Debug, Args)]
pub struct SimulateArgs {
    /// Folder for the session, new or empty
    pub out: PathBuf,
    /// Frames on the move
    #[arg(long, value_name = "N", default_value_t = 120, value_parser = clap::value_parser!(u32).range(1..=100_000))]
    pub frames: u32,
    /// Seed of the noise
    #[arg(long, value_name = "S", default_value_t = 1)]
    pub seed: u64,
    /// The sensor
    #[arg(long, value_enum, default_value_t = SensorArg::Kinect2)]
    pub sensor: SensorArg,
    /// Depth is stored in steps of 1 / N metres
    #[arg(long, value_name = "N", default_value_t = 5000, value_parser = clap::value_parser!(u32).range(100..=100_000))]
    pub depth_units: u32,
}

/// `relief demo`.
#[derive(Debug, Args)]
pub struct DemoArgs {
    /// Folder for the outputs; a new one under `out` without it
    #[arg(long, value_name = "DIR")]
    pub out: Option<PathBuf>,
}

/// `relief bench`.
#[derive(Debug, Args)]
pub struct BenchArgs {
    /// Folder of the session, or an .mcap file
    pub session: PathBuf,
    /// Configuration; keys that it leaves out keep their values from the layers below
    #[arg(long, value_name = "FILE")]
    pub config: Option<PathBuf>,
    /// Distance between voxels, metres
    #[arg(long, value_name = "M")]
    pub voxel_size: Option<f64>,
    /// Depth beyond this is ignored, metres
    #[arg(long, value_name = "M")]
    pub depth_max: Option<f64>,
    /// Threads; all processors without it
    #[arg(long, value_name = "N", value_parser = values::threads)]
    pub threads: Option<NonZeroUsize>,
    /// Print one JSON object on standard output
    #[arg(long)]
    pub json: bool,
}

impl BenchArgs {
    /// What the flags override in the configuration.
    pub fn overrides(&self) -> Overrides {
        Overrides {
            voxel_size_m: self.voxel_size,
            depth_max_m: self.depth_max,
            ..Overrides::default()
        }
    }
}

/// `relief evaluate`.
#[derive(Clone, Debug, Args)]
pub struct EvaluateArgs {
    /// The scan, and what is to be known of it
    #[command(flatten)]
    pub scan: RecordedScanArgs,
    /// Folder for the evaluation, new or empty
    #[arg(long, value_name = "DIR")]
    pub out: PathBuf,
    /// Refinements, each without its share of the views; as many as views leave out one at a time, 0 none
    #[arg(long, value_name = "N", default_value_t = 4, value_parser = folds)]
    pub folds: usize,
    /// Mesh (PLY, metres) measured by something better: base and refined mesh are compared with it
    #[arg(long, value_name = "FILE")]
    pub truth: Option<PathBuf>,
    /// Where the scan's world lies in the frame of --truth, to a centimetre; it is aligned from there
    #[arg(
        long,
        value_name = "TX,TY,TZ,QX,QY,QZ,QW",
        allow_hyphen_values = true,
        requires = "truth"
    )]
    pub truth_pose: Option<PoseArg>,
    /// What of --truth is compared, in its frame, metres; all of it without a box
    #[arg(
        long,
        value_name = "XMIN,YMIN,ZMIN,XMAX,YMAX,ZMAX",
        allow_hyphen_values = true,
        requires = "truth"
    )]
    pub truth_box: Option<RoiArg>,
    /// Also with fewer views, derivatives by differences, tracked poses, other materials and other values of gamma
    #[arg(long)]
    pub ablations: bool,
    /// Print one JSON object on standard output
    #[arg(long)]
    pub json: bool,
}

#[cfg(test)]
mod tests {
    use super::*;
    use clap::CommandFactory;

    #[test]
    fn the_command_line_is_consistent() {
        Cli::command().debug_assert();
    }

    #[test]
    fn progress_is_shown_where_there_is_some() {
        let style = |arguments: &[&str]| {
            let arguments = [&["relief"], arguments].concat();
            Cli::parse_from(arguments).command.progress_style()
        };
        assert_ne!(style(&["demo"]), ProgressStyle::Silent);
        assert_eq!(style(&["run"]), ProgressStyle::Silent);
        assert_eq!(style(&["bench", "session"]), ProgressStyle::Silent);
    }
}
