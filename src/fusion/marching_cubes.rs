//! Marching cubes (Lorensen and Cline 1987) over the sparse volume.
//!
//! Crossed cubes and edges are found 64 at a time in bit masks: see [`Crossings`]. Every crossed edge belongs to the block of its lower voxel and carries one vertex, whose number is that of the crossed edges before it, so
//! that cubes share vertices without a search. Blocks are worked on in parallel, and their parts put together in the order of
//! allocation.

use super::block::{BLOCK_SIDE, BLOCK_VOXELS, BlockCoord, voxel_index};
use super::block_masks::{
    LAST_LAYERS, LAYERS, Mask, NONE, NOTHING, Octant, SLABS, Voxels, bits, blocks_below,
    edges_of_cubes,
};
use super::crossings::{Crossed, Crossings, Found};
use super::cube_cases::{EDGE_CORNERS, EDGE_SLOTS, N_SLOTS, cases, corner_place, slot};
use super::volume::TsdfVolume;
use crate::geometry::TriMesh;
use nalgebra::Point3;
use pulp::{Arch, Simd, WithSimd};
use rayon::iter::repeat_n;
use rayon::prelude::*;

/// Extracts the zero surface where all eight voxels of a cube have at least `min_weight`.
// A symbol of its own, by which tests/bench/instructions.sh counts.
#[inline(never)]
pub fn marching_cubes(arch: Arch, volume: &TsdfVolume, min_weight: f32) -> TriMesh {
    let blocks: Vec<u32> = (0..volume.blocks().len() as u32).collect();
    let voxels = Voxels::of_blocks(arch, volume, &blocks, min_weight);
    let grid = Grid {
        volume,
        crossings: Crossings::of(arch, volume, &voxels),
    };
    let surfaces = numbered(grid.surfaces(arch));
    grid.mesh(arch, &surfaces)
}

/// The vertices on a block's edges.
#[derive(Default)]
struct Surface {
    /// Edges with a vertex, by axis, each at the bit of its lower voxel.
    edges: [Mask; 3],
    /// Vertices of the block before each word of `edges`.
    before: [[u16; SLABS]; 3],
    n_vertices: u32,
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

/// Numbers the vertices of all tasks' blocks through.
fn numbered(mut surfaces: Vec<Vec<Surface>>) -> Vec<Vec<Surface>> {
    let mut n_vertices = 0;
    for surface in surfaces.iter_mut().flatten() {
        surface.first_vertex = n_vertices;
        n_vertices += surface.n_vertices;
    }
    surfaces
}

/// The volume, and what the surface crosses of it.
struct Grid<'a> {
    volume: &'a TsdfVolume,
    crossings: Crossings,
}

/// Vertices and faces of a task's blocks, to be filled in.
type Part<'a> = (&'a mut [Point3<f64>], &'a mut [[u32; 3]]);

impl Grid<'_> {
    /// Those of all tasks, not yet numbered.
    fn surfaces(&self, arch: Arch) -> Vec<Vec<Surface>> {
        let tasks = self.crossings.tasks.par_iter();
        let surfaces = tasks.map(|Found { blocks, .. }| {
            arch.dispatch(
                #[inline(always)]
                || blocks.iter().map(|block| self.surface(block)).collect(),
            )
        });
        surfaces.collect()
    }

    #[inline(always)]
    fn surface(&self, crossed: &Crossed) -> Surface {
        let coord = self.volume.coords()[crossed.above[0] as usize];
        let below = blocks_below(self.volume, coord).map(|below| {
            let below = self.crossings.place(below);
            below.map_or(&NOTHING, |(task, place)| {
                &self.crossings.tasks[task].blocks[place].cubes
            })
        });
        let mut surface = Surface {
            edges: edges_of_cubes(&crossed.edges, below),
            ..Surface::default()
        };
        let words = surface.edges.as_flattened().iter();
        for (before, word) in surface.before.as_flattened_mut().iter_mut().zip(words) {
            *before = surface.n_vertices as u16;
            surface.n_vertices += word.count_ones();
        }
        surface
    }

    fn mesh(&self, arch: Arch, surfaces: &[Vec<Surface>]) -> TriMesh {
        let n_vertices = |of_task: &Vec<Surface>| -> usize {
            of_task.iter().map(|of| of.n_vertices as usize).sum()
        };
        let tasks = || surfaces.iter().map(n_vertices).zip(&self.crossings.tasks);
        let mut mesh = TriMesh {
            vertices: repeat_n(Point3::origin(), tasks().map(|of| of.0).sum()).collect(),
            faces: vec![[0; 3]; tasks().map(|of| of.1.n_faces).sum()],
        };
        let (mut vertices, mut faces) = (&mut mesh.vertices[..], &mut mesh.faces[..]);
        let parts = tasks().map_while(|(n_vertices, found)| {
            let vertices = vertices.split_off_mut(..n_vertices)?;
            Some((vertices, faces.split_off_mut(..found.n_faces)?))
        });
        let parts: Vec<Part<'_>> = parts.collect();
        parts.into_par_iter().enumerate().for_each(|(task, part)| {
            arch.dispatch(Writing {
                grid: self,
                surfaces,
                task,
                part,
            });
        });
        mesh
    }
}

/// Writes the part of a task.
struct Writing<'a> {
    grid: &'a Grid<'a>,
    /// Of all tasks.
    surfaces: &'a [Vec<Surface>],
    task: usize,
    part: Part<'a>,
}

impl WithSimd for Writing<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(mut self, _: S) {
        let (vertices, faces) = std::mem::take(&mut self.part);
        let (mut vertices, mut faces) = (vertices.iter_mut(), faces.iter_mut());
        let Found {
            blocks, patterns, ..
        } = &self.grid.crossings.tasks[self.task];
        let mut patterns = patterns.iter();
        let mut numbers = [0; N_SLOTS];
        for (block, surface) in blocks.iter().zip(&self.surfaces[self.task]) {
            self.place(block, surface, &mut numbers, &mut vertices);
            self.connect(block, &mut numbers, &mut patterns, &mut faces);
        }
    }
}

impl Writing<'_> {
    /// Places a block's vertices where the distance is zero on their edges, and writes their numbers to the edges' slots.
    #[inline(always)]
    fn place(
        &self,
        Crossed { above, .. }: &Crossed,
        surface: &Surface,
        numbers: &mut [u32; N_SLOTS],
        out: &mut std::slice::IterMut<'_, Point3<f64>>,
    ) {
        let volume = self.grid.volume;
        if surface.n_vertices == 0 {
            return;
        }
        let coord = volume.coords()[above[0] as usize];
        // All of the distances' cache lines are asked for at once: the edges would wait for one after the other.
        let lines = volume.blocks()[above[0] as usize].tsdf.iter().step_by(32);
        std::hint::black_box(lines.fold(0, |all, distance| all ^ distance));
        let mut number = surface.first_vertex;
        for (axis, mask) in surface.edges.iter().enumerate() {
            for (z, &word) in mask.iter().enumerate() {
                for (bit, out) in bits(word).zip(&mut *out) {
                    let low = [bit & 7, bit >> 3, z];
                    *out = place_on_edge(volume, coord, above, axis, low);
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
        Crossed { above, cubes, .. }: &Crossed,
        numbers: &mut [u32; N_SLOTS],
        patterns: &mut std::slice::Iter<'_, u8>,
        out: &mut std::slice::IterMut<'_, [u32; 3]>,
    ) {
        if *cubes == NOTHING {
            return;
        }
        for (side, &above) in above.iter().enumerate().skip(1) {
            if reach(cubes, side)
                && let Some((task, place)) = self.grid.crossings.place(above)
            {
                self.surfaces[task][place].number(side, numbers);
            }
        }
        let cases = cases();
        for (z, &word) in cubes.iter().enumerate() {
            for (bit, &pattern) in bits(word).zip(&mut *patterns) {
                let lowest = slot(0, [bit & 7, bit >> 3, z]);
                let number = |edge: u8| numbers[lowest + EDGE_SLOTS[edge as usize] as usize];
                let triangles = cases[pattern as usize].triangles();
                for (&[a, b, c], out) in triangles.iter().zip(&mut *out) {
                    // `map` of the three is a call, through memory.
                    *out = [number(a), number(b), number(c)];
                }
            }
        }
    }
}

/// Whether some of a block's cubes touch the block above it on a side.
#[inline(always)]
fn reach(cubes: &Mask, side: usize) -> bool {
    let first = if side >> 2 & 1 == 1 { SLABS - 1 } else { 0 };
    let any = cubes[first..].iter().fold(0, |any, word| any | word);
    any & LAST_LAYERS[side & 3] != 0
}

/// The lower voxel of an edge of the cube whose lowest voxel is `low` of a block: of that block or of the layer above it.
#[inline(always)]
pub fn edge_low([x, y, z]: [usize; 3], edge: u8) -> [usize; 3] {
    let [dx, dy, dz] = corner_place(EDGE_CORNERS[edge as usize].0);
    [x + dx, y + dy, z + dz]
}

/// Which of the blocks upwards a voxel of a block or of the layer above it belongs to: see [`Octant`].
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
    above: &Octant,
    axis: usize,
    low: [usize; 3],
) -> Point3<f64> {
    // No place in memory that `axis` would choose: it is known late.
    let high = [0, 1, 2].map(|k| low[k] + usize::from(k == axis));
    let (a, b) = (distance(volume, above, low), distance(volume, above, high));
    let (along, voxel) = (a / (a - b), f64::from(volume.voxel_size_m()));
    let place = |k: usize| {
        let low = f64::from(coord[k] * BLOCK_SIDE + low[k] as i32);
        (low + if k == axis { along } else { 0.0 }) * voxel
    };
    Point3::new(place(0), place(1), place(2))
}

/// The raw distance of a voxel of a block or of the layer above it.
#[inline(always)]
fn distance(volume: &TsdfVolume, above: &Octant, [x, y, z]: [usize; 3]) -> f64 {
    let block = above[side_of([x, y, z])] as usize;
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
        let n_faces = EdgeAdjacency::new(&mesh).n_faces;
        assert!(n_faces.iter().all(|&n| n == 2));
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
