//! The text and the tables of a calibration's page.

use super::{
    CalibrationPage, CalibrationResult, CalibrationSession,
    report_format::{count, percent},
    report_sections::{sensor_name, sentence},
};
use maud::{Markup, html};

/// The device, as the page's title names it.
pub(super) fn device(page: &CalibrationPage) -> String {
    let name = sensor_name(&page.sensor);
    match (name, page.serial.as_str()) {
        ("", "") => "Unknown device".into(),
        (name, "") => name.into(),
        ("", serial) => format!("Serial {serial}"),
        (name, serial) => format!("{name} · {serial}"),
    }
}

/// The device, when and by what it was calibrated, and what the page shows.
pub(super) fn heading(page: &CalibrationPage) -> Markup {
    html! {
        header {
            p class="kicker" { "Calibration" @if !page.command.is_empty() { ": " (page.command) } }
            h1 { (device(page)) }
            @if !page.date.is_empty() { p class="device" { (page.date) } }
            p class="summary" id="summary" { (summary(page)) }
        }
    }
}

fn summary(page: &CalibrationPage) -> String {
    let figures = [
        ("the response", page.response.is_some()),
        ("the fall of light with distance", page.distance.is_some()),
        ("the flat field", page.flat_field.is_some()),
    ];
    let (shown, missing): (Vec<_>, Vec<_>) = figures.iter().partition(|(_, is_shown)| *is_shown);
    let named = |parts: Vec<&(&str, bool)>| {
        let names: Vec<&str> = parts.iter().map(|(name, _)| *name).collect();
        match names.split_last() {
            Some((last, before)) if !before.is_empty() => {
                format!("{} and {last}", before.join(", "))
            }
            _ => names.concat(),
        }
    };
    let n_images: usize = page.sessions.iter().map(|session| session.n_images).sum();
    let from = match (n_images, page.sessions.len()) {
        (0, _) => String::new(),
        (n, 1) => format!(" from {} images of one recording", count(n)),
        (n, recordings) => format!(" from {} images of {recordings} recordings", count(n)),
    };
    let missing = if missing.is_empty() {
        String::new()
    } else {
        format!(" Not measured: {}.", named(missing))
    };
    if shown.is_empty() {
        return format!("Nothing is shown{from}.{missing}");
    }
    format!("This page shows {}{from}.{missing}", named(shown))
}

/// What a user must know.
pub(super) fn remarks(remarks: &[String]) -> Markup {
    html! {
        @if !remarks.is_empty() {
            section class="notice" id="remarks" {
                h2 { "What to know" }
                ul { @for remark in remarks { li { (sentence(remark)) } } }
            }
        }
    }
}

/// The numbers that were found.
pub(super) fn results(results: &[CalibrationResult]) -> Markup {
    html! {
        @if !results.is_empty() {
            section id="results" {
                h2 { "Results" }
                p class="quiet" { "Intervals hold the true value in 95 % of cases, if the model is right." }
                table class="results" {
                    thead { tr { th { "Quantity" } th class="text" { "Value" } th class="text" { "Remark" } } }
                    tbody { @for result in results { tr {
                        th { (result.name) } td class="text" { (result.value) } td class="text wrap" { (result.remark) }
                    } } }
                }
            }
        }
    }
}

/// The recordings and how well the model fits them.
pub(super) fn sessions(sessions: &[CalibrationSession]) -> Markup {
    html! {
        @if !sessions.is_empty() {
            section id="recordings" {
                h2 { "Recordings" }
                p { "Deviation is the robust standard deviation of observed from predicted intensity, as a share of it; "
                    "noise is what the sensor's noise alone would make of it; outliers count for nothing." }
                div class="scroll" { table {
                    thead { tr { th { "Recording" } th class="text" { "Target" } th { "Images used" } th { "Left out" }
                        th { "Samples" } th { "Deviation" } th { "Noise" } th { "Outliers" } } }
                    tbody { @for session in sessions { tr {
                        th { (session.name) } td class="text" { (session.target) }
                        td { (count(session.n_images)) } td { (count(session.n_unused)) } td { (count(session.n_samples)) }
                        td { (percent(session.deviation)) } td { (percent(session.noise)) }
                        td { (percent(session.outlier_share)) }
                    } } }
                } }
            }
        }
    }
}
