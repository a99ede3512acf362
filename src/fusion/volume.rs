//! A sparse truncated signed distance volume of 8³-voxel blocks.
//!
//! Voxel (i, j, k) sits at (i, j, k)·voxel size in the world frame. Each block keeps its distances and its weights in planes
//! of their own. Blocks are found through a two-level table: one load for the page, one for the block.

use nalgebra::Vector3;

/// Voxels along a block's side.
pub const BLOCK_SIDE: i32 = 8;
/// Voxels of a block.
pub const BLOCK_VOXELS: usize = 512;
/// Blocks along a page's side.
const PAGE_SIDE: i32 = 16;
/// Blocks of a page.
const PAGE_CELLS: usize = (PAGE_SIDE * PAGE_SIDE * PAGE_SIDE) as usize;
type Page = [u32; PAGE_CELLS];
/// Pages along the volume's side.
const TOP_SIDE: i32 = 64;
/// Blocks from the origin to the volume's border on each axis.
const HALF_SIDE: i32 = PAGE_SIDE * TOP_SIDE / 2;
/// Distances are kept in steps of the truncation distance divided by this.
pub const TSDF_ONE: f32 = 32_767.0;
/// The distance of a voxel that was never seen: one step beyond the least distance.
pub const UNSEEN: i16 = i16::MIN;
/// Weights are kept in steps of one 256th.
pub const WEIGHT_ONE: f32 = 256.0;

/// Voxel values of one block; voxel (x, y, z) of the block has index x + 8 y + 64 z.
#[derive(Clone)]
pub struct Block {
    /// Signed distance in units of truncation / 32767, positive in front of the surface; [`UNSEEN`] where nothing was seen.
    pub tsdf: [i16; BLOCK_VOXELS],
    /// Weight in units of 1/256; 0 where nothing was seen.
    pub weight: [u16; BLOCK_VOXELS],
}

impl Block {
    const EMPTY: Block = Block {
        tsdf: [UNSEEN; BLOCK_VOXELS],
        weight: [0; BLOCK_VOXELS],
    };
}

/// Block coordinates: voxel index divided by 8, rounded down.
pub type BlockCoord = [i32; 3];

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

    /// The block that holds a point.
    pub fn block_of(&self, point: &Vector3<f32>) -> BlockCoord {
        [point.x, point.y, point.z].map(|x| floor(x * self.inv_block))
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

    /// Signed distance (m) and its gradient (m per m) by trilinear interpolation; `None` unless all eight voxels were seen.
    #[inline]
    pub fn sample_with_gradient(&self, point: &Vector3<f32>) -> Option<(f32, Vector3<f32>)> {
        let (voxel, fraction) = self.place([point.x, point.y, point.z]);
        let corners = self.corners(voxel)?;
        let (distance, gradient) = self.interpolate(&corners, fraction);
        Some((distance, Vector3::from(gradient)))
    }

    /// The voxel at the low corner of a point's cell, and the point's place in the cell.
    #[inline(always)]
    pub fn place(&self, point: [f32; 3]) -> ([i32; 3], [f32; 3]) {
        let grid = point.map(|x| x * self.inv_voxel);
        let voxel = grid.map(floor);
        let fraction = [0, 1, 2].map(|axis| grid[axis] - voxel[axis] as f32);
        (voxel, fraction)
    }

    /// Distance (m) and gradient (m per m) between the eight corners of a cell, x fastest, in raw steps.
    #[inline(always)]
    pub fn interpolate(&self, corners: &[f32; 8], [fx, fy, fz]: [f32; 3]) -> (f32, [f32; 3]) {
        let [c000, c100, c010, c110, c001, c101, c011, c111] = *corners;
        let lerp = |a: f32, b: f32, t: f32| a + (b - a) * t;
        let (x00, x10) = (lerp(c000, c100, fx), lerp(c010, c110, fx));
        let (x01, x11) = (lerp(c001, c101, fx), lerp(c011, c111, fx));
        let (y0, y1) = (lerp(x00, x10, fy), lerp(x01, x11, fy));
        let dx = lerp(
            lerp(c100 - c000, c110 - c010, fy),
            lerp(c101 - c001, c111 - c011, fy),
            fz,
        );
        let dy = lerp(x10 - x00, x11 - x01, fz);
        let scale = self.truncation_m / TSDF_ONE;
        let gradient = [dx, dy, y1 - y0].map(|d| d * (scale * self.inv_voxel));
        (lerp(y0, y1, fz) * scale, gradient)
    }

    /// The eight voxels from `voxel` on, x fastest, in raw steps; `None` unless all were seen.
    #[inline(always)]
    pub fn corners(&self, voxel: [i32; 3]) -> Option<[f32; 8]> {
        let local = voxel.map(|i| i & 7);
        if local.contains(&7) {
            return self.corners_of_several(voxel);
        }
        let tsdf = &self.blocks[self.find(voxel.map(|i| i >> 3))?].tsdf;
        // Without a carry past the last voxel the eight indices stay within the block.
        let first = voxel_index(local) % (BLOCK_VOXELS - 73);
        let at = |offset: usize| tsdf[first + offset];
        seen([at(0), at(1), at(8), at(9), at(64), at(65), at(72), at(73)])
    }
}

impl TsdfVolume {
    /// The eight voxels from `voxel` on where they lie in two, four or eight blocks; each block is looked up once.
    fn corners_of_several(&self, voxel: [i32; 3]) -> Option<[f32; 8]> {
        let [x, y, z] = voxel.map(|i| (i & 7) as usize);
        // Bit a is set where the neighbour along axis a lies in another block.
        let across = usize::from(x == 7) | usize::from(y == 7) << 1 | usize::from(z == 7) << 2;
        let (xs, ys, zs) = ([x, (x + 1) & 7], [y, (y + 1) & 7], [z, (z + 1) & 7]);
        let (mut blocks, mut corners) = ([0; 8], [0; 8]);
        for side in 0..8 {
            let step = [side & 1, side >> 1 & 1, side >> 2];
            blocks[side] = match side & across {
                known if known != side => blocks[known],
                _ => self.find([0, 1, 2].map(|axis| (voxel[axis] >> 3) + step[axis] as i32))?,
            };
            let index = xs[step[0]] + 8 * ys[step[1]] + 64 * zs[step[2]];
            corners[side] = self.blocks[blocks[side]].tsdf[index % BLOCK_VOXELS];
        }
        seen(corners)
    }
}

/// Distances in raw steps; `None` unless all voxels were seen.
#[inline(always)]
fn seen(corners: [i16; 8]) -> Option<[f32; 8]> {
    let (mut values, mut all_seen) = ([0.0; 8], true);
    for (value, tsdf) in values.iter_mut().zip(corners) {
        all_seen &= tsdf != UNSEEN;
        *value = f32::from(tsdf);
    }
    all_seen.then_some(values)
}

/// By how many places to grow a list of `len`, of which no more than `most` may be had.
fn growth(len: usize, least: usize, most: usize) -> Result<usize, Refusal> {
    match (len / 2).max(least).min(most) {
        0 => Err(Refusal::OverBudget),
        growth => Ok(growth),
    }
}

/// 1.5 · 2²³: adding it to a number within ±2²² leaves the number, rounded, in the low bits.
const ROUND: f32 = 12_582_912.0;

/// Largest integer not above x for x within ±2²²; for any other, one that lies beyond every volume. A cast would do the same
/// and saturate, which compilers turn into scalar code.
#[inline(always)]
fn floor(x: f32) -> i32 {
    let shifted = x + ROUND;
    let rounded = (shifted.to_bits() as i32).wrapping_sub(ROUND.to_bits() as i32);
    rounded - i32::from(shifted - ROUND > x)
}

/// Index of a voxel within its block.
#[inline]
pub fn voxel_index([x, y, z]: [i32; 3]) -> usize {
    (x + BLOCK_SIDE * (y + BLOCK_SIDE * z)) as usize
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
pub(super) mod tests {
    use super::*;

    /// A volume of 2 mm voxels within 48 mm of the origin, all seen often, that hold a closed-form distance (m).
    pub fn volume_of(truncation_m: f32, distance_m: impl Fn(f64, f64, f64) -> f64) -> TsdfVolume {
        let mut volume = TsdfVolume::new(0.002, truncation_m, usize::MAX);
        for bx in -3..3 {
            for by in -3..3 {
                for bz in -3..3 {
                    volume.allocate([bx, by, bz]).expect("within the volume");
                }
            }
        }
        let (coords, blocks) = volume.blocks_mut();
        for (coord, block) in coords.iter().zip(blocks) {
            for index in 0..BLOCK_VOXELS {
                let at = |axis: usize, local: usize| {
                    (coord[axis] * BLOCK_SIDE) as f64 * 0.002 + local as f64 * 0.002
                };
                let d = distance_m(at(0, index & 7), at(1, (index >> 3) & 7), at(2, index >> 6));
                let share = (d / truncation_m as f64).clamp(-1.0, 1.0);
                block.tsdf[index] = (share * TSDF_ONE as f64) as i16;
                block.weight[index] = 1000;
            }
        }
        volume
    }

    #[test]
    fn trilinear_distance_and_gradient_of_a_sphere() {
        let volume = volume_of(0.02, |x, y, z| (x * x + y * y + z * z).sqrt() - 0.03);
        for direction in [[1.0, 0.2, -0.4], [-0.3, 0.9, 0.1], [0.1, -0.5, -0.8]] {
            let direction = Vector3::from(direction)
                .try_normalize(0.0)
                .expect("not zero");
            let p = direction * 0.031f32;
            let (distance, gradient) = volume.sample_with_gradient(&p).expect("inside");
            // Second-order error of trilinear interpolation: h²/4R = 0.03 mm.
            assert!((distance - 0.001).abs() < 5e-5);
            assert!((gradient - direction).norm() < 0.05);
        }
    }

    #[test]
    fn floor_is_exact_where_there_are_voxels_and_out_of_bounds_elsewhere() {
        for step in -40_000..40_000 {
            let x = step as f32 * 0.137;
            assert_eq!(floor(x), x.floor() as i32, "{x}");
        }
        for x in [-1.0, -0.0, 0.0, 0.5, -0.5, 1e-9, -1e-9, 4_000_000.5] {
            assert_eq!(floor(x), x.floor() as i32, "{x}");
        }
        for x in [
            5e6,
            -5e6,
            -12_582_912.0,
            1e30,
            -1e30,
            f32::INFINITY,
            f32::NEG_INFINITY,
            f32::NAN,
        ] {
            assert!(floor(x).unsigned_abs() > 1 << 22, "{x}");
        }
    }

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
