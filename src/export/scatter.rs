//! Plots of points over two axes of numbers as inline SVG: dots and lines, and a density where there are too many points
//! for dots. Colours come from the page's style, except the density's, which is legible on light and on dark.

use super::{
    chart::{linear_ticks, log_ticks, range},
    encode_png_rgba,
    page::data_address,
    report_format::compact,
};
use depth_camera::Image;
use maud::{Markup, html};
use std::io;

const WIDTH: f64 = 480.0;
const LEFT: f64 = 52.0;
const RIGHT: f64 = WIDTH - 10.0;
const TOP: f64 = 30.0;
/// Room beneath the plot for ticks and a name.
const BENEATH: f64 = 44.0;
/// Cells of a density on each axis: few enough that some thousand points fill them.
const N_CELLS: usize = 96;
/// Colour of the fullest cell.
const DENSE: [u8; 3] = [18, 140, 130];
/// Opacity of a cell with one point.
const FAINTEST: f64 = 0.25;

/// How far apart numbers lie on an axis.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Spacing {
    Linear,
    Logarithmic,
}

/// One axis.
#[derive(Clone, Debug)]
pub(super) struct Axis {
    /// Name and unit.
    pub name: &'static str,
    /// The number at its beginning; positive if the spacing is logarithmic.
    pub low: f64,
    /// The number at its end, greater.
    pub high: f64,
    /// How numbers are spaced.
    pub spacing: Spacing,
}

impl Axis {
    /// A logarithmic axis with a little air around some numbers; `None` if there is none that is finite and positive.
    pub fn logarithmic(name: &'static str, values: impl Iterator<Item = f64>) -> Option<Self> {
        let logs = values.filter(|x| x.is_finite() && *x > 0.0).map(f64::ln);
        let (low, high) = range(logs)?;
        let air = (0.06 * (high - low)).max(0.01);
        Some(Axis {
            name,
            low: (low - air).exp(),
            high: (high + air).exp(),
            spacing: Spacing::Logarithmic,
        })
    }

    /// Share of the way along the axis; not finite where the number has no place.
    fn share(&self, value: f64) -> f64 {
        match self.spacing {
            Spacing::Linear => (value - self.low) / (self.high - self.low),
            Spacing::Logarithmic => (value / self.low).ln() / (self.high / self.low).ln(),
        }
    }

    fn holds(&self, value: f64) -> bool {
        // Ends count as inside whatever rounding makes of them.
        (-1e-9..=1.0 + 1e-9).contains(&self.share(value))
    }

    fn ticks(&self) -> Vec<f64> {
        match self.spacing {
            Spacing::Linear => linear_ticks(self.low, self.high, 5),
            Spacing::Logarithmic => log_ticks(self.low.log10(), self.high.log10()),
        }
    }
}

/// Two axes and the height of what they enclose. Points outside are left out, whatever draws them.
#[derive(Clone, Debug)]
pub(super) struct Plot {
    x: Axis,
    y: Axis,
    height: f64,
}

impl Plot {
    /// As high as it is wide: for axes of one kind.
    pub fn square(x: Axis, y: Axis) -> Self {
        let height = RIGHT - LEFT;
        Plot { x, y, height }
    }

    /// Wider than high.
    pub fn wide(x: Axis, y: Axis) -> Self {
        let height = 0.75 * (RIGHT - LEFT);
        Plot { x, y, height }
    }

    /// Whether a point has a place on the plot.
    pub fn holds(&self, [x, y]: [f64; 2]) -> bool {
        self.x.holds(x) && self.y.holds(y)
    }

    /// Dots.
    pub fn dots(&self, class: &str, points: &[[f64; 2]]) -> Markup {
        html! { g class=(class) { @for &[x, y] in points.iter().filter(|point| self.holds(**point)) {
            circle class="dot" cx=(format!("{:.1}", self.place_x(x))) cy=(format!("{:.1}", self.place_y(y))) r="3.5" {}
        } } }
    }

    /// A line through points.
    pub fn line(&self, class: &str, points: impl Iterator<Item = [f64; 2]>) -> Markup {
        html! { g class=(class) { polyline class="line" points=(self.path(points)) {} } }
    }

    /// A filled polygon.
    pub fn area(&self, class: &str, corners: impl Iterator<Item = [f64; 2]>) -> Markup {
        html! { polygon class=(class) points=(self.path(corners)) {} }
    }

    /// How many points fall where: the shade grows with the logarithm of the number in a cell, whose greatest is returned.
    ///
    /// # Errors
    /// If the picture cannot be encoded.
    pub fn density(&self, points: &[[f64; 2]]) -> io::Result<(Markup, u32)> {
        let mut counts = Image::filled(N_CELLS, N_CELLS, 0u32);
        let cell = |share: f64| ((share * N_CELLS as f64) as usize).min(N_CELLS - 1);
        for &[x, y] in points.iter().filter(|point| self.holds(**point)) {
            let (column, row) = (cell(self.x.share(x)), cell(1.0 - self.y.share(y)));
            counts.data_mut()[row * N_CELLS + column] += 1;
        }
        let most = counts.data().iter().copied().max().unwrap_or(0);
        let [red, green, blue] = DENSE;
        let picture = counts.map(|&n| {
            if n == 0 {
                return [0; 4];
            }
            let share = f64::from(n).ln() / f64::from(most.max(2)).ln();
            let opacity = FAINTEST + (1.0 - FAINTEST) * share;
            [red, green, blue, (255.0 * opacity).round() as u8]
        });
        let address = data_address(&encode_png_rgba(&picture)?);
        let image = html! {
            image class="cells" href=(address) x=(LEFT) y=(TOP) width=(RIGHT - LEFT) height=(self.height)
                preserveAspectRatio="none" {}
        };
        Ok((image, most))
    }

    /// Axes, ticks and grid beneath what is drawn, and what to tell those who cannot see it.
    pub fn framed(&self, alt: &str, drawn: &Markup) -> Markup {
        let bottom = TOP + self.height;
        let height = bottom + BENEATH;
        html! {
            svg class="chart" viewBox=(format!("0 0 {WIDTH} {height}")) role="img" aria-label=(alt) {
                text class="axis-name" x="0" y="14" { (self.y.name) }
                @for tick in self.y.ticks() {
                    @let y = format!("{:.1}", self.place_y(tick));
                    line class="grid" x1=(LEFT) x2=(RIGHT) y1=(y) y2=(y) {}
                    text class="tick" x=(LEFT - 8.0) y=(y) dy="0.35em" text-anchor="end" { (compact(tick)) }
                }
                @for tick in self.x.ticks() {
                    @let x = format!("{:.1}", self.place_x(tick));
                    line class="grid" x1=(x) x2=(x) y1=(TOP) y2=(bottom) {}
                    text class="tick" x=(x) y=(bottom + 17.0) text-anchor="middle" { (compact(tick)) }
                }
                (drawn)
                line class="axis" x1=(LEFT) x2=(RIGHT) y1=(bottom) y2=(bottom) {}
                line class="axis" x1=(LEFT) x2=(LEFT) y1=(TOP) y2=(bottom) {}
                text class="axis-name" x=(0.5 * (LEFT + RIGHT)) y=(height - 6.0) text-anchor="middle" { (self.x.name) }
            }
        }
    }

    fn path(&self, points: impl Iterator<Item = [f64; 2]>) -> String {
        let inside = points.filter(|point| self.holds(*point));
        let places: Vec<String> = inside
            .map(|[x, y]| format!("{:.1},{:.1}", self.place_x(x), self.place_y(y)))
            .collect();
        places.join(" ")
    }

    fn place_x(&self, value: f64) -> f64 {
        LEFT + self.x.share(value) * (RIGHT - LEFT)
    }

    fn place_y(&self, value: f64) -> f64 {
        TOP + (1.0 - self.y.share(value)) * self.height
    }
}

/// What the marks of a plot mean: class and text of each.
pub(super) fn legend(entries: &[(&str, &str)]) -> Markup {
    html! { p class="legend" { @for (class, text) in entries { span { i class=(class) {} (text) } } } }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn percent(name: &'static str) -> Axis {
        Axis {
            name,
            low: 0.0,
            high: 100.0,
            spacing: Spacing::Linear,
        }
    }

    #[test]
    fn points_fall_where_the_axes_say() {
        let distance = Axis::logarithmic("Distance, m", [0.5, f64::NAN, -1.0, 2.0].into_iter());
        let x = distance.expect("two numbers are positive");
        assert!((x.share(1.0) - 0.5).abs() < 1e-9);
        let plot = Plot::wide(x, percent("Intensity, %"));
        let dots = plot.dots(
            "refined",
            &[[1.0, 50.0], [1.0, f64::NAN], [9.0, 1.0], [-1.0, 1.0]],
        );
        assert_eq!(dots.into_string().matches("<circle").count(), 1);
        assert!(Axis::logarithmic("", [0.0, f64::NAN].into_iter()).is_none());
    }

    #[test]
    fn a_density_counts_what_is_inside() {
        let plot = Plot::square(percent("x"), percent("y"));
        let points = [
            [0.0, 0.0],
            [0.1, 0.1],
            [100.0, 100.0],
            [120.0, 1.0],
            [f64::NAN, 1.0],
        ];
        let (image, most) = plot.density(&points).unwrap();
        assert_eq!(most, 2);
        assert!(
            plot.framed("alt <1>", &image)
                .into_string()
                .contains("alt &lt;1&gt;")
        );
        assert_eq!(plot.density(&[]).unwrap().1, 0);
    }
}
