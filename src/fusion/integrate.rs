//! Fusing a frame into the blocks that it touches (Curless and Levoy 1996).
//!
//! A voxel takes the measurement of the pixel nearest to it. The voxels of a brick go through each step together, so that
//! the steps are loops over arrays. Bricks that a frame does not see are left alone, and so are those in free space in which
//! nothing was ever seen.

use super::band_ends::BandSight;
use super::block::{BRICK_VOXELS, Block, BlockCoord, TSDF_ONE};
use super::observe::{DepthStep, Observation, Observations, slope_of, weight_of};
use super::view::View;
use super::volume::TsdfVolume;
use crate::geometry::lanes::round_bits;
use pulp::{Arch, Simd, WithSimd};

/// Blocks that one task updates.
const TASK_BLOCKS: usize = 128;

/// Updates the touched blocks, given in rising order, by the observations of one frame.
// A symbol of its own, by which tests/bench/instructions.sh counts.
#[inline(never)]
pub fn integrate(
    arch: Arch,
    volume: &mut TsdfVolume,
    touched: &[u32],
    observations: &Observations,
    view: &View,
) {
    let (coords, blocks) = volume.blocks_mut();
    update_tasks(blocks, touched, &|blocks, touched| {
        arch.dispatch(UpdateBlocks {
            first: touched.first().map_or(0, |&block| block),
            blocks,
            touched,
            coords,
            observations,
            view,
        });
    });
}

/// Halves the touched blocks until they are few, and gives each part the blocks from its first to its last.
fn update_tasks(
    blocks: &mut [Block],
    touched: &[u32],
    update: &(impl Fn(&mut [Block], &[u32]) + Sync),
) {
    fn split(
        blocks: &mut [Block],
        first: u32,
        touched: &[u32],
        update: &(impl Fn(&mut [Block], &[u32]) + Sync),
    ) {
        if touched.len() <= TASK_BLOCKS {
            if let (Some(&low), Some(&high)) = (touched.first(), touched.last()) {
                update(
                    &mut blocks[(low - first) as usize..=(high - first) as usize],
                    touched,
                );
            }
            return;
        }
        let (low, high) = touched.split_at(touched.len() / 2);
        let (low_blocks, high_blocks) = blocks.split_at_mut((high[0] - first) as usize);
        rayon::join(
            || split(low_blocks, first, low, update),
            || split(high_blocks, high[0], high, update),
        );
    }
    split(blocks, 0, touched, update);
}

struct UpdateBlocks<'a> {
    /// Blocks from index `first` on.
    blocks: &'a mut [Block],
    first: u32,
    touched: &'a [u32],
    coords: &'a [BlockCoord],
    observations: &'a Observations,
    view: &'a View,
}

impl WithSimd for UpdateBlocks<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, _: S) {
        let (pixels, ends) = (self.observations.pixels(), self.observations.band_ends());
        let step = self.observations.depth_step();
        for &index in self.touched {
            let block = &mut self.blocks[(index - self.first) as usize];
            let bricks = self.view.bricks(self.coords[index as usize]);
            let tsdf = block.tsdf.as_chunks_mut::<BRICK_VOXELS>().0;
            let weights = block.weight.as_chunks_mut::<BRICK_VOXELS>().0;
            for (brick, (tsdf, weights)) in tsdf.iter_mut().zip(weights).enumerate() {
                let sight = bricks.extent(brick).map(|extent| ends.sight(&extent));
                match sight {
                    None | Some(BandSight::Hidden) => continue,
                    // Free space is kept only where there may be something to carve away.
                    Some(BandSight::Free) if *weights == [0; BRICK_VOXELS] => continue,
                    Some(BandSight::Free | BandSight::InBand) => {}
                }
                let (nearest, depth) = self.view.project(&bricks, brick);
                let mut seen = [0; BRICK_VOXELS];
                for (seen, &pixel) in seen.iter_mut().zip(&nearest) {
                    *seen = pixels[pixel as usize];
                }
                let mut measured = measure(self.view, step, &seen, &depth);
                if let Some(weight) = self.view.weight_looking_through(&bricks, brick) {
                    take_back(&mut measured, weight, weights);
                }
                if measured.any {
                    blend(&measured, tsdf, weights);
                }
            }
        }
    }
}

/// What a brick's voxels are told: distances in units of the volume, and weights; 0 is no measurement.
struct Measured {
    distance: [f32; BRICK_VOXELS],
    weight: [f32; BRICK_VOXELS],
    any: bool,
}

/// Turns observations into distances; voxels hidden behind the band get none.
#[inline(always)]
fn measure(
    view: &View,
    step: DepthStep,
    seen: &[Observation; BRICK_VOXELS],
    depth: &[f32; BRICK_VOXELS],
) -> Measured {
    let (scale, frames) = (1.0 / view.truncation_m(), view.weight());
    let (mut distance, mut weight, mut any) = ([0.0; BRICK_VOXELS], [0.0; BRICK_VOXELS], 0);
    for voxel in 0..BRICK_VOXELS {
        let measured = step.depth_of(seen[voxel]);
        let truncations = (measured - depth[voxel]) * (slope_of(seen[voxel]) * scale);
        let counts = (measured > 0.0) & (truncations >= -1.0);
        let cut = if truncations < 1.0 { truncations } else { 1.0 };
        distance[voxel] = if counts { cut * TSDF_ONE } else { 0.0 };
        weight[voxel] = if counts {
            weight_of(seen[voxel]) * frames
        } else {
            0.0
        };
        any |= u32::from(counts);
    }
    Measured {
        distance,
        weight,
        any: any != 0,
    }
}

/// Where the camera looks through what was seen: lets measurements count by `weight`, and for no more than a share of what a voxel
/// has gathered. One frame that misses a thin part does not take it back, however little its rims weigh.
#[inline(always)]
fn take_back(measured: &mut Measured, weight: f32, gathered: &[u16; BRICK_VOXELS]) {
    for (counting, &gathered) in measured.weight.iter_mut().zip(gathered) {
        let most = MOST_TAKEN_BACK * f32::from(gathered);
        let taken = if weight < most { weight } else { most };
        *counting = if *counting > 0.0 { taken } else { 0.0 };
    }
}

/// A look through a voxel counts for no more than this share of what it has gathered; arbitrary, a surface half-way into its band is gone
/// after one or two looks.
const MOST_TAKEN_BACK: f32 = 0.5;

/// Adds measurements to the running means of a brick.
#[inline(always)]
fn blend(measured: &Measured, tsdf: &mut [i16; BRICK_VOXELS], weights: &mut [u16; BRICK_VOXELS]) {
    for voxel in 0..BRICK_VOXELS {
        let (old, old_weight) = (f32::from(tsdf[voxel]), f32::from(weights[voxel]));
        let added = measured.weight[voxel];
        let weight = old_weight + added;
        let share = added / if weight > 1.0 { weight } else { 1.0 };
        // Without a weight the share is 0 and the mean stays, to the bit.
        let mean = old + (measured.distance[voxel] - old) * share;
        tsdf[voxel] = (round_bits(mean + TSDF_BIAS) as i32 - TSDF_BIAS as i32) as i16;
        weights[voxel] = round_bits(if weight < MAX_WEIGHT {
            weight
        } else {
            MAX_WEIGHT
        }) as u16;
    }
}

/// Makes every distance positive, that of voxels never seen included.
const TSDF_BIAS: f32 = 32_768.0;
/// Weights stop growing here.
const MAX_WEIGHT: f32 = 65_535.0;

#[cfg(test)]
mod tests {
    use super::*;
    use crate::fusion::block::{BLOCK_SIDE, UNSEEN, WEIGHT_ONE, voxel_index};
    use crate::fusion::observe::observation;
    use crate::geometry::Lens;
    use crate::geometry::camera::tests::distorted_camera;
    use crate::geometry::lanes::arch_levels;
    use crate::geometry::{CameraModel, Pose};

    const N_PIXELS: usize = 512 * 424;

    /// Steps of 0.01 mm, in which the depths of the tests are whole numbers.
    fn depth_step() -> DepthStep {
        DepthStep::up_to(0.65535)
    }

    fn plane_at(depth_m: f32, weight: f32) -> Vec<Observation> {
        vec![observation(depth_step(), depth_m, weight, 1.0); N_PIXELS]
    }

    /// A volume of 4 mm voxels along the axis at 0.5 m.
    fn volume() -> TsdfVolume {
        let mut volume = TsdfVolume::new(0.004, 0.02, usize::MAX);
        for bx in -2..2 {
            for bz in 14..18 {
                volume.allocate([bx, 0, bz]).expect("within the volume");
            }
        }
        volume
    }

    fn fuse(arch: Arch, volume: &mut TsdfVolume, pixels: &[Observation], pose: &Pose) {
        let camera: CameraModel = distorted_camera();
        let view = View::new(volume, Lens::new(&camera), pose);
        let observations =
            Observations::of_pixels(arch, pixels, 512, depth_step(), volume.truncation_m());
        let touched: Vec<u32> = (0..volume.coords().len() as u32).collect();
        integrate(arch, volume, &touched, &observations, &view);
    }

    #[test]
    fn the_mean_of_measurements_is_weighted_and_hidden_voxels_stay_unseen() {
        let mut volume = volume();
        let pose = Pose::identity();
        fuse(Arch::new(), &mut volume, &plane_at(0.500, 0.75), &pose);
        fuse(Arch::new(), &mut volume, &plane_at(0.512, 0.375), &pose);
        let mut n_mean = 0;
        for (coord, block) in volume.coords().iter().zip(volume.blocks()) {
            for slab in 0..BLOCK_SIDE {
                let z = (coord[2] * BLOCK_SIDE + slab) as f32 * 0.004;
                let index = voxel_index([0, 0, slab]);
                let (tsdf, weight) = (block.tsdf[index], block.weight[index]);
                if z > 0.533 {
                    assert_eq!((tsdf, weight), (UNSEEN, 0));
                } else if z > 0.497 && z < 0.518 {
                    n_mean += 1;
                    let expected = (0.504 - z) / 0.02 * TSDF_ONE;
                    assert!(
                        (f32::from(tsdf) - expected).abs() < 2.0,
                        "{tsdf} {expected}"
                    );
                    assert_eq!(f32::from(weight), 1.125 * WEIGHT_ONE);
                }
            }
        }
        assert!(n_mean > 10);
    }

    #[test]
    fn every_instruction_set_gives_the_same_bits() {
        let pose = crate::geometry::increment(&nalgebra::Vector6::new(
            0.02, -0.1, 0.3, 0.01, -0.004, 0.02,
        ));
        let mut pixels = plane_at(0.5, 1.0);
        for (pixel, observed) in pixels.iter_mut().enumerate().take(N_PIXELS) {
            let bump = ((pixel * 2_654_435_761) % 1000) as f32 * 1e-5;
            *observed = observation(
                depth_step(),
                0.48 + bump,
                0.3 + 20.0 * bump,
                0.4 + 30.0 * bump,
            );
        }
        let fused = |arch: Arch| {
            let mut volume = volume();
            for _ in 0..3 {
                fuse(arch, &mut volume, &pixels, &pose);
            }
            let blocks = volume.blocks().iter();
            blocks
                .map(|block| (block.tsdf, block.weight))
                .collect::<Vec<_>>()
        };
        let expected = fused(Arch::Scalar);
        assert!(
            expected
                .iter()
                .flat_map(|(_, weight)| weight)
                .any(|&weight| weight > 0)
        );
        assert!(
            arch_levels()
                .into_iter()
                .all(|arch| fused(arch) == expected)
        );
    }
}
