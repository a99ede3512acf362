//! Planes, and which oriented points lie on one.

use nalgebra::{Point3, Vector3};

/// A plane `normal·x = offset_m`, its normal out of the surface.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Plane {
    /// Unit normal.
    pub normal: Vector3<f64>,
    /// Distance of the plane from the origin along the normal, metres.
    pub offset_m: f64,
}

impl Plane {
    /// A plane holds this share of what is seen, at least, if it is the one that things stand on; arbitrary.
    pub const SUPPORT_SHARE: f64 = 0.15;

    /// Surface lies on a plane within this angle of its normal: 20°, since measured normals are noisy.
    pub const MIN_COSINE: f64 = 0.94;

    /// The plane through a point with a unit normal.
    pub fn through(point: &Point3<f64>, normal: Vector3<f64>) -> Self {
        Plane {
            normal,
            offset_m: normal.dot(&point.coords),
        }
    }

    /// Where the ray (X/Z, Y/Z) from the origin meets the plane's front; `None` where it does not.
    pub fn met_by(&self, [x, y]: [f64; 2]) -> Option<Point3<f64>> {
        let direction = Vector3::new(x, y, 1.0);
        let slope = self.normal.dot(&direction);
        let is_met = slope < -1e-6 && self.offset_m < 0.0;
        is_met.then(|| Point3::from(direction * (self.offset_m / slope)))
    }

    /// Signed height of a point above the plane, metres.
    pub fn height_m(&self, point: &Point3<f64>) -> f64 {
        self.normal.dot(&point.coords) - self.offset_m
    }

    /// Whether surface at a point, with a unit normal, lies on the plane: within so many metres of it, and facing as it does.
    pub fn holds(&self, point: &Point3<f64>, normal: &Vector3<f64>, within_m: f64) -> bool {
        self.height_m(point).abs() < within_m && self.normal.dot(normal) > Plane::MIN_COSINE
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rays_meet_the_front_of_a_plane() {
        let plane = Plane::through(&Point3::new(0.0, 0.0, 2.0), -Vector3::z());
        assert_eq!(
            plane.met_by([0.5, -0.25]),
            Some(Point3::new(1.0, -0.5, 2.0))
        );
        let turned_away = Plane::through(&Point3::new(0.0, 0.0, 2.0), Vector3::z());
        assert_eq!(turned_away.met_by([0.5, -0.25]), None);
        let behind = Plane::through(&Point3::new(0.0, 0.0, -2.0), -Vector3::z());
        assert_eq!(behind.met_by([0.5, -0.25]), None);
        let along = Plane::through(&Point3::new(0.0, 1.0, 2.0), -Vector3::y());
        assert_eq!(along.met_by([0.5, 0.0]), None);
    }

    #[test]
    fn a_plane_holds_what_lies_near_it_and_faces_as_it_does() {
        let plane = Plane::through(&Point3::new(0.3, -0.1, 0.5), Vector3::z());
        assert!((plane.height_m(&Point3::new(7.0, 2.0, 0.49)) + 0.01).abs() < 1e-12);
        let turned = |angle: f64| Vector3::new(angle.sin(), 0.0, angle.cos());
        let at = |z: f64| Point3::new(1.0, 1.0, z);
        assert!(plane.holds(&at(0.495), &turned(0.3), 0.006));
        assert!(!plane.holds(&at(0.495), &turned(0.4), 0.006));
        assert!(!plane.holds(&at(0.495), &-Vector3::z(), 0.006));
        assert!(!plane.holds(&at(0.507), &Vector3::z(), 0.006));
    }
}
