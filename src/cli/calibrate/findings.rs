//! What a calibration found, in words and as figures for the device's file.

use super::targets::Aim;
use nalgebra::Point3;
use relief::{
    calibrate::{
        Estimate, INLIER, INTERVAL_SIGMAS, InverseSquare, Measured, Priors, ResponseCheck, Scan,
        Target,
    },
    config::CalibrationKey,
    export::{CalibrationResult, CalibrationSession},
};
use std::collections::BTreeMap;

/// Everything that a command learnt.
pub struct Findings {
    /// What it was for.
    pub aim: Aim,
    /// The sessions.
    pub scans: Vec<Scan>,
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

impl Findings {
    /// Whether the data tell where the light is, by axis.
    pub(super) fn axes_told(&self) -> [bool; 3] {
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
    pub(super) fn independent_gamma(&self) -> (Measured, String) {
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
        // An interval that is not known is no figure.
        let mut add = |name: &str, value: f64| {
            figures.extend(value.is_finite().then(|| (name.to_owned(), value)));
        };
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
            CalibrationKey::LightWhiteLevel
            | CalibrationKey::Noise
            | CalibrationKey::IrOffset
            | CalibrationKey::RangeError => {}
        }
        for (scan, fit) in self.scans.iter().zip(&self.estimate.fits) {
            add(&format!("{}_deviation", scan.name), fit.deviation);
            add(&format!("{}_images", scan.name), fit.n_images as f64);
        }
        figures
    }

    /// Relative standard deviation of lens and lobe together, over the flat field's grid and at its corners.
    pub(super) fn flat_uncertainty(&self) -> (f64, f64) {
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

    pub(super) fn sessions(&self) -> Vec<CalibrationSession> {
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

    pub(super) fn results(&self) -> Vec<CalibrationResult> {
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
            let [rms, corner] = [rms, corner].map(|sigma| 100.0 * INTERVAL_SIGMAS * sigma);
            results.push(result(
                "flat field, lens and lobe together",
                format!("known to {rms:.2} %"),
                format!("RMS over the image, {corner:.2} % in the worst corner"),
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
        let before_mm = INTERVAL_SIGMAS * self.priors.light_sigma_m * 1e3;
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
    pub(super) fn remarks(&self) -> Vec<String> {
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
    let (value, half_width) = (measured.value * scale, measured.half_width() * scale);
    match half_width.is_finite() {
        true => format!("{value:.digits$} ± {half_width:.digits$}"),
        false => format!("{value:.digits$}, interval not known"),
    }
}
