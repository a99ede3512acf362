//! The voxels of a block as bits, a word for each slab of 8×8, and what becomes of 64 cubes and edges at a time.

use super::block::{BLOCK_SIDE, BLOCK_VOXELS, BRICK_VOXELS, Block, BlockCoord, WEIGHT_ONE};
use super::volume::TsdfVolume;
use pulp::{Arch, Simd, WithSimd};
use rayon::prelude::*;

/// Slabs of a block.
pub const SLABS: usize = BLOCK_SIDE as usize;
/// One bit for each voxel of a block: word z, bit x + 8 y.
pub type Mask = [u64; SLABS];

/// The bits with x = 0.
const FIRST_COLUMN: u64 = 0x0101_0101_0101_0101;
/// The bits with x = 0 where bit 0 of the index is set, and with y = 0 where bit 1 is.
pub const LAYERS: [u64; 4] = [!0, FIRST_COLUMN, 0xFF, 1];
/// The bits with x = 7 where bit 0 of the index is set, and with y = 7 where bit 1 is.
pub const LAST_LAYERS: [u64; 4] = [!0, FIRST_COLUMN << 7, 0xFF << 56, 1 << 63];
/// Blocks that one task works on, of those that are worked on in parallel.
pub const TASK_BLOCKS: usize = 256;
/// No block.
pub const NONE: u32 = u32::MAX;

/// A block and seven beside it, in one direction along each axis; [`NONE`] where there is none. Bit a of an index stands for a
/// step along axis a.
pub type Octant = [u32; 8];

/// A block and those towards larger coordinates.
pub fn blocks_above(volume: &TsdfVolume, coord: BlockCoord) -> Octant {
    octant(volume, coord, 1)
}

/// A block and those towards smaller coordinates.
pub fn blocks_below(volume: &TsdfVolume, coord: BlockCoord) -> Octant {
    octant(volume, coord, -1)
}

#[inline(always)]
fn octant(volume: &TsdfVolume, coord: BlockCoord, step: i32) -> Octant {
    std::array::from_fn(|side| {
        let coord = [0, 1, 2].map(|axis| coord[axis] + step * (side >> axis & 1) as i32);
        volume.find(coord).map_or(NONE, |block| block as u32)
    })
}

/// What a block's voxels are.
#[derive(Clone, Copy, Debug, Default)]
pub struct Voxels {
    /// Seen often enough.
    pub seen: Mask,
    /// Seen often enough and inside.
    pub inside: Mask,
}

/// Which signs the distances of some voxels have, of those that were seen.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Signs(u8);

impl Signs {
    /// Both.
    pub const BOTH: Signs = Signs(3);

    /// Those of these voxels and of those.
    #[inline(always)]
    pub fn and(self, other: Signs) -> Signs {
        Signs(self.0 | other.0)
    }
}

impl Voxels {
    /// Reads some blocks; voxels of less than `min_weight` do not count as seen.
    pub fn of_blocks(
        arch: Arch,
        volume: &TsdfVolume,
        blocks: &[u32],
        min_weight: f32,
    ) -> Vec<Voxels> {
        let mut all = vec![Voxels::default(); blocks.len()];
        let tasks = all.par_chunks_mut(TASK_BLOCKS);
        let tasks = tasks.zip(blocks.par_chunks(TASK_BLOCKS));
        tasks.for_each(|(voxels, blocks)| {
            arch.dispatch(Reading {
                volume,
                blocks,
                min_weight,
                voxels,
            });
        });
        all
    }

    /// Which signs its distances have.
    #[inline(always)]
    pub fn signs(&self) -> Signs {
        let slabs = self.seen.iter().zip(&self.inside);
        let (inside, outside) = slabs.fold((0, 0), |(inside, outside), (seen, inside_here)| {
            (inside | inside_here, outside | (seen & !inside_here))
        });
        Signs(u8::from(inside != 0) | u8::from(outside != 0) << 1)
    }

    /// Reads a block.
    #[inline(always)]
    fn of(block: &Block, min_weight: f32) -> Self {
        let least = (min_weight * WEIGHT_ONE).ceil().max(1.0) as u16;
        // Loops over the whole block, which the compiler turns into vector code, where it would unroll shorter ones.
        let (mut is_seen, mut is_inside) = ([0; BLOCK_VOXELS], [0; BLOCK_VOXELS]);
        for (is_seen, &weight) in is_seen.iter_mut().zip(&block.weight) {
            *is_seen = u8::from(weight >= least);
        }
        for ((is_inside, &is_seen), &tsdf) in is_inside.iter_mut().zip(&is_seen).zip(&block.tsdf) {
            *is_inside = is_seen & u8::from(tsdf < 0);
        }
        let mut voxels = Voxels::default();
        let is_seen = is_seen.as_chunks::<BRICK_VOXELS>().0.iter();
        let is_inside = is_inside.as_chunks::<BRICK_VOXELS>().0;
        for (brick, (is_seen, is_inside)) in is_seen.zip(is_inside).enumerate() {
            let (seen, inside) = (word(is_seen), word(is_inside));
            // Four layers of a brick go to as many slabs.
            let (first_slab, at) = (brick >> 2 << 2, 4 * (brick & 1) + 32 * (brick >> 1 & 1));
            for layer in 0..4 {
                voxels.seen[first_slab + layer] |= spread(seen >> (16 * layer)) << at;
                voxels.inside[first_slab + layer] |= spread(inside >> (16 * layer)) << at;
            }
        }
        voxels
    }
}

/// Reads the voxels of one task's blocks.
struct Reading<'a> {
    volume: &'a TsdfVolume,
    blocks: &'a [u32],
    min_weight: f32,
    voxels: &'a mut [Voxels],
}

impl WithSimd for Reading<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, _: S) {
        for (voxels, &block) in self.voxels.iter_mut().zip(self.blocks) {
            *voxels = Voxels::of(&self.volume.blocks()[block as usize], self.min_weight);
        }
    }
}

/// 64 flags, each 0 or 1, as bits.
#[inline(always)]
fn word(flags: &[u8; BRICK_VOXELS]) -> u64 {
    let mut word = 0;
    for (row, flags) in flags.as_chunks::<8>().0.iter().enumerate() {
        // The product has flag i at bit 56 + i.
        let bits = u64::from_le_bytes(*flags).wrapping_mul(0x0102_0408_1020_4080) >> 56;
        word |= bits << (8 * row);
    }
    word
}

/// The 16 lowest bits, 4×4 voxels, at the low half of four rows of 8.
#[inline(always)]
fn spread(layer: u64) -> u64 {
    let layer = layer & 0xFFFF;
    let pairs = (layer | layer << 8) & 0x00FF_00FF;
    (pairs | pairs << 4) & 0x0F0F_0F0F
}

/// A plane of voxels with its neighbours along x, along y and along both, each at the bit of the voxel that it neighbours.
type Plane = [u64; 4];

/// Plane `z` (0 to 8) of a block and of those above it.
#[inline(always)]
fn plane(around: &[&Mask; 8], z: usize) -> Plane {
    let (upper, slab) = (4 * (z / SLABS), z % SLABS);
    let word = |side: usize| around[upper | side][slab];
    let along_x =
        |own: u64, next: u64| own >> 1 & !(FIRST_COLUMN << 7) | (next & FIRST_COLUMN) << 7;
    let along_y = |own: u64, next: u64| own >> 8 | next << 56;
    let (x, x_next) = (along_x(word(0), word(1)), along_x(word(2), word(3)));
    [word(0), x, along_y(word(0), word(2)), along_y(x, x_next)]
}

/// A mask of nothing.
pub const NOTHING: Mask = [0; SLABS];

/// Masks of a block and of those above it; nothing where there is none.
#[inline(always)]
fn upwards<'a>(
    voxels: &'a [Voxels],
    above: &Octant,
    mask: impl Fn(&'a Voxels) -> &'a Mask,
) -> [&'a Mask; 8] {
    let of = |block: u32| voxels.get(block as usize).map_or(&NOTHING, &mask);
    above.map(of)
}

/// Which corners of a block's cubes lie inside.
pub struct Corners([Plane; SLABS + 1]);

impl Corners {
    /// The corners of the cubes of a block, given what the voxels of all blocks are.
    #[inline(always)]
    pub fn of(voxels: &[Voxels], above: &Octant) -> Self {
        let around = upwards(voxels, above, |voxels| &voxels.inside);
        let mut planes = [[0; 4]; SLABS + 1];
        for (z, out) in planes.iter_mut().enumerate() {
            *out = plane(&around, z);
        }
        Corners(planes)
    }

    /// The inside corners of the cube whose lowest voxel is at a bit of slab `z`, one bit each, as
    /// [`cases`](super::cube_cases::cases) numbers them.
    #[inline(always)]
    pub fn pattern(&self, z: usize, bit: usize) -> u8 {
        let mut pattern = 0;
        for corner in 0..4 {
            pattern |= (self.0[z][corner] >> bit & 1) << corner;
            pattern |= (self.0[z + 1][corner] >> bit & 1) << (corner + 4);
        }
        pattern as u8
    }

    /// Cubes of the block of which all eight voxels were seen and that the surface crosses, each at the bit of its lowest voxel,
    /// given what the voxels of all blocks are.
    #[inline(always)]
    pub fn crossed_cubes(&self, voxels: &[Voxels], above: &Octant) -> Mask {
        let all = |[a, b, c, d]: Plane| a & b & c & d;
        let any = |[a, b, c, d]: Plane| a | b | c | d;
        let seen = upwards(voxels, above, |voxels| &voxels.seen);
        let mut seen_below = all(plane(&seen, 0));
        std::array::from_fn(|z| {
            let seen_above = all(plane(&seen, z + 1));
            let (below, above) = (self.0[z], self.0[z + 1]);
            let all_seen = std::mem::replace(&mut seen_below, seen_above) & seen_above;
            all_seen & (any(below) | any(above)) & !(all(below) & all(above))
        })
    }

    /// Edges of the block that the surface crosses, by axis, each at the bit of its lower voxel.
    #[inline(always)]
    pub fn crossed_edges(&self) -> [Mask; 3] {
        let end = |axis: usize, z: usize| match axis {
            2 => self.0[z + 1][0],
            _ => self.0[z][axis + 1],
        };
        std::array::from_fn(|axis| std::array::from_fn(|z| self.0[z][0] ^ end(axis, z)))
    }
}

/// Of a block's edges those that one of some cubes has, which are of the block and of those below it: see [`blocks_below`].
#[inline(always)]
pub fn edges_of_cubes(edges: &[Mask; 3], cubes: [&Mask; 8]) -> [Mask; 3] {
    let back_x = |own: u64, previous: u64| own << 1 & !FIRST_COLUMN | previous >> 7 & FIRST_COLUMN;
    let back_y = |own: u64, previous: u64| own << 8 | previous >> 56;
    let with_back_x = |own: u64, previous: u64| own | back_x(own, previous);
    let with_back_y = |own: u64, previous: u64| own | back_y(own, previous);
    let mut used = [NOTHING; 3];
    for z in 0..SLABS {
        // Slab z of the block, and the one below it, which may belong to the blocks below.
        let same = |side: usize| cubes[side][z];
        let below = |side: usize| match z {
            0 => cubes[4 | side][SLABS - 1],
            _ => cubes[side][z - 1],
        };
        let along_x = with_back_y(same(0), same(2)) | with_back_y(below(0), below(2));
        let (row, previous_row) = (with_back_x(same(0), same(1)), with_back_x(same(2), same(3)));
        let along_y = row | with_back_x(below(0), below(1));
        used[0][z] = edges[0][z] & along_x;
        used[1][z] = edges[1][z] & along_y;
        used[2][z] = edges[2][z] & with_back_y(row, previous_row);
    }
    used
}

/// The set bits of a word, lowest first.
#[inline(always)]
pub fn bits(mut word: u64) -> impl Iterator<Item = usize> {
    std::iter::from_fn(move || {
        let bit = word.trailing_zeros() as usize;
        let found = (word != 0).then_some(bit);
        word &= word.wrapping_sub(1);
        found
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::fusion::block::voxel_index;

    #[test]
    fn every_voxel_is_at_its_bit() {
        for number in 0..BLOCK_VOXELS {
            let [x, y, z] = [number & 7, number >> 3 & 7, number >> 6];
            let mut block = Block::EMPTY;
            let index = voxel_index([x, y, z].map(|c| c as i32));
            (block.tsdf[index], block.weight[index]) = (-5, 300);
            let voxels = Voxels::of(&block, 1.0);
            let mut expected = [0; SLABS];
            expected[z] = 1 << (x + 8 * y);
            assert_eq!((voxels.seen, voxels.inside), (expected, expected));
            assert_eq!(Voxels::of(&block, 1.2).seen, [0; SLABS]);
        }
    }
}
