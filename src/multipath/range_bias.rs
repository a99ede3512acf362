//! How far too long the ranges of a frame are, as a function of the white level.

use super::bounce::Bounce;
use super::strength;
use crate::geometry::{CellGrid, RayGrid};
use crate::interreflection::WhiteLevel;
use depth_camera::Image;

/// The bias of a frame's ranges on a grid of patches.
#[derive(Clone, Debug, PartialEq)]
pub struct RangeBias {
    cells: CellGrid,
    /// Row by row; patches without a measurement have that of their neighbours.
    bounces: Vec<Bounce>,
    /// Which cells were measured.
    is_measured: Vec<bool>,
}

/// No bias is taken to be larger than this, metres: in the contact of two surfaces patches are no points any more. What faces
/// a table away from the light has 30 mm.
const MAX_BIAS_M: f32 = 0.04;

impl Bounce {
    /// Mean range of direct and bounced light beyond the direct one, metres: `s b/(1 + s w)` with s = 1/(π white).
    pub(super) fn bias_m(&self, white: Option<WhiteLevel>) -> f32 {
        let strength = strength(white) as f32;
        (strength * self.range_m / (1.0 + strength * self.share)).min(MAX_BIAS_M)
    }

    /// Derivative of the bias by the strength, metres; 0 where it is as large as is believed.
    pub(super) fn bias_by_strength_m(&self, white: Option<WhiteLevel>) -> f64 {
        if self.bias_m(white) >= MAX_BIAS_M {
            return 0.0;
        }
        let lit = 1.0 + strength(white) * f64::from(self.share);
        f64::from(self.range_m) / (lit * lit)
    }
}

impl RangeBias {
    /// Takes what the patches of an image receive, row by row.
    pub(super) fn new(cells: CellGrid, bounces: &[Option<Bounce>]) -> Self {
        RangeBias {
            cells,
            bounces: cells.filled(bounces),
            is_measured: bounces.iter().map(Option::is_some).collect(),
        }
    }

    /// The cells whose patches they are.
    pub(super) fn cells(&self) -> &CellGrid {
        &self.cells
    }

    /// What the patch at an index receives; `None` where nothing was measured.
    pub(super) fn measured(&self, cell: usize) -> Option<&Bounce> {
        self.is_measured[cell].then(|| &self.bounces[cell])
    }

    /// The same on cells of which each holds several of these: the mean of what was measured in it.
    pub(super) fn coarsened(&self, cells: CellGrid) -> RangeBias {
        let mut sums = vec![(Bounce::default(), 0u32); cells.n_cells()];
        for (fine, bounce) in self.bounces.iter().enumerate() {
            if let Some(coarse) = cells.cell_of(self.cells.middle(fine))
                && self.is_measured[fine]
            {
                let (sum, n) = &mut sums[coarse];
                *sum = *sum + *bounce;
                *n += 1;
            }
        }
        let mean = |(sum, n): &(Bounce, u32)| (*n > 0).then(|| *sum * (1.0 / *n as f32));
        let means: Vec<Option<Bounce>> = sums.iter().map(mean).collect();
        RangeBias::new(cells, &means)
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
            .bounces
            .iter()
            .map(|bounce| bounce.bias_m(to) - bounce.bias_m(from))
            .collect();
        let change = self.cells.spread(&change);
        let pixels = depth_m
            .data()
            .iter()
            .zip(change.data())
            .zip(rays.rays().data());
        // Depth is range times the cosine of the ray.
        let shorter = pixels.map(|((&z, range_m), [x, y])| match z > 0.0 {
            true => (z - range_m / (1.0 + x * x + y * y).sqrt()).max(0.0),
            false => 0.0,
        });
        Image::from_vec(depth_m.width(), depth_m.height(), shorter.collect())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_bias_changes_with_strength_until_it_is_as_large_as_is_believed() {
        let bounce = Bounce {
            share: 0.2,
            range_m: 0.02,
        };
        let white = |strength: f64| WhiteLevel::of_strength(strength);
        let by_difference = |strength: f64| {
            let [less, more] = [0.99, 1.01].map(|share| bounce.bias_m(white(share * strength)));
            f64::from(more - less) / (0.02 * strength)
        };
        for strength in [0.5, 1.5] {
            let derivative = bounce.bias_by_strength_m(white(strength));
            assert!((derivative / by_difference(strength) - 1.0).abs() < 1e-3);
        }
        assert_eq!(bounce.bias_m(white(10.0)), MAX_BIAS_M);
        assert_eq!(bounce.bias_by_strength_m(white(10.0)), 0.0);
    }
}
