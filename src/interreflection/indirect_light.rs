//! Light that arrives over other surfaces, for shading: Eq. (1) with more than the lamp.
//!
//! A Lambertian patch that looks L bright sends `L cosθ dA/r²` along the way to a point. The sum over all patches above the
//! point's horizon, as a vector towards them, is to be added to what comes from the light: its product with the normal is
//! what a perfectly white surface would show of it, so that the derivative by the normal stays what it is. It varies slowly,
//! and is known on cells of the image.

use super::sources::{Sources, Way};
use super::{LitScene, WhiteLevel};
use crate::geometry::lanes::{LANES, Lane};
use crate::geometry::{CellGrid, DepthPatch, RayGrid};
use depth_camera::Image;
use nalgebra::Vector3;
use pulp::{Arch, Simd, WithSimd};
use rayon::prelude::*;

/// Columns of cells: 8 pixels a cell on a Kinect II.
const COLUMNS: usize = 64;
/// Pixels between those that a cell's plane is fitted to.
const STEP_PX: usize = 2;

/// Indirect light over an image, for a white level of 1/π, camera frame.
#[derive(Clone, Debug)]
pub struct IndirectLight {
    cells: CellGrid,
    /// With a fourth number, 0, so that one is one vector register.
    arriving: Vec<[f32; 4]>,
}

impl IndirectLight {
    /// The light that the surfaces of a scene send one another where `depth_m` (metres, 0 is none) has them.
    pub fn new(scene: &LitScene, depth_m: &Image<f32>, rays: &RayGrid) -> Self {
        let cells = CellGrid::new(depth_m.width(), depth_m.height(), COLUMNS);
        let (sources, arch) = (scene.sources(), Arch::new());
        let arriving: Vec<Option<Vector3<f32>>> = (0..cells.n_cells())
            .into_par_iter()
            .map(|cell| {
                let DepthPatch { centre, normal, .. } =
                    DepthPatch::fit(depth_m, rays, cells.square(cell, STEP_PX))?;
                Some(arch.dispatch(Arriving {
                    point: centre.coords.cast(),
                    normal: normal.cast(),
                    sources: &sources,
                }))
            })
            .collect();
        let arriving = cells.filled(&arriving).into_iter();
        IndirectLight {
            arriving: arriving.map(|light| light.push(0.0).into()).collect(),
            cells,
        }
    }

    /// The light that arrives at places on the image (columns and rows, pixels), as vectors towards where it comes from, in the
    /// unit of [`NearLight::incident`](crate::shading::NearLight::incident).
    #[inline(always)]
    pub fn at(&self, u: &Lane, v: &Lane, white: WhiteLevel) -> [Lane; 3] {
        let (cells, shares) = self.cells.around(u, v);
        let strength = white.strength() as f32;
        let mut sums = [[0.0; LANES]; 3];
        for i in 0..LANES {
            let mut sum = [0.0; 4];
            for (cells, shares) in cells.iter().zip(&shares) {
                let arriving = &self.arriving[cells[i] as usize];
                for (sum, arriving) in sum.iter_mut().zip(arriving) {
                    *sum += arriving * shares[i];
                }
            }
            for (sums, sum) in sums.iter_mut().zip(sum) {
                sums[i] = sum * strength;
            }
        }
        sums
    }
}

/// What arrives at one point.
struct Arriving<'a> {
    point: Vector3<f32>,
    normal: Vector3<f32>,
    sources: &'a Sources,
}

impl WithSimd for Arriving<'_> {
    type Output = Vector3<f32>;

    #[inline(always)]
    fn with_simd<S: Simd>(self, _: S) -> Vector3<f32> {
        let (point, normal) = (self.point.into(), self.normal.into());
        let mut sums = [[0.0f32; LANES]; 3];
        for step in self.sources.steps() {
            #[allow(
                clippy::needless_range_loop,
                reason = "one index runs through all the lanes, which is what becomes vector code"
            )]
            for i in 0..LANES {
                let way = Way::new(step, i, point, normal);
                let there = if way.here > 0.0 && way.there > 0.0 {
                    way.there
                } else {
                    0.0
                };
                let sent = way.power * there / way.to_the_fourth;
                let [dx, dy, dz] = way.across;
                sums[0][i] += sent * dx;
                sums[1][i] += sent * dy;
                sums[2][i] += sent * dz;
            }
        }
        Vector3::from(sums.map(|sum| sum.iter().sum()))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::interreflection::Lit;
    use std::f64::consts::PI;

    #[test]
    fn a_wall_on_an_endless_bright_floor_receives_half_of_what_a_ceiling_would() {
        // A floor of 8 m by 8 m, cut into squares of 40 mm, as bright everywhere.
        let (side, n) = (0.04f32, 100);
        let place = |k: i32| (k as f32 + 0.5) * side;
        let floor: Vec<Lit> = (-n..n)
            .flat_map(|i| (-n..n).map(move |j| [place(i), 0.0, place(j)]))
            .map(|point| Lit {
                point,
                normal: [0.0, -1.0, 0.0],
                area_m2: side * side,
                radiance: 0.7,
                direct: 1.0,
                light_m: 1.0,
            })
            .collect();
        let sources = Sources::new(floor.iter());
        let received = |normal: Vector3<f32>| {
            let point = Vector3::new(0.0, -0.15, 0.0);
            let kernel = Arriving {
                point,
                normal,
                sources: &sources,
            };
            f64::from(Arch::new().dispatch(kernel).dot(&normal))
        };
        // The form factor of the hemisphere is π; a floor that ends lacks a little of it, most where it is seen at a grazing angle.
        let ceiling = received(Vector3::y());
        assert!((ceiling / (0.7 * PI) - 1.0).abs() < 0.02, "{ceiling}");
        let wall = received(Vector3::x());
        assert!((wall / (0.7 * PI / 2.0) - 1.0).abs() < 0.05, "{wall}");
        assert_eq!(received(-Vector3::y()), 0.0);
    }
}
