//! Direct alignment of a frame to the signed distances (Bylow et al. 2013; Canelhas et al. 2013).
//!
//! The residual of a point is the distance that the volume keeps at its place, the derivative the gradient there, so that
//! neither a raycast nor a pairing comes between frame and model. It needs a start within the truncation distance.

use super::icp::{Points, is_small, rows, turn};
use super::noise::DepthNoise;
use super::normal_equations::{LANES, NormalEquations, Rows, TileSums, huber_weight};
use super::pyramid::{Level, N_REDUCED};
use super::volume::TsdfVolume;
use crate::geometry::Pose;
use pulp::{Arch, Simd, WithSimd};

/// Aligns a frame to the volume from a first guess, on the images reduced by 8 and then by 4, with so many iterations at
/// most on each. Returns the pose and the equations of the last iteration; `None` where nothing matches at all.
pub fn align(
    arch: Arch,
    levels: &[Level; N_REDUCED],
    volume: &TsdfVolume,
    guess: &Pose,
    noise: &DepthNoise,
    iterations: [usize; 2],
) -> Option<(Pose, NormalEquations)> {
    let mut world_from_camera = *guess;
    let mut last = None;
    for (level, n) in [&levels[2], &levels[1]].into_iter().zip(iterations) {
        for _ in 0..n {
            let equations = equations(arch, level, volume, &world_from_camera, noise);
            let step = equations.solve(&world_from_camera.translation.vector)?;
            world_from_camera = step * world_from_camera;
            last = Some(equations);
            if is_small(&step) {
                break;
            }
        }
    }
    last.map(|equations| (world_from_camera, equations))
}

/// The residuals of a level at a pose.
pub fn equations(
    arch: Arch,
    level: &Level,
    volume: &TsdfVolume,
    world_from_camera: &Pose,
    noise: &DepthNoise,
) -> NormalEquations {
    let rotation = rows(world_from_camera.rotation.to_rotation_matrix().matrix());
    let centre = world_from_camera.translation.vector.cast::<f32>().into();
    NormalEquations::of_tiles(level.n_tiles(), |tile| {
        arch.dispatch(PointToDistance {
            level,
            tile,
            volume,
            rotation,
            centre,
            noise,
        })
    })
}

struct PointToDistance<'a> {
    level: &'a Level,
    tile: usize,
    volume: &'a TsdfVolume,
    rotation: [[f32; 3]; 3],
    centre: [f32; 3],
    noise: &'a DepthNoise,
}

impl WithSimd for PointToDistance<'_> {
    type Output = TileSums;

    #[inline(always)]
    fn with_simd<S: Simd>(self, _: S) -> TileSums {
        let mut sums = TileSums::ZERO;
        let mut rows = Rows::EMPTY;
        for first in self.level.tile(self.tile).step_by(LANES) {
            let Some(points) = Points::load(self.level, first) else {
                continue;
            };
            sums.n_points += points.n_valid;
            self.residuals(&points, &mut rows);
            sums.add(&rows);
        }
        sums
    }
}

impl PointToDistance<'_> {
    #[inline(always)]
    fn residuals(&self, points: &Points, rows: &mut Rows) {
        let reach = 0.9 * self.volume.truncation_m();
        let mut voxels = [[0; 3]; LANES];
        let mut fractions = [[0.0; LANES]; 3];
        for i in 0..LANES {
            let point = [points.point[0][i], points.point[1][i], points.point[2][i]];
            let [x, y, z] = turn(&self.rotation, &point, &[0.0; 3]);
            let [cx, cy, cz] = self.centre;
            let (voxel, fraction) = self.volume.place([x + cx, y + cy, z + cz]);
            voxels[i] = voxel;
            for (axis, lever) in [x, y, z].into_iter().enumerate() {
                rows.lever[axis][i] = lever;
                fractions[axis][i] = fraction[axis];
            }
        }
        // Where nothing was seen all corners are 0, and so is the gradient.
        let mut corners = [[0.0; 8]; LANES];
        for i in 0..LANES {
            if points.normal[2][i] < 0.0 {
                corners[i] = self.volume.corners(voxels[i]).unwrap_or_default();
            }
        }
        for i in 0..LANES {
            let fraction = [fractions[0][i], fractions[1][i], fractions[2][i]];
            let (distance, [gx, gy, gz]) = self.volume.interpolate(&corners[i], fraction);
            // At the band's ends the distance is cut off and its gradient falls.
            let counts = (distance.abs() <= reach) & (gx * gx + gy * gy + gz * gz >= 0.25);
            let sigma = self.noise.sigma_m(points.point[2][i]);
            rows.residual[i] = distance;
            rows.weight[i] = if counts {
                huber_weight(distance, sigma)
            } else {
                0.0
            };
            for (axis, gradient) in [gx, gy, gz].into_iter().enumerate() {
                rows.normal[axis][i] = gradient;
            }
        }
    }
}
