//! Fig. 7 of the paper: observed against predicted intensity on a sphere, the response, and where the model is wrong.

use super::{
    ResponseFigure,
    chart::nothing,
    colour_scale::{ColourScale, Described, tint},
    report_format::{fixed, percent},
    scatter::{Axis, Plot, Spacing, legend},
};
use depth_camera::Image;
use maud::{Markup, html};
use std::io;

/// Points on the curve of the response: more than it has bends.
const CURVE_POINTS: u32 = 120;
/// Share of the points that the axes hold at least; a few outliers must not shrink the rest.
const SHOWN: f64 = 0.999;
/// Share of the residuals that the colours of the map tell apart.
const COLOURED: f64 = 0.98;
/// Mean residual at which a table cell has its full tint: five times the noise of a good fit, otherwise arbitrary.
const FULL_TINT: f64 = 0.05;

/// The response in two plots, a map and a table.
///
/// # Errors
/// If a picture cannot be encoded.
pub(super) fn response(figure: &ResponseFigure) -> io::Result<Markup> {
    let map = residual_map(&figure.residual_map)?;
    let plots = match end_of_axes(&figure.scatter) {
        Some(end) => html! { (prediction(figure, end)?) (curve(figure, end)?) },
        None => nothing(),
    };
    let bound = fixed(100.0 * figure.inlier_bound, 0);
    Ok(html! {
        section id="response" {
            h2 { "Response" }
            p { "The sensor turns linear intensity L into I = L" sup { "γ" } " with γ = " (fixed(figure.gamma, 3)) ". "
                (percent(figure.within)) " of the pixels lie within " (bound) " % of full scale of what the model predicts." }
            div class="plots" { (plots) }
            div class="plots" { (map) (residual_table(figure)) }
        }
    })
}

/// Where the axes of both plots end, in per cent of full scale; `None` if there is nothing to show.
fn end_of_axes(scatter: &[[f64; 3]]) -> Option<f64> {
    let finite = |point: &&[f64; 3]| point.iter().all(|x| x.is_finite());
    let greatest = |point: &[f64; 3]| point.iter().copied().fold(0.0, f64::max);
    let end = quantile(scatter.iter().filter(finite).map(greatest).collect(), SHOWN)?;
    (end > 0.0).then_some(105.0 * end)
}

/// The number that so large a share of the others does not exceed.
fn quantile(mut values: Vec<f64>, share: f64) -> Option<f64> {
    let last = values.len().checked_sub(1)?;
    let index = (share * last as f64).ceil() as usize;
    Some(*values.select_nth_unstable_by(index, f64::total_cmp).1)
}

fn intensity_axis(name: &'static str, end: f64) -> Axis {
    Axis {
        name,
        low: 0.0,
        high: end,
        spacing: Spacing::Linear,
    }
}

/// Observed against predicted intensity, with the band of the inliers.
fn prediction(figure: &ResponseFigure, end: f64) -> io::Result<Markup> {
    let plot = Plot::square(
        intensity_axis("Predicted intensity, % of full scale", end),
        intensity_axis("Observed intensity, % of full scale", end),
    );
    let points: Vec<[f64; 2]> = figure
        .scatter
        .iter()
        .map(|[_, predicted, observed]| [100.0 * predicted, 100.0 * observed])
        .collect();
    let (density, most) = plot.density(&points)?;
    let bound = 100.0 * figure.inlier_bound;
    let bound = if bound > end { end } else { bound };
    let band = [
        [0.0, 0.0],
        [0.0, bound],
        [end - bound, end],
        [end, end],
        [end, end - bound],
        [bound, 0.0],
    ];
    let drawn = html! {
        (plot.area("band", band.into_iter())) (density)
        (plot.line("theory", [[0.0, 0.0], [end, end]].into_iter()))
    };
    let alt = "Observed against predicted intensity: a density along the line of equality";
    let within = format!("within {} %", fixed(100.0 * figure.inlier_bound, 0));
    Ok(html! {
        figure {
            p class="title" { "Observed against predicted" }
            (plot.framed(alt, &drawn))
            (legend(&[("theory", "equal"), ("band", &within), ("density", &pixels_per_cell(most))]))
            (outside(&plot, &points))
        }
    })
}

fn pixels_per_cell(most: u32) -> String {
    format!("1 to {most} pixels a cell")
}

/// How many points the axes do not hold, if any.
fn outside(plot: &Plot, points: &[[f64; 2]]) -> Markup {
    let n = points.iter().filter(|point| !plot.holds(**point)).count();
    html! { @if n > 0 { figcaption { (n) " of " (points.len()) " points lie outside the axes." } } }
}

/// The response: observed against linear intensity.
fn curve(figure: &ResponseFigure, end: f64) -> io::Result<Markup> {
    let plot = Plot::square(
        intensity_axis("Predicted linear intensity, % of full scale", end),
        intensity_axis("Observed intensity, % of full scale", end),
    );
    let points: Vec<[f64; 2]> = figure
        .scatter
        .iter()
        .map(|[linear, _, observed]| [100.0 * linear, 100.0 * observed])
        .collect();
    let (density, most) = plot.density(&points)?;
    // Eq. (1)
    let respond = |linear: f64| 100.0 * (linear / 100.0).powf(figure.gamma);
    let linear = (0..=CURVE_POINTS).map(|k| end * f64::from(k) / f64::from(CURVE_POINTS));
    let drawn = html! {
        (density)
        (plot.line("theory", [[0.0, 0.0], [end, end]].into_iter()))
        (plot.line("fitted", linear.map(|x| [x, respond(x)])))
    };
    let alt = "Observed against linear intensity with the fitted power law";
    let fitted = format!("γ = {}", fixed(figure.gamma, 3));
    Ok(html! {
        figure {
            p class="title" { "Response curve" }
            (plot.framed(alt, &drawn))
            (legend(&[("fitted", &fitted), ("theory", "γ = 1"), ("density", &pixels_per_cell(most))]))
            (outside(&plot, &points))
        }
    })
}

/// Where on the sphere the model is wrong.
fn residual_map(map: &Image<f32>) -> io::Result<Markup> {
    let finite = map.data().iter().filter(|x| x.is_finite());
    let limit = quantile(finite.map(|x| f64::from(x.abs())).collect(), COLOURED);
    let (Some(limit), Some(part)) = (limit, compared_part(map)) else {
        return Ok(html! { figure { p class="title" { "Residual over one image" } (nothing()) } });
    };
    // A perfect fit still needs colours that differ.
    let limit = limit.max(1e-6);
    let shown = Image::from_vec(
        part.width,
        part.height,
        (part.top..part.top + part.height)
            .flat_map(|v| &map.row(v)[part.left..part.left + part.width])
            .copied()
            .collect(),
    );
    let described = Described {
        title: "Residual over one image, % of full scale",
        alt: "Map of observed less predicted intensity on the sphere".into(),
        caption: format!(
            "Observed less predicted: red is brighter than predicted, blue darker. The colours span ±{} % of full scale, which \
             holds {} % of the pixels; those beyond have the colours of the ends. Columns {} to {}, rows {} to {} of the image.",
            fixed(100.0 * limit, 2),
            fixed(100.0 * COLOURED, 0),
            part.left,
            part.left + part.width - 1,
            part.top,
            part.top + part.height - 1
        ),
        factor: 100.0,
    };
    ColourScale::symmetric(limit).figure(&shown, &described)
}

/// A part of an image, pixels.
struct Part {
    left: usize,
    top: usize,
    width: usize,
    height: usize,
}

/// The part in which something was compared.
fn compared_part(map: &Image<f32>) -> Option<Part> {
    let pixels = map.data().iter().enumerate().filter(|(_, x)| x.is_finite());
    let bounds = pixels.fold(None, |bounds, (pixel, _)| {
        let (u, v) = (pixel % map.width(), pixel / map.width());
        let (left, right, top, bottom) = bounds.unwrap_or((u, u, v, v));
        Some((left.min(u), right.max(u), top.min(v), bottom.max(v)))
    });
    bounds.map(|(left, right, top, bottom)| Part {
        left,
        top,
        width: right - left + 1,
        height: bottom - top + 1,
    })
}

/// Mean residual by incidence and interreflected share.
fn residual_table(figure: &ResponseFigure) -> Markup {
    let per_cent = |share: f64| fixed(100.0 * share, 0);
    let degrees = |cosine: f64| fixed(cosine.clamp(-1.0, 1.0).acos().to_degrees(), 0);
    html! {
        figure {
            p class="title" { "Mean residual, % of the prediction" }
            div class="scroll" { table class="matrix" {
                thead {
                    tr { th rowspan="2" { "Interreflected" br; "light, %" }
                        th colspan=(figure.incidences.len().saturating_sub(1)) { "Cosine and angle of incidence" } }
                    tr { @for border in figure.incidences.windows(2) {
                        th { (fixed(border[0], 2)) "–" (fixed(border[1], 2))
                            small { (degrees(border[0])) "°–" (degrees(border[1])) "°" } }
                    } }
                }
                tbody { @for (border, row) in figure.shares.windows(2).zip(&figure.residuals) { tr {
                    th { (per_cent(border[0])) "–" (per_cent(border[1])) }
                    @for cell in row { (residual_cell(*cell)) }
                } } }
            } }
            figcaption { "Interreflected light comes from the target's surroundings. Red is brighter than predicted, blue darker, \
                full colour at " (per_cent(FULL_TINT)) " %. A dash: too few pixels." }
        }
    }
}

fn residual_cell(residual: Option<f64>) -> Markup {
    match residual.filter(|x| x.is_finite()) {
        Some(x) => {
            let sign = if x > 0.0 { "+" } else { "" };
            html! { td style=(tint(x / FULL_TINT)) { (sign) (fixed(100.0 * x, 2)) } }
        }
        None => html! { td { "–" } },
    }
}
