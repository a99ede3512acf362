//! Normals of a level by central differences.

use super::noise::DepthNoise;
use super::preprocess::{SAME_SURFACE_SIGMAS, rows_round};
use super::pyramid::Level;
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
    fn with_simd<S: Simd>(self, _: S) {
        let n = self.depth[1].len() - 2;
        // Points of the neighbours in both directions, and of the pixel itself.
        let [up, centre, down] = [0, 1, 2].map(|v| Points::of(&self, v, 1, n));
        let [left, right] = [0, 2].map(|u| Points::of(&self, 1, u, n));
        let [out_x, out_y, out_z] = self.out.map(|plane| &mut plane[1..n + 1]);
        for u in 0..n {
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
            let same = |other: f32| (other > 0.0) & ((other - z).abs() < reach);
            let (nx, ny, nz) = (vy * hz - vz * hy, vz * hx - vx * hz, vx * hy - vy * hx);
            let length = (nx * nx + ny * ny + nz * nz).sqrt();
            let facing = nx * centre.x[u] + ny * centre.y[u] + nz;
            let valid = (z > 0.0)
                & same(z_up)
                & same(z_left)
                & same(z_right)
                & same(z_down)
                & (length > 1e-12)
                & (facing < 0.0)
                & (nz < 0.0);
            let scale = 1.0 / length;
            out_x[u] = if valid { nx * scale } else { 0.0 };
            out_y[u] = if valid { ny * scale } else { 0.0 };
            out_z[u] = if valid { nz * scale } else { 0.0 };
        }
    }
}

/// Rays and depths of `n` pixels of a row.
struct Points<'a> {
    x: &'a [f32],
    y: &'a [f32],
    z: &'a [f32],
}

impl<'a> Points<'a> {
    #[inline(always)]
    fn of(rows: &NormalsRow<'a>, v: usize, first: usize, n: usize) -> Self {
        Points {
            x: &rows.ray_x[v][first..first + n],
            y: &rows.ray_y[v][first..first + n],
            z: &rows.depth[v][first..first + n],
        }
    }
}
