//! What a calibration found, as a page.

use super::findings::Findings;
use depth_camera::Image;
use relief::{
    calibrate::{
        INCIDENCES, INLIER, InverseSquare, Measured, N_REGIONS, ResponseCheck, SHARES, Sensor,
    },
    export::{self, CalibrationPage, DistanceFigure, ExportError, FlatFieldFigure, ResponseFigure},
};
use std::{path::Path, time::SystemTime};

/// The flat field is sampled at every so many pixels.
const FLAT_STRIDE: usize = 4;

/// Writes the page.
///
/// # Errors
/// If the file cannot be written.
pub fn write_page(
    path: &Path,
    findings: &Findings,
    serial: &str,
    sensor: &Sensor,
) -> Result<(), ExportError> {
    let page = CalibrationPage {
        serial: serial.to_owned(),
        sensor: sensor.kind.name().to_owned(),
        date: humantime::format_rfc3339_seconds(SystemTime::now()).to_string(),
        command: findings.aim.name().to_owned(),
        sessions: findings.sessions(),
        results: findings.results(),
        remarks: findings.remarks(),
        response: findings
            .responses
            .first()
            .map(|(_, check)| response_figure(findings, check)),
        distance: findings
            .distances
            .first()
            .map(|(_, law)| distance_figure(findings, law)),
        flat_field: findings
            .estimate
            .flat_is_measured
            .then(|| flat_field_figure(findings, sensor)),
    };
    export::write_calibration_page(path, &page)
}

fn response_figure(findings: &Findings, check: &ResponseCheck) -> ResponseFigure {
    ResponseFigure {
        gamma: findings.estimate.state.gamma,
        scatter: check.scatter.clone(),
        within: check.within,
        inlier_bound: INLIER,
        residuals: check.residuals.iter().map(|row| row.to_vec()).collect(),
        shares: SHARES.to_vec(),
        incidences: INCIDENCES.to_vec(),
        residual_map: check.residual_map.clone(),
    }
}

fn distance_figure(findings: &Findings, law: &InverseSquare) -> DistanceFigure {
    let (gamma, _) = findings.independent_gamma();
    let shown = |product: &Measured| {
        let exponent = InverseSquare::exponent(product, &gamma);
        (exponent.value, exponent.half_width())
    };
    DistanceFigure {
        curve: law.curve.clone(),
        exponent: shown(&law.product),
        regions: std::array::from_fn::<_, N_REGIONS, _>(|row| {
            law.region_products[row].map(|product| product.as_ref().map(shown))
        }),
    }
}

fn flat_field_figure(findings: &Findings, sensor: &Sensor) -> FlatFieldFigure {
    let rays = sensor.rays.rays();
    let (width, height) = (rays.width() / FLAT_STRIDE, rays.height() / FLAT_STRIDE);
    let (mut factors, mut sigmas) = (Vec::new(), Vec::new());
    for pixel in 0..width * height {
        let [x, y] = rays.at(pixel % width * FLAT_STRIDE, pixel / width * FLAT_STRIDE);
        let measured = findings
            .estimate
            .log_far_field(f64::from(*x), f64::from(*y));
        let known = x.is_finite();
        factors.push(if known {
            measured.value.exp() as f32
        } else {
            f32::NAN
        });
        sigmas.push(if known {
            measured.sigma as f32
        } else {
            f32::NAN
        });
    }
    let [x, y] = rays.at(0, 0).map(f64::from);
    let corner = findings.estimate.log_far_field(x, y);
    FlatFieldFigure {
        factor: Image::from_vec(width, height, factors),
        sigma: Image::from_vec(width, height, sigmas),
        corner: (corner.value.exp(), corner.half_width()),
        sigma_rms: findings.flat_uncertainty().0,
    }
}
