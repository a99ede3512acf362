//! The flat field: how lens and light darken the image, and how well that is known.

use super::{
    FlatFieldFigure,
    chart::{nothing, range},
    colour_scale::{ColourScale, Described},
    report_format::{fixed, percent},
};
use depth_camera::Image;
use maud::{Markup, html};
use std::io;

/// The factor and its uncertainty as two pictures.
///
/// # Errors
/// If a picture cannot be encoded.
pub(super) fn flat_field(figure: &FlatFieldFigure) -> io::Result<Markup> {
    let factor = Described {
        title: "Factor over that of the optical axis",
        alt: "Map of the flat field's factor over the image".into(),
        caption:
            "The whole image; each colour is one step of the bar, so that borders are contours."
                .into(),
        factor: 1.0,
    };
    let sigma = Described {
        title: "Uncertainty of the factor, %",
        alt: "Map of the relative standard deviation of the flat field's factor over the image"
            .into(),
        caption: "Relative standard deviation, drawn in the same way.".into(),
        factor: 100.0,
    };
    let (corner, half_width) = figure.corner;
    let (factor, sigma) = (
        field(&figure.factor, &factor)?,
        field(&figure.sigma, &sigma)?,
    );
    Ok(html! {
        section id="flat-field" {
            h2 { "Flat field" }
            p { "In the corners the factor is " (fixed(corner, 3)) " ± " (fixed(half_width, 3)) " (95 % interval) of "
                "that of the optical axis. Its relative standard deviation is " (percent(figure.sigma_rms))
                " (root mean square over the image)." }
            div class="plots" { (factor) (sigma) }
        }
    })
}

fn field(field: &Image<f32>, described: &Described) -> io::Result<Markup> {
    let finite = field.data().iter().filter(|x| x.is_finite());
    match range(finite.map(|&x| f64::from(x))) {
        Some((low, high)) => ColourScale::banded(low, high).figure(field, described),
        None => Ok(html! { figure { p class="title" { (described.title) } (nothing()) } }),
    }
}
