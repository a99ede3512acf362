//! Marching cubes (Lorensen and Cline 1987) over the sparse volume.
//!
//! Crossed cubes and edges are found 64 at a time in bit masks. Every crossed edge belongs to the block of its lower voxel and
//! carries one vertex, whose number is that of the crossed edges before it, so that cubes share vertices without a search.
//! Blocks are worked on in parallel, and their parts put together in the order of allocation.

use super::block::{BLOCK_SIDE, BLOCK_VOXELS, BlockCoord, voxel_index};
use super::block_masks::{Cubes, Mask, NONE, Neighbours, SLABS, Voxels, bits, used_edges};
use super::cube_cases::{Case, edge_corners, trace_cases};
use super::volume::TsdfVolume;
use crate::geometry::TriMesh;
use nalgebra::Point3;
use pulp::{Arch, Simd, WithSimd};
use rayon::prelude::*;

/// Extracts the zero surface where all eight voxels of a cube have at least `min_weight`.
// A symbol of its own, by which tests/bench/instructions.sh counts.
#[inline(never)]
pub fn marching_cubes(arch: Arch, volume: &TsdfVolume, min_weight: f32) -> TriMesh {
    let blocks = volume.blocks().par_iter();
    let coords = volume.coords().par_iter();
    let voxels: Vec<Voxels> = blocks.map(|block| Voxels::of(block, min_weight)).collect();
    let neighbours: Vec<Neighbours> = coords.map(|&coord| Neighbours::of(volume, coord)).collect();
    let cubes = neighbours
        .par_iter()
        .map(|around| Cubes::of(&voxels, around));
    let cubes: Vec<Cubes> = cubes.collect();
    let vertices = neighbours
        .par_iter()
        .map(|around| EdgeVertices::of(&cubes, around));
    let mut vertices: Vec<EdgeVertices> = vertices.collect();
    let n_vertices = number(&mut vertices);
    let cases = trace_cases();
    let grid = Grid {
        volume,
        edges: edge_ends(),
        cases: &cases,
        voxels: &voxels,
        neighbours: &neighbours,
        cubes: &cubes,
        vertices: &vertices,
    };
    grid.mesh(arch, n_vertices)
}

/// The vertices on a block's edges.
struct EdgeVertices {
    /// Edges with a vertex, by axis, each at the bit of its lower voxel.
    edges: [Mask; 3],
    /// Vertices of the block before each word of `edges`.
    before: [[u16; SLABS]; 3],
    n_vertices: u32,
    /// Vertices of the blocks before this one.
    first: u32,
}

impl EdgeVertices {
    fn of(cubes: &[Cubes], neighbours: &Neighbours) -> Self {
        let edges = used_edges(cubes, neighbours);
        let (mut before, mut n_vertices) = ([[0; SLABS]; 3], 0);
        for (before, word) in before
            .as_flattened_mut()
            .iter_mut()
            .zip(edges.as_flattened())
        {
            *before = n_vertices as u16;
            n_vertices += word.count_ones();
        }
        EdgeVertices {
            edges,
            before,
            n_vertices,
            first: 0,
        }
    }

    /// Number of the vertex on an edge that has one.
    #[inline(always)]
    fn vertex(&self, axis: usize, slab: usize, bit: usize) -> u32 {
        let lower = self.edges[axis][slab] & ((1 << bit) - 1);
        self.first + u32::from(self.before[axis][slab]) + lower.count_ones()
    }
}

/// Numbers the vertices of all blocks through; returns how many there are.
fn number(vertices: &mut [EdgeVertices]) -> usize {
    let mut n_vertices = 0;
    for block in vertices {
        block.first = n_vertices;
        n_vertices += block.n_vertices;
    }
    n_vertices as usize
}

struct Grid<'a> {
    volume: &'a TsdfVolume,
    cases: &'a [Case],
    /// Corners of a cube's edges.
    edges: [(u8, u8); 12],
    voxels: &'a [Voxels],
    neighbours: &'a [Neighbours],
    cubes: &'a [Cubes],
    vertices: &'a [EdgeVertices],
}

impl Grid<'_> {
    fn mesh(&self, arch: Arch, n_vertices: usize) -> TriMesh {
        let mut vertices = vec![Point3::origin(); n_vertices];
        let mut rest = &mut vertices[..];
        let parts: Vec<&mut [Point3<f64>]> = self
            .vertices
            .iter()
            .map(|block| {
                rest.split_off_mut(..block.n_vertices as usize)
                    .expect("numbered through")
            })
            .collect();
        parts
            .into_par_iter()
            .enumerate()
            .for_each(|(block, part)| self.place(block, part));
        let n_blocks = self.cubes.len();
        let faces: Vec<Vec<[u32; 3]>> = (0..n_blocks.div_ceil(TASK_BLOCKS))
            .into_par_iter()
            .map(|task| {
                let blocks = task * TASK_BLOCKS..((task + 1) * TASK_BLOCKS).min(n_blocks);
                arch.dispatch(Faces { grid: self, blocks })
            })
            .collect();
        TriMesh {
            vertices,
            faces: faces.concat(),
        }
    }

    /// Places a block's vertices where the distance is zero on their edges.
    fn place(&self, block: usize, out: &mut [Point3<f64>]) {
        let (edges, coord) = (&self.vertices[block].edges, self.volume.coords()[block]);
        let edges = edges.iter().enumerate().flat_map(|(axis, mask)| {
            mask.iter().enumerate().flat_map(move |(z, &word)| {
                bits(word).map(move |bit| (axis, [bit & 7, bit >> 3, z]))
            })
        });
        let around = &self.neighbours[block];
        for (out, (axis, low)) in out.iter_mut().zip(edges) {
            *out = place_on_edge(self.volume, coord, around, axis, low);
        }
    }
}

/// The corners that the edges of a cube lead from and to.
pub fn edge_ends() -> [(u8, u8); 12] {
    std::array::from_fn(|edge| edge_corners(edge as u8))
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
    let mut high = low;
    high[axis] += 1;
    let (a, b) = (
        distance(volume, around, low),
        distance(volume, around, high),
    );
    let mut place = [0, 1, 2].map(|k| f64::from(coord[k] * BLOCK_SIDE + low[k] as i32));
    place[axis] += a / (a - b);
    Point3::from(place.map(|x| x * f64::from(volume.voxel_size_m())))
}

/// The raw distance of a voxel of a block or of the layer above it.
#[inline(always)]
fn distance(volume: &TsdfVolume, around: &Neighbours, [x, y, z]: [usize; 3]) -> f64 {
    let side = x >> 3 | y >> 3 << 1 | z >> 3 << 2;
    let block = around.up[side] as usize;
    debug_assert!(block != NONE as usize, "both ends of an edge were seen");
    let index = voxel_index([x & 7, y & 7, z & 7].map(|i| i as i32));
    f64::from(volume.blocks()[block].tsdf[index % BLOCK_VOXELS])
}

/// Block, slab and bit of each corner of a cube.
pub struct CubeCorners([(usize, usize, usize); 8]);

impl CubeCorners {
    /// The corners of the cube whose lowest voxel is `low` of a block.
    #[inline(always)]
    pub fn of(low: [usize; 3], around: &Neighbours) -> Self {
        CubeCorners(std::array::from_fn(|corner| {
            let [x, y, z] = [0, 1, 2].map(|axis| low[axis] + (corner >> axis & 1));
            let side = x >> 3 | y >> 3 << 1 | z >> 3 << 2;
            (around.up[side] as usize, z & 7, x & 7 | (y & 7) << 3)
        }))
    }

    /// Which corners lie inside, one bit each.
    #[inline(always)]
    pub fn pattern(&self, voxels: &[Voxels]) -> usize {
        let inside = |&(block, slab, bit): &(usize, usize, usize)| {
            (voxels[block].inside[slab] >> bit & 1) as usize
        };
        (0..8).fold(0, |pattern, corner| {
            pattern | inside(&self.0[corner]) << corner
        })
    }
}

/// Blocks whose faces one task writes.
const TASK_BLOCKS: usize = 256;

struct Faces<'a> {
    grid: &'a Grid<'a>,
    blocks: std::ops::Range<usize>,
}

impl WithSimd for Faces<'_> {
    type Output = Vec<[u32; 3]>;

    #[inline(always)]
    fn with_simd<S: Simd>(self, _: S) -> Vec<[u32; 3]> {
        let mut faces = Vec::new();
        for block in self.blocks.clone() {
            for (z, &word) in self.grid.cubes[block].crossed.iter().enumerate() {
                for bit in bits(word) {
                    self.cube(block, [bit & 7, bit >> 3, z], &mut faces);
                }
            }
        }
        faces
    }
}

impl Faces<'_> {
    #[inline(always)]
    fn cube(&self, block: usize, low: [usize; 3], faces: &mut Vec<[u32; 3]>) {
        let grid = self.grid;
        let corners = CubeCorners::of(low, &grid.neighbours[block]);
        let vertex = |edge: u8| {
            let (block, slab, bit) = corners.0[grid.edges[edge as usize].0 as usize];
            grid.vertices[block].vertex(edge as usize / 4, slab, bit)
        };
        let case = &grid.cases[corners.pattern(grid.voxels)];
        faces.extend(case.iter().map(|face| face.map(vertex)));
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::fusion::{arch_levels, sampling::tests::volume_of};
    use crate::geometry::EdgeAdjacency;

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
