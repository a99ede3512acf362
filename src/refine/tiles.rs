//! Tiles that sums and loops over sites run in: fixed ones, so that no number depends on threads.

use rayon::prelude::*;
use std::ops::Range;

/// Sites in a tile.
pub const TILE: usize = 2048;

/// The tiles of `n` sites.
pub fn tiles(n: usize) -> impl IndexedParallelIterator<Item = Range<usize>> {
    let all = (0..n.div_ceil(TILE)).into_par_iter().with_max_len(1);
    all.map(move |tile| tile * TILE..((tile + 1) * TILE).min(n))
}

/// The numbers of `n` sites, faces or vertices, of which threads that have nothing left to do take [`TILE`] from others.
pub fn in_tiles(n: usize) -> impl IndexedParallelIterator<Item = usize> + Clone {
    let all = (0..n).into_par_iter();
    all.with_min_len(TILE).with_max_len(TILE)
}
