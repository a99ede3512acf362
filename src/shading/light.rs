//! Irradiance under the near point light.

use nalgebra::{Point3, Vector3};

/// `(n·l)/d²` of Eq. (1), per square metre, as `n·v/|v|³` with v from the surface to the light; negative where the surface
/// faces away. Any frame, the same for all three.
#[inline]
pub fn falloff(point: &Point3<f64>, normal: &Vector3<f64>, light: &Point3<f64>) -> f64 {
    let v = light - point;
    let squared = v.norm_squared();
    normal.dot(&v) / (squared * squared.sqrt())
}

/// Derivative of [`falloff`] by the point, per cubic metre: `−n/|v|³ + 3 (n·v) v/|v|⁵`.
#[inline]
pub fn falloff_by_point(
    point: &Point3<f64>,
    normal: &Vector3<f64>,
    light: &Point3<f64>,
) -> Vector3<f64> {
    let v = light - point;
    let squared = v.norm_squared();
    let inv_cubed = 1.0 / (squared * squared.sqrt());
    v * (3.0 * normal.dot(&v) * inv_cubed / squared) - normal * inv_cubed
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn derivative_matches_central_differences() {
        let point = Point3::new(0.1, -0.05, 0.7);
        let light = Point3::new(0.05, 0.01, 0.0);
        let normal = Vector3::new(0.3, -0.2, -0.9)
            .try_normalize(0.0)
            .expect("not zero");
        let gradient = falloff_by_point(&point, &normal, &light);
        for axis in 0..3 {
            let mut step = Vector3::zeros();
            step[axis] = 1e-5;
            let numeric = (falloff(&(point + step), &normal, &light)
                - falloff(&(point - step), &normal, &light))
                / 2e-5;
            assert!((numeric - gradient[axis]).abs() < 1e-7 * gradient.norm());
        }
    }

    #[test]
    fn irradiance_falls_with_the_square_of_distance() {
        let normal = Vector3::new(0.0, 0.0, -1.0);
        let at = |z: f64| falloff(&Point3::new(0.0, 0.0, z), &normal, &Point3::origin());
        assert!((at(0.5) / at(1.0) - 4.0).abs() < 1e-12);
    }
}
