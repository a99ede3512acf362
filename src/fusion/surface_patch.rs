//! A patch of surface: that in the cubes of one block, with vertices of its own.
//!
//! Two patches meet in the vertices on their rims. Such a vertex has its place on an edge between two voxels that both patches
//! know by the same [`LatticeEdge`], even where they were extracted at different times and have it in different places.

use super::block::{BLOCK_SIDE, BlockCoord};
use super::block_masks::{Corners, NOTHING, Octant, Voxels, bits};
use super::cube_cases::{EDGE_SLOTS, N_SLOTS, cases, slot};
use super::marching_cubes::{edge_low, place_on_edge};
use super::volume::TsdfVolume;
use crate::geometry::TriMesh;
use pulp::{Simd, WithSimd};

/// The surface in the cubes of one block.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct SurfacePatch {
    /// Vertices, world frame (m), and faces.
    pub mesh: TriMesh,
    /// Which of the vertices other patches may have too, in rising order, each with its edge.
    pub rim: Vec<(u32, LatticeEdge)>,
}

/// An edge between two voxels of the volume that are neighbours.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub struct LatticeEdge(u64);

impl LatticeEdge {
    /// The edge along `axis` from voxel `low` of the block at `coord`, or of the layer above it.
    #[inline(always)]
    fn new(coord: BlockCoord, axis: usize, low: [usize; 3]) -> Self {
        let voxel = |k: usize| coord[k] * BLOCK_SIDE + low[k] as i32;
        LatticeEdge::of_voxel([0, 1, 2].map(voxel), axis)
    }

    /// The edge along `axis` from a voxel.
    #[inline(always)]
    pub(crate) fn of_voxel(voxel: [i32; 3], axis: usize) -> Self {
        // A volume is 8192 voxels wide.
        let bits = |c: i32| u64::from(c as u16);
        let [x, y, z] = voxel.map(bits);
        LatticeEdge(x | y << 16 | z << 32 | (axis as u64) << 48)
    }
}

/// Whether cubes of other blocks have an edge too.
#[inline(always)]
fn is_on_rim(axis: usize, low: [usize; 3]) -> bool {
    let side = BLOCK_SIDE as usize;
    (0..3).any(|k| k != axis && (low[k] == 0 || low[k] == side))
}

/// No vertex on an edge yet.
const UNPLACED: u16 = u16::MAX;

/// Extracts the patches of some blocks anew.
pub struct Renewal<'a> {
    /// The volume.
    pub volume: &'a TsdfVolume,
    /// The voxels of all blocks, as they are now in the blocks and above them.
    pub voxels: &'a [Voxels],
    /// What the patches were, to be replaced.
    pub patches: &'a mut [SurfacePatch],
    /// The block of each, and those above it.
    pub above: &'a [Octant],
}

impl WithSimd for Renewal<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, _: S) {
        let mut extraction = Extraction::new(self.volume, self.voxels);
        for (patch, above) in self.patches.iter_mut().zip(self.above) {
            extraction.renew(patch, above);
        }
    }
}

/// Extracts one patch after the other.
struct Extraction<'a> {
    volume: &'a TsdfVolume,
    voxels: &'a [Voxels],
    /// The patch's vertex on each edge, [`UNPLACED`] between two patches.
    vertex_of: [u16; N_SLOTS],
    /// The edges that have one.
    placed: Vec<u16>,
}

impl<'a> Extraction<'a> {
    fn new(volume: &'a TsdfVolume, voxels: &'a [Voxels]) -> Self {
        Extraction {
            volume,
            voxels,
            vertex_of: [UNPLACED; N_SLOTS],
            placed: Vec::new(),
        }
    }

    /// Puts the surface in a block's cubes in the place of what the patch was, with the room that it needs.
    #[inline(always)]
    fn renew(&mut self, patch: &mut SurfacePatch, above: &Octant) {
        self.extract(patch, above);
        fit(&mut patch.mesh.vertices);
        fit(&mut patch.mesh.faces);
        fit(&mut patch.rim);
    }

    #[inline(always)]
    fn extract(&mut self, patch: &mut SurfacePatch, above: &Octant) {
        let SurfacePatch { mesh: patch, rim } = patch;
        patch.vertices.clear();
        patch.faces.clear();
        rim.clear();
        let coord = self.volume.coords()[above[0] as usize];
        let corners = Corners::of(self.voxels, above);
        let cubes = corners.crossed_cubes(self.voxels, above);
        if cubes == NOTHING {
            return;
        }
        let cases = cases();
        for (z, &word) in cubes.iter().enumerate() {
            for bit in bits(word) {
                let low = [bit & 7, bit >> 3, z];
                for triangle in cases[corners.pattern(z, bit) as usize].triangles() {
                    let mut face = [0; 3];
                    for (vertex, &edge) in face.iter_mut().zip(triangle) {
                        let slot = slot(0, low) + EDGE_SLOTS[edge as usize] as usize;
                        let known = &mut self.vertex_of[slot];
                        if *known == UNPLACED {
                            let (axis, low) = (edge as usize / 4, edge_low(low, edge));
                            *known = patch.vertices.len() as u16;
                            self.placed.push(slot as u16);
                            if is_on_rim(axis, low) {
                                let vertex = patch.vertices.len() as u32;
                                rim.push((vertex, LatticeEdge::new(coord, axis, low)));
                            }
                            let place = place_on_edge(self.volume, coord, above, axis, low);
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

/// Gives back room for more than a quarter of what is there, but for an eighth: thousands of patches would each stay as large
/// as they ever were, and a scan of hours would grow.
fn fit<T>(values: &mut Vec<T>) {
    if values.capacity() > values.len() + values.len() / 4 {
        values.shrink_to(values.len() + values.len() / 8);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::fusion::block_masks::blocks_above;
    use crate::fusion::marching_cubes::marching_cubes;
    use crate::fusion::sampling::tests::volume_of;
    use pulp::Arch;
    use std::collections::HashMap;

    #[test]
    fn patches_meet_in_the_vertices_on_the_same_edges_and_nowhere_else() {
        let volume = volume_of(0.01, |x, y, z| (x * x + y * y).sqrt() - 0.02013 + 0.31 * z);
        let blocks: Vec<u32> = (0..volume.blocks().len() as u32).collect();
        let arch = Arch::new();
        let voxels = Voxels::of_blocks(arch, &volume, &blocks, 1.0);
        let coords = volume.coords().iter();
        let above: Vec<Octant> = coords.map(|coord| blocks_above(&volume, *coord)).collect();
        let mut patches = vec![SurfacePatch::default(); blocks.len()];
        arch.dispatch(Renewal {
            volume: &volume,
            voxels: &voxels,
            patches: &mut patches,
            above: &above,
        });
        let (mut place_of, mut n_shared) = (HashMap::new(), 0);
        let mut n_vertices = 0;
        for SurfacePatch { mesh, rim } in &patches {
            assert!(rim.is_sorted_by_key(|(vertex, _)| *vertex));
            n_vertices += mesh.vertices.len() - rim.len();
            for (vertex, edge) in rim {
                let place = mesh.vertices[*vertex as usize];
                let known = place_of.insert(*edge, place);
                n_shared += usize::from(known.is_some());
                assert!(known.is_none_or(|known| known == place), "{edge:?}");
            }
        }
        assert!(n_shared > 100, "{n_shared}");
        let whole = marching_cubes(arch, &volume, 1.0);
        assert_eq!(n_vertices + place_of.len(), whole.vertices.len());
    }
}
