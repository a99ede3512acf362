//! Fusing a frame into the blocks that it touches (Curless and Levoy 1996).
//!
//! A voxel takes the measurement of the pixel nearest to it. Voxels of a slab of 8×8 go through each step together, so that
//! the steps are loops over arrays.

use super::lens::{Lens, round_bits};
use super::observe::{Observation, SLOPE_ONE};
use super::volume::{BLOCK_SIDE, Block, BlockCoord, TSDF_ONE, TsdfVolume};
use crate::geometry::Pose;
use nalgebra::{Matrix3, Vector3};
use pulp::{Arch, Simd, WithSimd};

/// Voxels of one slab of a block.
const SLAB: usize = (BLOCK_SIDE * BLOCK_SIDE) as usize;
/// Blocks that one task updates.
const TASK_BLOCKS: usize = 128;

/// Updates the touched blocks, given in rising order, by the observations of one frame.
pub fn integrate(
    arch: Arch,
    volume: &mut TsdfVolume,
    touched: &[u32],
    observations: &[Observation],
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

/// The voxel grid as a camera sees it.
#[derive(Clone, Debug)]
pub struct View {
    lens: Lens,
    inv_truncation: f32,
    /// World origin in the camera frame, metres.
    origin: Vector3<f64>,
    /// Columns are the steps from voxel to voxel along the world's axes, in the camera frame, metres.
    axes: Matrix3<f64>,
    /// Places of a slab's voxels from its first one, x, y and z in the camera frame, metres.
    slab: [[f32; SLAB]; 3],
}

impl View {
    /// The grid of a volume from a pose.
    pub fn new(volume: &TsdfVolume, lens: Lens, world_from_camera: &Pose) -> Self {
        let camera_from_world = world_from_camera.inverse();
        let rotation = camera_from_world.rotation.to_rotation_matrix();
        let axes = rotation.matrix() * f64::from(volume.voxel_size_m());
        let place = |voxel: usize, axis: usize| {
            let (x, y) = ((voxel % 8) as f64, (voxel / 8) as f64);
            (axes[(axis, 0)] * x + axes[(axis, 1)] * y) as f32
        };
        View {
            lens,
            inv_truncation: 1.0 / volume.truncation_m(),
            origin: camera_from_world.translation.vector,
            slab: std::array::from_fn(|axis| std::array::from_fn(|voxel| place(voxel, axis))),
            axes,
        }
    }

    /// Place of a slab's first voxel in the camera frame, metres.
    #[inline(always)]
    fn corner(&self, coord: BlockCoord, slab: usize) -> [f32; 3] {
        let [x, y, z] = coord.map(|c| f64::from(c * BLOCK_SIDE));
        let place = self.origin + self.axes * Vector3::new(x, y, z + slab as f64);
        [place.x as f32, place.y as f32, place.z as f32]
    }
}

struct UpdateBlocks<'a> {
    /// Blocks from index `first` on.
    blocks: &'a mut [Block],
    first: u32,
    touched: &'a [u32],
    coords: &'a [BlockCoord],
    observations: &'a [Observation],
    view: &'a View,
}

impl WithSimd for UpdateBlocks<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, _: S) {
        for &index in self.touched {
            let block = &mut self.blocks[(index - self.first) as usize];
            let coord = self.coords[index as usize];
            let tsdf = block.tsdf.as_chunks_mut::<SLAB>().0;
            let weights = block.weight.as_chunks_mut::<SLAB>().0;
            for (slab, (tsdf, weights)) in tsdf.iter_mut().zip(weights).enumerate() {
                let corner = self.view.corner(coord, slab);
                let (pixels, depth) = project(self.view, corner);
                let mut seen = [0; SLAB];
                for (seen, &pixel) in seen.iter_mut().zip(&pixels) {
                    *seen = self.observations[pixel as usize];
                }
                let measured = measure(self.view, &seen, &depth);
                if measured.any {
                    blend(&measured, tsdf, weights);
                }
            }
        }
    }
}

/// Pixel and depth (m) of a slab's voxels.
#[inline(always)]
fn project(view: &View, corner: [f32; 3]) -> ([u32; SLAB], [f32; SLAB]) {
    let (mut pixels, mut depth) = ([0; SLAB], [0.0; SLAB]);
    for voxel in 0..SLAB {
        let point = [0, 1, 2].map(|axis| corner[axis] + view.slab[axis][voxel]);
        pixels[voxel] = view.lens.pixel_index(point);
        depth[voxel] = point[2];
    }
    (pixels, depth)
}

/// What a slab's voxels are told: distances in units of the volume, and weights; 0 is no measurement.
struct Measured {
    distance: [f32; SLAB],
    weight: [f32; SLAB],
    any: bool,
}

/// Turns observations into distances; voxels hidden behind the band get none.
#[inline(always)]
fn measure(view: &View, seen: &[Observation; SLAB], depth: &[f32; SLAB]) -> Measured {
    let scale = view.inv_truncation / SLOPE_ONE;
    let (mut distance, mut weight, mut any) = ([0.0; SLAB], [0.0; SLAB], 0);
    for voxel in 0..SLAB {
        let measured = f32::from_bits(seen[voxel] as u32);
        let packed = (seen[voxel] >> 32) as u32;
        let slope = (packed >> 16) as i32 as f32 * scale;
        let truncations = (measured - depth[voxel]) * slope;
        let counts = (measured > 0.0) & (truncations >= -1.0);
        let cut = if truncations < 1.0 { truncations } else { 1.0 };
        distance[voxel] = if counts { cut * TSDF_ONE } else { 0.0 };
        weight[voxel] = if counts {
            (packed & 0xFFFF) as i32 as f32
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

/// Adds measurements to the running means of a slab.
#[inline(always)]
fn blend(measured: &Measured, tsdf: &mut [i16; SLAB], weights: &mut [u16; SLAB]) {
    for voxel in 0..SLAB {
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
    use crate::fusion::arch_levels;
    use crate::fusion::observe::observation;
    use crate::fusion::volume::{UNSEEN, WEIGHT_ONE};
    use crate::geometry::CameraModel;
    use crate::geometry::camera::tests::distorted_camera;

    const N_PIXELS: usize = 512 * 424;

    fn plane_at(depth_m: f32, weight: f32) -> Vec<Observation> {
        let mut pixels = vec![observation(depth_m, weight, 1.0); N_PIXELS];
        pixels.push(0);
        pixels
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
        let touched: Vec<u32> = (0..volume.coords().len() as u32).collect();
        integrate(arch, volume, &touched, pixels, &view);
    }

    #[test]
    fn the_mean_of_measurements_is_weighted_and_hidden_voxels_stay_unseen() {
        let mut volume = volume();
        let pose = Pose::identity();
        fuse(Arch::new(), &mut volume, &plane_at(0.500, 1.0), &pose);
        fuse(Arch::new(), &mut volume, &plane_at(0.512, 0.5), &pose);
        let mut n_mean = 0;
        for (coord, block) in volume.coords().iter().zip(volume.blocks()) {
            for slab in 0..SLABS_OF_BLOCK {
                let z = (coord[2] * 8 + slab as i32) as f32 * 0.004;
                let (tsdf, weight) = (block.tsdf[slab * SLAB], block.weight[slab * SLAB]);
                if z > 0.533 {
                    assert_eq!((tsdf, weight), (UNSEEN, 0));
                } else if z > 0.497 && z < 0.518 {
                    n_mean += 1;
                    let expected = (0.504 - z) / 0.02 * TSDF_ONE;
                    assert!(
                        (f32::from(tsdf) - expected).abs() < 2.0,
                        "{tsdf} {expected}"
                    );
                    assert_eq!(f32::from(weight), 1.5 * WEIGHT_ONE);
                }
            }
        }
        assert!(n_mean > 10);
    }

    const SLABS_OF_BLOCK: usize = BLOCK_SIDE as usize;

    #[test]
    fn every_instruction_set_gives_the_same_bits() {
        let pose = crate::geometry::increment(&nalgebra::Vector6::new(
            0.02, -0.1, 0.3, 0.01, -0.004, 0.02,
        ));
        let mut pixels = plane_at(0.5, 1.0);
        for (pixel, observed) in pixels.iter_mut().enumerate().take(N_PIXELS) {
            let bump = ((pixel * 2_654_435_761) % 1000) as f32 * 1e-5;
            *observed = observation(0.48 + bump, 0.3 + 20.0 * bump, 0.4 + 30.0 * bump);
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
