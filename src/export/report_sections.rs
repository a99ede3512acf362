//! The sections of the report page, in the order in which they stand there.

use super::{
    FrameCounts, Report,
    page::figure,
    report_format::{area, change, count, duration, fixed, length, memory, percent},
    report_html::EncodedPictures,
};
use maud::{Markup, html};

/// What the pictures show, in the order of `views::three_views`.
const VIEW_NAMES: [&str; 3] = ["Front", "From the left", "From the right, above"];

/// Name of the scan, the device, and the result in one sentence.
pub(super) fn heading(report: &Report) -> Markup {
    html! {
        header {
            p class="kicker" { "Scan report" }
            h1 { (report.session) }
            p class="device" {
                (sensor_name(&report.sensor)) @if !report.serial.is_empty() { " · serial " (report.serial) }
                " · Relief " (report.relief_version)
                @if !report.calibration.is_empty() { " · calibration: " (report.calibration) }
            }
            p class="summary" id="summary" { (summary(report)) }
        }
    }
}

/// A sensor as people call it.
pub(super) fn sensor_name(sensor: &str) -> &str {
    match sensor {
        "kinect1" => "Kinect I",
        "kinect2" => "Kinect II",
        other => other,
    }
}

fn summary(report: &Report) -> String {
    let capture = fused(&report.frames);
    match &report.refined_mesh {
        None => format!(
            "{capture}: a surface of {} faces and {}.",
            count(report.base_mesh.faces),
            area(report.base_mesh.area_m2)
        ),
        Some(refined) => format!(
            "{capture}; {} faces refined from {} shading images. The difference between rendered and observed infrared went \
             from {} to {} of the mean intensity ({}).",
            count(refined.faces),
            refined.views.len(),
            percent(refined.rmse_before),
            percent(refined.rmse_after),
            change(refined.rmse_before, refined.rmse_after)
        ),
    }
}

/// How many frames were fused, and how many of them count where some were taken back.
fn fused(frames: &FrameCounts) -> String {
    let fused = format!(
        "{} of {} frames fused",
        count(frames.fused),
        count(frames.total)
    );
    match frames.in_model == frames.fused {
        true => fused,
        false => format!("{fused}, {} of them in the model", count(frames.in_model)),
    }
}

/// Why there is no refined mesh, if there is none.
pub(super) fn not_refined(report: &Report) -> Markup {
    let reason = report.not_refined_reason.as_deref();
    html! {
        @if report.refined_mesh.is_none() {
            section class="notice" id="not-refined" {
                h2 { "This scan was not refined" }
                p { (sentence(reason.unwrap_or("no reason was recorded"))) }
                @if report.base_mesh.faces > 0 {
                    p class="quiet" { "The base mesh below is complete and can be used as it is." }
                }
            }
        }
    }
}

/// Upper case at the beginning, a full stop at the end.
pub(super) fn sentence(text: &str) -> String {
    let mut chars = text.trim().chars();
    let first: String = chars
        .next()
        .map(|c| c.to_uppercase().collect())
        .unwrap_or_default();
    let text = first + chars.as_str();
    if text.ends_with(['.', '!', '?']) {
        text
    } else {
        text + "."
    }
}

/// What the operator should know.
pub(super) fn warnings(report: &Report) -> Markup {
    html! {
        @if !report.warnings.is_empty() {
            section class="notice warning" id="warnings" {
                h2 { @if report.warnings.len() == 1 { "One warning" } @else { (report.warnings.len()) " warnings" } }
                ul { @for warning in &report.warnings { li { (sentence(warning)) } } }
            }
        }
    }
}

/// The figures that one looks for first.
pub(super) fn key_figures(report: &Report) -> Markup {
    let frames = &report.frames;
    let share = frames.fused as f64 / frames.total as f64;
    let fused = if share.is_finite() {
        format!("{} %", fixed(100.0 * share, 1))
    } else {
        "–".into()
    };
    let mut figures = vec![
        ("Frames fused", fused),
        ("Camera path", length(report.tracking.path_length_m)),
        (
            "Base mesh",
            format!("{} faces", count(report.base_mesh.faces)),
        ),
    ];
    if let Some(refined) = &report.refined_mesh {
        figures.push(("Refined mesh", format!("{} faces", count(refined.faces))));
        figures.push(("Mean edge", length(refined.edge_length_m)));
        figures.push((
            "Infrared difference",
            change(refined.rmse_before, refined.rmse_after),
        ));
    } else {
        figures.push(("Surface", area(report.base_mesh.area_m2)));
    }
    html! {
        dl class="figures" { @for (name, value) in figures { div { dt { (name) } dd { (value) } } } }
    }
}

/// Pictures of the base mesh and, beside each, of the refined one.
pub(super) fn surface(report: &Report, pictures: &EncodedPictures) -> Markup {
    let names = VIEW_NAMES.iter().copied().chain(std::iter::repeat("View"));
    let refined = |index: usize| pictures.refined.get(index);
    let base = &report.base_mesh;
    html! {
        section id="surface" {
            h2 { "Surface" }
            // Beside each other per view if there is something to compare, else all in a row.
            div class=(if pictures.refined.is_empty() { "row" } else { "pair" }) {
                @for (index, (address, name)) in pictures.base.iter().zip(names).enumerate() {
                    (figure(address, &format!("{name} · base mesh")))
                    @if let Some(address) = refined(index) { (figure(address, &format!("{name} · refined mesh"))) }
                }
            }
            div class="scroll" { table {
                thead { tr { th { "Mesh" } th { "Vertices" } th { "Faces" } th { "Area" } th class="text" { "File" } } }
                tbody {
                    tr { th { "Base" } td { (count(base.vertices)) } td { (count(base.faces)) } td { (area(base.area_m2)) }
                        td class="text" { (base.path) } }
                    @if let Some(mesh) = &report.refined_mesh {
                        tr { th { "Refined" } td { (count(mesh.vertices)) } td { (count(mesh.faces)) } td { (area(mesh.area_m2)) }
                            td class="text" { (mesh.path) } }
                    }
                }
            } }
        }
    }
}

/// Small pictures of what the sensor saw.
pub(super) fn images(pictures: &EncodedPictures) -> Markup {
    html! {
        @if !pictures.thumbnails.is_empty() || pictures.depth.is_some() {
            section id="images" {
                h2 { "What the sensor saw" }
                div class="thumbnails" {
                    @if let Some(address) = &pictures.depth { (figure(address, "Depth")) }
                    @for (caption, address) in &pictures.thumbnails { (figure(address, caption)) }
                }
            }
        }
    }
}

/// Frames and tracking.
pub(super) fn capture(report: &Report) -> Markup {
    let f = &report.frames;
    let rows = [
        ("Total", f.total),
        ("Fused", f.fused),
        ("In the model", f.in_model),
        ("Tracking lost", f.lost),
        ("Damaged", f.damaged),
        ("Dropped", f.dropped),
        ("Without depth", f.without_depth),
        ("Paused", f.paused),
        ("Missed by the driver", f.missed),
    ];
    let spans = &report.tracking.lost_spans;
    html! {
        section id="capture" {
            h2 { "Capture and tracking" }
            dl class="figures small" { @for (name, n) in rows { div { dt { (name) } dd { (count(n)) } } } }
            @if spans.is_empty() {
                p { "Tracking was never lost along a camera path of " (length(report.tracking.path_length_m)) "." }
            } @else {
                p { "Tracking was lost " @if spans.len() == 1 { "once" } @else { (spans.len()) " times" }
                    " along a camera path of " (length(report.tracking.path_length_m)) "." }
                div class="scroll" { table {
                    thead { tr { th { "Frames" } th { "From, s" } th { "To, s" } th class="text" { "Reason" } } }
                    tbody { @for span in spans { tr {
                        th { (span.first_frame_id) "–" (span.last_frame_id) }
                        td { (fixed(span.start_secs, 2)) } td { (fixed(span.end_secs, 2)) } td class="text" { (span.reason) }
                    } } }
                } }
            }
        }
    }
}

/// Time and memory.
pub(super) fn timings(report: &Report) -> Markup {
    html! {
        section id="timings" {
            h2 { "Time and memory" }
            div class="scroll" { table {
                thead { tr { th { "Stage" } th { "Total" } th { "Runs" } th { "Median" } } }
                tbody { @for stage in &report.timings { tr {
                    th { (stage.name) } td { (duration(stage.total_secs)) } td { (count(stage.n)) }
                    td { (duration(1e-3 * stage.median_ms)) }
                } } }
            } }
            @if let Some(bytes) = report.peak_memory_bytes {
                p class="quiet" { "Peak memory: " (memory(bytes)) "." }
            }
        }
    }
}

/// The files written.
pub(super) fn outputs(report: &Report) -> Markup {
    html! {
        section id="outputs" {
            h2 { "Files" }
            ul class="files" { @for path in &report.outputs { li { code { (path) } } } }
        }
    }
}
