//! Which blocks a frame touches: those along its truncation band.

use super::block::{BLOCK_SIDE, BlockCoord};
use super::pyramid::FramePyramid;
use super::volume::{Refusal, TsdfVolume};
use crate::geometry::Pose;
use nalgebra::Vector3;

/// Rays are looked at on a grid of so many pixels where they lie close, of half as many elsewhere.
const COARSE_STRIDE: usize = 4;

/// Rays this share of a block's side apart miss no block but for its corners, which the next frames see.
const MAX_SPACING_BLOCKS: f32 = 0.75;

/// The blocks that the last frame touched, and what the volume refused.
#[derive(Clone, Debug, Default)]
pub struct Band {
    /// Frame that touched each block last.
    touched_in: Vec<u32>,
    frame: u32,
    /// The touched blocks, in rising order.
    touched: Vec<u32>,
    refused: Refused,
    /// The block in which the last sample lay: neighbouring samples often share it.
    last: Option<BlockCoord>,
}

/// Blocks that were seen and not allocated; one that is seen in many frames counts once for each.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Refused {
    /// Beyond the volume's border.
    pub n_outside: u64,
    /// Beyond the memory budget.
    pub n_over_budget: u64,
}

impl Refused {
    /// What was refused, as a sentence for the operator; `None` if nothing was.
    pub fn sentence(&self, memory_budget_mb: usize) -> Option<String> {
        let over_budget = (self.n_over_budget > 0).then(|| {
            format!(
                "the model has reached fusion.memory_budget_mb, {memory_budget_mb}: new parts of the scene are not fused, \
                 {} blocks in all frames",
                self.n_over_budget
            )
        });
        let outside = (self.n_outside > 0).then(|| {
            format!(
                "parts of the scene lie beyond the volume's border and are not fused, {} blocks in all frames",
                self.n_outside
            )
        });
        match (over_budget, outside) {
            (Some(budget), Some(outside)) => Some(format!("{budget}; {outside}")),
            (one, other) => one.or(other),
        }
    }
}

impl Band {
    /// The touched blocks, in rising order.
    pub fn touched(&self) -> &[u32] {
        &self.touched
    }

    /// How many frames were taken in.
    pub fn frame(&self) -> u32 {
        self.frame
    }

    /// The blocks that were touched after so many frames, in rising order.
    pub fn touched_since(&self, frame: u32) -> impl Iterator<Item = u32> {
        let touched_in = self.touched_in.iter().enumerate();
        touched_in
            .filter(move |(_, last)| **last > frame)
            .map(|(block, _)| block as u32)
    }

    /// What the volume refused so far.
    pub fn refused(&self) -> Refused {
        self.refused
    }

    /// Finds the blocks within the truncation distance of a frame's depth and allocates those that are new.
    pub fn find(
        &mut self,
        volume: &mut TsdfVolume,
        frame: &FramePyramid,
        world_from_camera: &Pose,
    ) {
        self.frame += 1;
        self.last = None;
        let rotation = world_from_camera.rotation.to_rotation_matrix();
        let rotation = rotation.matrix().cast::<f32>();
        let origin = world_from_camera.translation.vector.cast::<f32>();
        let block_m = volume.voxel_size_m() * BLOCK_SIDE as f32;
        let pitch = 0.5 * frame.reduced[0].pitch;
        // Where coarse rays are farther apart than this share of a block, blocks could fall between them.
        let coarse_until_m = MAX_SPACING_BLOCKS * block_m / (pitch * COARSE_STRIDE as f32);
        let fine_stride = COARSE_STRIDE / 2;
        for v in (fine_stride / 2..frame.rays.height).step_by(fine_stride) {
            let is_coarse_row = v % COARSE_STRIDE == fine_stride / 2;
            for u in (fine_stride / 2..frame.rays.width).step_by(fine_stride) {
                let pixel = v * frame.rays.width + u;
                let depth = frame.depth[pixel];
                let is_coarse = is_coarse_row && u % COARSE_STRIDE == fine_stride / 2;
                if depth <= 0.0 || (!is_coarse && depth < coarse_until_m) {
                    continue;
                }
                let ray = Vector3::new(frame.rays.x[pixel], frame.rays.y[pixel], 1.0);
                self.mark(volume, &origin, &(rotation * ray), depth);
            }
        }
        let mut touched = std::mem::take(&mut self.touched);
        touched.clear();
        touched.extend(self.touched_since(self.frame - 1));
        self.touched = touched;
    }

    /// Marks the blocks that a ray crosses from `depth` less the truncation distance to `depth` plus it.
    fn mark(
        &mut self,
        volume: &mut TsdfVolume,
        origin: &Vector3<f32>,
        direction: &Vector3<f32>,
        depth: f32,
    ) {
        let band = volume.truncation_m() / direction.norm();
        // Steps of half a block's side cannot jump a block by more than a corner.
        let n_steps =
            (4.0 * volume.truncation_m() / (volume.voxel_size_m() * BLOCK_SIDE as f32)).ceil();
        for step in 0..=n_steps as usize {
            let z = depth + band * (2.0 * step as f32 / n_steps - 1.0);
            let coord = volume.block_of((origin + direction * z).into());
            if self.last == Some(coord) {
                continue;
            }
            self.last = Some(coord);
            match volume.allocate(coord) {
                Ok(block) => {
                    if block >= self.touched_in.len() {
                        self.touched_in.push(0);
                    }
                    self.touched_in[block] = self.frame;
                }
                Err(Refusal::Outside) => self.refused.n_outside += 1,
                Err(Refusal::OverBudget) => self.refused.n_over_budget += 1,
            }
        }
    }
}
