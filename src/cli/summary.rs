//! What the program says on standard output when a run is over.

use relief::{
    export::{BaseMesh, FrameCounts, HeldOut, Report, StageTiming, Tracking},
    pipeline::{Ending, Outcome},
};
use serde::Serialize;
use serde_json::json;

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
    rmse_before: f64,
    rmse_after: f64,
    held_out: HeldOut,
}

/// Prints the summary as one JSON object on one line.
///
/// # Errors
/// Never for what a run leaves behind; numbers that do not exist are `null`.
pub fn print_json(outcome: &Outcome) -> serde_json::Result<()> {
    println!("{}", serde_json::to_string(&summary(outcome))?);
    Ok(())
}

/// Prints an error as the JSON object that replaces the summary.
pub fn print_error(error: &anyhow::Error) {
    println!(
        "{}",
        json!({"status": "failed", "failures": [format!("{error:#}")]})
    );
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

/// Prints the summary as a person reads it.
pub fn print_text(outcome: &Outcome) {
    let report = &outcome.report;
    print_frames(report);
    if report.base_mesh.faces > 0 {
        println!("base mesh:    {}", report.base_mesh.path);
    }
    match (&report.refined_mesh, &report.not_refined_reason) {
        (Some(mesh), _) => println!("refined mesh: {} ({})", mesh.path, mesh.status),
        (None, Some(reason)) => println!("not refined:  {reason}"),
        (None, None) => {}
    }
    if let Some(page) = report.outputs.iter().find(|path| path.ends_with(".html")) {
        println!("report:       {page}");
    }
    for failure in &outcome.failures {
        eprintln!("error: {failure}");
    }
}

fn print_frames(report: &Report) {
    let frames = &report.frames;
    let seconds: f64 = report.timings.iter().map(|stage| stage.total_secs).sum();
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
    println!("{line}; {seconds:.1} s of computing");
}
