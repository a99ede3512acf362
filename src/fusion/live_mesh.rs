//! The surface while the scan goes on: one patch for each block, extracted again only where the block has changed.
//!
//! A patch is the surface in a block's cubes, with vertices of its own. The cubes reach one voxel into the blocks above, so
//! that a changed block changes its own patch and those of the seven blocks below it. All patches together are the triangles
//! of [`Fusion::mesh`], to the last bit; only the vertices on the patches' rims are there more than once.

use super::Fusion;
use super::block::BLOCK_SIDE;
use super::block_masks::{Corners, Cubes, Neighbours, Voxels, bits};
use super::cube_cases::cases;
use super::each_block::{Reading, TASK_BLOCKS, each};
use super::marching_cubes::{edge_low, place_on_edge};
use super::volume::TsdfVolume;
use crate::geometry::TriMesh;
use pulp::{Simd, WithSimd};
use rayon::prelude::*;

/// The patches of a model, as they were when it was looked at last.
#[derive(Clone, Default)]
pub struct LiveMesh {
    patches: Vec<TriMesh>,
    voxels: Vec<Voxels>,
    /// Which volume it is of, and the frame that was fused last: see [`Fusion`].
    volume_number: usize,
    frame: u32,
}

impl LiveMesh {
    /// A patch for each block of the volume, in the order in which they were allocated; empty where there is no surface.
    pub fn patches(&self) -> &[TriMesh] {
        &self.patches
    }

    /// All patches in one mesh, world frame.
    pub fn mesh(&self) -> TriMesh {
        let mut mesh = TriMesh::default();
        for patch in &self.patches {
            let first = mesh.vertices.len() as u32;
            mesh.vertices.extend_from_slice(&patch.vertices);
            let faces = patch.faces.iter();
            mesh.faces
                .extend(faces.map(|face| face.map(|vertex| vertex + first)));
        }
        mesh
    }
}

impl Fusion {
    /// Brings the patches up to the model as it is; returns which of them were extracted again, in rising order. A mesh that
    /// was of another volume, such as that before loops were closed, is made anew.
    pub fn refresh(&self, live: &mut LiveMesh) -> Vec<u32> {
        if live.volume_number != self.volume_number {
            *live = LiveMesh::default();
        }
        let changed: Vec<u32> = self.band.touched_since(live.frame).collect();
        live.frame = self.band.frame();
        live.volume_number = self.volume_number;
        let n_blocks = self.volume.blocks().len();
        live.voxels.resize(n_blocks, Voxels::default());
        live.patches.resize(n_blocks, TriMesh::default());
        let arch = self.eye.arch;
        let reading = Reading {
            volume: &self.volume,
            blocks: &changed,
            min_weight: self.params.min_surface_weight as f32,
        };
        let voxels = each(arch, changed.len(), &reading);
        for (&block, voxels) in changed.iter().zip(voxels) {
            live.voxels[block as usize] = voxels;
        }
        let affected = affected(&self.volume, &changed);
        let mut patches: Vec<TriMesh> = affected
            .iter()
            .map(|&block| std::mem::take(&mut live.patches[block as usize]))
            .collect();
        let tasks = patches.par_chunks_mut(TASK_BLOCKS);
        let tasks = tasks.zip(affected.par_chunks(TASK_BLOCKS));
        tasks.for_each(|(patches, blocks)| {
            arch.dispatch(Renewal {
                volume: &self.volume,
                voxels: &live.voxels,
                patches,
                blocks,
            });
        });
        for (&block, patch) in affected.iter().zip(patches) {
            live.patches[block as usize] = patch;
        }
        affected
    }
}

/// The blocks whose cubes have a corner in one of the changed blocks, in rising order.
fn affected(volume: &TsdfVolume, changed: &[u32]) -> Vec<u32> {
    let mut is_affected = vec![false; volume.blocks().len()];
    for &block in changed {
        let around = Neighbours::of(volume, volume.coords()[block as usize]);
        for below in around.down {
            // Where there is no block the number lies beyond all blocks.
            if let Some(is_affected) = is_affected.get_mut(below as usize) {
                *is_affected = true;
            }
        }
    }
    let blocks = is_affected.iter().enumerate();
    blocks
        .filter(|(_, is_affected)| **is_affected)
        .map(|(block, _)| block as u32)
        .collect()
}

/// Voxels along a side that a block's cubes reach, and edges that begin at these.
const REACH: usize = BLOCK_SIDE as usize + 1;
const N_EDGES: usize = 3 * REACH * REACH * REACH;

/// No vertex on an edge yet.
const UNPLACED: u16 = u16::MAX;

/// Extracts the patches of some blocks anew.
struct Renewal<'a> {
    volume: &'a TsdfVolume,
    voxels: &'a [Voxels],
    patches: &'a mut [TriMesh],
    blocks: &'a [u32],
}

impl WithSimd for Renewal<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, _: S) {
        let mut extraction = Extraction::new(self.volume, self.voxels);
        for (patch, &block) in self.patches.iter_mut().zip(self.blocks) {
            extraction.renew(patch, block as usize);
        }
    }
}

/// Extracts one patch after the other.
struct Extraction<'a> {
    volume: &'a TsdfVolume,
    voxels: &'a [Voxels],
    /// The patch's vertex on each edge, [`UNPLACED`] between two patches.
    vertex_of: [u16; N_EDGES],
    /// The edges that have one.
    placed: Vec<u16>,
}

impl<'a> Extraction<'a> {
    fn new(volume: &'a TsdfVolume, voxels: &'a [Voxels]) -> Self {
        Extraction {
            volume,
            voxels,
            vertex_of: [UNPLACED; N_EDGES],
            placed: Vec::new(),
        }
    }

    /// Puts the surface in a block's cubes in the place of what the patch was.
    #[inline(always)]
    fn renew(&mut self, patch: &mut TriMesh, block: usize) {
        patch.vertices.clear();
        patch.faces.clear();
        let coord = self.volume.coords()[block];
        let around = Neighbours::of(self.volume, coord);
        let cubes = Cubes::of(self.voxels, &around);
        if !cubes.any_crossed() {
            return;
        }
        let (corners, cases) = (Corners::of(self.voxels, &around), cases());
        for (z, &word) in cubes.crossed.iter().enumerate() {
            for bit in bits(word) {
                let low = [bit & 7, bit >> 3, z];
                for triangle in cases[corners.pattern(z, bit)].triangles() {
                    let mut face = [0; 3];
                    for (vertex, &edge) in face.iter_mut().zip(triangle) {
                        let (axis, low) = (edge as usize / 4, edge_low(low, edge));
                        let key = axis + 3 * (low[0] + REACH * (low[1] + REACH * low[2]));
                        let known = &mut self.vertex_of[key];
                        if *known == UNPLACED {
                            *known = patch.vertices.len() as u16;
                            self.placed.push(key as u16);
                            let place = place_on_edge(self.volume, coord, &around, axis, low);
                            patch.vertices.push(place);
                        }
                        *vertex = u32::from(*known);
                    }
                    patch.faces.push(face);
                }
            }
        }
        for edge in self.placed.drain(..) {
            self.vertex_of[edge as usize] = UNPLACED;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::fusion::tests::{frames, small_params};
    use crate::fusion::{DepthNoise, FusionParams};
    use depth_camera::Sensor;

    /// The triangles of a mesh by the bits of their places, each from its least corner on, in order.
    fn triangles(mesh: &TriMesh) -> Vec<[[u64; 3]; 3]> {
        let mut triangles: Vec<[[u64; 3]; 3]> = (0..mesh.faces.len())
            .map(|face| {
                let mut corners = mesh
                    .corners(face)
                    .map(|p| [p.x, p.y, p.z].map(f64::to_bits));
                let least = (0..3).min_by_key(|&corner| corners[corner]);
                corners.rotate_left(least.expect("three"));
                corners
            })
            .collect();
        triangles.sort_unstable();
        triangles
    }

    #[test]
    fn after_every_frame_the_patches_are_the_whole_mesh() {
        let (frames, _, camera) = frames(9);
        let params = FusionParams {
            min_surface_weight: 1.0,
            ..small_params()
        };
        let mut fusion = Fusion::new(camera, DepthNoise::of_sensor(Sensor::Kinect2), params);
        let mut live = LiveMesh::default();
        // Some refreshes have one frame to catch up with, others two.
        for (index, frame) in frames.iter().enumerate() {
            let depth = frame.depth.as_ref().expect("Kinect II");
            fusion.fuse(depth, frame.device_time_secs);
            if index % 3 == 1 {
                continue;
            }
            fusion.refresh(&mut live);
            assert!(
                triangles(&live.mesh()) == triangles(&fusion.mesh()),
                "frame {index}"
            );
        }
        assert!(live.mesh().faces.len() > 10_000);
        assert!(fusion.refresh(&mut live).is_empty(), "nothing has changed");
    }

    #[test]
    fn a_block_that_no_frame_touches_is_left_alone() {
        let (frames, truth, camera) = frames(1);
        let params = FusionParams {
            min_surface_weight: 0.5,
            ..small_params()
        };
        let mut fusion = Fusion::new(camera, DepthNoise::of_sensor(Sensor::Kinect2), params);
        let depth = frames[0].depth.as_ref().expect("Kinect II");
        let mut left = depth.clone();
        for row in left.data_mut().chunks_mut(depth.width()) {
            row[depth.width() / 4..].fill(0.0);
        }
        fusion.fuse_at(depth, 0.0, &truth[0]);
        let mut live = LiveMesh::default();
        let all = fusion.refresh(&mut live).len();
        fusion.fuse_at(&left, 0.1, &truth[0]);
        let again = fusion.refresh(&mut live).len();
        assert!(again > 0 && again * 2 < all, "{again} of {all}");
        assert!(triangles(&live.mesh()) == triangles(&fusion.mesh()));
    }
}
