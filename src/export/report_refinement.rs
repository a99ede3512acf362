//! The sections of the report page that exist only when a scan was refined.

use super::report_html::EncodedPictures;
use super::{
    Evidence, HeldOut, RefinedMesh, Remeshing,
    chart::{Labels, Series, bars, log_lines},
    report_format::{change, compact, count, fixed, length, percent},
};
use maud::{Markup, html};

/// How refinement went, step by step.
pub(super) fn refinement(refined: &RefinedMesh, pictures: &EncodedPictures) -> Markup {
    let numbers = || {
        (1..=refined.iterations.len())
            .map(|k| k.to_string())
            .collect::<Vec<_>>()
    };
    let energy = Labels {
        y: "Energy, log scale",
        x: "Step",
        ticks: numbers(),
    };
    let before = refined.iterations.iter().map(|i| i.energy_before).collect();
    let after = refined.iterations.iter().map(|i| i.energy_after).collect();
    html! {
        section id="refinement" {
            h2 { "Refinement" }
            p { "Ended: " strong { (refined.status) } ", after " (refined.iterations.len()) " steps." }
            div class="split" {
                figure class="plot" { (log_lines(&energy, &before_and_after(before, after))) }
                div class="scroll" { table {
                    thead { tr { th { "#" } th { "Energy before" } th { "after" } th { "Max. step" } th { "Damping" } } }
                    tbody { @for (k, i) in refined.iterations.iter().enumerate() { tr {
                        th { (k + 1) } td { (compact(i.energy_before)) } td { (compact(i.energy_after)) }
                        td { (length(i.max_step_m)) } td { (compact(i.damping)) }
                    } } }
                } }
            }
            @if refined.held_out.n_views > 0 { (held_out(&refined.held_out)) }
            (evidence(&refined.evidence))
            (remeshing(&refined.remeshing))
            @if !refined.albedo.is_empty() {
                p class="quiet" { "Albedo: "
                    @for (label, material) in refined.albedo.iter().enumerate() {
                        @if label > 0 { ", " }
                        (fixed(material.albedo, 3)) " (label " (label) ") on " (fixed(100.0 * material.area_share, 0)) " % of the surface"
                        @if material.gloss > 0.0 { ", glossy: " (fixed(material.gloss, 2)) " of it at the middle of a highlight" }
                    } "."
                }
            }
            @if !pictures.fields.is_empty() {
                div class="row" { @for field in &pictures.fields { (field) } }
            }
        }
    }
}

/// How well the vertices are known.
fn evidence(evidence: &Evidence) -> Markup {
    html! {
        p { "A vertex is seen by " (evidence.median_views) " images in the median, its displacement known to "
            (length(evidence.median_sigma_m)) " (nine tenths of them to " (length(evidence.high_sigma_m)) ")."
            @if evidence.unseen_share > 0.0 {
                " No image shows " strong { (percent(evidence.unseen_share)) " of its vertices" } ": there the surface is as it was fused, but for the first 8 mm or so beside what images show, where it goes along."
            }
            @if evidence.weak_share > 0.0 {
                " Of another " (percent(evidence.weak_share)) " images say little, since they show them from one side only."
            }
        }
    }
}

/// How far remeshing moved the surface.
fn remeshing(remeshing: &Remeshing) -> Markup {
    let (base, remeshed) = (&remeshing.from_base, &remeshing.from_remeshed);
    html! {
        p { "Remeshed and not displaced yet, the surface lay within " (length(remeshing.hausdorff_m)) " of the base mesh (Hausdorff distance over "
            (count(base.n_points)) " vertices of the base mesh and " (count(remeshed.n_points)) " faces; root mean square "
            (length(base.rms_m)) " and " (length(remeshed.rms_m)) ")."
        }
    }
}

/// What images that refinement did not use say.
fn held_out(held_out: &HeldOut) -> Markup {
    html! {
        p { (held_out.n_views) " images were held out to judge: of their intensity "
            (percent(held_out.intensity_base)) " is unexplained by the base mesh, "
            (percent(held_out.intensity_refined)) " by the refined one, " (percent(held_out.intensity_noise)) " is noise; of its gradient "
            (percent(held_out.gradient_base)) ", " (percent(held_out.gradient_refined)) " and " (percent(held_out.gradient_noise)) "."
        }
    }
}

fn before_and_after(before: Vec<f64>, after: Vec<f64>) -> [Series; 2] {
    [
        Series {
            name: "before",
            class: "base",
            values: before,
        },
        Series {
            name: "after",
            class: "refined",
            values: after,
        },
    ]
}

/// The shading images and how well each is explained.
pub(super) fn views(refined: &RefinedMesh) -> Markup {
    let per_cent = |share: f64| 100.0 * share;
    let labels = Labels {
        y: "RMSE, % of mean intensity",
        x: "Frame",
        ticks: refined
            .views
            .iter()
            .map(|view| view.frame_id.to_string())
            .collect(),
    };
    let before = refined
        .views
        .iter()
        .map(|view| per_cent(view.rmse_before))
        .collect();
    let after = refined
        .views
        .iter()
        .map(|view| per_cent(view.rmse_after))
        .collect();
    html! {
        section id="views" {
            h2 { "Shading images" }
            p { "How far the infrared image rendered from the mesh is from the observed one." }
            div class="split" {
                figure class="plot" { (bars(&labels, &before_and_after(before, after))) }
                div class="scroll" { table {
                    thead { tr { th { "Frame" } th { "Time, s" } th { "Gain" } th { "Shift u, v, px" } th { "RMSE before" }
                        th { "after" } th { "Change" } th { "Sites" } } }
                    tbody { @for view in &refined.views { tr {
                        th { (view.frame_id) } td { (fixed(view.time_secs, 2)) } td { (fixed(view.gain, 3)) }
                        td { (fixed(view.shift_px[0], 2)) ", " (fixed(view.shift_px[1], 2)) }
                        td { (percent(view.rmse_before)) } td { (percent(view.rmse_after)) }
                        td { (change(view.rmse_before, view.rmse_after)) } td { (count(view.n_sites)) }
                    } } }
                } }
            }
        }
    }
}
