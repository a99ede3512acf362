//! What a glossy surface adds to Eq. (1).

use nalgebra::{Point3, Vector3};

/// A lobe as of Blinn and Phong about the direction halfway between light and camera: `rho · strength · |E| · (n·h)^power`, with the light
/// E that arrives from the lamp.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Gloss {
    /// Brightness at the middle of the lobe, in albedos; 0 is matte.
    pub strength: f64,
    /// Exponent: 10 is waxy, 30 satin, 100 lacquer.
    pub power: f64,
}

impl Default for Gloss {
    /// A matte surface.
    fn default() -> Self {
        Gloss {
            strength: 0.0,
            power: 30.0,
        }
    }
}

/// What the lobe adds for an albedo of 1.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Highlight {
    /// Irradiance, per square metre.
    pub value: f64,
    /// Its derivative by the normal.
    pub by_normal: Vector3<f64>,
}

impl Gloss {
    /// Whether it adds nothing.
    pub fn is_matte(&self) -> bool {
        self.strength == 0.0
    }

    /// The highlight at a point (m, camera frame) with a normal of any length, where `direct` arrives from the light as of
    /// [`NearLight::incident`](super::NearLight::incident). None where no light arrives, as behind the light, or where light and
    /// camera lie in opposite directions.
    #[inline]
    pub fn highlight(
        &self,
        point: &Point3<f64>,
        normal: &Vector3<f64>,
        direct: &Vector3<f64>,
    ) -> Highlight {
        if self.is_matte() {
            return Highlight::default();
        }
        let brightness = direct.norm();
        if brightness == 0.0 {
            return Highlight::default();
        }
        let between = direct / brightness - point.coords / point.coords.norm();
        let spread = between.norm();
        if spread == 0.0 {
            return Highlight::default();
        }
        let half = between / spread;
        let length = normal.norm();
        let cosine = (normal.dot(&half) / length).max(0.0);
        let lobe = self.strength * brightness * cosine.powf(self.power - 1.0);
        Highlight {
            value: lobe * cosine,
            by_normal: (half - normal * (cosine / length)) * (self.power * lobe / length),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::shading::NearLight;

    #[test]
    fn a_highlight_is_brightest_halfway_and_its_derivative_matches_differences() {
        let (point, gloss) = (
            Point3::new(0.1, -0.05, 0.7),
            Gloss {
                strength: 0.4,
                power: 20.0,
            },
        );
        let direct = NearLight::even(Point3::new(0.12, -0.07, 0.02)).incident(&point);
        let unit = |v: Vector3<f64>| v / v.norm();
        let half = unit(unit(direct) - unit(point.coords));
        let brightest = gloss.highlight(&point, &half, &direct);
        assert!((brightest.value - 0.4 * direct.norm()).abs() < 1e-12);
        assert!(brightest.by_normal.norm() < 1e-9);

        let normal = half + Vector3::new(0.1, -0.15, 0.2);
        let found = gloss.highlight(&point, &normal, &direct);
        assert!(found.value > 0.0 && found.value < brightest.value);
        for axis in 0..3 {
            let step = Vector3::ith(axis, 1e-6);
            let at = |normal: Vector3<f64>| gloss.highlight(&point, &normal, &direct).value;
            let numeric = (at(normal + step) - at(normal - step)) / 2e-6;
            assert!((numeric - found.by_normal[axis]).abs() < 1e-6 * direct.norm());
        }
        assert_eq!(
            Gloss::default().highlight(&point, &normal, &direct).value,
            0.0
        );
    }

    #[test]
    fn nothing_shines_where_no_light_arrives_or_nothing_lies_halfway() {
        let (normal, gloss) = (
            Vector3::new(0.0, 0.0, -1.0),
            Gloss {
                strength: 0.4,
                power: 20.0,
            },
        );
        let lamp = NearLight {
            position: Point3::new(0.05, 0.0, 0.3),
            lobe_power: 2.0,
        };
        let before_it = Point3::new(0.0, 0.0, 0.2);
        let direct = lamp.incident(&before_it);
        assert_eq!(direct, Vector3::zeros());
        let found = gloss.highlight(&before_it, &normal, &direct);
        assert_eq!(found, Highlight::default());

        let beyond = NearLight::even(Point3::new(0.0, 0.0, 0.5)).incident(&before_it);
        let found = gloss.highlight(&before_it, &normal, &beyond);
        assert_eq!(found, Highlight::default());
    }
}
