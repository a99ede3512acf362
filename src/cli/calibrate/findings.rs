//! What a calibration found: in words, as JSON, as figures for the device's file, and as a page.

use super::targets::Aim;
use depth_camera::Image;
use nalgebra::Point3;
use relief::{
    calibrate::{
        Estimate, INCIDENCES, INLIER, InverseSquare, Measured, N_REGIONS, Priors, ResponseCheck,
        SHARES, Scan, Sensor, Target,
    },
    config::CalibrationKey,
    export::{
        self, CalibrationPage, CalibrationResult, CalibrationSession, DistanceFigure, ExportError,
        FlatFieldFigure, ResponseFigure,
    },
};
use serde_json::json;
use std::{collections::BTreeMap, path::Path, time::SystemTime};

/// Everything that a command learnt.
pub struct Findings<'a> {
    /// What it was for.
    pub aim: Aim,
    /// The sessions.
    pub scans: &'a [Scan],
    /// The fit to all of them.
    pub estimate: Estimate,
    /// The fit to the spheres only, where there are walls too.
    pub spheres_alone: Option<Estimate>,
    /// Index of each session with a sphere, and how its pixels fit.
    pub responses: Vec<(usize, ResponseCheck)>,
    /// Index of each session with a wall, and how light falls with distance there.
    pub distances: Vec<(usize, InverseSquare)>,
    /// What was believed beforehand.
    pub priors: Priors,
    /// The exponent of the response in the calibration so far, and where that is from.
    pub known_gamma: f64,
    /// Where it is from.
    pub gamma_origin: String,
}

/// An axis is told by the data where its interval is at most this share of what was believed beforehand.
const TELLING: f64 = 0.5;
const AXES: [&str; 3] = ["x", "y", "z"];
/// The flat field is sampled at every so many pixels for the page.
const FLAT_STRIDE: usize = 4;

impl Findings<'_> {
    /// Whether the data tell where the light is, by axis.
    fn axes_told(&self) -> [bool; 3] {
        let sigma_m = self.priors.light_sigma_m;
        self.estimate
            .light_position()
            .map(|axis| axis.sigma <= TELLING * sigma_m)
    }

    /// The light's place, metres: as measured where the data tell, else as believed beforehand.
    pub fn believed_position(&self) -> Point3<f64> {
        let (measured, told) = (self.estimate.light_position(), self.axes_told());
        let before = self.priors.light.position;
        Point3::from(std::array::from_fn(|axis| match told[axis] {
            true => measured[axis].value,
            false => before[axis],
        }))
    }

    /// The exponent of the response that tests the inverse square law without taking it for granted, and where it is from.
    fn independent_gamma(&self) -> (Measured, String) {
        match &self.spheres_alone {
            Some(alone) => (alone.gamma(), "of the spheres alone".to_owned()),
            None => (
                Measured {
                    value: self.known_gamma,
                    sigma: 0.0,
                },
                format!("{:.4} ({})", self.known_gamma, self.gamma_origin),
            ),
        }
    }

    /// Figures of a key for the device's file.
    pub fn figures(&self, key: CalibrationKey) -> BTreeMap<String, f64> {
        let mut figures = BTreeMap::new();
        let mut add = |name: &str, value: f64| figures.insert(name.to_owned(), value);
        match key {
            CalibrationKey::Gamma => {
                add("half_interval_95", self.estimate.gamma().half_width());
                for (index, check) in &self.responses {
                    let name = &self.scans[*index].name;
                    add(&format!("{name}_share_within_0.05"), check.within);
                }
            }
            CalibrationKey::LightLobePower => {
                add("half_interval_95", self.estimate.lobe_power().half_width());
            }
            CalibrationKey::LightPosition => {
                for (axis, measured) in AXES.iter().zip(self.estimate.light_position()) {
                    add(&format!("{axis}_half_interval_95_m"), measured.half_width());
                }
            }
            CalibrationKey::FlatField => {
                let (rms, corner) = self.flat_uncertainty();
                add("sigma_rms", rms);
                add("sigma_corners", corner);
                for (index, law) in &self.distances {
                    let name = &self.scans[*index].name;
                    add(&format!("{name}_gamma_times_exponent"), law.product.value);
                }
            }
            CalibrationKey::Noise | CalibrationKey::IrOffset => {}
        }
        for (scan, fit) in self.scans.iter().zip(&self.estimate.fits) {
            add(&format!("{}_deviation", scan.name), fit.deviation);
            add(&format!("{}_images", scan.name), fit.n_images as f64);
        }
        figures
    }

    /// Relative standard deviation of lens and lobe together, over the flat field's grid and at its corners.
    fn flat_uncertainty(&self) -> (f64, f64) {
        const N: usize = 12;
        let grid = &self.estimate.state.flat.grid;
        let at = |[first, last]: [f64; 2], k: usize| first + (last - first) * k as f64 / N as f64;
        let sigma = |column: usize, row: usize| {
            self.estimate
                .log_far_field(at(grid.x, column), at(grid.y, row))
                .sigma
        };
        let squares = (0..=N).flat_map(|row| (0..=N).map(move |column| sigma(column, row).powi(2)));
        let rms = (squares.sum::<f64>() / ((N + 1) * (N + 1)) as f64).sqrt();
        let corners = [(0, 0), (N, 0), (0, N), (N, N)].map(|(column, row)| sigma(column, row));
        (rms, corners.into_iter().fold(0.0, f64::max))
    }

    fn sessions(&self) -> Vec<CalibrationSession> {
        let fits = self.scans.iter().zip(&self.estimate.fits).enumerate();
        fits.map(|(index, (scan, fit))| CalibrationSession {
            name: scan.name.clone(),
            target: match (scan.target, self.estimate.radius(index)) {
                (Target::Sphere(_), Some(radius)) => {
                    format!("sphere, radius {} mm", interval(&radius, 1e3, 1))
                }
                _ => "wall".to_owned(),
            },
            n_images: fit.n_images,
            n_unused: scan.n_unused,
            n_samples: fit.n_samples,
            deviation: fit.deviation,
            noise: fit.noise,
            outlier_share: fit.outlier_share,
        })
        .collect()
    }

    fn results(&self) -> Vec<CalibrationResult> {
        let estimate = &self.estimate;
        let [by_x, by_y, by_z, by_lobe] = estimate.gamma_correlations();
        let mut results = vec![result(
            "response, gamma",
            interval(&estimate.gamma(), 1.0, 4),
            format!(
                "correlation with the light's x {by_x:+.2}, y {by_y:+.2}, z {by_z:+.2}, with its lobe {by_lobe:+.2}"
            ),
        )];
        if let Some(alone) = &self.spheres_alone {
            let gamma = interval(&alone.gamma(), 1.0, 4);
            results.push(result("gamma of the spheres alone", gamma, String::new()));
        }
        for (index, check) in &self.responses {
            results.push(self.response_result(*index, check));
        }
        let (gamma, origin) = self.independent_gamma();
        for (index, law) in &self.distances {
            let exponent = InverseSquare::exponent(&law.product, &gamma);
            results.push(result(
                &format!("{}: exponent of distance", self.scans[*index].name),
                interval(&exponent, 1.0, 4),
                format!(
                    "with gamma {origin}; gamma times exponent {}; {:.2} to {:.2} m",
                    interval(&law.product, 1.0, 4),
                    law.range_m[0],
                    law.range_m[1]
                ),
            ));
        }
        if estimate.flat_is_measured {
            let (rms, corner) = self.flat_uncertainty();
            results.push(result(
                "flat field, lens and lobe together",
                format!("known to {:.2} %", 196.0 * rms),
                format!(
                    "RMS over the image, {:.2} % in the worst corner",
                    196.0 * corner
                ),
            ));
        }
        let lobe = estimate.lobe_power();
        results.push(result(
            "light, lobe power",
            interval(&lobe, 1.0, 2),
            String::new(),
        ));
        results.extend(self.light_results());
        results
    }

    fn response_result(&self, index: usize, check: &ResponseCheck) -> CalibrationResult {
        result(
            &format!("{}: pixels within {INLIER}", self.scans[index].name),
            format!("{:.1} %", check.within * 100.0),
            format!(
                "{:.1} % of those that interreflection does not mask; {:.0} % are masked; the plain power law alone: gamma \
                 {:.3}, {:.1} %",
                check.within_unmasked * 100.0,
                check.masked_share * 100.0,
                check.plain.gamma,
                check.plain.inlier_share * 100.0
            ),
        )
    }

    fn light_results(&self) -> Vec<CalibrationResult> {
        let (measured, told) = (self.estimate.light_position(), self.axes_told());
        let before_mm = 1.96 * self.priors.light_sigma_m * 1e3;
        let lobe = self.estimate.lobe_correlations();
        (0..3)
            .map(|axis| {
                let moved_mm = (measured[axis].value - self.priors.light.position[axis]) * 1e3;
                let said = match told[axis] {
                    true => format!("{moved_mm:+.1} mm from where it was believed"),
                    false => format!(
                        "the data cannot tell: believed to ±{before_mm:.1} mm beforehand; left at {:.1} mm",
                        self.priors.light.position[axis] * 1e3
                    ),
                };
                result(
                    &format!("light, {}", AXES[axis]),
                    format!("{} mm", interval(&measured[axis], 1e3, 1)),
                    format!("{said}; correlation with the lobe {:+.2}", lobe[axis]),
                )
            })
            .collect()
    }

    /// What a user must know.
    fn remarks(&self) -> Vec<String> {
        /// Correlations above this mean that the data hardly part two unknowns.
        const INSEPARABLE: f64 = 0.95;
        let mut remarks = Vec::new();
        if !self.estimate.flat_is_measured {
            remarks.push(
                "no wall among the sessions: the flat field is taken as it was known, and a sphere at one distance cannot tell \
                 it from gamma, lobe and light"
                    .to_owned(),
            );
        }
        if self
            .estimate
            .lobe_correlations()
            .iter()
            .any(|c| c.abs() > INSEPARABLE)
        {
            remarks.push(
                "the light's place and its lobe can hardly be told apart by these sessions; a sphere beside the wall parts them"
                    .to_owned(),
            );
        }
        for (index, check) in &self.responses {
            if let Some(rise) = interreflection_rise(check) {
                remarks.push(format!(
                    "{}: where surroundings light the sphere most it is {:+.1} % off the model; {:.0} % of it are masked",
                    self.scans[*index].name,
                    rise * 100.0,
                    check.masked_share * 100.0
                ));
            }
        }
        for (index, law) in &self.distances {
            let (gamma, origin) = self.independent_gamma();
            let exponent = InverseSquare::exponent(&law.product, &gamma);
            if (exponent.value + 2.0).abs() > exponent.half_width().max(0.03) {
                remarks.push(format!(
                    "{}: light falls with distance to the {:.3} with gamma {origin}: that gamma does not belong to this device, \
                     by the inverse square law it is {:.3}",
                    self.scans[*index].name,
                    exponent.value,
                    -0.5 * law.product.value
                ));
            }
        }
        remarks
    }
}

/// Mean residual of the pixels that are lit most by their surroundings.
fn interreflection_rise(check: &ResponseCheck) -> Option<f64> {
    let most = check
        .residuals
        .iter()
        .rev()
        .find(|row| row.iter().any(Option::is_some))?;
    let known: Vec<f64> = most.iter().flatten().copied().collect();
    Some(known.iter().sum::<f64>() / known.len() as f64)
}

fn result(name: &str, value: String, remark: String) -> CalibrationResult {
    CalibrationResult {
        name: name.to_owned(),
        value,
        remark,
    }
}

fn interval(measured: &Measured, scale: f64, digits: usize) -> String {
    format!(
        "{:.digits$} ± {:.digits$}",
        measured.value * scale,
        measured.half_width() * scale
    )
}

/// Prints what was found: text, or one JSON object.
///
/// # Errors
/// Never: numbers that do not exist are `null`.
pub fn print(findings: &Findings, as_json: bool) -> serde_json::Result<()> {
    if as_json {
        println!("{}", serde_json::to_string(&machine_readable(findings))?);
        return Ok(());
    }
    for session in findings.sessions() {
        println!(
            "{}: {}, {} images, {} samples, {:.2} % off the model ({:.2} % is noise), {:.1} % outliers",
            session.name,
            session.target,
            session.n_images,
            session.n_samples,
            session.deviation * 100.0,
            session.noise * 100.0,
            session.outlier_share * 100.0
        );
    }
    for CalibrationResult {
        name,
        value,
        remark,
    } in findings.results()
    {
        match remark.as_str() {
            "" => println!("{name:<36}{value}"),
            remark => println!("{name:<36}{value}   ({remark})"),
        }
    }
    for remark in findings.remarks() {
        println!("note: {remark}");
    }
    println!("intervals are of 95 %");
    Ok(())
}

fn machine_readable(findings: &Findings) -> serde_json::Value {
    let measured = |m: &Measured| json!({"value": m.value, "half_interval_95": m.half_width()});
    let estimate = &findings.estimate;
    let (gamma, _) = findings.independent_gamma();
    let (flat_rms, flat_corner) = findings.flat_uncertainty();
    let exponents: BTreeMap<&str, serde_json::Value> = findings
        .distances
        .iter()
        .map(|(index, law)| {
            let exponent = InverseSquare::exponent(&law.product, &gamma);
            let value = json!({
                "exponent": measured(&exponent),
                "gamma_times_exponent": measured(&law.product),
                "range_m": law.range_m,
            });
            (findings.scans[*index].name.as_str(), value)
        })
        .collect();
    let spheres: BTreeMap<&str, serde_json::Value> = findings
        .responses
        .iter()
        .map(|(index, check)| {
            let value = json!({
                "radius_m": estimate.radius(*index).as_ref().map(measured),
                "share_within": check.within,
                "share_within_unmasked": check.within_unmasked,
                "masked_share": check.masked_share,
                "plain_gamma": check.plain.gamma,
                "plain_share_within": check.plain.inlier_share,
            });
            (findings.scans[*index].name.as_str(), value)
        })
        .collect();
    json!({
        "status": "complete",
        "gamma": measured(&estimate.gamma()),
        "gamma_of_spheres_alone": findings.spheres_alone.as_ref().map(|e| measured(&e.gamma())),
        "light_position_m": estimate.light_position().iter().map(measured).collect::<Vec<_>>(),
        "light_told": findings.axes_told(),
        "lobe_power": measured(&estimate.lobe_power()),
        "flat_field": estimate.flat_is_measured.then(|| json!({"sigma_rms": flat_rms, "sigma_corners": flat_corner})),
        "walls": exponents,
        "spheres": spheres,
        "notes": findings.remarks(),
    })
}

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
