//! Eq. (1) at one sample, with its derivatives by all unknowns that it touches.

use super::samples::{Cap, LimbPoint, Place, Sample};
use super::state::{SphereState, State};
use crate::shading::NearLight;
use nalgebra::{Point3, Vector3};

/// A residual in standard deviations and its derivatives.
#[derive(Clone, Debug, Default)]
pub struct Row {
    /// The residual.
    pub residual: f64,
    /// Index of each unknown touched, and the derivative by it.
    pub entries: Vec<(usize, f64)>,
}

/// A point on a sphere as a ray sees it.
#[derive(Clone, Copy, Debug)]
pub struct SpherePoint {
    /// Where the ray meets it, camera frame, metres.
    pub point: Point3<f64>,
    /// Outward unit normal.
    pub normal: Vector3<f64>,
    /// Unit direction of the ray.
    pub direction: Vector3<f64>,
}

/// Where the ray (X/Z, Y/Z) meets a sphere; `None` where it misses.
pub fn meet_sphere([x, y]: [f64; 2], centre: &Vector3<f64>, radius_m: f64) -> Option<SpherePoint> {
    let direction = Vector3::new(x, y, 1.0) / (1.0 + x * x + y * y).sqrt();
    let along = direction.dot(centre);
    let squared = along * along - centre.norm_squared() + radius_m * radius_m;
    if squared <= 0.0 || along <= 0.0 {
        return None;
    }
    let point = direction * (along - squared.sqrt());
    Some(SpherePoint {
        point: Point3::from(point),
        normal: (point - centre) / radius_m,
        direction,
    })
}

impl SpherePoint {
    /// Cosine of the angle at which the camera sees it.
    pub fn view_cosine(&self) -> f64 {
        -self.normal.dot(&self.direction)
    }

    /// Cosine of the angle at which the light reaches it.
    pub fn light_cosine(&self, light: &NearLight) -> f64 {
        let to_light = light.position - self.point;
        self.normal.dot(&to_light) / to_light.norm()
    }
}

/// Direct irradiance at a sample with its derivatives by the centre and the radius of the sphere it may lie on.
struct Irradiance {
    value: f64,
    point: Point3<f64>,
    by_point: Vector3<f64>,
    by_centre: Vector3<f64>,
    by_radius: f64,
}

fn irradiance_of_wall(point: &Point3<f64>, normal: &Vector3<f64>, light: &NearLight) -> Irradiance {
    Irradiance {
        value: light.irradiance(point, normal),
        point: *point,
        by_point: light.irradiance_by_point(point, normal),
        by_centre: Vector3::zeros(),
        by_radius: 0.0,
    }
}

/// The ray is held; centre and radius move the point along it, `dt = (dR + n·dC)/(n·u)`, and turn the normal,
/// `dn = (u dt − dC − n dR)/R`.
fn irradiance_of_sphere(at: &SpherePoint, radius_m: f64, light: &NearLight) -> Irradiance {
    let SpherePoint {
        point,
        normal,
        direction,
    } = at;
    let incident = light.incident(point);
    let by_point = light.irradiance_by_point(point, normal);
    let by_range = by_point.dot(direction) + incident.dot(direction) / radius_m;
    let slant = 1.0 / normal.dot(direction);
    Irradiance {
        value: incident.dot(normal),
        point: *point,
        by_point,
        by_centre: normal * (by_range * slant) - incident / radius_m,
        by_radius: by_range * slant - incident.dot(normal) / radius_m,
    }
}

/// Logarithm of the predicted linear intensity of a sample and of its share that is interreflected; `None` where the
/// sample is not lit or its ray misses.
pub fn log_linear(sample: &Sample, state: &State) -> Option<(f64, f64)> {
    let session = &state.sessions[sample.session];
    let direct = irradiance(sample, state)?.value * session.log_albedo.exp();
    let second = reflectance(session.sphere.as_ref()) * sample.interreflected;
    let total = direct + second;
    let [x, y] = sample.ray;
    (direct > 0.0).then(|| (total.ln() + state.flat.log_factor(x, y), second / total))
}

fn reflectance(sphere: Option<&SphereState>) -> f64 {
    sphere.map_or(0.0, |sphere| sphere.reflectance)
}

fn irradiance(sample: &Sample, state: &State) -> Option<Irradiance> {
    match sample.place {
        Place::Wall { point, normal } => Some(irradiance_of_wall(&point, &normal, &state.light)),
        Place::Sphere { image } => {
            let sphere = state.sessions[sample.session].sphere.as_ref()?;
            let at = meet_sphere(sample.ray, &sphere.centres[image], sphere.radius_m)?;
            Some(irradiance_of_sphere(&at, sphere.radius_m, &state.light))
        }
    }
}

/// Residual of Eq. (1) in the logarithm, `(log I − γ log L)/σ`; `None` where the sample is not lit.
pub fn intensity_row(sample: &Sample, state: &State, row: &mut Row) -> Option<()> {
    let session = &state.sessions[sample.session];
    let irradiance = irradiance(sample, state)?;
    if irradiance.value <= 0.0 {
        return None;
    }
    let albedo = session.log_albedo.exp();
    let direct = albedo * irradiance.value;
    let total = direct + reflectance(session.sphere.as_ref()) * sample.interreflected;
    let [x, y] = sample.ray;
    let log_linear = total.ln() + state.flat.log_factor(x, y);

    let inv_sigma = 1.0 / sample.sigma;
    row.residual = (sample.log_observed - state.gamma * log_linear) * inv_sigma;
    row.entries.clear();
    row.entries.push((0, -log_linear * inv_sigma));
    // Everything else acts on the logarithm of the linear intensity.
    let scale = -state.gamma * inv_sigma;
    let by_direct = scale * albedo / total;
    for axis in 0..3 {
        // The light moves against the point.
        row.entries
            .push((1 + axis, -by_direct * irradiance.by_point[axis]));
    }
    let log_cosine = state.light.log_cosine(&irradiance.point);
    row.entries
        .push((4, by_direct * irradiance.value * log_cosine));
    for (index, weight) in state.flat.grid.weights(x, y) {
        row.entries
            .push((state.flat_start() + index, scale * weight));
    }
    let start = state.session_start(sample.session);
    row.entries.push((start, scale * direct / total));
    if let Place::Sphere { image } = sample.place {
        row.entries
            .push((start + 1, scale * sample.interreflected / total));
        row.entries
            .push((start + 2, by_direct * irradiance.by_radius));
        push_vector(
            row,
            start + 3 + 3 * image,
            &(irradiance.by_centre * by_direct),
        );
    }
    Some(())
}

fn push_vector(row: &mut Row, first: usize, vector: &Vector3<f64>) {
    row.entries
        .extend((0..3).map(|axis| (first + axis, vector[axis])));
}

/// Residual of a limb point: its angle from the sphere's axis less the sphere's angular radius, in sigmas.
pub fn limb_row(limb: &LimbPoint, state: &State, row: &mut Row) -> Option<()> {
    let sphere = state.sessions[limb.session].sphere.as_ref()?;
    let centre = &sphere.centres[limb.image];
    let distance = centre.norm();
    let axis = centre / distance;
    let sine = sphere.radius_m / distance;
    if sine >= 1.0 {
        return None;
    }
    let cosine = limb.direction.dot(&axis);
    let aside = limb.direction - axis * cosine;
    let inv_sigma = 1.0 / limb.sigma_rad;
    let by_sine = 1.0 / (1.0 - sine * sine).sqrt();
    row.residual = (aside.norm().atan2(cosine) - sine.asin()) * inv_sigma;
    let by_centre = -aside / (aside.norm() * distance) + axis * (by_sine * sine / distance);
    let start = state.session_start(limb.session);
    row.entries.clear();
    row.entries
        .push((start + 2, -by_sine / distance * inv_sigma));
    push_vector(row, start + 3 + 3 * limb.image, &(by_centre * inv_sigma));
    Some(())
}

/// Residual of a cap: distance of the sphere's nearest point less the one measured, in sigmas.
pub fn cap_row(cap: &Cap, state: &State, row: &mut Row) -> Option<()> {
    /// Depth's own error on a smooth surface, metres.
    const SIGMA_M: f64 = 0.002;
    let sphere = state.sessions[cap.session].sphere.as_ref()?;
    let centre = &sphere.centres[cap.image];
    let distance = centre.norm();
    row.residual = (distance - sphere.radius_m - cap.range_m) / SIGMA_M;
    let start = state.session_start(cap.session);
    row.entries.clear();
    row.entries.push((start + 2, -1.0 / SIGMA_M));
    push_vector(
        row,
        start + 3 + 3 * cap.image,
        &(centre / (distance * SIGMA_M)),
    );
    Some(())
}
