//! Two kinds of chart as inline SVG: lines over a logarithmic scale, and pairs of bars. Colours come from the page's style.

use super::report_format::compact;
use maud::{Markup, html};

/// One row of numbers in a chart.
pub(super) struct Series {
    /// Name in the legend.
    pub name: &'static str,
    /// Class that gives the colour.
    pub class: &'static str,
    /// One number for each label on the horizontal axis; those that are not finite are left out.
    pub values: Vec<f64>,
}

/// What is written on a chart.
pub(super) struct Labels {
    /// Name and unit of the vertical axis.
    pub y: &'static str,
    /// Name of the horizontal axis.
    pub x: &'static str,
    /// The ticks of the horizontal axis.
    pub ticks: Vec<String>,
}

const WIDTH: f64 = 480.0;
const HEIGHT: f64 = 280.0;
const LEFT: f64 = 52.0;
const RIGHT: f64 = WIDTH - 10.0;
const TOP: f64 = 34.0;
const BOTTOM: f64 = HEIGHT - 44.0;
/// More labels than this run into each other.
const MAX_X_TICKS: usize = 12;
const MAX_BAR: f64 = 26.0;

/// Lines with a dot at each number over a logarithmic axis; numbers that are not positive have no place there.
pub(super) fn log_lines(labels: &Labels, series: &[Series]) -> Markup {
    let drawn = |x: &f64| x.is_finite() && *x > 0.0;
    let logs = series
        .iter()
        .flat_map(|s| &s.values)
        .copied()
        .filter(drawn)
        .map(f64::log10);
    let Some((low, high)) = range(logs) else {
        return nothing();
    };
    // A little air, and at least 2 % between the ends of the axis.
    let air = (0.06 * (high - low)).max(0.005);
    let (low, high) = (low - air, high + air);
    let y = |value: f64| BOTTOM - (value.log10() - low) / (high - low) * (BOTTOM - TOP);
    let n = labels.ticks.len().max(1) as f64;
    let x = |index: usize| LEFT + (index as f64 + 0.5) / n * (RIGHT - LEFT);
    let ticks = log_ticks(low, high);
    let lines = html! {
        @for s in series {
            @let points: Vec<(f64, f64)> = s.values.iter().enumerate()
                .filter(|(_, value)| drawn(value))
                .map(|(index, &value)| (x(index), y(value)))
                .collect();
            @let path: Vec<String> = points.iter().map(|(x, y)| format!("{x:.1},{y:.1}")).collect();
            g class=(s.class) {
                polyline class="line" points=(path.join(" ")) {}
                @for (x, y) in &points {
                    circle class="dot" cx=(format!("{x:.1}")) cy=(format!("{y:.1}")) r="3" {}
                }
            }
        }
    };
    frame(labels, series, &ticks, y, lines)
}

/// One group of bars for each label, one bar in it for each series, from zero.
pub(super) fn bars(labels: &Labels, series: &[Series]) -> Markup {
    let values = series.iter().flat_map(|s| &s.values).copied();
    let Some((_, high)) = range(values.filter(|x| x.is_finite() && *x >= 0.0)) else {
        return nothing();
    };
    let high = if high > 0.0 { 1.05 * high } else { 1.0 };
    let y = |value: f64| BOTTOM - value / high * (BOTTOM - TOP);
    let slot = (RIGHT - LEFT) / labels.ticks.len().max(1) as f64;
    let bar = (0.8 * slot / series.len() as f64).min(MAX_BAR);
    let rects = html! {
        @for (place, s) in series.iter().enumerate() {
            g class=(s.class) {
                @for (index, &value) in s.values.iter().enumerate() {
                    @if value.is_finite() && value >= 0.0 {
                        @let middle = LEFT + (index as f64 + 0.5) * slot;
                        @let left = middle + (place as f64 - 0.5 * series.len() as f64) * bar;
                        rect class="bar" x=(format!("{left:.1}")) y=(format!("{:.1}", y(value)))
                            width=(format!("{:.1}", 0.92 * bar)) height=(format!("{:.1}", BOTTOM - y(value))) {}
                    }
                }
            }
        }
    };
    frame(labels, series, &linear_ticks(0.0, high, 5), y, rects)
}

/// Axes, ticks, grid and legend around what is drawn.
fn frame(
    labels: &Labels,
    series: &[Series],
    y_ticks: &[f64],
    y: impl Fn(f64) -> f64,
    inner: Markup,
) -> Markup {
    let n = labels.ticks.len();
    let every = n.div_ceil(MAX_X_TICKS).max(1);
    let slot = (RIGHT - LEFT) / n.max(1) as f64;
    html! {
        svg class="chart" viewBox=(format!("0 0 {WIDTH} {HEIGHT}")) role="img" aria-label=(labels.y) {
            text class="axis-name" x="0" y="14" { (labels.y) }
            @for (place, s) in series.iter().rev().enumerate() {
                @let right = RIGHT - 76.0 * place as f64;
                g class=(s.class) {
                    rect class="bar" x=(right - 66.0) y="5" width="10" height="10" rx="2" {}
                    text class="legend" x=(right - 52.0) y="14" { (s.name) }
                }
            }
            @for &tick in y_ticks {
                @let at = format!("{:.1}", y(tick));
                line class="grid" x1=(LEFT) x2=(RIGHT) y1=(at) y2=(at) {}
                text class="tick" x=(LEFT - 8.0) y=(at) dy="0.35em" text-anchor="end" { (compact(tick)) }
            }
            (inner)
            line class="axis" x1=(LEFT) x2=(RIGHT) y1=(BOTTOM) y2=(BOTTOM) {}
            @for (index, label) in labels.ticks.iter().enumerate().step_by(every) {
                @let middle = LEFT + (index as f64 + 0.5) * slot;
                text class="tick" x=(format!("{middle:.1}")) y=(BOTTOM + 17.0) text-anchor="middle" { (label) }
            }
            text class="axis-name" x=(0.5 * (LEFT + RIGHT)) y=(HEIGHT - 6.0) text-anchor="middle" { (labels.x) }
        }
    }
}

/// What stands in place of a chart without numbers.
pub(super) fn nothing() -> Markup {
    html! { p class="quiet" { "There is nothing to draw." } }
}

/// The least and the greatest of some numbers.
pub(super) fn range(values: impl Iterator<Item = f64>) -> Option<(f64, f64)> {
    values.fold(None, |range, x| match range {
        None => Some((x, x)),
        Some((low, high)) => Some((x.min(low), x.max(high))),
    })
}

/// Ticks between two powers of ten, given by their exponents: decades, or 1-2-5, or round numbers where even those are too
/// far apart.
pub(super) fn log_ticks(low: f64, high: f64) -> Vec<f64> {
    let every = ((high - low) / 6.0).ceil().max(1.0) as i32;
    let ticks = |mantissas: &[f64], every: i32| {
        let powers =
            (low.floor() as i32..=high.ceil() as i32).filter(|power| power.rem_euclid(every) == 0);
        let all = powers.flat_map(|power| mantissas.iter().map(move |m| m * 10f64.powi(power)));
        all.filter(|x| (low..=high).contains(&x.log10()))
            .collect::<Vec<f64>>()
    };
    let decades = ticks(&[1.0], every);
    if decades.len() >= 3 {
        return decades;
    }
    let steps = ticks(&[1.0, 2.0, 5.0], 1);
    if steps.len() >= 3 {
        return steps;
    }
    linear_ticks(10f64.powf(low), 10f64.powf(high), 4)
}

/// Round numbers between two numbers, about so many, in steps of 1, 2 or 5 times a power of ten.
pub(super) fn linear_ticks(low: f64, high: f64, about: usize) -> Vec<f64> {
    let rough = (high - low) / about as f64;
    let power = 10f64.powf(rough.log10().floor());
    let steps = [1.0, 2.0, 5.0, 10.0].map(|m| m * power);
    let step = steps
        .into_iter()
        .find(|&step| step >= rough)
        .unwrap_or(rough);
    let (first, last) = ((low / step).ceil() as i64, (high / step).floor() as i64);
    (first..=last).map(|k| k as f64 * step).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ticks_are_round_and_inside() {
        assert_eq!(log_ticks(0.9, 4.1), [10.0, 100.0, 1000.0, 10000.0]);
        assert_eq!(log_ticks(2.0, 3.0), [100.0, 200.0, 500.0, 1000.0]);
        let close = log_ticks(5.0, 5.02);
        assert!(
            (3..=6).contains(&close.len()) && close.iter().all(|x| (1e5..=1.05e5).contains(x)),
            "{close:?}"
        );
        assert_eq!(linear_ticks(0.0, 4.2, 5), [0.0, 1.0, 2.0, 3.0, 4.0]);
    }

    #[test]
    fn charts_leave_out_what_they_cannot_draw() {
        let labels = Labels {
            y: "Energy",
            x: "Iteration",
            ticks: vec!["1".into(), "2".into(), "3".into()],
        };
        let series = |values: Vec<f64>| {
            [Series {
                name: "after",
                class: "refined",
                values,
            }]
        };
        let chart = log_lines(&labels, &series(vec![100.0, f64::NAN, 10.0])).into_string();
        assert_eq!(chart.matches("<circle").count(), 2);
        assert!(!chart.contains("NaN"));
        assert!(
            log_lines(&labels, &series(vec![0.0, -1.0]))
                .into_string()
                .contains("nothing to draw")
        );
        let chart = bars(&labels, &series(vec![0.02, 0.0, f64::INFINITY])).into_string();
        assert_eq!(chart.matches("<rect").count(), 3); // Two bars and the legend.
    }
}
