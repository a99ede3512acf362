//! Where the surface passes through the volume: the blocks that it crosses, and which of their cubes and edges.

use super::block_masks::{
    Corners, Mask, NOTHING, Octant, Signs, TASK_BLOCKS, Voxels, bits, blocks_above,
};
use super::cube_cases::cases;
use super::volume::TsdfVolume;
use pulp::{Arch, Simd, WithSimd};
use rayon::prelude::*;

/// What the surface crosses in a volume.
pub struct Crossings {
    /// In the blocks of each task, which are as many one after the other.
    pub tasks: Vec<Found>,
    /// Where each of all blocks stands among those found of its task.
    place_of: Vec<u16>,
}

/// The block has nothing that the surface crosses.
const NO_PLACE: u16 = u16::MAX;

impl Crossings {
    /// What the surface crosses, given what the voxels of all blocks are.
    pub fn of(arch: Arch, volume: &TsdfVolume, voxels: &[Voxels]) -> Self {
        let signs: Vec<Signs> = voxels.par_iter().map(Voxels::signs).collect();
        let mut place_of = vec![NO_PLACE; voxels.len()];
        let tasks = place_of.par_chunks_mut(TASK_BLOCKS).enumerate();
        let tasks = tasks.map(|(task, place_of)| {
            arch.dispatch(Finding {
                volume,
                voxels,
                signs: &signs,
                first: (task * TASK_BLOCKS) as u32,
                place_of,
            })
        });
        Crossings {
            tasks: tasks.collect(),
            place_of,
        }
    }

    /// The task of a block and its place among those found; `None` where the surface crosses nothing, or there is no block.
    #[inline(always)]
    pub fn place(&self, block: u32) -> Option<(usize, usize)> {
        // Where there is no block, the number lies beyond all blocks.
        let place = *self.place_of.get(block as usize)?;
        (place != NO_PLACE).then_some((block as usize / TASK_BLOCKS, place as usize))
    }
}

/// What the surface crosses in one task's blocks, where it crosses something.
pub struct Found {
    /// In the order in which they were allocated.
    pub blocks: Vec<Crossed>,
    /// Patterns of their crossed cubes, slab by slab.
    pub patterns: Vec<u8>,
    /// Faces in these cubes.
    pub n_faces: usize,
}

/// What the surface crosses in a block.
pub struct Crossed {
    /// The block, and those above it.
    pub above: Octant,
    /// Cubes, at the bits of their lowest voxels.
    pub cubes: Mask,
    /// Edges, used or not, by axis, at the bits of their lower voxels.
    pub edges: [Mask; 3],
}

/// Finds what the surface crosses in one task's blocks.
struct Finding<'a> {
    volume: &'a TsdfVolume,
    /// Of all blocks.
    voxels: &'a [Voxels],
    signs: &'a [Signs],
    /// The first of the blocks.
    first: u32,
    /// Where each of them stands among those found.
    place_of: &'a mut [u16],
}

impl WithSimd for Finding<'_> {
    type Output = Found;

    #[inline(always)]
    fn with_simd<S: Simd>(self, _: S) -> Found {
        let cases = cases();
        let (mut blocks, mut patterns, mut n_faces) = (Vec::new(), Vec::new(), 0);
        for (block, place) in (self.first..).zip(self.place_of) {
            let above = blocks_above(self.volume, self.volume.coords()[block as usize]);
            let signs = |block: u32| self.signs.get(block as usize).copied();
            let signs = above.into_iter().filter_map(signs);
            if signs.fold(Signs::default(), Signs::and) != Signs::BOTH {
                continue;
            }
            let corners = Corners::of(self.voxels, &above);
            let edges = corners.crossed_edges();
            let cubes = corners.crossed_cubes(self.voxels, &above);
            if edges == [NOTHING; 3] && cubes == NOTHING {
                continue;
            }
            for (z, &word) in cubes.iter().enumerate() {
                for bit in bits(word) {
                    let pattern = corners.pattern(z, bit);
                    n_faces += cases[pattern as usize].n_triangles();
                    patterns.push(pattern);
                }
            }
            *place = blocks.len() as u16;
            blocks.push(Crossed {
                above,
                cubes,
                edges,
            });
        }
        Found {
            blocks,
            patterns,
            n_faces,
        }
    }
}
