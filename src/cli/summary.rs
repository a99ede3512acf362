//! What the program says on standard output when a run is over.

use super::stdout::Stdout;
use relief::{
    control::Stderr,
    export::{BaseMesh, FrameCounts, HeldOut, Remeshing, Report, StageTiming, Tracking},
    pipeline::{Ending, Outcome},
};
use serde::Serialize;
use serde_json::json;
use std::io::{self, Write};

/// The machine-readable summary: the report without what belongs to single views and iterations.
#[derive(Serialize)]
struct Summary<'a> {
    /// `complete`, `stopped` or `failed`.
    status: &'static str,
    failures: &'a [String],
    session: &'a str,
    sensor: &'a str,
    serial: &'a str,
    calibration: &'a str,
    frames: &'a FrameCounts,
    tracking: &'a Tracking,
    base_mesh: &'a BaseMesh,
    refined: bool,
    refined_mesh: Option<Refined<'a>>,
    not_refined_reason: Option<&'a str>,
    warnings: &'a [String],
    outputs: &'a [String],
    timings: &'a [StageTiming],
    peak_memory_bytes: Option<u64>,
}

#[derive(Serialize)]
struct Refined<'a> {
    vertices: usize,
    faces: usize,
    area_m2: f64,
    path: &'a str,
    status: &'a str,
    n_views: usize,
    n_iterations: usize,
    edge_length_m: f64,
    remeshing: Remeshing,
    rmse_before: f64,
    rmse_after: f64,
    held_out: HeldOut,
}

/// Prints the summary as one JSON object on one line.
///
/// # Errors
/// If it cannot be printed.
pub fn print_json(outcome: &Outcome) -> anyhow::Result<()> {
    writeln!(Stdout, "{}", serde_json::to_string(&summary(outcome))?)?;
    Ok(())
}

/// An error with its causes, each once: most errors tell of their cause themselves.
pub fn with_causes(error: &anyhow::Error) -> String {
    let mut told = error.to_string();
    for cause in error.chain().skip(1).map(ToString::to_string) {
        if !told.contains(&cause) {
            told += &format!(": {cause}");
        }
    }
    told
}

/// Prints an error as the JSON object that replaces the summary.
///
/// # Errors
/// If it cannot be printed.
pub fn print_error(told: &str) -> io::Result<()> {
    writeln!(
        Stdout,
        "{}",
        json!({"status": "failed", "failures": [told]})
    )
}

fn summary(outcome: &Outcome) -> Summary<'_> {
    let report = &outcome.report;
    let refined = report.refined_mesh.as_ref().map(|mesh| Refined {
        vertices: mesh.vertices,
        faces: mesh.faces,
        area_m2: mesh.area_m2,
        path: &mesh.path,
        status: &mesh.status,
        n_views: mesh.views.len(),
        n_iterations: mesh.iterations.len(),
        edge_length_m: mesh.edge_length_m,
        remeshing: mesh.remeshing,
        rmse_before: mesh.rmse_before,
        rmse_after: mesh.rmse_after,
        held_out: mesh.held_out,
    });
    Summary {
        status: match outcome.ending {
            Ending::Stopped => "stopped",
            Ending::Complete if outcome.failures.is_empty() => "complete",
            Ending::Complete => "failed",
        },
        failures: &outcome.failures,
        session: &report.session,
        sensor: &report.sensor,
        serial: &report.serial,
        calibration: &report.calibration,
        frames: &report.frames,
        tracking: &report.tracking,
        base_mesh: &report.base_mesh,
        refined: refined.is_some(),
        refined_mesh: refined,
        not_refined_reason: report.not_refined_reason.as_deref(),
        warnings: &report.warnings,
        outputs: &report.outputs,
        timings: &report.timings,
        peak_memory_bytes: report.peak_memory_bytes,
    }
}

/// Prints the summary of a scan as a person reads it.
///
/// # Errors
/// If it cannot be printed.
pub fn print_scan(outcome: &Outcome) -> io::Result<()> {
    let report = &outcome.report;
    writeln!(
        Stdout,
        "{}; {:.1} s of computing",
        frames(&report.frames),
        computing_secs(report)
    )?;
    print_outputs(outcome)
}

/// Prints the summary of a refinement of what was fused before as a person reads it.
///
/// # Errors
/// If it cannot be printed.
pub fn print_refinement(outcome: &Outcome) -> io::Result<()> {
    let report = &outcome.report;
    writeln!(
        Stdout,
        "{} frames were fused before; {:.1} s of computing",
        report.frames.fused,
        computing_secs(report)
    )?;
    print_outputs(outcome)
}

fn print_outputs(outcome: &Outcome) -> io::Result<()> {
    let report = &outcome.report;
    // Of a mesh that could not be written a failure tells.
    let is_written = |path: &String| report.outputs.contains(path);
    if report.base_mesh.faces > 0 && is_written(&report.base_mesh.path) {
        writeln!(Stdout, "base mesh:    {}", report.base_mesh.path)?;
    }
    match (&report.refined_mesh, &report.not_refined_reason) {
        (Some(mesh), _) if is_written(&mesh.path) => {
            writeln!(Stdout, "refined mesh: {} ({})", mesh.path, mesh.status)?;
        }
        (None, Some(reason)) => writeln!(Stdout, "not refined:  {reason}")?,
        _ => {}
    }
    if let Some(page) = report.outputs.iter().find(|path| path.ends_with(".html")) {
        writeln!(Stdout, "report:       {page}")?;
    }
    for failure in &outcome.failures {
        writeln!(Stderr, "error: {failure}")?;
    }
    Ok(())
}

fn computing_secs(report: &Report) -> f64 {
    let stages = report.timings.iter().map(|stage| stage.total_secs);
    // A sum of nothing is -0.
    0.0 + stages.sum::<f64>()
}

/// What became of the frames, in a line.
fn frames(frames: &FrameCounts) -> String {
    let mut line = format!("{} of {} frames fused", frames.fused, frames.total);
    for (n, what) in [
        (frames.lost, "lost"),
        (frames.damaged, "damaged"),
        (frames.dropped, "dropped"),
        (frames.without_depth, "without depth"),
        (frames.paused, "paused"),
    ] {
        if n > 0 {
            line += &format!(", {n} {what}");
        }
    }
    line
}

#[cfg(test)]
mod tests {
    use super::*;
    use anyhow::Context;
    use relief::pipeline::OutputFolderError;

    #[test]
    fn causes_are_told_once() {
        let full = || io::Error::from_raw_os_error(28);
        let error = OutputFolderError::Io {
            folder: "out".into(),
            source: full(),
        };
        let error = anyhow::Error::from(error).context("cannot begin");
        assert_eq!(
            with_causes(&error),
            "cannot begin: cannot use output folder out: No space left on device (os error 28)"
        );
        let error = Err::<(), _>(full()).context("cannot record").unwrap_err();
        assert_eq!(
            with_causes(&error),
            "cannot record: No space left on device (os error 28)"
        );
    }
}
