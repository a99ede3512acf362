//! Weighted 6×6 normal equations, summed in single precision over a tile of pixels and in double precision over tiles.

use crate::geometry::lanes::{LANES, Lane};
use crate::geometry::{Pose, increment_about};
use nalgebra::{Matrix6, Vector3, Vector6};
use rayon::prelude::*;

/// Residuals with their derivatives by the left increment about the camera's centre; a weight of 0 is no residual.
#[derive(Clone, Debug)]
pub struct Rows {
    /// Places of the points from the camera's centre, world axes, metres.
    pub lever: [Lane; 3],
    /// Directions in which the residuals are measured, world frame.
    pub normal: [Lane; 3],
    /// Signed distances, metres.
    pub residual: Lane,
    /// Inverse variances, m⁻².
    pub weight: Lane,
}

impl Rows {
    /// No residuals.
    pub const EMPTY: Rows = Rows {
        lever: [[0.0; LANES]; 3],
        normal: [[0.0; LANES]; 3],
        residual: [0.0; LANES],
        weight: [0.0; LANES],
    };

    /// Sets one residual.
    pub fn set(
        &mut self,
        lane: usize,
        lever: &Vector3<f32>,
        normal: &Vector3<f32>,
        residual: f32,
        weight: f32,
    ) {
        for axis in 0..3 {
            self.lever[axis][lane] = lever[axis];
            self.normal[axis][lane] = normal[axis];
        }
        self.residual[lane] = residual;
        self.weight[lane] = weight;
    }
}

/// Upper triangle of JᵀWJ, then JᵀWr, the sum of weights and that of weighted squares.
const N_SUMS: usize = 21 + 6 + 2;

/// Sums over the residuals of one tile.
#[derive(Clone, Debug)]
pub struct TileSums {
    sums: [Lane; N_SUMS],
    n_inliers: [u32; LANES],
    /// Points that were looked at.
    pub n_points: u32,
}

impl TileSums {
    /// Sums of nothing.
    pub const ZERO: TileSums = TileSums {
        sums: [[0.0; LANES]; N_SUMS],
        n_inliers: [0; LANES],
        n_points: 0,
    };

    /// Adds residuals.
    #[inline(always)]
    pub fn add(&mut self, rows: &Rows) {
        let [lx, ly, lz] = &rows.lever;
        let [nx, ny, nz] = &rows.normal;
        let mut jacobian = [[0.0; LANES]; 6];
        for i in 0..LANES {
            jacobian[0][i] = ly[i] * nz[i] - lz[i] * ny[i];
            jacobian[1][i] = lz[i] * nx[i] - lx[i] * nz[i];
            jacobian[2][i] = lx[i] * ny[i] - ly[i] * nx[i];
        }
        jacobian[3..].copy_from_slice(&rows.normal);
        let mut sum = 0;
        for row in 0..6 {
            let mut weighted = [0.0; LANES];
            for i in 0..LANES {
                weighted[i] = rows.weight[i] * jacobian[row][i];
            }
            for column in &jacobian[row..] {
                add_product(&mut self.sums[sum], &weighted, column);
                sum += 1;
            }
            add_product(&mut self.sums[21 + row], &weighted, &rows.residual);
        }
        for i in 0..LANES {
            let weighted = rows.weight[i] * rows.residual[i];
            self.sums[27][i] += rows.weight[i];
            self.sums[28][i] += weighted * rows.residual[i];
            self.n_inliers[i] += u32::from(rows.weight[i] > 0.0);
        }
    }
}

#[inline(always)]
fn add_product(sum: &mut Lane, a: &Lane, b: &Lane) {
    for i in 0..LANES {
        sum[i] += a[i] * b[i];
    }
}

/// So many tiles are summed at the same time: those of a level of a Kinect's images.
const AT_ONCE: usize = 16;

/// Normal equations of one iteration.
#[derive(Clone, Debug)]
pub struct NormalEquations {
    jtj: Matrix6<f64>,
    jtr: Vector6<f64>,
    weight: f64,
    weighted_square: f64,
    /// Points that were looked at.
    pub n_points: usize,
    /// Points that gave a residual.
    pub n_inliers: usize,
}

impl NormalEquations {
    /// JᵀWJ by left increments about the camera's centre, rotation (rad), then translation (m).
    pub fn jtj(&self) -> &Matrix6<f64> {
        &self.jtj
    }

    /// JᵀWr.
    pub fn jtr(&self) -> &Vector6<f64> {
        &self.jtr
    }

    /// Sum of all weights.
    pub fn weight(&self) -> f64 {
        self.weight
    }

    /// These residuals and others together.
    pub fn and(&self, other: &Self) -> Self {
        NormalEquations {
            jtj: self.jtj + other.jtj,
            jtr: self.jtr + other.jtr,
            weight: self.weight + other.weight,
            weighted_square: self.weighted_square + other.weighted_square,
            n_points: self.n_points + other.n_points,
            n_inliers: self.n_inliers + other.n_inliers,
        }
    }

    /// Sums the tiles `0..n_tiles` in order, whatever thread they are summed on, and asks for no memory.
    pub fn of_tiles(n_tiles: usize, sum_tile: impl Fn(usize) -> TileSums + Send + Sync) -> Self {
        let mut at_once = [TileSums::ZERO; AT_ONCE];
        let (mut sums, mut n_points, mut n_inliers) = ([0.0; N_SUMS], 0, 0);
        for first in (0..n_tiles).step_by(AT_ONCE) {
            let tiles = &mut at_once[..AT_ONCE.min(n_tiles - first)];
            let indexed = tiles.par_iter_mut().with_max_len(1).enumerate();
            indexed.for_each(|(tile, summed)| *summed = sum_tile(first + tile));
            for tile in tiles {
                for (sum, lanes) in sums.iter_mut().zip(&tile.sums) {
                    *sum += lanes.iter().map(|&x| f64::from(x)).sum::<f64>();
                }
                n_points += tile.n_points as usize;
                n_inliers += tile.n_inliers.iter().sum::<u32>() as usize;
            }
        }
        let mut jtj = Matrix6::zeros();
        let mut entries = sums.iter();
        for row in 0..6 {
            for (column, &entry) in (row..6).zip(&mut entries) {
                jtj[(row, column)] = entry;
                jtj[(column, row)] = entry;
            }
        }
        NormalEquations {
            jtj,
            jtr: Vector6::from_column_slice(&sums[21..27]),
            weight: sums[27],
            weighted_square: sums[28],
            n_points,
            n_inliers,
        }
    }

    /// The left increment about `centre` that lowers the residuals, with a prior that holds what the data do not see.
    pub fn solve(&self, centre: &Vector3<f64>) -> Option<Pose> {
        // A thousandth of a point's worth of prior: 1 rad and 1 m are far beyond any frame's motion.
        let prior = 1e-3 * self.weight / self.n_inliers.max(1) as f64;
        let jtj = self.jtj + Matrix6::identity() * prior;
        let step = -jtj.cholesky()?.solve(&self.jtr);
        Some(increment_about(centre, &step))
    }

    /// Smallest over largest eigenvalue, levers scaled by `scale_m` so that angles and lengths compare.
    pub fn conditioning(&self, scale_m: f64) -> f64 {
        let s = 1.0 / scale_m;
        let scale = Matrix6::from_diagonal(&Vector6::new(s, s, s, 1.0, 1.0, 1.0));
        let eigenvalues = (scale * self.jtj * scale).symmetric_eigenvalues();
        eigenvalues.min().max(0.0) / eigenvalues.max().max(f64::MIN_POSITIVE)
    }

    /// Mean square of the residuals by a left increment: m² per (rad, m)².
    pub fn mean_curvature(&self) -> Matrix6<f64> {
        self.jtj / self.weight.max(f64::MIN_POSITIVE)
    }

    /// Share of the points that gave a residual.
    pub fn inlier_share(&self) -> f64 {
        self.n_inliers as f64 / self.n_points.max(1) as f64
    }

    /// Weighted root mean square of the residuals, metres.
    pub fn rmse_m(&self) -> f64 {
        (self.weighted_square / self.weight.max(f64::MIN_POSITIVE)).sqrt()
    }
}

/// Huber weight over the variance: residuals beyond two sigmas pull with constant force.
#[inline(always)]
pub fn huber_weight(residual: f32, sigma: f32) -> f32 {
    const HUBER_SIGMAS: f32 = 2.0;
    let (size, reach) = (residual.abs(), HUBER_SIGMAS * sigma);
    let share = if size <= reach { 1.0 } else { reach / size };
    share / (sigma * sigma)
}
