//! `relief devices` and `relief doctor`: what is plugged in, and what keeps it from working.

mod watch;

use super::{
    run::{Verdict, calibrations, require_folder},
    stdout::Stdout,
};
use clap::Args;
use relief::{
    config::calibration_path,
    control::{self, DataFolder},
    devices::{
        Controller, Kinect, Machine, Model,
        doctor::{self, Check, Finding, Level},
        list,
    },
};
use serde::Serialize;
use serde_json::json;
use std::{
    io::{self, ErrorKind, Write},
    path::{Path, PathBuf},
};

/// `relief devices`.
#[derive(Debug, Args)]
pub struct DevicesArgs {
    /// Look at the machine whose files lie in this folder instead: a copy of /sys, /dev, /etc
    #[arg(long, value_name = "DIR", default_value = "/")]
    pub root: PathBuf,
    /// Go on, and tell of each Kinect that comes or goes, until SIGINT, SIGTERM or SIGHUP
    #[arg(long)]
    pub watch: bool,
    /// Print one JSON object on standard output; with --watch one a line for each change
    #[arg(long)]
    pub json: bool,
}

/// `relief doctor`.
#[derive(Debug, Args)]
pub struct DoctorArgs {
    /// Look at the machine whose files lie in this folder instead: a copy of /sys, /dev, /etc
    #[arg(long, value_name = "DIR", default_value = "/")]
    pub root: PathBuf,
    /// Folder that scans go to; where `relief run` writes them without it
    #[arg(long, value_name = "DIR")]
    pub data: Option<PathBuf>,
    /// Configuration, beside which calibrations are looked for
    #[arg(long, value_name = "FILE")]
    pub config: Option<PathBuf>,
    /// Folder of the calibrations named SERIAL.toml
    #[arg(long, value_name = "DIR")]
    pub calibration_dir: Option<PathBuf>,
    /// Print the udev rules that let a Kinect be used, and nothing else
    #[arg(long)]
    pub print_rules: bool,
    /// Print one JSON object on standard output
    #[arg(long)]
    pub json: bool,
}

/// A Kinect as `--json` tells of it.
#[derive(Serialize)]
struct Entry<'a> {
    serial: Option<&'a str>,
    sensor: &'static str,
    model: Model,
    model_name: String,
    /// `bcdDevice`; the firmware's own number is known when the device is open.
    release: String,
    port: &'a str,
    node: String,
    speed_mbps: Option<f64>,
    controller: Option<&'a Controller>,
    /// Whether the program can open it, as far as is known from outside.
    usable: bool,
    obstacle: Option<String>,
}

fn entry(kinect: &Kinect) -> Entry<'_> {
    let camera = &kinect.camera;
    Entry {
        serial: kinect.serial.as_deref(),
        sensor: kinect.model.sensor().name(),
        model: kinect.model,
        model_name: kinect.model.to_string(),
        release: format!("{:x}.{:02x}", camera.release >> 8, camera.release & 0xff),
        port: &camera.port,
        node: camera.node(),
        speed_mbps: camera.speed_mbps,
        controller: camera.controller.as_ref(),
        usable: kinect.serial.is_some() && kinect.obstacle.is_none(),
        obstacle: kinect.obstacle.as_ref().map(ToString::to_string),
    }
}

/// `relief devices`.
pub fn devices(args: &DevicesArgs) -> anyhow::Result<Verdict> {
    require_folder("--root", &args.root)?;
    if args.watch {
        let root = args.root.clone();
        let tell = match args.json {
            true => watch::tell_json,
            false => watch::tell_text,
        };
        return match control::until_stopped(move |stop| watch::watch(&root, tell, stop))? {
            // Nobody listens any more.
            Err(error) if error.kind() == ErrorKind::BrokenPipe => Ok(Verdict::Done),
            watched => Ok(watched.map(|()| Verdict::Done)?),
        };
    }
    let kinects = list(&Machine::under(&args.root));
    let entries: Vec<_> = kinects.iter().map(entry).collect();
    if args.json {
        writeln!(Stdout, "{}", json!({ "devices": entries }))?;
        return Ok(Verdict::Done);
    }
    if entries.is_empty() {
        writeln!(
            Stdout,
            "no Kinect is plugged in; `relief doctor` looks for the reason"
        )?;
    }
    entries.iter().try_for_each(print_entry)?;
    Ok(Verdict::Done)
}

fn print_entry(entry: &Entry<'_>) -> io::Result<()> {
    let speed = entry.speed_mbps.map(|speed| format!(" at {speed} Mbit/s"));
    let controller = entry
        .controller
        .map(|controller| format!(", controller {}", controller.address));
    writeln!(
        Stdout,
        "{}  {} (release {}), port {}{}{}",
        entry.serial.unwrap_or("(no serial number)"),
        entry.model_name,
        entry.release,
        entry.port,
        speed.unwrap_or_default(),
        controller.unwrap_or_default(),
    )?;
    match &entry.obstacle {
        None => writeln!(Stdout, "    ready"),
        Some(obstacle) => writeln!(Stdout, "    not usable: {obstacle}"),
    }
}

/// `relief doctor`.
pub fn doctor(args: &DoctorArgs) -> anyhow::Result<Verdict> {
    if args.print_rules {
        write!(Stdout, "{}", doctor::UDEV_RULES)?;
        return Ok(Verdict::Done);
    }
    require_folder("--root", &args.root)?;
    let machine = Machine::under(&args.root);
    let data = match &args.data {
        Some(data) => data.clone(),
        // The machine is to be looked at even where nothing says where scans would go.
        None => DataFolder::conventional().unwrap_or_else(|_| ".".into()),
    };
    let mut findings = doctor::examine(&machine, &data);
    let folder = calibrations(args.calibration_dir.as_deref(), args.config.as_deref())?;
    let kinects = list(&machine);
    findings.extend(
        kinects
            .iter()
            .filter_map(|kinect| calibration(kinect, &folder)),
    );
    let worst = doctor::worst(&findings);
    match args.json {
        true => writeln!(
            Stdout,
            "{}",
            json!({ "worst": worst, "findings": findings })
        )?,
        false => findings.iter().try_for_each(print)?,
    }
    Ok(match worst {
        Level::Ok | Level::Warning => Verdict::Done,
        Level::Error => Verdict::Failed,
    })
}

/// Whether the device's own calibration is known.
fn calibration(kinect: &Kinect, folder: &Path) -> Option<Finding> {
    let serial = kinect.serial.as_deref()?;
    let finding = match calibration_path(folder, serial) {
        Ok(path) if path.exists() => {
            Finding::ok(Check::Calibration, format!("{} is there", path.display()))
        }
        Ok(path) => Finding::warning(
            Check::Calibration,
            format!(
                "{} is not there: what is shipped for every device is used",
                path.display()
            ),
            "relief calibrate response SPHERE WALL, then flat-field, light and offset: README, \"Calibrating a sensor\"",
        ),
        Err(error) => Finding::error(
            Check::Calibration,
            error.to_string(),
            "name the file of its calibration by --calibration",
        ),
    };
    Some(finding.about(kinect))
}

fn print(finding: &Finding) -> io::Result<()> {
    let level = match finding.level {
        Level::Ok => "ok     ",
        Level::Warning => "warning",
        Level::Error => "ERROR  ",
    };
    let device = finding.device.as_ref().map(|device| format!("{device}: "));
    writeln!(
        Stdout,
        "{level}  {}{}",
        device.unwrap_or_default(),
        finding.says
    )?;
    if let (Some(mend), Level::Warning | Level::Error) = (&finding.mend, finding.level) {
        writeln!(Stdout, "         → {mend}")?;
    }
    Ok(())
}
