//! The plane that things stand on, beyond the image's border.
//!
//! What the image does not show of a table lights its object all the same, most of all the part between object and camera.
//! Without it the recorded bust and sphere keep 1.3 and 1.0 mm of error wherever they see the table at all.

use super::patches::{Lit, PatchGrid};
use super::sources::Sources;
use crate::geometry::lanes::LANES;
use crate::geometry::{Plane, tangents};
use crate::robust::median;
use nalgebra::{Point3, Vector3};
use pulp::{Arch, Simd, WithSimd};

/// Patches belong to the plane within this distance, metres.
const ON_PLANE_M: f64 = 0.012;
/// How far the plane is taken to reach from below what is seen, metres: farther off it adds nothing that shows.
const REACH_M: f64 = 0.6;
/// Side of the squares that it is cut into, metres.
const SQUARE_M: f64 = 0.04;

/// Squares of the plane that most patches lie on, as bright as its visible part, where the image does not show it.
pub fn beyond_the_image(patches: &[Option<Lit>], grid: &PatchGrid) -> Vec<Lit> {
    let support = Support::of_most(patches);
    let support = support.and_then(|support| Some((tangents(&support.normal)?, support)));
    let Some(([along, across], support)) = support else {
        return Vec::new();
    };
    let n_half = (REACH_M / SQUARE_M) as i32;
    let offsets = (-n_half..n_half).map(|k| (f64::from(k) + 0.5) * SQUARE_M);
    let squares = offsets
        .clone()
        .flat_map(|a| offsets.clone().map(move |b| along * a + across * b));
    let margin_px = grid.cells().cell_px() as f64;
    let camera = grid.rays().camera();
    let is_hidden = |point: &Point3<f64>| {
        camera
            .project(point)
            .is_none_or(|pixel| !camera.contains(&pixel, margin_px))
    };
    squares
        .map(|offset| support.below + offset)
        .filter(is_hidden)
        .filter_map(|point| {
            let square = grid.lit(&point, &support.normal, SQUARE_M * SQUARE_M, 0.0)?;
            let radiance = support.reflected * square.direct;
            Some(Lit { radiance, ..square })
        })
        .collect()
}

/// What things stand on, camera frame.
struct Support {
    /// Where the middle of all that is seen stands on its plane.
    below: Point3<f64>,
    /// Unit normal towards the camera.
    normal: Vector3<f64>,
    /// Median share of the light that it reflects, in units of the white level.
    reflected: f32,
}

impl Support {
    /// The plane that most patches lie on. Every patch is tried; the best one's companions make the plane.
    fn of_most(patches: &[Option<Lit>]) -> Option<Self> {
        let (arch, laid_out) = (Arch::new(), Sources::new(patches.iter().flatten()));
        let n_on_plane_of = |patch: &&Lit| {
            arch.dispatch(OnPlane {
                patch,
                sources: &laid_out,
            })
        };
        let best = patches.iter().flatten().max_by_key(n_on_plane_of)?;
        let seen: Vec<_> = patches.iter().flatten().map(oriented).collect();
        let (point, normal, _) = oriented(best);
        let plane = Plane::through(&point, normal);
        let companions: Vec<_> = seen
            .iter()
            .filter(|(p, n, _)| plane.holds(p, n, ON_PLANE_M))
            .collect();
        if (companions.len() as f64) < Plane::SUPPORT_SHARE * patches.len() as f64 {
            return None;
        }
        let n = companions.len() as f64;
        let middle = companions
            .iter()
            .map(|(p, ..)| p.coords)
            .sum::<Vector3<f64>>()
            / n;
        let normal = companions
            .iter()
            .map(|(_, n, _)| n)
            .sum::<Vector3<f64>>()
            .try_normalize(0.0)?;
        let shares = companions.iter().map(|(.., share)| f64::from(*share));
        let reflected = median(&mut shares.collect::<Vec<_>>())?;
        let all = seen.iter().map(|(p, ..)| p.coords).sum::<Vector3<f64>>() / seen.len() as f64;
        Some(Support {
            below: Point3::from(all - normal * normal.dot(&(all - middle))),
            normal,
            reflected: reflected as f32,
        })
    }
}

/// Where a patch is, its normal, and the share of the light that it reflects.
fn oriented(patch: &Lit) -> (Point3<f64>, Vector3<f64>, f32) {
    let [point, normal] = [patch.point, patch.normal].map(|v| Vector3::from(v).cast::<f64>());
    (Point3::from(point), normal, patch.radiance / patch.direct)
}

/// How many patches lie on the plane of one, as [`Plane::holds`] has it.
struct OnPlane<'a> {
    patch: &'a Lit,
    sources: &'a Sources,
}

impl WithSimd for OnPlane<'_> {
    type Output = u32;

    #[inline(always)]
    fn with_simd<S: Simd>(self, _: S) -> u32 {
        let ([px, py, pz], [nx, ny, nz]) = (self.patch.point, self.patch.normal);
        let mut n = [0u32; LANES];
        for [x, y, z, mx, my, mz, ..] in self.sources.steps() {
            for i in 0..LANES {
                let height_m = nx * (x[i] - px) + ny * (y[i] - py) + nz * (z[i] - pz);
                let cosine = nx * mx[i] + ny * my[i] + nz * mz[i];
                let is_near = u32::from(height_m.abs() < ON_PLANE_M as f32);
                n[i] += is_near & u32::from(cosine > Plane::MIN_COSINE as f32);
            }
        }
        n.iter().sum()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::lanes::arch_levels;

    #[test]
    fn as_many_patches_are_counted_on_a_plane_as_it_holds() {
        let patch = |k: usize| {
            let [a, b, c] = [0.7, 1.3, 2.9].map(|step| (step * k as f32).sin());
            let slanting = Vector3::new(0.3 * a, 0.3 * b, -1.0);
            let normal = slanting / slanting.norm();
            Lit {
                point: [a, b, 1.0 + 0.02 * c],
                normal: normal.into(),
                area_m2: 1e-4,
                radiance: 0.5,
                direct: 1.0,
                light_m: 1.0,
            }
        };
        let patches: Vec<Lit> = (0..100).map(patch).collect();
        let sources = Sources::new(patches.iter());
        for patch in &patches {
            let (point, normal, _) = oriented(patch);
            let plane = Plane::through(&point, normal);
            let held = patches.iter().map(oriented);
            let held = held.filter(|(point, normal, _)| plane.holds(point, normal, ON_PLANE_M));
            let n_held = held.count() as u32;
            assert!(n_held > 0);
            for arch in arch_levels() {
                let sources = &sources;
                assert_eq!(arch.dispatch(OnPlane { patch, sources }), n_held);
            }
        }
    }
}
