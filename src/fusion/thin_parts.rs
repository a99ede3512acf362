//! Thin parts of a finished model: rims, leaves, handles.
//!
//! A view writes negative distances behind the surface that it sees, as far as the truncation distance. In a part thinner than
//! that they reach through to the other side, and push it outwards. The tracker wants a wide band nevertheless, and only a
//! wide one makes a single surface of views that disagree by millimetres. So the finished model is fused once more with a
//! narrow band, and holds that where two surfaces stand back to back.
//!
//! Not handled: what is thinner than the narrow band, and parts whose other side no view has seen.

use super::block::{BLOCK_SIDE, BRICK_SIDE, BRICK_VOXELS, BRICKS, Block, BlockCoord, UNSEEN};
use super::fused_volume::FusedVolume;
use super::improvement::{Counted, GoesOn, Work};
use super::volume::TsdfVolume;
use super::{Fusion, PoseCorrection, marching_cubes};
use crate::geometry::{PointGrid, TriMesh, cell_of, facing_side};
use nalgebra::{Point3, Vector3};
use std::collections::{HashMap, HashSet};
use std::ops::Range;

/// Surfaces whose normals have a smaller cosine than this face away from one another.
const OPPOSED: f64 = -0.3;
/// Surface of one direction in a brick counts from this share of the square of the brick's side; less is noise.
const MIN_AREA_SHARE: f64 = 0.25;
/// Surfaces back to back may be shifted against one another by so many sides of a brick.
const MAX_SHIFT_BRICKS: f64 = 1.5;

/// A brick of the whole volume, counted along each axis.
type BrickCoord = [i32; 3];

impl Fusion {
    /// At the end of a scan, when its poses are known as well as they will be: parts thinner than the truncation distance are
    /// fused anew with a narrow band, [`super::FusionParams::thin_truncation_voxels`]. `correction` is what the frames' poses
    /// were moved by since they were fused. How many bricks were replaced: 0, and nothing is changed, if there are no frames to
    /// fuse or no room for a second volume, or as soon as `goes_on` says no.
    ///
    /// Costs another fusing of all frames, and a second volume while it lasts.
    pub fn separate_thin_parts(&mut self, correction: &PoseCorrection, goes_on: &GoesOn) -> usize {
        let (frames, params) = (self.keyframes.frames(), &self.params);
        if frames.is_empty() || params.thin_truncation_voxels >= params.truncation_voxels {
            return 0;
        }
        let mut narrow = FusedVolume::untouched(params.thin_volume());
        let step = Counted::new(Work::SeparateThinParts, frames.len(), goes_on);
        let is_whole = narrow.fuse_again(frames, correction, &self.eye, &|| step.goes_on());
        if !is_whole || narrow.band.refused().n_over_budget > 0 {
            return 0;
        }
        let min_weight = params.surface_weight();
        let mesh = marching_cubes::marching_cubes(self.eye.arch, &narrow.volume, min_weight);
        let thin = bricks_of_thin_parts(&mesh, params.voxel_size_m, params.truncation_m());
        self.volume_number += usize::from(!thin.is_empty());
        replace(&mut self.fused.volume, &narrow.volume, &thin)
    }
}

/// Surface of about one direction in a brick.
struct Facet {
    brick: BrickCoord,
    centre: Point3<f64>,
    normal: Vector3<f64>,
}

/// The bricks of a mesh's parts that are thinner than `reach_m`, and those about them within that distance.
fn bricks_of_thin_parts(mesh: &TriMesh, voxel_size_m: f64, reach_m: f64) -> HashSet<BrickCoord> {
    let brick_m = voxel_size_m * BRICK_SIDE as f64;
    let facets = facets(mesh, brick_m);
    let max_shift_m = MAX_SHIFT_BRICKS * brick_m;
    let centres = facets.iter().map(|facet| facet.centre).collect();
    let grid = PointGrid::new(centres, reach_m.hypot(max_shift_m));
    let is_back_to_back = |facet: &Facet, other: &Facet| {
        let apart = facet.centre - other.centre;
        let thickness = apart.dot(&facet.normal);
        let shift = apart - thickness * facet.normal;
        facet.normal.dot(&other.normal) < OPPOSED
            && (0.0..reach_m).contains(&thickness)
            && shift.norm() < max_shift_m
    };
    let thin = facets.iter().filter(|facet| {
        grid.near(&facet.centre)
            .any(|other| is_back_to_back(facet, &facets[other]))
    });
    let reach = (reach_m / brick_m).ceil() as i32;
    thin.flat_map(|facet| around(facet.brick, reach)).collect()
}

/// What the faces of a facet add up to.
#[derive(Default)]
struct FacetSums {
    /// Area vectors, which are shorter together than one by one where the surface is curved.
    areas: Vector3<f64>,
    /// Lengths of the area vectors.
    weight: f64,
    /// Centres by these weights.
    moments: Vector3<f64>,
}

/// A mesh's surface by bricks and, within them, by the axis that it faces most.
fn facets(mesh: &TriMesh, brick_m: f64) -> Vec<Facet> {
    let mut sums: HashMap<(BrickCoord, usize), FacetSums> = HashMap::new();
    for face in 0..mesh.faces.len() {
        let (area, centre) = (mesh.face_normal(face), mesh.centroid(face));
        let weight = area.norm();
        let place = (cell_of(&centre, brick_m), facing_side(&area));
        let sums = sums.entry(place).or_default();
        sums.areas += area;
        sums.weight += weight;
        sums.moments += centre.coords * weight;
    }
    // Area vectors are twice the area long.
    let min_norm = 2.0 * MIN_AREA_SHARE * brick_m * brick_m;
    sums.into_iter()
        .filter(|(_, sums)| sums.areas.norm() > min_norm)
        .map(|((brick, _), sums)| Facet {
            brick,
            centre: Point3::from(sums.moments / sums.weight),
            normal: sums.areas / sums.areas.norm(),
        })
        .collect()
}

/// Replaces bricks of a volume by those of another one with the same voxels; how many.
fn replace(volume: &mut TsdfVolume, narrow: &TsdfVolume, bricks: &HashSet<BrickCoord>) -> usize {
    let scale = narrow.truncation_m() / volume.truncation_m();
    let (coords, blocks) = volume.blocks_mut();
    let mut n_replaced = 0;
    for (coord, block) in coords.iter().zip(blocks) {
        let source = narrow.find(*coord).map(|index| &narrow.blocks()[index]);
        let source = source.unwrap_or(&Block::EMPTY);
        let thin = (0..BRICKS).filter(|&brick| bricks.contains(&brick_coord(*coord, brick)));
        for brick in thin {
            copy_brick(
                block,
                source,
                brick * BRICK_VOXELS..(brick + 1) * BRICK_VOXELS,
                scale,
            );
            n_replaced += 1;
        }
    }
    n_replaced
}

/// Copies some voxels of a block into another one, whose distances have another unit.
fn copy_brick(block: &mut Block, source: &Block, voxels: Range<usize>, scale: f32) {
    block.weight[voxels.clone()].copy_from_slice(&source.weight[voxels.clone()]);
    let distances = block.tsdf[voxels.clone()].iter_mut();
    for (distance, &from) in distances.zip(&source.tsdf[voxels]) {
        *distance = match from {
            UNSEEN => UNSEEN,
            _ => (f32::from(from) * scale).round() as i16,
        };
    }
}

/// The bricks that are at most `reach` away along each axis.
fn around([x, y, z]: BrickCoord, reach: i32) -> impl Iterator<Item = BrickCoord> {
    let steps = move || -reach..=reach;
    let columns = steps().flat_map(move |i| steps().map(move |j| (x + i, y + j)));
    columns.flat_map(move |(x, y)| steps().map(move |k| [x, y, z + k]))
}

fn brick_coord(block: BlockCoord, brick: usize) -> BrickCoord {
    let bricks_a_side = BLOCK_SIDE / BRICK_SIDE as i32;
    std::array::from_fn(|axis| block[axis] * bricks_a_side + (brick >> axis & 1) as i32)
}

#[cfg(test)]
mod tests;
