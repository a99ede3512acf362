//! Fig. 5 of the paper: how light falls with distance, over the whole image and by region.

use super::{
    DistanceFigure,
    chart::{nothing, range},
    colour_scale::tint,
    report_format::fixed,
    scatter::{Axis, Plot, Spacing, legend},
};
use maud::{Markup, html};

/// The exponent of a light that is a point.
const INVERSE_SQUARE: f64 = -2.0;
/// Points on a line that is bent in one of the plots.
const LINE_POINTS: u32 = 60;
/// Distance from the exponent of a point light at which a table cell has its full tint; arbitrary.
const FULL_TINT: f64 = 0.2;
const DISTANCE: &str = "Distance from the light, m";
const ROWS: [&str; 3] = ["Top", "Middle", "Bottom"];
const COLUMNS: [&str; 3] = ["Left", "Middle", "Right"];

/// The fall of light in two plots and a table.
pub(super) fn distance(figure: &DistanceFigure) -> Markup {
    let points: Vec<[f64; 2]> = figure
        .curve
        .iter()
        .filter(|point| point.iter().all(|x| x.is_finite() && *x > 0.0))
        .copied()
        .collect();
    html! {
        section id="distance" {
            h2 { "Light and distance" }
            p { "Intensity goes with distance to the power of " (interval(figure.exponent))
                " (95 % interval); by the inverse square law it would be −2." }
            div class="plots" { (plots(&points, figure.exponent.0)) }
            (regions(figure))
        }
    }
}

fn interval((value, half_width): (f64, f64)) -> String {
    format!("{} ± {}", fixed(value, 3), fixed(half_width, 3))
}

/// Lines of any exponent through the middle of the points, which is where a fitted line goes through.
struct Middle {
    log_distance: f64,
    log_intensity: f64,
}

impl Middle {
    fn of(points: &[[f64; 2]]) -> Self {
        let mean =
            |axis: usize| points.iter().map(|p| p[axis].ln()).sum::<f64>() / points.len() as f64;
        Middle {
            log_distance: mean(0),
            log_intensity: mean(1),
        }
    }

    fn intensity(&self, exponent: f64, distance_m: f64) -> f64 {
        (self.log_intensity + exponent * (distance_m.ln() - self.log_distance)).exp()
    }

    /// Per cent by which an intensity exceeds the inverse square law.
    fn excess(&self, [distance_m, intensity]: [f64; 2]) -> [f64; 2] {
        let ratio = intensity / self.intensity(INVERSE_SQUARE, distance_m);
        [distance_m, 100.0 * (ratio - 1.0)]
    }
}

fn plots(points: &[[f64; 2]], exponent: f64) -> Markup {
    let Some(x) = Axis::logarithmic(DISTANCE, points.iter().map(|p| p[0])) else {
        return nothing();
    };
    let Some(y) = Axis::logarithmic(
        "Relative linear intensity, log scale",
        points.iter().map(|p| p[1]),
    ) else {
        return nothing();
    };
    let middle = Middle::of(points);
    let line = |exponent: f64| {
        let (first, ratio) = (x.low, x.high / x.low);
        let middle = &middle;
        (0..=LINE_POINTS).map(move |k| {
            let distance_m = first * ratio.powf(f64::from(k) / f64::from(LINE_POINTS));
            [distance_m, middle.intensity(exponent, distance_m)]
        })
    };
    let excesses: Vec<[f64; 2]> = points.iter().map(|p| middle.excess(*p)).collect();
    let fitted_excess: Vec<[f64; 2]> = line(exponent).map(|p| middle.excess(p)).collect();
    let falls = Plot::wide(x.clone(), y);
    let departs = Plot::wide(
        x.clone(),
        excess_axis(&[&excesses[..], &fitted_excess].concat()),
    );
    let fall = html! {
        (falls.line("theory", line(INVERSE_SQUARE))) (falls.line("fitted", line(exponent)))
        (falls.dots("refined", points))
    };
    let departure = html! {
        (departs.line("theory", [[x.low, 0.0], [x.high, 0.0]].into_iter()))
        (departs.line("fitted", fitted_excess.into_iter())) (departs.dots("refined", &excesses))
    };
    let fitted = format!("exponent {}", fixed(exponent, 3));
    let key = legend(&[
        ("dots", "images"),
        ("fitted", &fitted),
        ("theory", "exponent −2"),
    ]);
    html! {
        figure {
            p class="title" { "Fall with distance" }
            (falls.framed("Intensity against distance on logarithmic axes, with the fitted and the theoretical line", &fall))
            (key)
        }
        figure {
            p class="title" { "Departure from the inverse square law" }
            (departs.framed("Departure of intensity from the inverse square law, per cent, against distance", &departure))
            (key)
        }
    }
}

/// An axis with zero in its middle, at least 1 % to either side.
fn excess_axis(points: &[[f64; 2]]) -> Axis {
    let (low, high) =
        range(points.iter().map(|p| p[1]).filter(|x| x.is_finite())).unwrap_or((0.0, 0.0));
    let limit = 1.1 * (-low).max(high).max(1.0);
    Axis {
        name: "Intensity over that of the inverse square law, %",
        low: -limit,
        high: limit,
        spacing: Spacing::Linear,
    }
}

/// The exponent by region of the image.
fn regions(figure: &DistanceFigure) -> Markup {
    html! {
        figure {
            p class="title" { "Exponent by region of the image" }
            div class="scroll" { table class="matrix" {
                thead { tr { th {} @for name in COLUMNS { th { (name) } } } }
                tbody { @for (name, row) in ROWS.iter().zip(&figure.regions) { tr {
                    th { (name) }
                    @for cell in row { (region(*cell)) }
                } } }
            } }
            figcaption { "With 95 % intervals. Blue falls faster than by the inverse square law, red slower; full colour at a \
                difference of " (fixed(FULL_TINT, 1)) ". A dash: not measured." }
        }
    }
}

fn region(exponent: Option<(f64, f64)>) -> Markup {
    match exponent.filter(|(value, _)| value.is_finite()) {
        Some((value, half_width)) => {
            let style = tint((value - INVERSE_SQUARE) / FULL_TINT);
            html! { td style=(style) { (fixed(value, 3)) small { "± " (fixed(half_width, 3)) } } }
        }
        None => html! { td { "–" } },
    }
}
