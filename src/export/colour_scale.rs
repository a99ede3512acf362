//! Numbers as colours: pictures of measured fields, the bar that explains them, and tints of table cells.
//!
//! Both scales are told apart by readers who do not see red and green alike. What is not finite has no colour: it is
//! transparent, so that the page shows through, light or dark.

use super::{chart::linear_ticks, encode_png_rgba, page::data_address, report_format::compact};
use depth_camera::Image;
use maud::{Markup, html};
use std::io;

/// From blue (less) through white to red (more).
const DIVERGING: [[u8; 3]; 7] = [
    [33, 102, 172],
    [103, 169, 207],
    [209, 229, 240],
    [247, 247, 247],
    [253, 219, 199],
    [239, 138, 98],
    [178, 24, 43],
];
/// From dark violet (little) through green to yellow (much).
const SEQUENTIAL: [[u8; 3]; 9] = [
    [68, 1, 84],
    [71, 44, 122],
    [59, 81, 139],
    [44, 113, 142],
    [33, 144, 141],
    [39, 173, 129],
    [92, 200, 99],
    [170, 220, 50],
    [253, 231, 37],
];
/// Width of a colour bar, pixels.
const BAR_COLUMNS: usize = 240;

/// Which colour stands for which number.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct ColourScale {
    stops: &'static [[u8; 3]],
    low: f64,
    high: f64,
    /// Numbers in one step share a colour, so that its borders are contours; `None` for smooth colours.
    step: Option<f64>,
}

impl ColourScale {
    /// White at zero, blue and red at and beyond `limit` to either side.
    pub fn symmetric(limit: f64) -> Self {
        ColourScale {
            stops: &DIVERGING,
            low: -limit,
            high: limit,
            step: None,
        }
    }

    /// From dark to bright between two numbers.
    pub fn sequential(low: f64, high: f64) -> Self {
        ColourScale {
            stops: &SEQUENTIAL,
            low,
            high: high.max(low + f64::EPSILON),
            step: None,
        }
    }

    /// About ten bands between round numbers around what lies between `low` and `high`.
    pub fn banded(low: f64, high: f64) -> Self {
        // A constant field has one band.
        let air = (1e-3 * high.abs()).max(1e-6);
        let (low, high) = if high - low > air {
            (low, high)
        } else {
            (low - air, high + air)
        };
        let ticks = linear_ticks(low, high, 10);
        let step = ticks.windows(2).next().map_or(high - low, |t| t[1] - t[0]);
        ColourScale {
            stops: &SEQUENTIAL,
            low: (low / step).floor() * step,
            high: (high / step).ceil() * step,
            step: Some(step),
        }
    }

    /// The colour of a number; transparent if it is not finite, the nearer end's if it lies outside.
    pub fn colour(&self, value: f64) -> [u8; 4] {
        if !value.is_finite() {
            return [0; 4];
        }
        let value = match self.step {
            None => value,
            Some(step) => {
                let band = ((value - self.low) / step).floor();
                let last = ((self.high - self.low) / step).round() - 1.0;
                self.low + (band.clamp(0.0, last) + 0.5) * step
            }
        };
        let [red, green, blue] = blend(self.stops, (value - self.low) / (self.high - self.low));
        [red, green, blue, 255]
    }

    /// Numbers to write along the bar: round ones, borders of bands if there are bands.
    fn ticks(&self) -> Vec<f64> {
        let Some(step) = self.step else {
            return linear_ticks(self.low, self.high, 5);
        };
        let (first, last) = ((self.low / step).round(), (self.high / step).round());
        let every = ((last - first) / 6.0).ceil() as i64;
        (first as i64..=last as i64)
            .filter(|border| border.rem_euclid(every) == 0)
            .map(|border| border as f64 * step)
            .collect()
    }

    /// A figure of a field of numbers, with a bar whose ticks are `factor` times them, and a caption.
    ///
    /// # Errors
    /// If the field has no pixels.
    pub fn figure(&self, field: &Image<f32>, what: &Described) -> io::Result<Markup> {
        let picture = field.map(|&value| self.colour(f64::from(value)));
        let width = self.high - self.low;
        let columns = (0..BAR_COLUMNS).map(|column| (column as f64 + 0.5) / BAR_COLUMNS as f64);
        let bar = columns.map(|share| self.colour(self.low + share * width));
        let bar = Image::from_vec(BAR_COLUMNS, 1, bar.collect());
        let (picture, bar) = (encode_png_rgba(&picture)?, encode_png_rgba(&bar)?);
        let written = |value: f64| compact(what.factor * value);
        Ok(html! {
            figure class="field" {
                p class="title" { (what.title) }
                img class=(if self.step.is_some() { "smooth" } else { "cells" }) src=(data_address(&picture)) alt=(what.alt);
                div class="colour-bar" {
                    img src=(data_address(&bar))
                        alt=(format!("Colour bar from {} to {}", written(self.low), written(self.high)));
                    div class="ticks" {
                        @for value in self.ticks() {
                            span style=(format!("left: {:.1}%", 100.0 * (value - self.low) / width)) { (written(value)) }
                        }
                    }
                }
                figcaption { (what.caption) }
            }
        })
    }
}

/// What a field's figure says of it.
#[derive(Clone, Debug)]
pub(super) struct Described {
    /// Name and unit of the numbers.
    pub title: &'static str,
    /// For those who cannot see the picture.
    pub alt: String,
    /// What is to be known beside.
    pub caption: String,
    /// From numbers to what the ticks say, such as 100 for per cent.
    pub factor: f64,
}

/// The background of a table cell: none at zero, full at -1 (blue) and 1 (red), as a style that leaves the text legible.
pub(super) fn tint(share: f64) -> String {
    let [red, green, blue] = DIVERGING[if share < 0.0 { 0 } else { DIVERGING.len() - 1 }];
    let opacity = 0.55 * share.abs().min(1.0);
    format!("background: rgb({red} {green} {blue} / {opacity:.2})")
}

/// The colour at a share of the way through stops at equal distances.
fn blend(stops: &[[u8; 3]], share: f64) -> [u8; 3] {
    let place = share.clamp(0.0, 1.0) * (stops.len() - 1) as f64;
    let before = (place as usize).min(stops.len() - 2);
    let weight = place - before as f64;
    std::array::from_fn(|channel| {
        let (a, b) = (stops[before][channel], stops[before + 1][channel]);
        (f64::from(a) * (1.0 - weight) + f64::from(b) * weight).round() as u8
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn colours_meet_their_ends_and_leave_out_what_is_not_there() {
        let scale = ColourScale::symmetric(0.02);
        assert_eq!(scale.colour(0.0), [247, 247, 247, 255]);
        assert_eq!(scale.colour(-0.02), [33, 102, 172, 255]);
        assert_eq!(scale.colour(7.0), [178, 24, 43, 255]);
        assert_eq!(scale.colour(f64::NAN)[3], 0);
    }

    #[test]
    fn bands_have_round_borders() {
        let scale = ColourScale::banded(0.43, 1.01);
        assert!((scale.low - 0.4).abs() < 1e-9 && (scale.high - 1.1).abs() < 1e-9);
        assert_eq!(scale.colour(0.51), scale.colour(0.59));
        assert_ne!(scale.colour(0.59), scale.colour(0.61));
        let borders: Vec<String> = scale.ticks().into_iter().map(compact).collect();
        assert_eq!(borders, ["0.4", "0.6", "0.8", "1"]);
        // One number everywhere still has a colour.
        assert_eq!(ColourScale::banded(1.0, 1.0).colour(1.0)[3], 255);
    }

    #[test]
    fn tints_have_the_sign_of_their_number() {
        assert_eq!(tint(0.5), "background: rgb(178 24 43 / 0.28)");
        assert_eq!(tint(-9.0), "background: rgb(33 102 172 / 0.55)");
        assert!(tint(0.0).ends_with("0.00)"));
    }
}
