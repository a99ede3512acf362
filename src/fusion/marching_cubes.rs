//! Marching cubes (Lorensen and Cline 1987) over the sparse volume.
//!
//! Crossed cubes and edges are found 64 at a time in bit masks. Every crossed edge belongs to the block of its lower voxel and
//! carries one vertex, whose number is that of the crossed edges before it, so that cubes share vertices without a search.
//! Blocks are worked on in parallel, and their parts put together in the order of allocation.

use super::block::{BLOCK_SIDE, BLOCK_VOXELS, BlockCoord, voxel_index};
use super::block_masks::{
    Corners, Cubes, LAYERS, Mask, NONE, Neighbours, SLABS, Voxels, bits, used_edges,
};
use super::cube_cases::{EDGE_CORNERS, EDGE_SLOTS, N_SLOTS, cases, corner_place, slot};
use super::each_block::{OfBlock, Reading, TASK_BLOCKS, each};
use super::volume::TsdfVolume;
use crate::geometry::TriMesh;
use nalgebra::Point3;
use pulp::{Arch, Simd, WithSimd};
use rayon::prelude::*;

/// Extracts the zero surface where all eight voxels of a cube have at least `min_weight`.
// A symbol of its own, by which tests/bench/instructions.sh counts.
#[inline(never)]
pub fn marching_cubes(arch: Arch, volume: &TsdfVolume, min_weight: f32) -> TriMesh {
    let n_blocks = volume.blocks().len();
    let all: Vec<u32> = (0..n_blocks as u32).collect();
    let reading = Reading {
        volume,
        blocks: &all,
        min_weight,
    };
    let voxels = each(arch, n_blocks, &reading);
    let around = each(
        arch,
        n_blocks,
        &Crossing {
            volume,
            voxels: &voxels,
        },
    );
    let grid = Grid {
        volume,
        voxels: &voxels,
        around: &around,
    };
    let surfaces = numbered(each(arch, n_blocks, &grid));
    grid.mesh(arch, &surfaces)
}

/// Finds the blocks around each, and its cubes.
struct Crossing<'a> {
    volume: &'a TsdfVolume,
    voxels: &'a [Voxels],
}

impl OfBlock for Crossing<'_> {
    type Out = (Neighbours, Cubes);

    #[inline(always)]
    fn of(&self, block: usize) -> (Neighbours, Cubes) {
        let neighbours = Neighbours::of(self.volume, self.volume.coords()[block]);
        (neighbours, Cubes::of(self.voxels, &neighbours))
    }
}

/// The vertices on a block's edges and the faces in its cubes.
#[derive(Clone, Default)]
struct Surface {
    /// Edges with a vertex, by axis, each at the bit of its lower voxel.
    edges: [Mask; 3],
    /// Vertices of the block before each word of `edges`.
    before: [[u16; SLABS]; 3],
    n_vertices: u32,
    n_faces: u32,
    /// Vertices of the blocks before this one.
    first_vertex: u32,
}

impl Surface {
    /// Writes the numbers of the block's vertices to the slots that their edges have for a block below it, whose neighbour on `side`
    /// this one is: only those where that block's cubes reach it.
    #[inline(always)]
    fn number(&self, side: usize, numbers: &mut [u32; N_SLOTS]) {
        let beyond = |axis: usize| side >> axis & 1;
        let first = [0, 1, 2].map(|axis| beyond(axis) * BLOCK_SIDE as usize);
        let reached = LAYERS[side & 3];
        let n_slabs = if beyond(2) == 1 { 1 } else { SLABS };
        for axis in (0..3).filter(|&axis| beyond(axis) == 0) {
            for z in 0..n_slabs {
                let word = self.edges[axis][z];
                let before = self.first_vertex + u32::from(self.before[axis][z]);
                for bit in bits(word & reached) {
                    let place = [first[0] + (bit & 7), first[1] + (bit >> 3), first[2] + z];
                    let lower = word & ((1 << bit) - 1);
                    numbers[slot(axis, place)] = before + lower.count_ones();
                }
            }
        }
    }
}

/// Vertices and faces of some blocks.
fn counts(surfaces: &[Surface]) -> (usize, usize) {
    surfaces.iter().fold((0, 0), |(vertices, faces), surface| {
        let more = (surface.n_vertices as usize, surface.n_faces as usize);
        (vertices + more.0, faces + more.1)
    })
}

/// Numbers the vertices of all blocks through.
fn numbered(mut surfaces: Vec<Surface>) -> Vec<Surface> {
    let mut n_vertices = 0;
    for surface in &mut surfaces {
        surface.first_vertex = n_vertices;
        n_vertices += surface.n_vertices;
    }
    surfaces
}

struct Grid<'a> {
    volume: &'a TsdfVolume,
    voxels: &'a [Voxels],
    around: &'a [(Neighbours, Cubes)],
}

impl OfBlock for Grid<'_> {
    type Out = Surface;

    #[inline(always)]
    fn of(&self, block: usize) -> Surface {
        let (neighbours, cubes) = &self.around[block];
        let edges = used_edges(self.voxels, self.around, block);
        let mut surface = Surface {
            edges,
            ..Surface::default()
        };
        let words = edges.as_flattened().iter();
        for (before, word) in surface.before.as_flattened_mut().iter_mut().zip(words) {
            *before = surface.n_vertices as u16;
            surface.n_vertices += word.count_ones();
        }
        if cubes.any_crossed() {
            let (corners, cases) = (Corners::of(self.voxels, neighbours), cases());
            for (z, &word) in cubes.0.iter().enumerate() {
                for bit in bits(word) {
                    surface.n_faces += cases[corners.pattern(z, bit)].n_triangles() as u32;
                }
            }
        }
        surface
    }
}

/// Vertices and faces of a task's blocks, to be filled in.
type Part<'a> = (&'a mut [Point3<f64>], &'a mut [[u32; 3]]);

impl Grid<'_> {
    fn mesh(&self, arch: Arch, surfaces: &[Surface]) -> TriMesh {
        let (n_vertices, n_faces) = counts(surfaces);
        let mut mesh = TriMesh {
            vertices: vec![Point3::origin(); n_vertices],
            faces: vec![[0; 3]; n_faces],
        };
        let (mut vertices, mut faces) = (&mut mesh.vertices[..], &mut mesh.faces[..]);
        let parts: Vec<Part<'_>> = surfaces
            .chunks(TASK_BLOCKS)
            .map_while(|of_task| {
                let (n_vertices, n_faces) = counts(of_task);
                let vertices = vertices.split_off_mut(..n_vertices)?;
                Some((vertices, faces.split_off_mut(..n_faces)?))
            })
            .collect();
        parts.into_par_iter().enumerate().for_each(|(task, part)| {
            let first = task * TASK_BLOCKS;
            arch.dispatch(Writing {
                grid: self,
                surfaces,
                first,
                part,
            });
        });
        mesh
    }
}

/// Writes the part of the task that begins with block `first`.
struct Writing<'a> {
    grid: &'a Grid<'a>,
    surfaces: &'a [Surface],
    first: usize,
    part: Part<'a>,
}

impl WithSimd for Writing<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(mut self, _: S) {
        let (vertices, faces) = std::mem::take(&mut self.part);
        let (mut vertices, mut faces) = (vertices.iter_mut(), faces.iter_mut());
        let mut numbers = [0; N_SLOTS];
        for block in self.first..(self.first + TASK_BLOCKS).min(self.surfaces.len()) {
            self.place(block, &mut numbers, &mut vertices);
            self.connect(block, &mut numbers, &mut faces);
        }
    }
}

impl Writing<'_> {
    /// Places a block's vertices where the distance is zero on their edges, and writes their numbers to the edges' slots.
    #[inline(always)]
    fn place(
        &self,
        block: usize,
        numbers: &mut [u32; N_SLOTS],
        out: &mut std::slice::IterMut<'_, Point3<f64>>,
    ) {
        let volume = self.grid.volume;
        let (coord, (around, _)) = (volume.coords()[block], &self.grid.around[block]);
        let surface = &self.surfaces[block];
        let mut number = surface.first_vertex;
        for (axis, mask) in surface.edges.iter().enumerate() {
            for (z, &word) in mask.iter().enumerate() {
                for (bit, out) in bits(word).zip(&mut *out) {
                    let low = [bit & 7, bit >> 3, z];
                    *out = place_on_edge(volume, coord, around, axis, low);
                    numbers[slot(axis, low)] = number;
                    number += 1;
                }
            }
        }
    }

    /// Joins the vertices on the edges of a block's cubes to faces. `numbers` holds those of the block; what it holds of blocks before is
    /// not read.
    #[inline(always)]
    fn connect(
        &self,
        block: usize,
        numbers: &mut [u32; N_SLOTS],
        out: &mut std::slice::IterMut<'_, [u32; 3]>,
    ) {
        let (around, cubes) = &self.grid.around[block];
        if !cubes.any_crossed() {
            return;
        }
        for (side, &above) in around.up.iter().enumerate().skip(1) {
            if let Some(surface) = self.surfaces.get(above as usize) {
                surface.number(side, numbers);
            }
        }
        let (corners, cases) = (Corners::of(self.grid.voxels, around), cases());
        for (z, &word) in cubes.0.iter().enumerate() {
            for bit in bits(word) {
                let lowest = slot(0, [bit & 7, bit >> 3, z]);
                let number = |edge: u8| numbers[lowest + EDGE_SLOTS[edge as usize] as usize];
                let triangles = cases[corners.pattern(z, bit)].triangles();
                for (triangle, out) in triangles.iter().zip(&mut *out) {
                    *out = triangle.map(number);
                }
            }
        }
    }
}

/// The lower voxel of an edge of the cube whose lowest voxel is `low` of a block: of that block or of the layer above it.
#[inline(always)]
pub fn edge_low([x, y, z]: [usize; 3], edge: u8) -> [usize; 3] {
    let [dx, dy, dz] = corner_place(EDGE_CORNERS[edge as usize].0);
    [x + dx, y + dy, z + dz]
}

/// Which of the blocks upwards a voxel of a block or of the layer above it belongs to: see [`Neighbours`].
#[inline(always)]
fn side_of([x, y, z]: [usize; 3]) -> usize {
    x >> 3 | y >> 3 << 1 | z >> 3 << 2
}

/// Where the distance is zero on an edge that the surface crosses, world frame (m): it runs along `axis` from voxel `low` of
/// the block at `coord`, or of the layer above it.
#[inline(always)]
pub fn place_on_edge(
    volume: &TsdfVolume,
    coord: BlockCoord,
    around: &Neighbours,
    axis: usize,
    low: [usize; 3],
) -> Point3<f64> {
    // No place in memory that `axis` would choose: it is known late.
    let high = [0, 1, 2].map(|k| low[k] + usize::from(k == axis));
    let (a, b) = (
        distance(volume, around, low),
        distance(volume, around, high),
    );
    let (along, voxel) = (a / (a - b), f64::from(volume.voxel_size_m()));
    let place = [0, 1, 2].map(|k| {
        let low = f64::from(coord[k] * BLOCK_SIDE + low[k] as i32);
        (low + if k == axis { along } else { 0.0 }) * voxel
    });
    Point3::from(place)
}

/// The raw distance of a voxel of a block or of the layer above it.
#[inline(always)]
fn distance(volume: &TsdfVolume, around: &Neighbours, [x, y, z]: [usize; 3]) -> f64 {
    let block = around.up[side_of([x, y, z])] as usize;
    debug_assert!(block != NONE as usize, "both ends of an edge were seen");
    let index = voxel_index([x as i32 & 7, y as i32 & 7, z as i32 & 7]);
    f64::from(volume.blocks()[block].tsdf[index % BLOCK_VOXELS])
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::EdgeAdjacency;
    use crate::{fusion::sampling::tests::volume_of, geometry::lanes::arch_levels};

    #[test]
    fn a_sphere_is_closed_oriented_and_in_its_place() {
        let volume = volume_of(0.01, |x, y, z| (x * x + y * y + z * z).sqrt() - 0.0301);
        let mesh = marching_cubes(Arch::new(), &volume, 1.0);
        let edges = EdgeAdjacency::new(&mesh);
        assert!(edges.n_faces.iter().all(|&n| n == 2), "closed");
        let euler = mesh.vertices.len() as i64 - edges.edges.len() as i64 + mesh.faces.len() as i64;
        assert_eq!(euler, 2);
        for vertex in &mesh.vertices {
            assert!(
                (vertex.coords.norm() - 0.0301).abs() < 5e-5,
                "within h²/8R of the sphere"
            );
        }
        for face in 0..mesh.faces.len() {
            assert!(
                mesh.face_normal(face).dot(&mesh.centroid(face).coords) >= 0.0,
                "points outwards"
            );
        }
    }

    #[test]
    fn every_sign_pattern_closes_against_its_neighbours() {
        // A signed noise field meets all ambiguous faces; wherever cubes exist on both sides, edges must pair up.
        let hash = |x: f64, y: f64, z: f64| {
            let n = [x, y, z].map(|c| (c * 500.0).round() as i64);
            let h = (n[0] * 73_856_093) ^ (n[1] * 19_349_663) ^ (n[2] * 83_492_791);
            ((h.wrapping_mul(2_654_435_761) >> 7) % 1000) as f64 / 1000.0
        };
        let rim = |x: f64, y: f64, z: f64| x.abs().max(y.abs()).max(z.abs()) > 0.03;
        let volume = volume_of(0.01, |x, y, z| {
            if rim(x, y, z) {
                0.01
            } else {
                0.008 * (hash(x, y, z).abs() - 0.5)
            }
        });
        let mesh = marching_cubes(Arch::new(), &volume, 1.0);
        assert!(mesh.faces.len() > 10_000);
        assert!(
            EdgeAdjacency::new(&mesh)
                .n_faces
                .iter()
                .all(|&n| n % 2 == 0)
        );
    }

    #[test]
    fn vertices_are_shared_and_all_used_whatever_the_instruction_set() {
        let volume = volume_of(0.01, |x, y, z| (x * x + y * y).sqrt() - 0.02013 + 0.31 * z);
        let mesh = marching_cubes(Arch::Scalar, &volume, 1.0);
        let mut used = vec![false; mesh.vertices.len()];
        for &vertex in mesh.faces.iter().flatten() {
            used[vertex as usize] = true;
        }
        assert!(used.iter().all(|&used| used));
        let mut places: Vec<[u64; 3]> = mesh
            .vertices
            .iter()
            .map(|p| [p.x, p.y, p.z].map(f64::to_bits))
            .collect();
        places.sort_unstable();
        // Vertices may only meet where the surface passes through a voxel.
        let n_meeting = places.windows(2).filter(|pair| pair[0] == pair[1]).count();
        assert!(
            n_meeting * 100 < places.len(),
            "{n_meeting} of {}",
            places.len()
        );
        for arch in arch_levels() {
            assert_eq!(marching_cubes(arch, &volume, 1.0), mesh);
        }
    }
}
