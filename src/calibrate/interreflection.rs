//! What lights a sphere a second time: everything else that the camera sees.
//!
//! A Lambertian patch of the surroundings that looks L bright sends `L cosθ cosθ' dA/(π d²)` to the sphere, where a
//! perfectly white surface would look as bright. With light and camera side by side, what the camera does not see the
//! light hardly reaches, so that the IR and depth images hold nearly all of it; what lies beyond the image's border is
//! missing. Later bounces are in it, since the patches are as bright as they are seen.

use super::Sensor;
use super::gather::TargetImage;
use super::state::State;
use crate::geometry::{DepthPatch, PixelSquare};
use nalgebra::{Point3, Vector3};
use std::f64::consts::PI;

/// The patches round a sphere in one image.
pub struct Surroundings {
    patches: Vec<Patch>,
}

/// A patch: `weight` is its brightness times its area over π.
struct Patch {
    point: Point3<f64>,
    normal: Vector3<f64>,
    weight: f64,
}

/// Side of a patch, pixels.
const PATCH_PX: usize = 10;
/// Depth within this distance of the sphere's surface is the sphere, metres; multipath near the contact bends it.
const OFF_SPHERE_M: f64 = 0.012;
/// What lies nearer lights as if it lay so far off, metres: nearer than any patch does.
const NEAREST_M: f64 = 0.001;

impl Surroundings {
    /// The patches of an image, without the sphere itself.
    pub fn new(
        shown: &TargetImage,
        sensor: &Sensor,
        state: &State,
        centre: &Vector3<f64>,
        radius_m: f64,
    ) -> Self {
        let (width, height) = (shown.depth_m.width(), shown.depth_m.height());
        let scene = Scene {
            shown,
            sensor,
            state,
        };
        let corners = (0..height / PATCH_PX)
            .flat_map(|row| (0..width / PATCH_PX).map(move |column| (column, row)));
        let patches = corners
            .filter_map(|(column, row)| scene.patch(column * PATCH_PX, row * PATCH_PX))
            .filter(|patch| (patch.point.coords - centre).norm() > radius_m + OFF_SPHERE_M)
            .collect();
        Surroundings { patches }
    }

    /// Linear intensity that a perfectly white surface would show of their light.
    pub fn at(&self, point: &Point3<f64>, normal: &Vector3<f64>) -> f64 {
        let of_patch = |patch: &Patch| {
            let across = patch.point - point;
            let here = normal.dot(&across).max(0.0);
            let there = -patch.normal.dot(&across).min(0.0);
            let squared = across.norm_squared().max(NEAREST_M * NEAREST_M);
            patch.weight * here * there / (squared * squared)
        };
        self.patches.iter().map(of_patch).sum()
    }
}

/// One image and what the sensor makes of it.
struct Scene<'a> {
    shown: &'a TargetImage,
    sensor: &'a Sensor<'a>,
    state: &'a State,
}

impl Scene<'_> {
    /// The plane through the depth of a square of pixels, and its mean brightness.
    fn patch(&self, u: usize, v: usize) -> Option<Patch> {
        let square = PixelSquare {
            u,
            v,
            side: PATCH_PX,
            step: 1,
        };
        let depth_m = &self.shown.depth_m;
        let DepthPatch {
            centre,
            normal,
            area_m2,
        } = DepthPatch::fit(depth_m, self.sensor.rays, square)?;
        let (mut linear, mut n) = (0.0, 0);
        for (u, v) in square.pixels() {
            let [x, y] = self.sensor.rays.rays().at(u, v).map(f64::from);
            if *depth_m.at(u, v) > 0.0 && x.is_finite() {
                let observed = f64::from(*self.shown.ir_counts.at(u, v)) / self.sensor.full_scale;
                linear += observed.max(0.0).powf(1.0 / self.state.gamma)
                    / self.state.flat.log_factor(x, y).exp();
                n += 1;
            }
        }
        Some(Patch {
            point: centre,
            normal,
            weight: linear / f64::from(n) * area_m2 / PI,
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_patch_that_all_but_touches_the_sphere_lights_it_as_one_a_little_way_off() {
        let surroundings = Surroundings {
            patches: vec![Patch {
                point: Point3::new(0.0, 0.0, 0.5),
                normal: -Vector3::z(),
                weight: 1.0,
            }],
        };
        let at = |away_m: f64| {
            let point = Point3::new(0.0, 0.0, 0.5 - away_m);
            surroundings.at(&point, &Vector3::z())
        };
        assert!((at(0.1) * 0.1 * 0.1 - 1.0).abs() < 1e-9);
        assert!(at(1e-4) <= at(NEAREST_M));
        assert_eq!(at(0.0), 0.0);
    }
}
