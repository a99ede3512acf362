//! The grey material of the pictures, the two lights, and the sRGB curve.

use nalgebra::Vector3;
use std::sync::LazyLock;

/// How a surface is drawn.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PhongParams {
    /// Whether every face has one brightness, so that single triangles show; otherwise normals are interpolated.
    pub flat: bool,
    /// Share of the light that the material scatters.
    pub reflectance: f64,
    /// Strength of the highlight at its centre.
    pub specular: f64,
    /// Exponent of the highlight; small is soft.
    pub shininess: i32,
    /// Colour around the mesh, sRGB.
    pub background: [u8; 3],
}

impl Default for PhongParams {
    /// A light grey plaster on white; the figures are arbitrary.
    fn default() -> Self {
        PhongParams {
            flat: false,
            reflectance: 0.66,
            specular: 0.09,
            shininess: 18,
            background: [255; 3],
        }
    }
}

/// Light from all sides, before the material.
const AMBIENT: f64 = 0.10;
/// Further light from above.
const SKY: f64 = 0.08;
/// Key light from the upper left, low enough to graze relief, and a weak fill from the right: direction towards the light
/// in the camera frame (x right, y down, z forward), and strength.
const LIGHTS: [([f64; 3], f64); 2] = [([-0.55, -0.60, -0.58], 0.88), ([0.80, 0.15, -0.60], 0.26)];

/// The same with unit directions.
static UNIT_LIGHTS: LazyLock<[(Vector3<f64>, f64); 2]> = LazyLock::new(|| {
    LIGHTS.map(|(direction, strength)| {
        let direction = Vector3::from(direction);
        (direction / direction.norm(), strength)
    })
});

/// A direction of looking: from where, and where highlights are.
pub(super) struct Look {
    /// Unit, camera frame.
    pub towards_camera: Vector3<f64>,
    /// Unit normal of what shows the highlight of each light at its brightest; zero where there is none.
    halves: [Vector3<f64>; LIGHTS.len()],
}

impl Look {
    /// Along a ray from the camera, of any length; `None` if that is zero.
    pub fn along(ray: &Vector3<f64>) -> Option<Look> {
        let towards_camera = (-ray).try_normalize(0.0)?;
        let half = |(light, _): &(Vector3<f64>, f64)| {
            let half = (light + towards_camera).try_normalize(1e-9);
            half.unwrap_or_default()
        };
        let [key, fill] = &*UNIT_LIGHTS;
        Some(Look {
            halves: [half(key), half(fill)],
            towards_camera,
        })
    }
}

/// Linear brightness of a surface with this unit normal.
pub(super) fn shade(normal: &Vector3<f64>, look: &Look, params: &PhongParams) -> f64 {
    let mut scattered = AMBIENT + SKY * (0.5 - 0.5 * normal.y);
    let mut highlight = 0.0;
    for (&(light, strength), half) in UNIT_LIGHTS.iter().zip(&look.halves) {
        let cosine = normal.dot(&light).max(0.0);
        scattered += strength * cosine;
        highlight += strength * cosine * normal.dot(half).max(0.0).powi(params.shininess);
    }
    params.reflectance * scattered + params.specular * highlight
}

/// Linear share of full light of an sRGB code.
pub(super) fn linear_from_srgb(code: u8) -> f64 {
    linear_from_fraction(f64::from(code) / 255.0)
}

/// The sRGB curve, IEC 61966-2-1.
fn linear_from_fraction(s: f64) -> f64 {
    if s <= 0.04045 {
        s / 12.92
    } else {
        ((s + 0.055) / 1.055).powf(2.4)
    }
}

/// Linear share from which on a code is nearer than the one before it, for codes from 1.
static CODE_STARTS: LazyLock<[f64; 255]> =
    LazyLock::new(|| std::array::from_fn(|code| linear_from_fraction((code as f64 + 0.5) / 255.0)));

/// The nearest sRGB code of a linear share of full light, which is cut at 0 and 1.
pub(super) fn srgb_from_linear(linear: f64) -> u8 {
    CODE_STARTS.partition_point(|&start| start <= linear) as u8
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn srgb_survives_the_round_trip() {
        assert!((0..=255).all(|code| srgb_from_linear(linear_from_srgb(code)) == code));
    }
}
