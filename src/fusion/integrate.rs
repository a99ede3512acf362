//! Fusing a depth image into the volume (Curless and Levoy 1996), in the blocks along the truncation band.

use super::noise::DepthNoise;
use super::preprocess::VertexMap;
use super::volume::{BLOCK_SIDE, Block, BlockCoord, TSDF_ONE, TsdfVolume, WEIGHT_ONE, voxel_index};
use crate::geometry::{CameraModel, Pose, RayGrid};
use depth_camera::Image;
use nalgebra::{Point3, Vector3};
use rayon::prelude::*;

/// One pixel as the volume takes it.
#[derive(Clone, Copy, Debug, Default)]
pub struct Observation {
    /// Measured depth, metres; 0 is none.
    depth_m: f32,
    /// Weight of the measurement, 1 at normal incidence at the reference depth.
    weight: f32,
    /// `n·(x, y, 1)` with the ray of the pixel: turns a difference along the optical axis into a distance to the surface.
    slope: f32,
}

/// Depth at which a frontal measurement has weight 1: object scale.
const REFERENCE_DEPTH_M: f32 = 0.6;
/// Weight of a pixel without a normal, on a rim, where depth is least reliable; arbitrary.
const RIM_WEIGHT: f32 = 0.1;
/// A difference along the axis never counts for less than this share of itself (surfaces steeper than 75°).
const MIN_SLOPE: f32 = 0.25;

/// Weighs every pixel of a clipped depth image by noise, (σ(0.6 m)/σ(z))², and by incidence.
pub fn observe(depth: &Image<f32>, map: &VertexMap, noise: &DepthNoise) -> Image<Observation> {
    let reference = noise.sigma_m(REFERENCE_DEPTH_M);
    let data = depth
        .data()
        .par_iter()
        .zip(map.points.data())
        .zip(map.normals.data())
        .map(|((&depth_m, point), normal)| {
            if depth_m <= 0.0 || point.z <= 0.0 {
                return Observation::default();
            }
            let ratio = reference / noise.sigma_m(depth_m);
            let ray = point / point.z;
            let slope = -normal.dot(&ray);
            if slope <= 0.0 {
                let weight = RIM_WEIGHT * ratio * ratio;
                return Observation {
                    depth_m,
                    weight,
                    slope: 1.0,
                };
            }
            let cosine = slope / ray.norm();
            Observation {
                depth_m,
                weight: (cosine * ratio * ratio).max(1.0 / WEIGHT_ONE),
                slope: slope.max(MIN_SLOPE),
            }
        })
        .collect();
    Image::from_vec(depth.width(), depth.height(), data)
}

/// The blocks within the truncation band of an image, sorted.
pub fn blocks_in_band(
    volume: &TsdfVolume,
    observations: &Image<Observation>,
    rays: &RayGrid,
    world_from_camera: &Pose,
) -> Vec<BlockCoord> {
    /// Rows of a tile; every second row and column is looked at.
    const TILE_ROWS: usize = 16;
    let rotation = world_from_camera
        .rotation
        .to_rotation_matrix()
        .matrix()
        .cast::<f32>();
    let translation = world_from_camera.translation.vector.cast::<f32>();
    let n_tiles = observations.height().div_ceil(TILE_ROWS);
    let tiles: Vec<Vec<u64>> = (0..n_tiles)
        .into_par_iter()
        .map(|tile| {
            let mut seen = RecentKeys::new();
            let rows = tile * TILE_ROWS..((tile + 1) * TILE_ROWS).min(observations.height());
            for v in rows.step_by(2) {
                for u in (0..observations.width()).step_by(2) {
                    let depth = observations.at(u, v).depth_m;
                    if depth <= 0.0 {
                        continue;
                    }
                    let direction = rotation * rays.direction(u, v);
                    mark_band(volume, &translation, &direction, depth, &mut seen);
                }
            }
            seen.keys
        })
        .collect();
    let mut keys: Vec<u64> = tiles.into_iter().flatten().collect();
    keys.par_sort_unstable();
    keys.dedup();
    keys.into_iter().map(coord_of_key).collect()
}

/// Marks the blocks that a ray crosses from `depth` less the truncation distance to `depth` plus it.
fn mark_band(
    volume: &TsdfVolume,
    origin: &Vector3<f32>,
    direction: &Vector3<f32>,
    depth: f32,
    seen: &mut RecentKeys,
) {
    let length = direction.norm();
    let band = volume.truncation_m() / length;
    // Steps of half a block's side cannot jump a block by more than a corner.
    let n_steps =
        (4.0 * volume.truncation_m() / (volume.voxel_size_m() * BLOCK_SIDE as f32)).ceil();
    for step in 0..=n_steps as usize {
        let z = depth + band * (2.0 * step as f32 / n_steps - 1.0);
        let coord = volume.block_of(&(origin + direction * z));
        if TsdfVolume::in_bounds(coord) {
            seen.push(key_of_coord(coord));
        }
    }
}

/// Keys without most of their repetitions: a direct-mapped cache of those seen lately.
struct RecentKeys {
    keys: Vec<u64>,
    cache: [u64; 1024],
}

impl RecentKeys {
    fn new() -> Self {
        RecentKeys {
            keys: Vec::new(),
            cache: [u64::MAX; 1024],
        }
    }

    fn push(&mut self, key: u64) {
        let slot = &mut self.cache[(key.wrapping_mul(0x9E37_79B9_7F4A_7C15) >> 54) as usize];
        if *slot != key {
            *slot = key;
            self.keys.push(key);
        }
    }
}

/// Bias that makes block coordinates positive.
const KEY_BIAS: i32 = 1 << 20;

fn key_of_coord(coord: BlockCoord) -> u64 {
    coord
        .iter()
        .rev()
        .fold(0, |key, &c| (key << 21) | (c + KEY_BIAS) as u64)
}

fn coord_of_key(key: u64) -> BlockCoord {
    [0, 1, 2].map(|axis| ((key >> (21 * axis)) & 0x1F_FFFF) as i32 - KEY_BIAS)
}

/// Allocates and updates the given blocks; blocks beyond the volume's border are left out and counted.
pub fn integrate(
    volume: &mut TsdfVolume,
    band: &[BlockCoord],
    observations: &Image<Observation>,
    camera: &CameraModel,
    world_from_camera: &Pose,
) -> usize {
    let mut touched = Vec::with_capacity(band.len());
    for &coord in band {
        touched.extend(volume.allocate(coord));
    }
    let n_outside = band.len() - touched.len();
    let mut is_touched = vec![false; volume.blocks().len()];
    for &index in &touched {
        is_touched[index] = true;
    }
    let camera_from_world = world_from_camera.inverse();
    let grid = Grid {
        voxel_size_m: volume.voxel_size_m(),
        truncation_m: volume.truncation_m(),
        camera,
        origin: camera_from_world.translation.vector,
        axes: *camera_from_world.rotation.to_rotation_matrix().matrix()
            * volume.voxel_size_m() as f64,
    };
    let (coords, blocks) = volume.blocks_mut();
    blocks
        .par_iter_mut()
        .zip(coords)
        .zip(&is_touched)
        .filter(|(_, touched)| **touched)
        .for_each(|((block, coord), _)| grid.update(block, *coord, observations));
    n_outside
}

/// The voxel grid seen from the camera.
struct Grid<'a> {
    voxel_size_m: f32,
    truncation_m: f32,
    camera: &'a CameraModel,
    /// World origin in the camera frame, metres.
    origin: Vector3<f64>,
    /// Columns are the steps from voxel to voxel along the world's axes, in the camera frame, metres.
    axes: nalgebra::Matrix3<f64>,
}

impl Grid<'_> {
    /// Running weighted mean of distance in every voxel that the image sees in front of the band's back.
    fn update(&self, block: &mut Block, coord: BlockCoord, observations: &Image<Observation>) {
        let first = coord.map(|c| (c * BLOCK_SIDE) as f64);
        let corner = self.origin + self.axes * Vector3::from(first);
        for z in 0..BLOCK_SIDE {
            for y in 0..BLOCK_SIDE {
                let row = corner + self.axes.column(1) * y as f64 + self.axes.column(2) * z as f64;
                for x in 0..BLOCK_SIDE {
                    let point = Point3::from(row + self.axes.column(0) * x as f64);
                    let Some((distance, weight)) = self.measure(&point, observations) else {
                        continue;
                    };
                    blend(block, voxel_index([x, y, z]), distance, weight);
                }
            }
        }
    }

    /// Distance to the measured surface in truncations, and its weight; `None` where hidden or not measured.
    fn measure(
        &self,
        point: &Point3<f64>,
        observations: &Image<Observation>,
    ) -> Option<(f32, f32)> {
        let pixel = self.camera.project(point)?;
        if !self.camera.contains(&pixel, 0.0) {
            return None;
        }
        let observation = observations.at((pixel.x + 0.5) as usize, (pixel.y + 0.5) as usize);
        if observation.depth_m <= 0.0 {
            return None;
        }
        let z = point.z as f32;
        let nearest = (observation.depth_m - z) * observation.slope / self.truncation_m;
        if nearest < -1.0 {
            return None;
        }
        if nearest > 1.0 + self.voxel_size_m / self.truncation_m {
            return Some((1.0, observation.weight));
        }
        let depth = interpolate(
            observations,
            pixel.x as f32,
            pixel.y as f32,
            observation.depth_m,
        );
        let distance = (depth - z) * observation.slope / self.truncation_m;
        (distance >= -1.0).then_some((distance.min(1.0), observation.weight))
    }
}

/// Depth between pixels, bilinear where all four lie on the surface of the nearest pixel; else that pixel's.
fn interpolate(observations: &Image<Observation>, u: f32, v: f32, nearest: f32) -> f32 {
    /// Beyond this share of its depth a neighbour is another surface: 45° at a focal length of 365 pixels, fivefold.
    const SAME_SURFACE: f32 = 0.014;
    let (u0, v0) = (u as usize, v as usize);
    if u0 + 1 >= observations.width() || v0 + 1 >= observations.height() {
        return nearest;
    }
    let (fu, fv) = (u - u0 as f32, v - v0 as f32);
    let four =
        [(0, 0), (1, 0), (0, 1), (1, 1)].map(|(du, dv)| observations.at(u0 + du, v0 + dv).depth_m);
    if four
        .iter()
        .any(|z| (z - nearest).abs() > SAME_SURFACE * nearest)
    {
        return nearest;
    }
    let top = four[0] + (four[1] - four[0]) * fu;
    let bottom = four[2] + (four[3] - four[2]) * fu;
    top + (bottom - top) * fv
}

/// Adds one measurement to a voxel's running mean.
fn blend(block: &mut Block, index: usize, distance: f32, weight: f32) {
    let old_weight = block.weight[index] as f32;
    let added = (weight * WEIGHT_ONE).max(1.0);
    let old = block.tsdf[index] as f32;
    let mean = old + (distance * TSDF_ONE - old) * (added / (old_weight + added));
    // Rounds to nearest without a call into the mathematics library: the shifted value is positive.
    block.tsdf[index] =
        ((mean.clamp(-TSDF_ONE, TSDF_ONE) + (TSDF_ONE + 0.5)) as i32 - TSDF_ONE as i32) as i16;
    block.weight[index] = (old_weight + added).min(u16::MAX as f32) as u16;
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn keys_are_the_coordinates() {
        for coord in [[0, 0, 0], [-512, 511, -1], [17, -300, 256]] {
            assert_eq!(coord_of_key(key_of_coord(coord)), coord);
        }
    }

    #[test]
    fn the_mean_of_measurements_is_weighted() {
        let mut block = Block {
            tsdf: [i16::MAX; 512],
            weight: [0; 512],
        };
        blend(&mut block, 5, 0.5, 1.0);
        blend(&mut block, 5, -0.25, 0.5);
        assert!((block.tsdf[5] as f32 / TSDF_ONE - 0.25).abs() < 1e-4);
        assert_eq!(block.weight[5], 384);
    }
}
