//! How far too long the ranges of a frame are, as a function of the white level.

use super::bounce::Bounce;
use super::{WhiteLevel, strength};
use crate::geometry::RayGrid;
use depth_camera::Image;
use rayon::prelude::*;

/// The bias of a frame's ranges on a grid of patches.
#[derive(Clone, Debug, PartialEq)]
pub struct RangeBias {
    columns: usize,
    cell_px: usize,
    /// Row by row; patches without a measurement have that of their neighbours.
    cells: Vec<Bounce>,
    /// Which cells were measured.
    is_measured: Vec<bool>,
}

/// No bias is taken to be larger than this, metres: in the contact of two surfaces patches are no points any more.
const MAX_BIAS_M: f32 = 0.015;

impl Bounce {
    /// Mean range of direct and bounced light beyond the direct one, metres: `s b/(1 + s w)` with s = 1/(π white).
    pub(super) fn bias_m(&self, white: Option<WhiteLevel>) -> f32 {
        let strength = strength(white) as f32;
        (strength * self.range_m / (1.0 + strength * self.share)).min(MAX_BIAS_M)
    }

    /// Derivative of the bias by the strength, metres.
    pub(super) fn bias_by_strength_m(&self, white: Option<WhiteLevel>) -> f64 {
        let lit = 1.0 + strength(white) * f64::from(self.share);
        f64::from(self.range_m) / (lit * lit)
    }
}

impl RangeBias {
    /// Takes what the patches of an image receive, row by row.
    pub(super) fn new(columns: usize, cell_px: usize, bounces: &[Option<Bounce>]) -> Self {
        RangeBias {
            columns,
            cell_px,
            cells: filled(columns, bounces),
            is_measured: bounces.iter().map(Option::is_some).collect(),
        }
    }

    /// Patches in a row.
    pub(super) fn columns(&self) -> usize {
        self.columns
    }

    /// Side of a patch, pixels.
    pub(super) fn cell_px(&self) -> usize {
        self.cell_px
    }

    /// What the patch at an index receives; `None` where nothing was measured.
    pub(super) fn measured(&self, cell: usize) -> Option<&Bounce> {
        self.is_measured[cell].then(|| &self.cells[cell])
    }

    /// How many patches there are.
    pub(super) fn n_cells(&self) -> usize {
        self.cells.len()
    }

    /// A depth image whose bias is changed from that of one white level to that of another, bilinear between the patches.
    pub(super) fn corrected(
        &self,
        depth_m: &Image<f32>,
        rays: &RayGrid,
        from: Option<WhiteLevel>,
        to: Option<WhiteLevel>,
    ) -> Image<f32> {
        let change: Vec<f32> = self
            .cells
            .iter()
            .map(|cell| cell.bias_m(to) - cell.bias_m(from))
            .collect();
        let width = depth_m.width();
        let mut out = vec![0.0f32; depth_m.data().len()];
        out.par_chunks_mut(width).enumerate().for_each(|(v, out)| {
            let (above, below, down) = self.between(v, self.cells.len() / self.columns);
            let [above, below] =
                [above, below].map(|row| &change[row * self.columns..][..self.columns]);
            let row: Vec<f32> = above
                .iter()
                .zip(below)
                .map(|(a, b)| a + (b - a) * down)
                .collect();
            for (u, ((out, &z), [x, y])) in out
                .iter_mut()
                .zip(depth_m.row(v))
                .zip(rays.rays().row(v))
                .enumerate()
            {
                let (left, right, along) = self.between(u, self.columns);
                let range_m = row[left] + (row[right] - row[left]) * along;
                // Depth is range times the cosine of the ray.
                let shorter = z - range_m / (1.0 + x * x + y * y).sqrt();
                *out = if z > 0.0 && shorter > 0.0 {
                    shorter
                } else {
                    0.0
                };
            }
        });
        Image::from_vec(width, depth_m.height(), out)
    }

    /// The patches before and after a pixel along one side of the image, and how far it lies between their middles.
    fn between(&self, pixel: usize, n: usize) -> (usize, usize, f32) {
        let place = (pixel as f32 + 0.5) / self.cell_px as f32 - 0.5;
        let place = place.clamp(0.0, (n - 1) as f32);
        let first = place as usize;
        (first, (first + 1).min(n - 1), place - first as f32)
    }
}

/// Gives patches without a value the mean of their neighbours, from the known ones outwards.
fn filled(columns: usize, bounces: &[Option<Bounce>]) -> Vec<Bounce> {
    let mut cells = bounces.to_vec();
    while cells.iter().any(Option::is_none) {
        let known = cells.clone();
        let mut is_done = true;
        for (index, cell) in cells.iter_mut().enumerate() {
            if cell.is_none() {
                *cell = mean(neighbours(columns, index).filter_map(|k| *known.get(k)?));
                is_done &= cell.is_none();
            }
        }
        if is_done {
            break;
        }
    }
    cells.into_iter().map(Option::unwrap_or_default).collect()
}

/// Indices of the four neighbours, some of which may lie below the last row.
fn neighbours(columns: usize, index: usize) -> impl Iterator<Item = usize> {
    let column = index % columns;
    let beside = [
        (column > 0).then(|| index - 1),
        (column + 1 < columns).then_some(index + 1),
        index.checked_sub(columns),
        Some(index + columns),
    ];
    beside.into_iter().flatten()
}

fn mean(bounces: impl Iterator<Item = Bounce>) -> Option<Bounce> {
    let (mut sum, mut n) = (Bounce::default(), 0);
    for bounce in bounces {
        sum.share += bounce.share;
        sum.range_m += bounce.range_m;
        n += 1;
    }
    (n > 0).then(|| Bounce {
        share: sum.share / n as f32,
        range_m: sum.range_m / n as f32,
    })
}
