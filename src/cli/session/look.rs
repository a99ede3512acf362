//! `relief session info` and `verify`: looking at a recording without changing it.

use super::{SessionArgs, list::state_name, megabytes, require_mcap};
use crate::cli::{run::Verdict, stdout::Stdout};
use depth_camera::CameraInfo;
use mcap_session::{FileReport, SessionRecord, describe, files};
use serde_json::{Value, json};
use std::{
    io::{self, Write},
    path::Path,
};

/// `relief session info`.
pub fn info(args: &SessionArgs) -> anyhow::Result<Verdict> {
    require_mcap(&args.session)?;
    let described = describe(&args.session)?;
    let record = SessionRecord::read(&args.session).ok();
    let files = files(&args.session)?;
    let n_bytes: u64 = files
        .iter()
        .filter_map(|path| path.metadata().ok())
        .map(|metadata| metadata.len())
        .sum();
    let units_per_metre = described.depth_scale.units_per_metre;
    let (info, topics) = (&described.info, described.topics);
    if args.json {
        let object = json!({
            "path": args.session.display().to_string(),
            "session": record,
            "camera": camera(info),
            "depth_units_per_metre": units_per_metre,
            "topics": topics,
            "files": files.len(),
            "bytes": n_bytes,
        });
        writeln!(Stdout, "{object}")?;
        return Ok(Verdict::Done);
    }
    let i = &info.intrinsics;
    writeln!(Stdout, "{}", args.session.display())?;
    writeln!(Stdout, "  {} {}", info.sensor.name(), info.serial)?;
    writeln!(
        Stdout,
        "  {}×{} pixels, fx {:.2} fy {:.2} cx {:.2} cy {:.2}",
        i.width, i.height, i.fx, i.fy, i.cx, i.cy
    )?;
    writeln!(Stdout, "  depth in 1/{units_per_metre} m")?;
    match info.light {
        Some(light) => writeln!(
            Stdout,
            "  infrared lit by the {} at {:?} m",
            light.kind.name(),
            light.position_m
        )?,
        None => writeln!(Stdout, "  no infrared")?,
    }
    writeln!(Stdout, "  {} files, {}", files.len(), megabytes(n_bytes))?;
    for topic in topics {
        writeln!(Stdout, "  {topic}")?;
    }
    if let Some(record) = record {
        let c = &record.counters;
        writeln!(
            Stdout,
            "  {}: {} frames, {} depth, {} infrared, {} poses, {} events",
            state_name(record.state),
            c.frames,
            c.depth,
            c.infrared,
            c.poses,
            c.events
        )?;
        if let Some(why) = record.stopped_because {
            writeln!(Stdout, "  stopped before the scan did: {why}")?;
        }
    }
    Ok(Verdict::Done)
}

fn camera(info: &CameraInfo) -> Value {
    let mut camera = json!(info.intrinsics);
    camera["sensor"] = json!(info.sensor.name());
    camera["serial"] = json!(info.serial);
    camera["driver"] = json!(info.driver);
    camera["ir_full_scale"] = json!(info.ir_full_scale);
    camera["light"] = json!(info.light.map(|light| json!({
        "kind": light.kind.name(),
        "position_m": light.position_m,
    })));
    camera
}

/// `relief session verify`.
pub fn verify(args: &SessionArgs) -> anyhow::Result<Verdict> {
    require_mcap(&args.session)?;
    let reports = mcap_session::verify(&args.session)?;
    let is_whole = reports.iter().all(|report| report.problems.is_empty());
    if args.json {
        let files: Vec<Value> = reports.iter().map(file).collect();
        writeln!(Stdout, "{}", json!({ "whole": is_whole, "files": files }))?;
    } else {
        reports.iter().try_for_each(print_report)?;
    }
    Ok(match is_whole {
        true => Verdict::Done,
        false => Verdict::Failed,
    })
}

fn file(report: &FileReport) -> Value {
    json!({
        "path": report.path.display().to_string(),
        "bytes": report.n_bytes,
        "frames": report.n_frames,
        "messages": report.summary.n_messages(),
        "problems": report.problems,
    })
}

fn print_report(report: &FileReport) -> io::Result<()> {
    let name = report
        .path
        .file_name()
        .map(Path::new)
        .unwrap_or(&report.path);
    writeln!(
        Stdout,
        "{}  {} frames  {} messages  {}  {}",
        name.display(),
        report.n_frames,
        report.summary.n_messages(),
        megabytes(report.n_bytes),
        match report.problems.is_empty() {
            true => "whole",
            false => "damaged",
        }
    )?;
    for problem in &report.problems {
        writeln!(Stdout, "  {problem}")?;
    }
    Ok(())
}
