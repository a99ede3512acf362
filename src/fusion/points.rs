//! The points of a reduced level and the sums over their residuals, whatever they are aligned to.

use super::normal_equations::{NormalEquations, Rows, TileSums};
use super::pyramid::{Level, lane};
use crate::geometry::lanes::{LANES, Lane};
use pulp::{Arch, Simd, WithSimd};

/// What points are aligned to.
pub trait Residuals: Sync {
    /// Sets the rows of these points; a weight of 0 where a point has no residual.
    fn residuals(&self, points: &Points, rows: &mut Rows);
}

/// The normal equations of all points of a level.
pub fn equations(arch: Arch, level: &Level, target: &impl Residuals) -> NormalEquations {
    NormalEquations::of_tiles(level.n_tiles(), |tile| {
        arch.dispatch(SumTile {
            level,
            tile,
            target,
        })
    })
}

struct SumTile<'a, T> {
    level: &'a Level,
    tile: usize,
    target: &'a T,
}

impl<T: Residuals> WithSimd for SumTile<'_, T> {
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
            self.target.residuals(&points, &mut rows);
            sums.add(&rows);
        }
        sums
    }
}

/// Points of a level, camera frame.
pub struct Points {
    /// Places, metres.
    pub point: [Lane; 3],
    /// Normals; zero where there is none.
    pub normal: [Lane; 3],
    /// How many have a normal.
    pub n_valid: u32,
}

impl Points {
    /// The points of `LANES` pixels from `first` on; `None` if none of them has a normal.
    #[inline(always)]
    pub fn load(level: &Level, first: usize) -> Option<Points> {
        let load = |plane: &[f32]| lane(plane, first);
        let normal = [0, 1, 2].map(|axis| load(&level.normals[axis]));
        let n_valid = normal[2].iter().map(|&z| u32::from(z < 0.0)).sum();
        if n_valid == 0 {
            return None;
        }
        let (mut x, mut y, z) = (load(&level.rays.x), load(&level.rays.y), load(&level.depth));
        for i in 0..LANES {
            // Where the lens has no ray, nothing is measured: a weight of zero would not make a number of what is none.
            let is_there = z[i] > 0.0;
            x[i] = if is_there { x[i] * z[i] } else { 0.0 };
            y[i] = if is_there { y[i] * z[i] } else { 0.0 };
        }
        Some(Points {
            point: [x, y, z],
            normal,
            n_valid,
        })
    }
}
