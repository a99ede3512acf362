//! What a calibration found, as a page with the plots of Fig. 5 and Fig. 7 of the paper.
//!
//! The page is told plain numbers and knows nothing of how they came about; intensities are shares of full scale, lengths
//! metres. What was not measured has no section. `calibration_sections` holds the text and tables, `calibration_response`,
//! `calibration_distance` and `calibration_flat_field` one figure each.

use super::{
    ExportError, atomic::write_atomically, calibration_distance::distance,
    calibration_flat_field::flat_field, calibration_response::response,
    calibration_sections as sections, page::document,
};
use depth_camera::Image;
use maud::{Markup, html};
use std::{
    io::{self, Write},
    path::Path,
};

/// What a calibration found, for its page.
#[derive(Clone, Debug, Default)]
pub struct CalibrationPage {
    /// Serial number of the device; may be empty.
    pub serial: String,
    /// Kind of device, such as "kinect2".
    pub sensor: String,
    /// When it was calibrated, as it is to be read.
    pub date: String,
    /// What was asked for, such as "response".
    pub command: String,
    /// The recordings, and how well the model fits each.
    pub sessions: Vec<CalibrationSession>,
    /// What was found.
    pub results: Vec<CalibrationResult>,
    /// What the data cannot tell, what was masked, what a user must know.
    pub remarks: Vec<String>,
    /// The response, if a sphere was seen.
    pub response: Option<ResponseFigure>,
    /// How light falls with distance, if a wall was seen at several.
    pub distance: Option<DistanceFigure>,
    /// How lens and light darken the image, if a wall was seen.
    pub flat_field: Option<FlatFieldFigure>,
}

/// One recording of a calibration.
#[derive(Clone, Debug, Default)]
pub struct CalibrationSession {
    /// Its name.
    pub name: String,
    /// What it shows: "wall", "sphere, radius 120.5 ± 0.3 mm".
    pub target: String,
    /// Images used.
    pub n_images: usize,
    /// Images that could not be used.
    pub n_unused: usize,
    /// Pixels or cells compared.
    pub n_samples: usize,
    /// Robust standard deviation of observed over predicted intensity, as a share.
    pub deviation: f64,
    /// What noise alone would make of it.
    pub noise: f64,
    /// Share of the samples that count for nothing.
    pub outlier_share: f64,
}

/// One number that was found.
#[derive(Clone, Debug, Default)]
pub struct CalibrationResult {
    /// Its name.
    pub name: String,
    /// Its value with interval and unit.
    pub value: String,
    /// How it was found, or what it is worth; may be empty.
    pub remark: String,
}

/// Fig. 7: observed against predicted intensity on a sphere.
#[derive(Clone, Debug)]
pub struct ResponseFigure {
    /// Exponent of the response, I = L^γ.
    pub gamma: f64,
    /// Predicted linear, predicted and observed intensity, shares of full scale.
    pub scatter: Vec<[f64; 3]>,
    /// Share of the pixels nearer to the prediction than the inlier bound.
    pub within: f64,
    /// The inlier bound, share of full scale.
    pub inlier_bound: f64,
    /// Mean of observed over predicted, less one, by share of interreflected light (rows) and cosine of incidence (columns);
    /// `None` where too few pixels were compared.
    pub residuals: Vec<Vec<Option<f64>>>,
    /// Borders of the rows, one more than there are rows: interreflected over all light.
    pub shares: Vec<f64>,
    /// Borders of the columns, one more than there are columns: cosine of the angle of incidence.
    pub incidences: Vec<f64>,
    /// Observed less predicted share of full scale over one image; NaN where nothing was compared.
    pub residual_map: Image<f32>,
}

/// Fig. 5: how light falls with distance on a wall.
#[derive(Clone, Debug)]
pub struct DistanceFigure {
    /// Distance from the light (m) and relative linear intensity freed of everything else, one an image.
    pub curve: Vec<[f64; 2]>,
    /// The exponent of distance and half the width of its 95 % interval; -2 by theory.
    pub exponent: (f64, f64),
    /// The same in regions of the image, row by row from the upper left; `None` where too few images reach.
    pub regions: [[Option<(f64, f64)>; 3]; 3],
}

/// How lens and light darken the image towards its corners.
#[derive(Clone, Debug)]
pub struct FlatFieldFigure {
    /// Factor over that of the optical axis, over the image (any size); NaN where unknown.
    pub factor: Image<f32>,
    /// Relative standard deviation of the factor, over the image (any size); NaN where unknown.
    pub sigma: Image<f32>,
    /// Mean factor in the corners and half the width of its 95 % interval.
    pub corner: (f64, f64),
    /// Root mean square of the relative standard deviation over the image.
    pub sigma_rms: f64,
}

/// Writes what a calibration found as one HTML file that refers to nothing outside itself.
///
/// Numbers that are not finite are dashes in tables and left out of plots.
///
/// # Errors
/// [`ExportError::Write`] if the file cannot be written.
pub fn write_calibration_page(path: &Path, page: &CalibrationPage) -> Result<(), ExportError> {
    write_atomically(path, |file| {
        file.write_all(markup(page)?.into_string().as_bytes())
    })
}

fn markup(page: &CalibrationPage) -> io::Result<Markup> {
    let response = page.response.as_ref().map(response).transpose()?;
    let distance = page.distance.as_ref().map(distance);
    let flat_field = page.flat_field.as_ref().map(flat_field).transpose()?;
    let device = sections::device(page);
    let parts = html! {
        (sections::heading(page))
        (sections::remarks(&page.remarks))
        (sections::results(&page.results))
        @for figure in [response, distance, flat_field].iter().flatten() { (figure) }
        (sections::sessions(&page.sessions))
        footer { "Relief" }
    };
    Ok(document(&format!("{device} – calibration"), &parts))
}

#[cfg(test)]
mod tests;
