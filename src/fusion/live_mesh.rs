//! The surface while the scan goes on: one patch for each block, extracted again only where the block has changed.
//!
//! A patch is the surface in a block's cubes: see [`SurfacePatch`]. The cubes reach one voxel into the blocks above, so
//! that a changed block changes its own patch and those of the seven blocks below it. All patches together are the triangles
//! of [`Fusion::mesh`], to the last bit; only the vertices on the patches' rims are there more than once.
//!
//! Patches may be brought up to the model in rounds, a part at a time, with frames fused in between. A patch is of one state of
//! the model, that at its own part; the rims of two parts may lie apart by what the frames in between moved them, on the same
//! edges of the lattice. Whatever they changed is extracted again in the next round, so that the first round without frames leaves
//! nothing apart.

use super::Fusion;
use super::block_masks::{Octant, TASK_BLOCKS, Voxels, blocks_above, blocks_below};
use super::fused_volume::FusedVolume;
use super::surface_patch::{Renewal, SurfacePatch};
use super::volume::TsdfVolume;
use crate::geometry::TriMesh;
use rayon::prelude::*;

/// The patches of a model, as they were when it was looked at last.
#[derive(Clone, Default)]
pub struct LiveMesh {
    patches: Vec<SurfacePatch>,
    voxels: Vec<Voxels>,
    /// The frame after which each block's voxels were read.
    read_after: Vec<u32>,
    /// Patches that the round has still to extract, in rising order.
    waiting: Vec<u32>,
    /// Which volume it is of, and the frame after which the round began: see [`Fusion`].
    volume_number: usize,
    frame: u32,
}

impl LiveMesh {
    /// A patch for each block of the volume, in the order in which they were allocated; empty where there is no surface.
    pub fn patches(&self) -> &[SurfacePatch] {
        &self.patches
    }

    /// Whether a round has begun and not ended.
    pub fn is_under_way(&self) -> bool {
        !self.waiting.is_empty()
    }

    /// All patches in one mesh, world frame.
    pub fn mesh(&self) -> TriMesh {
        let mut mesh = TriMesh::default();
        for SurfacePatch { mesh: patch, .. } in &self.patches {
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
        self.begin_round(live);
        self.extract_waiting(live, usize::MAX)
    }

    /// A part of [`Self::refresh`], for which frames do not have to wait: extracts at most `max_patches` of the patches that
    /// were behind the model when the round began, and begins one where none is under way. The round has ended when the mesh is
    /// under way no more.
    pub fn refresh_part(&self, live: &mut LiveMesh, max_patches: usize) -> Vec<u32> {
        if !live.is_under_way() || live.volume_number != self.volume_number {
            self.begin_round(live);
        }
        self.extract_waiting(live, max_patches)
    }

    /// Finds the patches that are behind the model.
    fn begin_round(&self, live: &mut LiveMesh) {
        if live.volume_number != self.volume_number {
            *live = LiveMesh::default();
        }
        let FusedVolume { volume, band } = &self.fused;
        let changed = band.touched_since(live.frame);
        live.waiting = affected(volume, changed, &live.waiting);
        live.frame = band.frame();
        live.volume_number = self.volume_number;
    }

    /// Extracts the first patches of those that wait, at most so many.
    fn extract_waiting(&self, live: &mut LiveMesh, max_patches: usize) -> Vec<u32> {
        let volume = &self.fused.volume;
        let n_patches = live.waiting.len().min(max_patches);
        let blocks: Vec<u32> = live.waiting.drain(..n_patches).collect();
        live.patches
            .resize(volume.blocks().len(), SurfacePatch::default());
        let coords = volume.coords();
        let above: Vec<Octant> = blocks
            .iter()
            .map(|&block| blocks_above(volume, coords[block as usize]))
            .collect();
        self.read(live, &above);
        let mut patches: Vec<SurfacePatch> = blocks
            .iter()
            .map(|&block| std::mem::take(&mut live.patches[block as usize]))
            .collect();
        let tasks = patches.par_chunks_mut(TASK_BLOCKS);
        let tasks = tasks.zip(above.par_chunks(TASK_BLOCKS));
        tasks.for_each(|(patches, above)| {
            self.eye.arch.dispatch(Renewal {
                volume,
                voxels: &live.voxels,
                patches,
                above,
            });
        });
        for (&block, patch) in blocks.iter().zip(patches) {
            live.patches[block as usize] = patch;
        }
        blocks
    }

    /// Reads the voxels that the cubes of some blocks reach, as far as frames have changed them since they were read.
    fn read(&self, live: &mut LiveMesh, above: &[Octant]) {
        let FusedVolume { volume, band } = &self.fused;
        let n_blocks = volume.blocks().len();
        live.voxels.resize(n_blocks, Voxels::default());
        live.read_after.resize(n_blocks, 0);
        let mut changed = Vec::new();
        for &block in above.as_flattened() {
            // Where there is no block the number lies beyond all blocks.
            if let Some(read_after) = live.read_after.get_mut(block as usize)
                && *read_after < band.touched_in(block)
            {
                *read_after = band.frame();
                changed.push(block);
            }
        }
        let min_weight = self.params.surface_weight();
        let voxels = Voxels::of_blocks(self.eye.arch, volume, &changed, min_weight);
        for (&block, voxels) in changed.iter().zip(voxels) {
            live.voxels[block as usize] = voxels;
        }
    }
}

/// The blocks whose cubes have a corner in one of the changed blocks, and those that wait, in rising order.
fn affected(volume: &TsdfVolume, changed: impl Iterator<Item = u32>, waiting: &[u32]) -> Vec<u32> {
    let mut is_affected = vec![false; volume.blocks().len()];
    for &block in waiting {
        is_affected[block as usize] = true;
    }
    for block in changed {
        for below in blocks_below(volume, volume.coords()[block as usize]) {
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

    /// Goes on in parts of so many patches until nothing is behind the model.
    fn catch_up(fusion: &Fusion, live: &mut LiveMesh, max_patches: usize) {
        while !fusion.refresh_part(live, max_patches).is_empty() {}
    }

    #[test]
    fn parts_between_frames_end_as_the_mesh_made_at_once() {
        let (frames, _, camera) = frames(9);
        let params = FusionParams {
            min_surface_weight: 1.0,
            ..small_params()
        };
        for max_patches in [1, 60, 400] {
            let noise = DepthNoise::of_sensor(Sensor::Kinect2);
            let mut fusion = Fusion::new(camera, noise, params.clone());
            let (mut live, mut n_cut_short) = (LiveMesh::default(), 0);
            for (index, frame) in frames.iter().enumerate() {
                let depth = frame.depth.as_ref().expect("Kinect II");
                fusion.fuse(depth, frame.device_time_secs);
                let part = fusion.refresh_part(&mut live, max_patches);
                assert!(part.len() <= max_patches && part.is_sorted());
                n_cut_short += usize::from(live.is_under_way());
                if index == 6 {
                    // Frames are taken back while a round is under way.
                    let cut = 0.5 * (frames[4].device_time_secs + frames[5].device_time_secs);
                    assert!(live.is_under_way() && fusion.take_back(cut, &|_| {}));
                }
            }
            assert!(n_cut_short > 5, "{n_cut_short}");
            // A round that is under way ends, and what was changed meanwhile is caught up with in the next.
            catch_up(&fusion, &mut live, max_patches);
            let mut at_once = LiveMesh::default();
            fusion.refresh(&mut at_once);
            assert!(
                live.patches() == at_once.patches(),
                "parts of {max_patches}"
            );
            assert!(triangles(&live.mesh()) == triangles(&fusion.mesh()));
            assert!(live.mesh().faces.len() > 10_000);
            // No patch holds the room of what it was.
            for SurfacePatch { mesh, rim } in live.patches() {
                let rooms = [
                    (mesh.vertices.capacity(), mesh.vertices.len()),
                    (mesh.faces.capacity(), mesh.faces.len()),
                    (rim.capacity(), rim.len()),
                ];
                assert!(
                    rooms.iter().all(|&(room, n)| room <= n + n / 4),
                    "{rooms:?}"
                );
            }
        }
    }

    #[test]
    fn what_waits_in_a_round_is_part_of_a_refresh_at_once() {
        let (frames, _, camera) = frames(3);
        let noise = DepthNoise::of_sensor(Sensor::Kinect2);
        let mut fusion = Fusion::new(camera, noise, small_params());
        let mut live = LiveMesh::default();
        for frame in &frames {
            let depth = frame.depth.as_ref().expect("Kinect II");
            fusion.fuse(depth, frame.device_time_secs);
        }
        fusion.refresh_part(&mut live, 10);
        assert!(live.is_under_way());
        fusion.refresh(&mut live);
        assert!(!live.is_under_way());
        assert!(triangles(&live.mesh()) == triangles(&fusion.mesh()));
    }
}
