//! A block of the volume: 8³ voxels in 2×2×2 bricks of 4³.
//!
//! A brick's voxels lie together, distances and weights in planes of their own, so that what a frame does not see of a block
//! is not even loaded.

/// Voxels along a block's side.
pub const BLOCK_SIDE: i32 = 8;
/// Voxels of a block.
pub const BLOCK_VOXELS: usize = 512;
/// Voxels along a brick's side.
pub const BRICK_SIDE: usize = 4;
/// Voxels of a brick.
pub const BRICK_VOXELS: usize = 64;
/// Bricks of a block. Bit a of a brick's number stands for a step along axis a.
pub const BRICKS: usize = BLOCK_VOXELS / BRICK_VOXELS;
/// Distances are kept in steps of the truncation distance divided by this.
pub const TSDF_ONE: f32 = 32_767.0;
/// The distance of a voxel that was never seen: one step beyond the least distance.
pub const UNSEEN: i16 = i16::MIN;
/// Weights are kept in steps of one 256th.
pub const WEIGHT_ONE: f32 = 256.0;

/// Block coordinates: voxel index divided by 8, rounded down.
pub type BlockCoord = [i32; 3];

/// Voxel values of one block, each at its [`voxel_index`].
#[derive(Clone)]
pub struct Block {
    /// Signed distance in units of truncation / 32767, positive in front of the surface; [`UNSEEN`] where nothing was seen.
    pub tsdf: [i16; BLOCK_VOXELS],
    /// Weight in units of 1/256; 0 where nothing was seen.
    pub weight: [u16; BLOCK_VOXELS],
}

impl Block {
    /// Nothing seen yet.
    pub const EMPTY: Block = Block {
        tsdf: [UNSEEN; BLOCK_VOXELS],
        weight: [0; BLOCK_VOXELS],
    };
}

/// What each coordinate (0 to 7) of a voxel adds to its index: x + 4 y + 16 z within a brick, 64 for each brick.
#[inline(always)]
pub fn index_parts([x, y, z]: [i32; 3]) -> [usize; 3] {
    let part = |c: i32, low: u32, high: u32| ((c & 3) << low | (c & 4) << high) as usize;
    [part(x, 0, 4), part(y, 2, 5), part(z, 4, 6)]
}

/// Index of a voxel within its block.
#[inline(always)]
pub fn voxel_index(voxel: [i32; 3]) -> usize {
    let [x, y, z] = index_parts(voxel);
    x | y | z
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_voxel_has_an_index_of_its_own_and_bricks_lie_together() {
        let mut used = [false; BLOCK_VOXELS];
        for number in 0..BLOCK_VOXELS as i32 {
            let voxel = [number & 7, number >> 3 & 7, number >> 6];
            let index = voxel_index(voxel);
            assert!(!std::mem::replace(&mut used[index], true));
            let brick = (0..3).fold(0, |brick, axis| brick | voxel[axis] >> 2 << axis);
            assert_eq!(index / BRICK_VOXELS, brick as usize);
        }
    }
}
