//! Marching cubes (Lorensen and Cline 1987) over the sparse volume.
//!
//! The triangles of a cube are not looked up but traced: crossings are joined along the cube's faces, always round the
//! inside corners, into loops, and loops cut into fans. Two cubes see their common face alike, so that the mesh has no
//! cracks wherever all voxels were seen.

use super::volume::{BLOCK_SIDE, TsdfVolume};
use crate::geometry::TriMesh;
use nalgebra::Point3;
use rayon::prelude::*;
use std::collections::HashMap;

/// The triangles of one cube: edges (0..12) three by three.
type Case = Vec<[u8; 3]>;

/// Corners of edge `e` of a cube; corner `c` lies at (c & 1, c >> 1 & 1, c >> 2). Edge 4a + b runs along axis a.
fn edge_corners(edge: u8) -> (u8, u8) {
    let axis = edge / 4;
    let (p, q) = ((axis + 1) % 3, (axis + 2) % 3);
    let first = ((edge & 1) << p) | (((edge >> 1) & 1) << q);
    (first, first | (1 << axis))
}

/// The edge between two neighbouring corners.
fn edge_between(a: u8, b: u8) -> u8 {
    (0..12)
        .find(|&edge| edge_corners(edge) == (a.min(b), a.max(b)))
        .expect("corners of one edge")
}

/// Corners of the cube's six faces, counter-clockwise seen from outside.
fn face_loops() -> [[u8; 4]; 6] {
    std::array::from_fn(|face| {
        let (axis, side) = (face as u8 / 2, face as u8 % 2);
        let (p, q) = ((axis + 1) % 3, (axis + 2) % 3);
        let base = side << axis;
        let loop_ = [base, base | 1 << p, base | 1 << p | 1 << q, base | 1 << q];
        if side == 1 {
            loop_
        } else {
            [loop_[0], loop_[3], loop_[2], loop_[1]]
        }
    })
}

/// Traces the triangles of all 256 sign patterns; bit c of a pattern is set where corner c lies inside.
fn trace_cases() -> Vec<Case> {
    let faces = face_loops();
    (0..256u32)
        .map(|pattern| trace_case(pattern as u8, &faces))
        .collect()
}

fn trace_case(pattern: u8, faces: &[[u8; 4]; 6]) -> Case {
    let inside = |corner: u8| pattern >> corner & 1 == 1;
    // On each face, walk round it: the surface enters where outside turns to inside and leaves where inside turns to outside;
    // each run of inside corners is cut off by one segment from its leaving edge back to its entering edge.
    let mut next = [u8::MAX; 12];
    for corners in faces {
        for start in 0..4 {
            let (before, first) = (corners[(start + 3) % 4], corners[start]);
            if inside(before) || !inside(first) {
                continue;
            }
            let mut last = start;
            while inside(corners[(last + 1) % 4]) {
                last = (last + 1) % 4;
            }
            let leave = edge_between(corners[last], corners[(last + 1) % 4]);
            next[leave as usize] = edge_between(before, first);
        }
    }
    let mut triangles = Vec::new();
    let mut used = [false; 12];
    for first in 0..12u8 {
        if next[first as usize] == u8::MAX || used[first as usize] {
            continue;
        }
        let mut ring = Vec::new();
        let mut edge = first;
        while !used[edge as usize] {
            used[edge as usize] = true;
            ring.push(edge);
            edge = next[edge as usize];
        }
        triangles.extend((1..ring.len() - 1).map(|i| [ring[0], ring[i + 1], ring[i]]));
    }
    triangles
}

/// A mesh vertex's name: the voxel at the low end of its edge and the edge's axis.
type VertexKey = ([i32; 3], u8);

struct BlockMesh {
    vertices: Vec<(VertexKey, Point3<f64>)>,
    faces: Vec<[u32; 3]>,
}

/// Extracts the zero surface where all eight voxels of a cube have at least `min_weight`.
///
/// Blocks are visited in the order of their coordinates, so that the mesh does not depend on the order of allocation.
pub fn marching_cubes(volume: &TsdfVolume, min_weight: f32) -> TriMesh {
    let cases = trace_cases();
    let mut order: Vec<usize> = (0..volume.coords().len()).collect();
    order.sort_unstable_by_key(|&index| volume.coords()[index]);
    let parts: Vec<BlockMesh> = order
        .par_iter()
        .map(|&index| mesh_block(volume, volume.coords()[index], min_weight, &cases))
        .collect();
    let mut mesh = TriMesh::default();
    let mut index_of: HashMap<VertexKey, u32> = HashMap::new();
    for part in parts {
        let indices: Vec<u32> = part
            .vertices
            .iter()
            .map(|(key, point)| {
                *index_of.entry(*key).or_insert_with(|| {
                    mesh.vertices.push(*point);
                    mesh.vertices.len() as u32 - 1
                })
            })
            .collect();
        mesh.faces.extend(
            part.faces
                .iter()
                .map(|face| face.map(|vertex| indices[vertex as usize]))
                .filter(|[a, b, c]| a != b && b != c && c != a),
        );
    }
    mesh
}

fn mesh_block(volume: &TsdfVolume, coord: [i32; 3], min_weight: f32, cases: &[Case]) -> BlockMesh {
    let mut part = BlockMesh {
        vertices: Vec::new(),
        faces: Vec::new(),
    };
    let mut index_of: HashMap<VertexKey, u32> = HashMap::new();
    let halo = Halo::gather(volume, coord, min_weight);
    for z in 0..BLOCK_SIDE {
        for y in 0..BLOCK_SIDE {
            for x in 0..BLOCK_SIDE {
                let Some(values) = halo.cube([x, y, z]) else {
                    continue;
                };
                let pattern = (0..8).fold(0, |bits, c| bits | usize::from(values[c] < 0.0) << c);
                for triangle in &cases[pattern] {
                    let face = triangle.map(|edge| {
                        let (low, high) = edge_corners(edge);
                        let voxel = [0, 1, 2].map(|axis| {
                            coord[axis] * BLOCK_SIDE + [x, y, z][axis] + (low >> axis & 1) as i32
                        });
                        let axis = edge / 4;
                        *index_of.entry((voxel, axis)).or_insert_with(|| {
                            let (a, b) =
                                (values[low as usize] as f64, values[high as usize] as f64);
                            let mut point = voxel.map(f64::from);
                            point[axis as usize] += a / (a - b);
                            let scaled = point.map(|i| i * volume.voxel_size_m() as f64);
                            part.vertices.push(((voxel, axis), Point3::from(scaled)));
                            part.vertices.len() as u32 - 1
                        })
                    });
                    part.faces.push(face);
                }
            }
        }
    }
    part
}

/// The 9³ voxels of a block and its neighbours' first layers; NaN where not seen often enough.
struct Halo {
    values: Vec<f32>,
    /// Whether any voxel lies inside and any outside.
    crossed: bool,
}

const HALO: i32 = BLOCK_SIDE + 1;

impl Halo {
    fn gather(volume: &TsdfVolume, coord: [i32; 3], min_weight: f32) -> Halo {
        let mut values = Vec::with_capacity((HALO * HALO * HALO) as usize);
        let (mut any_inside, mut any_outside) = (false, false);
        for z in 0..HALO {
            for y in 0..HALO {
                for x in 0..HALO {
                    let voxel = [0, 1, 2].map(|axis| coord[axis] * BLOCK_SIDE + [x, y, z][axis]);
                    let value = match volume.voxel(voxel) {
                        Some((distance, weight)) if weight >= min_weight => distance,
                        _ => f32::NAN,
                    };
                    any_inside |= value < 0.0;
                    any_outside |= value >= 0.0;
                    values.push(value);
                }
            }
        }
        Halo {
            values,
            crossed: any_inside && any_outside,
        }
    }

    /// The eight corners of a cube; `None` if one was not seen or the surface is nowhere near.
    fn cube(&self, [x, y, z]: [i32; 3]) -> Option<[f32; 8]> {
        if !self.crossed {
            return None;
        }
        let mut corners = [0.0; 8];
        for (c, corner) in corners.iter_mut().enumerate() {
            let c = c as i32;
            let (x, y, z) = (x + (c & 1), y + (c >> 1 & 1), z + (c >> 2));
            *corner = self.values[(x + HALO * (y + HALO * z)) as usize];
            if corner.is_nan() {
                return None;
            }
        }
        Some(corners)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::fusion::volume::tests::volume_of;
    use crate::geometry::EdgeAdjacency;

    #[test]
    fn a_sphere_is_closed_oriented_and_in_its_place() {
        let volume = volume_of(0.01, |x, y, z| (x * x + y * y + z * z).sqrt() - 0.0301);
        let mesh = marching_cubes(&volume, 1.0);
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
        let mesh = marching_cubes(&volume, 1.0);
        assert!(mesh.faces.len() > 10_000);
        assert!(
            EdgeAdjacency::new(&mesh)
                .n_faces
                .iter()
                .all(|&n| n % 2 == 0)
        );
    }
}
