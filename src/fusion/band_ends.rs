//! Where the truncation band of a frame begins and ends, by tiles of the image: what lies before or behind it is told without
//! a look at the pixels.

use super::observe::{DepthStep, Observation, slope_of};
use super::view::Extent;
use pulp::{Arch, Simd, WithSimd};

/// Pixels along a tile's side.
pub const TILE: usize = 4;
/// Columns that go through the kernel together.
const COLUMNS: usize = 16 * TILE;

/// Least and largest depth (m) of the band in a tile; `NOTHING` in a tile without depth.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Ends {
    near_m: f32,
    far_m: f32,
}

const NOTHING: Ends = Ends {
    near_m: f32::MAX,
    far_m: f32::MIN,
};

/// Where a brick lies with respect to the band.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum BandSight {
    /// In free space as a whole.
    Free,
    /// In the band, or partly so.
    InBand,
    /// Behind the surface or where nothing was measured.
    Hidden,
}

/// The ends of the band in all tiles of an image.
#[derive(Clone, Debug)]
pub struct BandEnds {
    n_columns: usize,
    tiles: Vec<Ends>,
}

impl BandEnds {
    /// Of an image without depth.
    pub fn new(width: usize, height: usize) -> Self {
        let n_columns = width.div_ceil(TILE);
        BandEnds {
            n_columns,
            tiles: vec![NOTHING; n_columns * height.div_ceil(TILE)],
        }
    }

    /// The tiles, a chunk for each row of them.
    pub fn rows_mut(&mut self) -> impl rayon::iter::IndexedParallelIterator<Item = &mut [Ends]> {
        use rayon::slice::ParallelSliceMut;
        self.tiles.par_chunks_mut(self.n_columns)
    }

    /// Whether what lies in a part of the image is seen to be before the band: nothing was measured as near, and something in most tiles.
    pub fn is_before(&self, extent: &Extent) -> bool {
        let (mut n_tiles, mut n_measured, mut ends) = (0, 0, NOTHING);
        for tile in self.tiles_of(extent).flatten() {
            n_tiles += 1;
            n_measured += usize::from(*tile != NOTHING);
            ends = ends.joined(tile);
        }
        extent.far_m < ends.near_m && 2 * n_measured > n_tiles
    }

    /// The tiles that a part of the image reaches, row by row.
    #[inline(always)]
    fn tiles_of(&self, extent: &Extent) -> impl Iterator<Item = &[Ends]> {
        let columns = extent.columns.start() / TILE..extent.columns.end() / TILE + 1;
        let rows = extent.rows.start() / TILE..=extent.rows.end() / TILE;
        rows.map(move |row| &self.tiles[row * self.n_columns..][columns.clone()])
    }

    /// Where a brick lies.
    #[inline(always)]
    pub fn sight(&self, extent: &Extent) -> BandSight {
        let ends = self.tiles_of(extent).fold(NOTHING, |ends, tiles| {
            tiles.iter().fold(ends, |ends, tile| ends.joined(tile))
        });
        if extent.near_m > ends.far_m {
            BandSight::Hidden
        } else if extent.far_m < ends.near_m {
            BandSight::Free
        } else {
            BandSight::InBand
        }
    }
}

impl Ends {
    #[inline(always)]
    fn joined(self, other: &Ends) -> Ends {
        Ends {
            near_m: least(self.near_m, other.near_m),
            far_m: -least(-self.far_m, -other.far_m),
        }
    }
}

#[inline(always)]
fn least(a: f32, b: f32) -> f32 {
    if a < b { a } else { b }
}

/// Finds the ends in a row of tiles from the pixels below it, row by row.
pub fn find(
    arch: Arch,
    tiles: &mut [Ends],
    pixels: &[Observation],
    width: usize,
    step: DepthStep,
    truncation_m: f32,
) {
    arch.dispatch(TileRow {
        tiles,
        pixels,
        width,
        step,
        truncation_m,
    });
}

struct TileRow<'a> {
    tiles: &'a mut [Ends],
    pixels: &'a [Observation],
    width: usize,
    step: DepthStep,
    truncation_m: f32,
}

impl WithSimd for TileRow<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, _: S) {
        // Rounding in the depth of voxels must not take one out of the band.
        let reach_m = 1.001 * self.truncation_m;
        let out = self.tiles.chunks_mut(COLUMNS / TILE);
        for (out, first) in out.zip((0..self.width).step_by(COLUMNS)) {
            let (mut near, mut far) = ([f32::MAX; COLUMNS], [f32::MAX; COLUMNS]);
            let n = COLUMNS.min(self.width - first);
            for row in self.pixels.chunks_exact(self.width) {
                let row = row[first..first + n].iter();
                for ((&pixel, near), far) in row.zip(&mut near).zip(&mut far) {
                    let depth = self.step.depth_of(pixel);
                    let reach = reach_m / slope_of(pixel);
                    let is_measured = depth > 0.0;
                    *near = least(*near, if is_measured { depth - reach } else { f32::MAX });
                    *far = least(
                        *far,
                        if is_measured {
                            -depth - reach
                        } else {
                            f32::MAX
                        },
                    );
                }
            }
            let columns = near
                .as_chunks::<TILE>()
                .0
                .iter()
                .zip(far.as_chunks::<TILE>().0);
            for (out, (near, far)) in out.iter_mut().zip(columns) {
                *out = Ends {
                    near_m: near.iter().fold(f32::MAX, |a, &b| least(a, b)),
                    far_m: -far.iter().fold(f32::MAX, |a, &b| least(a, b)),
                };
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::fusion::observe::{Observations, observation};

    #[test]
    fn bricks_before_in_and_behind_the_band_are_told_apart() {
        const WIDTH: usize = 100;
        let step = DepthStep::up_to(1.0);
        // Depth in the left half only, on a surface whose band reaches 0.04 m along the axis.
        let depth = |pixel: usize| if pixel % WIDTH < 50 { 0.5 } else { 0.0 };
        let pixels = (0..10 * WIDTH).map(|pixel| observation(step, depth(pixel), 0.5, 0.5));
        let pixels: Vec<Observation> = pixels.collect();
        for arch in crate::geometry::lanes::arch_levels() {
            let observations = Observations::of_pixels(arch, &pixels, WIDTH, step, 0.02);
            let extent = |first_column: usize, near_m: f32| Extent {
                columns: first_column..=first_column + 9,
                rows: 3..=9,
                near_m,
                far_m: near_m + 0.01,
            };
            let ends = observations.band_ends();
            let sight = |first_column, near_m| ends.sight(&extent(first_column, near_m));
            let is_before = |first_column, near_m| ends.is_before(&extent(first_column, near_m));
            assert!(is_before(20, 0.445) && !is_before(20, 0.455));
            // Where half of it is not measured it may be anything.
            assert!(is_before(42, 0.445) && !is_before(47, 0.445) && !is_before(60, 0.445));
            assert_eq!(sight(20, 0.445), BandSight::Free);
            assert_eq!(sight(20, 0.455), BandSight::InBand);
            assert_eq!(sight(45, 0.535), BandSight::InBand);
            assert_eq!(sight(20, 0.545), BandSight::Hidden);
            assert_eq!(sight(60, 0.5), BandSight::Hidden);
        }
    }
}
