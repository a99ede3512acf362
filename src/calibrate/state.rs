//! The unknowns of a calibration and their order in the normal equations.

use super::Sensor;
use super::gather::{Place, Scan, Target};
use super::model::log_linear;
use super::refusal::Refusal;
use super::response::{plain_power_law, rendered_pairs, sphere_pixels};
use super::samples::{Sample, Samples};
use crate::robust::median;
use crate::shading::{FlatField, FlatMap, NearLight, SplineGrid};
use nalgebra::{DMatrix, DVector, Vector3};

/// What is believed beforehand.
#[derive(Clone, Debug)]
pub struct Priors {
    /// Where the light stands by the device's own statement, and its lobe.
    pub light: NearLight,
    /// How well its place is known on each axis, metres.
    pub light_sigma_m: f64,
    /// How well the lobe's power is known.
    pub lobe_sigma: f64,
    /// The flat field so far; measured anew where there is a wall, held where there is none.
    pub flat_field: FlatField,
}

/// All unknowns.
#[derive(Clone, Debug)]
pub struct State {
    /// Exponent of the response.
    pub gamma: f64,
    /// The light in the camera frame.
    pub light: NearLight,
    /// Logarithm of the flat field.
    pub flat: FlatMap,
    /// What belongs to one session each.
    pub sessions: Vec<SessionState>,
}

/// The unknowns of one session.
#[derive(Clone, Debug)]
pub struct SessionState {
    /// Logarithm of the albedo times the light's strength, m².
    pub log_albedo: f64,
    /// Those of its sphere, if it shows one.
    pub sphere: Option<SphereState>,
}

/// The unknowns of a session's sphere.
#[derive(Clone, Debug)]
pub struct SphereState {
    /// Radius, metres.
    pub radius_m: f64,
    /// Its fused or given radius and the standard deviation of that, metres.
    pub radius_prior_m: [f64; 2],
    /// Share of the light from its surroundings that it sends back.
    pub reflectance: f64,
    /// Its centre in each image, camera frame, metres.
    pub centres: Vec<Vector3<f64>>,
}

/// Columns and rows of the flat field's splines: intervals of about 60 pixels, over which a lens is smooth.
const FLAT_COLUMNS: usize = 11;
const FLAT_ROWS: usize = 10;
/// Unknowns that all sessions share, before the flat field's coefficients.
const N_SHARED: usize = 5;
/// A white sphere sends this share back; believed to a third.
const REFLECTANCE: f64 = 0.8;
const REFLECTANCE_SIGMA: f64 = 0.25;
/// A response is believed to be linear within this before anything is measured.
const GAMMA_SIGMA: f64 = 0.3;

impl State {
    /// The state to start from: a linear response, the light and flat field of the priors, spheres where tracking has them.
    ///
    /// # Errors
    /// If there is no scan.
    pub fn start(scans: &[Scan], sensor: &Sensor, priors: &Priors) -> Result<Self, Refusal> {
        if scans.is_empty() {
            return Err(Refusal::NoScans);
        }
        let sessions = scans
            .iter()
            .map(|scan| SessionState {
                log_albedo: 0.0,
                sphere: match scan.target {
                    Target::Wall => None,
                    Target::Sphere(found) => Some(SphereState {
                        radius_m: found.radius_m,
                        radius_prior_m: [found.radius_m, found.radius_sigma_m],
                        reflectance: REFLECTANCE,
                        centres: scan
                            .images
                            .iter()
                            .filter_map(|i| sphere_place(&i.place))
                            .collect(),
                    }),
                },
            })
            .collect();
        let grid = grid_over(sensor);
        Ok(State {
            gamma: 1.0,
            light: priors.light,
            flat: FlatMap {
                log: spline_of(&priors.flat_field, &grid),
                grid,
            },
            sessions,
        })
    }

    /// Gives the response and the albedos their start: the paper's power law on the first sphere, a linear response on
    /// walls alone.
    pub fn start_intensities(&mut self, scans: &[Scan], sensor: &Sensor) {
        let sphere = (0..scans.len()).find(|session| self.sessions[*session].sphere.is_some());
        if let Some(session) = sphere {
            let pixels = sphere_pixels(&scans[session], session, sensor, self);
            let pairs = rendered_pairs(&pixels, session, self);
            if let Some(law) = plain_power_law(&pairs) {
                self.gamma = law.gamma;
            }
        }
        for session in &mut self.sessions {
            session.log_albedo = 0.0;
        }
        let samples = Samples::gather(scans, sensor, self).intensities;
        let excess = |sample: &Sample| {
            let (log_linear, _) = log_linear(sample, self)?;
            Some(sample.log_observed / self.gamma - log_linear)
        };
        let medians: Vec<f64> = (0..scans.len())
            .map(|session| {
                let of_session = samples.iter().filter(|sample| sample.session == session);
                let mut excesses: Vec<f64> = of_session.filter_map(excess).collect();
                median(&mut excesses).unwrap_or(0.0)
            })
            .collect();
        for (session, median) in self.sessions.iter_mut().zip(medians) {
            session.log_albedo = median;
        }
    }

    /// Number of unknowns.
    pub fn n_unknowns(&self) -> usize {
        self.session_start(self.sessions.len())
    }

    /// Index of the first coefficient of the flat field.
    pub fn flat_start(&self) -> usize {
        N_SHARED
    }

    /// Index of a session's log albedo; its reflectance, radius and centres follow.
    pub fn session_start(&self, session: usize) -> usize {
        let before = self.sessions[..session].iter();
        let n_before: usize = before
            .map(|s| {
                1 + s
                    .sphere
                    .as_ref()
                    .map_or(0, |sphere| 2 + 3 * sphere.centres.len())
            })
            .sum();
        N_SHARED + self.flat.log.len() + n_before
    }

    /// Moves every unknown by its part of a step.
    pub fn moved(&self, step: &DVector<f64>) -> State {
        let mut next = self.clone();
        let mut parts = step.iter().copied();
        let mut part = || parts.next().expect("a step has a part for each unknown");
        // The exponent stays where a response can be.
        next.gamma = (next.gamma + part()).clamp(0.2, 3.0);
        for axis in 0..3 {
            next.light.position[axis] += part();
        }
        next.light.lobe_power = (next.light.lobe_power + part()).clamp(0.0, 12.0);
        for log in &mut next.flat.log {
            *log += part();
        }
        for session in &mut next.sessions {
            session.log_albedo += part();
            if let Some(sphere) = &mut session.sphere {
                sphere.reflectance = (sphere.reflectance + part()).max(0.0);
                sphere.radius_m = (sphere.radius_m + part()).max(1e-3);
                for centre in &mut sphere.centres {
                    *centre += Vector3::new(part(), part(), part());
                }
            }
        }
        next
    }

    /// What is believed beforehand, as `(index, distance from the prior, 1/sigma²)`.
    pub fn prior_terms(&self, priors: &Priors) -> Vec<(usize, f64, f64)> {
        let weight = |sigma: f64| 1.0 / (sigma * sigma);
        let mut terms = vec![(0, self.gamma - 1.0, weight(GAMMA_SIGMA))];
        let offset = self.light.position - priors.light.position;
        for axis in 0..3 {
            terms.push((1 + axis, offset[axis], weight(priors.light_sigma_m)));
        }
        let lobe = self.light.lobe_power - priors.light.lobe_power;
        terms.push((4, lobe, weight(priors.lobe_sigma)));
        for (index, session) in self.sessions.iter().enumerate() {
            if let Some(sphere) = &session.sphere {
                let start = self.session_start(index);
                let [radius_m, sigma_m] = sphere.radius_prior_m;
                terms.push((
                    start + 1,
                    sphere.reflectance - REFLECTANCE,
                    weight(REFLECTANCE_SIGMA),
                ));
                terms.push((start + 2, sphere.radius_m - radius_m, weight(sigma_m)));
            }
        }
        terms
    }
}

fn sphere_place(place: &Place) -> Option<Vector3<f64>> {
    match place {
        Place::Sphere(centre) => Some(centre.coords),
        Place::Wall(_) => None,
    }
}

/// A grid over all rays of a sensor.
fn grid_over(sensor: &Sensor) -> SplineGrid {
    let rays = sensor.rays.rays().data();
    let range = |axis: usize| {
        let finite = rays
            .iter()
            .map(|ray| f64::from(ray[axis]))
            .filter(|x| x.is_finite());
        finite.fold([f64::MAX, f64::MIN], |[low, high], x| {
            [low.min(x), high.max(x)]
        })
    };
    SplineGrid {
        x: range(0),
        y: range(1),
        columns: FLAT_COLUMNS,
        rows: FLAT_ROWS,
    }
}

/// Coefficients of a spline through a flat field, by least squares over the grid.
fn spline_of(field: &FlatField, grid: &SplineGrid) -> Vec<f64> {
    const PER_INTERVAL: usize = 3;
    let n = grid.n_coefficients();
    let (mut jtj, mut jtr) = (DMatrix::zeros(n, n), DVector::zeros(n));
    let steps = |count: usize| (count - 3) * PER_INTERVAL;
    let (columns, rows) = (steps(grid.columns), steps(grid.rows));
    for row in 0..=rows {
        for column in 0..=columns {
            let at = |[first, last]: [f64; 2], k: usize, of: usize| {
                first + (last - first) * k as f64 / of as f64
            };
            let (x, y) = (at(grid.x, column, columns), at(grid.y, row, rows));
            let value = field.factor(x, y).ln();
            let weights = grid.weights(x, y);
            for (i, a) in weights {
                jtr[i] += a * value;
                for (j, b) in weights {
                    jtj[(i, j)] += a * b;
                }
            }
        }
    }
    for k in 0..n {
        jtj[(k, k)] += 1e-9;
    }
    let solution = jtj
        .cholesky()
        .expect("the ridge makes it definite")
        .solve(&jtr);
    solution.data.into()
}
