//! Normals of a level by central differences.

use super::noise::DepthNoise;
use super::preprocess::{SAME_SURFACE_SIGMAS, rows_round};
use super::pyramid::{Level, lane};
use crate::geometry::lanes::{LANES, Lane};
use pulp::{Arch, Simd, WithSimd};
use rayon::prelude::*;

/// Takes normals from central differences of the points; none where a neighbour is missing or lies on another surface.
pub fn find_normals(arch: Arch, noise: &DepthNoise, level: &mut Level) {
    let Level {
        rays,
        depth,
        normals: [x, y, z],
        ..
    } = level;
    let (width, height) = (rays.width, rays.height);
    x.par_chunks_mut(width)
        .zip(y.par_chunks_mut(width))
        .zip(z.par_chunks_mut(width))
        .enumerate()
        .filter(|(v, _)| *v > 0 && v + 1 < height)
        .for_each(|(v, ((x, y), z))| {
            arch.dispatch(NormalsRow {
                out: [x, y, z],
                depth: rows_round(depth, width, v),
                ray_x: rows_round(&rays.x, width, v),
                ray_y: rows_round(&rays.y, width, v),
                noise,
            });
        });
}

struct NormalsRow<'a> {
    out: [&'a mut [f32]; 3],
    /// Three rows round the one whose normals are found.
    depth: [&'a [f32]; 3],
    ray_x: [&'a [f32]; 3],
    ray_y: [&'a [f32]; 3],
    noise: &'a DepthNoise,
}

impl WithSimd for NormalsRow<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(mut self, _: S) {
        let n = self.depth[1].len() - 2;
        for first in (0..n).step_by(LANES) {
            let normals = self.normals(first);
            let n = LANES.min(n - first);
            for (out, normal) in self.out.iter_mut().zip(&normals) {
                let out = &mut out[first + 1..][..n];
                match out.first_chunk_mut() {
                    Some(out) => *out = *normal,
                    None => out.copy_from_slice(&normal[..n]),
                }
            }
        }
    }
}

impl NormalsRow<'_> {
    /// Normals of `LANES` pixels from the one after column `first` on.
    #[allow(
        clippy::needless_range_loop,
        reason = "one index runs through all the lanes, which is what becomes vector code"
    )]
    #[inline(always)]
    fn normals(&self, first: usize) -> [Lane; 3] {
        // Points of the neighbours in both directions, and of the pixels themselves.
        let (up, down) = (self.points(0, first + 1), self.points(2, first + 1));
        let (left, right) = (self.points(1, first), self.points(1, first + 2));
        let centre = self.points(1, first + 1);
        let mut normals = [[0.0; LANES]; 3];
        for u in 0..LANES {
            let (z, z_up, z_down) = (centre.z[u], up.z[u], down.z[u]);
            let (z_left, z_right) = (left.z[u], right.z[u]);
            let hx = right.x[u] * z_right - left.x[u] * z_left;
            let hy = right.y[u] * z_right - left.y[u] * z_left;
            let hz = z_right - z_left;
            let vx = down.x[u] * z_down - up.x[u] * z_up;
            let vy = down.y[u] * z_down - up.y[u] * z_up;
            let vz = z_down - z_up;
            // On a steep surface neighbours differ by more than noise: a slope of 5 (79°) over the pixel pitch is still one.
            let (across, along) = (hx.abs(), vy.abs());
            let pitch = if across > along { across } else { along };
            let reach = SAME_SURFACE_SIGMAS * self.noise.sigma_m(z) + 2.5 * pitch;
            let mut same = true;
            for other in [z_up, z_left, z_right, z_down] {
                same &= (other > 0.0) & ((other - z).abs() < reach);
            }
            let (nx, ny, nz) = (vy * hz - vz * hy, vz * hx - vx * hz, vx * hy - vy * hx);
            let length = (nx * nx + ny * ny + nz * nz).sqrt();
            let facing = nx * centre.x[u] + ny * centre.y[u] + nz;
            let valid = (z > 0.0) & same & (length > 1e-12) & (facing < 0.0) & (nz < 0.0);
            let scale = 1.0 / length;
            normals[0][u] = if valid { nx * scale } else { 0.0 };
            normals[1][u] = if valid { ny * scale } else { 0.0 };
            normals[2][u] = if valid { nz * scale } else { 0.0 };
        }
        normals
    }

    /// Rays and depths of `LANES` pixels of a row from column `first` on.
    #[inline(always)]
    fn points(&self, row: usize, first: usize) -> Points {
        Points {
            x: lane(self.ray_x[row], first),
            y: lane(self.ray_y[row], first),
            z: lane(self.depth[row], first),
        }
    }
}

/// Rays and depths of some pixels.
struct Points {
    x: Lane,
    y: Lane,
    z: Lane,
}
