//! A sparse truncated signed distance volume of 8³-voxel blocks.
//!
//! Voxel (i, j, k) sits at (i, j, k)·voxel size in the world frame. Blocks are found through a two-level table: one load for
//! the page, one for the block.

use super::block::{BLOCK_SIDE, Block, BlockCoord};
use crate::geometry::lanes::floor;

/// Blocks along a page's side.
const PAGE_SIDE: i32 = 16;
/// Blocks of a page.
const PAGE_CELLS: usize = (PAGE_SIDE * PAGE_SIDE * PAGE_SIDE) as usize;
type Page = [u32; PAGE_CELLS];
/// Pages along the volume's side.
const TOP_SIDE: i32 = 64;
/// Blocks from the origin to the volume's border on each axis.
const HALF_SIDE: i32 = PAGE_SIDE * TOP_SIDE / 2;
/// Voxels from the origin to there.
pub const HALF_SIDE_VOXELS: i32 = HALF_SIDE * BLOCK_SIDE;

/// The volume.
#[derive(Clone)]
pub struct TsdfVolume {
    voxel_size_m: f32,
    truncation_m: f32,
    /// Voxels and blocks a metre.
    inv_voxel: f32,
    inv_block: f32,
    /// Page of each top cell, `NO_ENTRY` where there is none.
    top: Vec<u32>,
    /// Block of each cell of each page.
    pages: Vec<Page>,
    coords: Vec<BlockCoord>,
    blocks: Vec<Block>,
    budget_bytes: usize,
}

/// Why a block is not allocated.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Refusal {
    /// It lies beyond the volume's border.
    Outside,
    /// It would take more memory than the volume may have, or than the system gives.
    OverBudget,
}

/// Room for so many blocks and pages is made at once, or for half as many as there are.
const MIN_GROWTH_BLOCKS: usize = 1024;
const MIN_GROWTH_PAGES: usize = 8;

const NO_ENTRY: u32 = u32::MAX;

impl TsdfVolume {
    /// An empty volume that will hold `budget_bytes` at most, beyond the table of pages that it always has.
    pub fn new(voxel_size_m: f32, truncation_m: f32, budget_bytes: usize) -> Self {
        TsdfVolume {
            voxel_size_m,
            truncation_m,
            inv_voxel: 1.0 / voxel_size_m,
            inv_block: 1.0 / (voxel_size_m * BLOCK_SIDE as f32),
            top: vec![NO_ENTRY; (TOP_SIDE * TOP_SIDE * TOP_SIDE) as usize],
            pages: Vec::new(),
            coords: Vec::new(),
            blocks: Vec::new(),
            budget_bytes,
        }
    }

    /// Distance between voxels, metres.
    pub fn voxel_size_m(&self) -> f32 {
        self.voxel_size_m
    }

    /// Distance at which the signed distance is cut off, metres.
    pub fn truncation_m(&self) -> f32 {
        self.truncation_m
    }

    /// Voxels a metre.
    #[inline(always)]
    pub fn inv_voxel(&self) -> f32 {
        self.inv_voxel
    }

    /// Coordinates of all blocks, in the order in which they were allocated.
    pub fn coords(&self) -> &[BlockCoord] {
        &self.coords
    }

    /// All blocks, in the same order.
    pub fn blocks(&self) -> &[Block] {
        &self.blocks
    }

    /// Coordinates and blocks for writing, in the same order.
    pub fn blocks_mut(&mut self) -> (&[BlockCoord], &mut [Block]) {
        (&self.coords, &mut self.blocks)
    }

    /// Bytes held by blocks and tables.
    pub fn memory_bytes(&self) -> usize {
        self.blocks.capacity() * size_of::<Block>()
            + self.coords.capacity() * size_of::<BlockCoord>()
            + self.pages.capacity() * size_of::<Page>()
            + self.top.len() * size_of::<u32>()
    }

    /// Coordinate of the block in which a coordinate (m) lies.
    #[inline(always)]
    pub fn block_coord(&self, x: f32) -> i32 {
        floor(x * self.inv_block)
    }

    /// Whether block coordinates lie within the volume.
    pub fn in_bounds(coord: BlockCoord) -> bool {
        coord.iter().all(|c| (-HALF_SIDE..HALF_SIDE).contains(c))
    }

    /// Index of a block, if it is allocated.
    #[inline]
    pub fn find(&self, coord: BlockCoord) -> Option<usize> {
        if !Self::in_bounds(coord) {
            return None;
        }
        let (cell, entry) = table_cells(coord);
        let page = self.top[cell];
        if page == NO_ENTRY {
            return None;
        }
        let block = self.pages[page as usize][entry];
        (block != NO_ENTRY).then_some(block as usize)
    }

    /// Index of a block, allocating it where it is new.
    ///
    /// # Errors
    /// Where the block is new and there is no place for it.
    #[inline]
    pub fn allocate(&mut self, coord: BlockCoord) -> Result<usize, Refusal> {
        match self.find(coord) {
            Some(block) => Ok(block),
            None => self.allocate_new(coord),
        }
    }

    #[cold]
    fn allocate_new(&mut self, coord: BlockCoord) -> Result<usize, Refusal> {
        if !Self::in_bounds(coord) {
            return Err(Refusal::Outside);
        }
        let (cell, entry) = table_cells(coord);
        self.make_room(self.top[cell] == NO_ENTRY)?;
        if self.top[cell] == NO_ENTRY {
            self.top[cell] = self.pages.len() as u32;
            self.pages.push([NO_ENTRY; PAGE_CELLS]);
        }
        let block = self.blocks.len();
        self.pages[self.top[cell] as usize][entry] = block as u32;
        self.blocks.push(Block::EMPTY);
        self.coords.push(coord);
        Ok(block)
    }

    /// Makes room for one more block, and for a page if need be.
    fn make_room(&mut self, needs_page: bool) -> Result<(), Refusal> {
        const PER_BLOCK: usize = size_of::<Block>() + size_of::<BlockCoord>();
        let refused = |_| Refusal::OverBudget;
        let blocks_held = self.blocks.capacity() * PER_BLOCK;
        let held = blocks_held + self.pages.capacity() * size_of::<Page>();
        let mut free = self.budget_bytes.saturating_sub(held);
        if needs_page && self.pages.len() == self.pages.capacity() {
            let growth = growth(self.pages.len(), MIN_GROWTH_PAGES, free / size_of::<Page>())?;
            self.pages.try_reserve_exact(growth).map_err(refused)?;
            free -= growth * size_of::<Page>();
        }
        if self.blocks.len() == self.blocks.capacity() {
            let growth = growth(self.blocks.len(), MIN_GROWTH_BLOCKS, free / PER_BLOCK)?;
            self.blocks.try_reserve_exact(growth).map_err(refused)?;
            self.coords.try_reserve_exact(growth).map_err(refused)?;
        }
        Ok(())
    }
}

/// By how many places to grow a list of `len`, of which no more than `most` may be had.
fn growth(len: usize, least: usize, most: usize) -> Result<usize, Refusal> {
    match (len / 2).max(least).min(most) {
        0 => Err(Refusal::OverBudget),
        growth => Ok(growth),
    }
}

/// Cell in the top table and entry in its page.
#[inline]
fn table_cells(coord: BlockCoord) -> (usize, usize) {
    let [x, y, z] = coord.map(|c| c + HALF_SIDE);
    let flat = |x: i32, y: i32, z: i32, side: i32| (x + side * (y + side * z)) as usize;
    (
        flat(x >> 4, y >> 4, z >> 4, TOP_SIDE),
        flat(x & 15, y & 15, z & 15, PAGE_SIDE),
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn blocks_are_found_where_they_were_put_and_nowhere_else() {
        let mut volume = TsdfVolume::new(0.002, 0.01, usize::MAX);
        let coords = [[0, 0, 0], [-1, 5, 300], [511, -512, 17]];
        for (index, coord) in coords.iter().enumerate() {
            assert_eq!(volume.allocate(*coord), Ok(index));
            assert_eq!(volume.allocate(*coord), Ok(index));
        }
        assert_eq!(volume.find([-1, 5, 300]), Some(1));
        assert_eq!(volume.find([-1, 5, 299]), None);
        assert_eq!(volume.allocate([512, 0, 0]), Err(Refusal::Outside));
        let border = HALF_SIDE_VOXELS / BLOCK_SIDE;
        assert!(TsdfVolume::in_bounds([border - 1, 0, 0]));
        assert!(!TsdfVolume::in_bounds([border, 0, 0]));
    }

    #[test]
    fn a_full_volume_refuses_new_blocks_and_keeps_the_old_ones() {
        let budget_bytes = 5 << 20;
        let mut volume = TsdfVolume::new(0.002, 0.01, budget_bytes);
        let table_bytes = volume.memory_bytes();
        let refused = (0..4000)
            .filter(|&i| {
                volume.allocate([i % 16, i / 16 % 16, i / 256]) == Err(Refusal::OverBudget)
            })
            .count();
        assert_eq!(volume.coords().len() + refused, 4000);
        assert!(volume.memory_bytes() - table_bytes <= budget_bytes);
        // 2 KiB a block, one page: nine tenths of the budget hold blocks.
        assert!(volume.coords().len() > 2200, "{}", volume.coords().len());
        assert_eq!(volume.allocate([3, 0, 0]), Ok(3));
    }
}
