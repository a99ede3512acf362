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
/// Pages along the volume's side.
const TOP_SIDE: i32 = 64;
/// Blocks from the origin to the volume's border on each axis.
const HALF_SIDE: i32 = PAGE_SIDE * TOP_SIDE / 2;
/// Distances are kept in steps of the truncation distance divided by this.
pub const TSDF_ONE: f32 = 32_767.0;
/// Weights are kept in steps of one 256th.
pub const WEIGHT_ONE: f32 = 256.0;

/// Voxel values of one block; voxel (x, y, z) of the block has index x + 8 y + 64 z.
#[derive(Clone)]
pub struct Block {
    /// Signed distance in units of truncation / 32767, positive in front of the surface.
    pub tsdf: [i16; BLOCK_VOXELS],
    /// Weight in units of 1/256; 0 where nothing was seen.
    pub weight: [u16; BLOCK_VOXELS],
}

impl Block {
    const EMPTY: Block = Block {
        tsdf: [i16::MAX; BLOCK_VOXELS],
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
    /// Page of each top cell, `NO_ENTRY` where there is none.
    top: Vec<u32>,
    /// Block of each cell of each page.
    pages: Vec<[u32; (PAGE_SIDE * PAGE_SIDE * PAGE_SIDE) as usize]>,
    coords: Vec<BlockCoord>,
    blocks: Vec<Block>,
}

const NO_ENTRY: u32 = u32::MAX;

impl TsdfVolume {
    /// An empty volume.
    pub fn new(voxel_size_m: f32, truncation_m: f32) -> Self {
        TsdfVolume {
            voxel_size_m,
            truncation_m,
            top: vec![NO_ENTRY; (TOP_SIDE * TOP_SIDE * TOP_SIDE) as usize],
            pages: Vec::new(),
            coords: Vec::new(),
            blocks: Vec::new(),
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
            + self.pages.capacity() * size_of_val(&[0u32; 4096])
            + self.top.len() * size_of::<u32>()
    }

    /// The block that holds a point.
    pub fn block_of(&self, point: &Vector3<f32>) -> BlockCoord {
        let inv_block = 1.0 / (self.voxel_size_m * BLOCK_SIDE as f32);
        [point.x, point.y, point.z].map(|x| floor(x * inv_block))
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

    /// Index of a block, allocating it where it is new. `None` outside the volume.
    pub fn allocate(&mut self, coord: BlockCoord) -> Option<usize> {
        if !Self::in_bounds(coord) {
            return None;
        }
        let (cell, entry) = table_cells(coord);
        if self.top[cell] == NO_ENTRY {
            self.top[cell] = self.pages.len() as u32;
            self.pages.push([NO_ENTRY; 4096]);
        }
        let slot = &mut self.pages[self.top[cell] as usize][entry];
        if *slot == NO_ENTRY {
            *slot = self.blocks.len() as u32;
            self.blocks.push(Block::EMPTY);
            self.coords.push(coord);
        }
        Some(*slot as usize)
    }

    /// Distance (m) and weight of one voxel; `None` where nothing was seen.
    #[inline]
    pub fn voxel(&self, voxel: [i32; 3]) -> Option<(f32, f32)> {
        let block = &self.blocks[self.find(voxel.map(|i| i >> 3))?];
        let index = voxel_index(voxel.map(|i| i & 7));
        let weight = block.weight[index];
        (weight > 0).then(|| {
            (
                block.tsdf[index] as f32 * (self.truncation_m / TSDF_ONE),
                weight as f32 / WEIGHT_ONE,
            )
        })
    }

    /// Signed distance (m) and its gradient (m per m) by trilinear interpolation; `None` unless all eight voxels were seen.
    #[inline]
    pub fn sample_with_gradient(&self, point: &Vector3<f32>) -> Option<(f32, Vector3<f32>)> {
        let (corners, [fx, fy, fz]) = self.corners(point)?;
        let [c000, c100, c010, c110, c001, c101, c011, c111] = corners;
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
        let gradient = Vector3::new(dx, dy, y1 - y0) * (scale / self.voxel_size_m);
        Some((lerp(y0, y1, fz) * scale, gradient))
    }

    /// The eight voxels round a point, x fastest, in raw steps, and the point's place between them.
    #[inline]
    fn corners(&self, point: &Vector3<f32>) -> Option<([f32; 8], [f32; 3])> {
        let grid = point / self.voxel_size_m;
        let voxel = [grid.x, grid.y, grid.z].map(floor);
        let fraction = [0, 1, 2].map(|axis| grid[axis] - voxel[axis] as f32);
        let local = voxel.map(|i| i & 7);
        let mut corners = [0.0f32; 8];
        if local.iter().all(|&i| i < 7) {
            let block = &self.blocks[self.find(voxel.map(|i| i >> 3))?];
            let first = voxel_index(local);
            for (corner, offset) in corners.iter_mut().zip([0, 1, 8, 9, 64, 65, 72, 73]) {
                if block.weight[first + offset] == 0 {
                    return None;
                }
                *corner = block.tsdf[first + offset] as f32;
            }
        } else {
            for (index, corner) in corners.iter_mut().enumerate() {
                let at = [0, 1, 2].map(|axis| voxel[axis] + ((index >> axis) & 1) as i32);
                let block = &self.blocks[self.find(at.map(|i| i >> 3))?];
                let index = voxel_index(at.map(|i| i & 7));
                if block.weight[index] == 0 {
                    return None;
                }
                *corner = block.tsdf[index] as f32;
            }
        }
        Some((corners, fraction))
    }
}

/// Largest integer not above x, without a call into the mathematics library.
#[inline]
fn floor(x: f32) -> i32 {
    let truncated = x as i32;
    truncated - i32::from(x < truncated as f32)
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
        let mut volume = TsdfVolume::new(0.002, truncation_m);
        for bx in -3..3 {
            for by in -3..3 {
                for bz in -3..3 {
                    volume.allocate([bx, by, bz]);
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
    fn blocks_are_found_where_they_were_put_and_nowhere_else() {
        let mut volume = TsdfVolume::new(0.002, 0.01);
        let coords = [[0, 0, 0], [-1, 5, 300], [511, -512, 17]];
        for (index, coord) in coords.iter().enumerate() {
            assert_eq!(volume.allocate(*coord), Some(index));
            assert_eq!(volume.allocate(*coord), Some(index));
        }
        assert_eq!(volume.find([-1, 5, 300]), Some(1));
        assert_eq!(volume.find([-1, 5, 299]), None);
        assert_eq!(volume.allocate([512, 0, 0]), None);
    }
}
