//! Passes over the blocks of the volume: in parallel, and in the vector code of the processor's own instruction set.

use super::block_masks::Voxels;
use super::volume::TsdfVolume;
use pulp::{Arch, Simd, WithSimd};
use rayon::prelude::*;

/// Blocks that one task works on.
pub const TASK_BLOCKS: usize = 256;

/// Something that is found out of every block. Implementations are always inlined, so as to become vector code.
pub trait OfBlock: Sync {
    /// What it is.
    type Out: Clone + Default + Send;
    /// Finds it for the block at an index.
    fn of(&self, index: usize) -> Self::Out;
}

/// Finds something out of `n` blocks, in parallel and in the vector code of `arch`.
pub fn each<P: OfBlock>(arch: Arch, n: usize, pass: &P) -> Vec<P::Out> {
    let mut all = vec![P::Out::default(); n];
    let tasks = all.par_chunks_mut(TASK_BLOCKS).enumerate();
    tasks.for_each(|(task, outs)| {
        let first = task * TASK_BLOCKS;
        arch.dispatch(Task { pass, first, outs });
    });
    all
}

struct Task<'a, P: OfBlock> {
    pass: &'a P,
    first: usize,
    outs: &'a mut [P::Out],
}

impl<P: OfBlock> WithSimd for Task<'_, P> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, _: S) {
        for (index, out) in self.outs.iter_mut().enumerate() {
            *out = self.pass.of(self.first + index);
        }
    }
}

/// Reads the voxels of some blocks.
pub struct Reading<'a> {
    /// The volume.
    pub volume: &'a TsdfVolume,
    /// Numbers of the blocks.
    pub blocks: &'a [u32],
    /// Voxels of less do not count as seen.
    pub min_weight: f32,
}

impl OfBlock for Reading<'_> {
    type Out = Voxels;

    #[inline(always)]
    fn of(&self, index: usize) -> Voxels {
        let block = self.blocks[index] as usize;
        Voxels::of(&self.volume.blocks()[block], self.min_weight)
    }
}
