//! The near light that moves with the camera.

use crate::geometry::lanes::{LANES, Lane, floor};
use nalgebra::{Point3, Vector3};

/// A near point light in the camera frame whose emission falls off by a cosine power about the camera's optical axis.
///
/// The emitter of a Kinect II has such a lobe. It depends on the direction *from the light*, so that it cannot be part of a
/// flat field, which depends on the pixel: with the light 5 cm beside the camera the two differ by 5 % at 0.6 m.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct NearLight {
    /// Position in the camera frame, metres.
    pub position: Point3<f64>,
    /// Exponent of the cosine between the ray from the light and the optical axis; 0 for a lamp that shines evenly.
    pub lobe_power: f64,
}

impl NearLight {
    /// A light that shines evenly.
    pub fn even(position: Point3<f64>) -> Self {
        NearLight {
            position,
            lobe_power: 0.0,
        }
    }

    /// Light that reaches a point (m, camera frame) as a vector towards the light, per square metre: `E · v/|v|³` with v
    /// from the point to the light and the lobe E. Its product with the normal is the irradiance, so that it is also the
    /// derivative of [`Self::irradiance`] by the normal. Zero behind the light.
    #[inline]
    pub fn incident(&self, point: &Point3<f64>) -> Vector3<f64> {
        let v = self.position - point;
        let squared = v.norm_squared();
        v * (self.lobe(-v.z, squared) / (squared * squared.sqrt()))
    }

    /// `E · (n·l)/d²` of Eq. (1), per square metre; negative where the surface faces away.
    #[inline]
    pub fn irradiance(&self, point: &Point3<f64>, normal: &Vector3<f64>) -> f64 {
        normal.dot(&self.incident(point))
    }

    /// The same where light comes in at a cosine above `min_cosine`; `None` elsewhere, and where the normal is none.
    #[inline]
    pub fn irradiance_above(
        &self,
        min_cosine: f64,
        point: &Point3<f64>,
        normal: &Vector3<f64>,
    ) -> Option<f64> {
        let incident = self.incident(point);
        let irradiance = normal.dot(&incident);
        (irradiance > min_cosine * incident.norm()).then_some(irradiance)
    }

    /// Derivative of [`Self::irradiance`] by the point, per cubic metre.
    #[inline]
    pub fn irradiance_by_point(&self, point: &Point3<f64>, normal: &Vector3<f64>) -> Vector3<f64> {
        let v = self.position - point;
        let squared = v.norm_squared();
        let scale = self.lobe(-v.z, squared) / (squared * squared.sqrt());
        let irradiance = normal.dot(&v) * scale;
        // log E = power · (log w_z − log|w|), w = −v; the point moves w, and v the other way.
        let lobe_slope = if self.lobe_power == 0.0 || v.z >= 0.0 {
            0.0
        } else {
            self.lobe_power * irradiance / -v.z
        };
        v * ((3.0 + self.lobe_power) * irradiance / squared) - normal * scale
            + Vector3::new(0.0, 0.0, lobe_slope)
    }

    /// Logarithm of the cosine between the ray from the light to a point (m, camera frame) and the optical axis, of 10⁻⁹ at least:
    /// the derivative of the lobe's logarithm by its power. Those by the light's place are of [`Self::irradiance_by_point`], since
    /// the light moves against the point.
    pub fn log_cosine(&self, point: &Point3<f64>) -> f64 {
        let ray = point - self.position;
        (ray.z / ray.norm()).max(1e-9).ln()
    }

    /// The emission towards a point at depth `z` from the light; `squared` is its squared distance.
    #[inline]
    fn lobe(&self, z: f64, squared: f64) -> f64 {
        if self.lobe_power == 0.0 {
            1.0
        } else {
            (z.max(0.0) / squared.sqrt()).powf(self.lobe_power)
        }
    }
}

/// A light for kernels: its lobe as a table over the cosine, right to 10⁻⁵ up to 60° from the axis.
#[derive(Clone, Debug)]
pub struct LightTable {
    position: [f32; 3],
    power: f32,
    /// Emission at cosines from 0 to 1.
    lobe: Vec<f32>,
}

impl LightTable {
    /// Steps of the table.
    const STEPS: usize = 1024;

    /// Tabulates a light.
    pub fn new(light: &NearLight) -> Self {
        let cosines = (0..=Self::STEPS + 1).map(|k| k as f64 / Self::STEPS as f64);
        LightTable {
            position: light.position.coords.cast::<f32>().into(),
            power: light.lobe_power as f32,
            lobe: cosines.map(|c| light.lobe(c, 1.0) as f32).collect(),
        }
    }

    /// [`NearLight::incident`] at many points (m, camera frame).
    #[inline(always)]
    pub fn incident(&self, points: &[Lane; 3]) -> [Lane; 3] {
        let [lx, ly, lz] = self.position;
        let mut v = [[0.0; LANES]; 3];
        let (mut falloff, mut step, mut beyond) = ([0.0; LANES], [0; LANES], [0.0; LANES]);
        for i in 0..LANES {
            let (x, y, z) = (lx - points[0][i], ly - points[1][i], lz - points[2][i]);
            let squared = x * x + y * y + z * z;
            let distance = squared.sqrt();
            falloff[i] = 1.0 / (squared * distance);
            let place = (-z / distance).max(0.0) * Self::STEPS as f32;
            step[i] = floor(place);
            beyond[i] = place - step[i] as f32;
            v[0][i] = x;
            v[1][i] = y;
            v[2][i] = z;
        }
        let (mut before, mut after) = ([0.0; LANES], [0.0; LANES]);
        for i in 0..LANES {
            before[i] = self.lobe[step[i] as usize];
            after[i] = self.lobe[step[i] as usize + 1];
        }
        for i in 0..LANES {
            let scale = (before[i] + (after[i] - before[i]) * beyond[i]) * falloff[i];
            for axis in &mut v {
                axis[i] *= scale;
            }
        }
        v
    }

    /// [`NearLight::irradiance_by_point`] at many points (m, camera frame), times vectors `along` which they move; `incident` is as of
    /// [`Self::incident`] there.
    #[inline(always)]
    pub fn irradiance_along(
        &self,
        points: &[Lane; 3],
        incident: &[Lane; 3],
        normals: &[Lane; 3],
        along: &[Lane; 3],
    ) -> Lane {
        let mut by_motion = [0.0; LANES];
        for i in 0..LANES {
            let dot =
                |a: &[Lane; 3], b: &[f32; 3]| a[0][i] * b[0] + a[1][i] * b[1] + a[2][i] * b[2];
            let v = [0, 1, 2].map(|axis| self.position[axis] - points[axis][i]);
            let m = [0, 1, 2].map(|axis| along[axis][i]);
            let irradiance = dot(normals, &[incident[0][i], incident[1][i], incident[2][i]]);
            let squared = v[0] * v[0] + v[1] * v[1] + v[2] * v[2];
            let towards = (3.0 + self.power) * irradiance * dot(along, &v);
            let tilt = dot(incident, &v) * dot(normals, &m);
            // Where nothing is lit, nothing changes.
            let lobe = self.power * irradiance * m[2] / (-v[2]).max(1e-6);
            by_motion[i] = (towards - tilt) / squared + lobe;
        }
        by_motion
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn derivative_matches_central_differences() {
        let point = Point3::new(0.1, -0.05, 0.7);
        let normal = Vector3::new(0.3, -0.2, -0.9)
            .try_normalize(0.0)
            .expect("not zero");
        for lobe_power in [0.0, 2.0, 3.5] {
            let light = NearLight {
                position: Point3::new(0.05, 0.01, 0.0),
                lobe_power,
            };
            let gradient = light.irradiance_by_point(&point, &normal);
            for axis in 0..3 {
                let mut step = Vector3::zeros();
                step[axis] = 1e-5;
                let numeric = (light.irradiance(&(point + step), &normal)
                    - light.irradiance(&(point - step), &normal))
                    / 2e-5;
                assert!((numeric - gradient[axis]).abs() < 1e-7 * gradient.norm());
            }
        }
    }

    #[test]
    fn the_table_gives_what_the_light_does() {
        for lobe_power in [0.0, 0.7, 1.3, 4.0] {
            let light = NearLight {
                position: Point3::new(0.05, -0.02, 0.01),
                lobe_power,
            };
            let table = LightTable::new(&light);
            let line = |from: f32, by: f32| std::array::from_fn(|lane| from + by * lane as f32);
            let points = [line(-0.7, 0.1), line(0.3, -0.03), line(0.5, 0.05)];
            let many = table.incident(&points);
            for lane in 0..LANES {
                let at = |of: &[Lane; 3]| [0, 1, 2].map(|axis| f64::from(of[axis][lane]));
                let exact = light.incident(&Point3::from(at(&points)));
                let off = (Vector3::from(at(&many)) - exact).norm();
                assert!(off < 1e-5 * exact.norm(), "{lobe_power}: {off}");
            }
            let (normals, along) = ([[0.3; LANES], [-0.2; LANES], [-0.9; LANES]], points);
            let slopes = table.irradiance_along(&points, &many, &normals, &along);
            for (lane, slope) in slopes.into_iter().enumerate() {
                let at = |of: &[Lane; 3]| Vector3::from(of.map(|axis| f64::from(axis[lane])));
                let by_point = light.irradiance_by_point(&at(&points).into(), &at(&normals));
                let exact = by_point.dot(&at(&along));
                assert!((f64::from(slope) - exact).abs() < 1e-4 * by_point.norm());
            }
        }
    }

    #[test]
    fn irradiance_falls_with_the_square_of_distance_and_the_power_of_the_cosine() {
        let normal = Vector3::new(0.0, 0.0, -1.0);
        let light = NearLight {
            position: Point3::new(0.1, 0.0, 0.0),
            lobe_power: 2.0,
        };
        let at = |x: f64, z: f64| light.irradiance(&Point3::new(0.1 + x, 0.0, z), &normal);
        assert!((at(0.0, 0.5) / at(0.0, 1.0) - 4.0).abs() < 1e-12);
        // 45° from the axis: half of it by the squared distance, 2^-1/2 by incidence, half by the lobe.
        assert!((at(0.5, 0.5) / at(0.0, 0.5) - 0.25 / 2.0f64.sqrt()).abs() < 1e-12);
        assert_eq!(at(0.0, -0.5), 0.0);
    }
}
