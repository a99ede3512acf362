//! Halving of all edges at once, for a finer mesh whose vertices and faces are known by those of the coarser one.

use super::dynamic_mesh::DynamicMesh;
use super::relax::{relax, relax_onto};
use crate::geometry::{TriMesh, TriangleBvh};

/// Marks an edge that has no middle yet.
const NONE: u32 = u32::MAX;

/// Sharp edges, which the coarser mesh cuts off by half of one of its own, are found again: of a cube's by 1.2 of the finer
/// mesh's edges after one, 0.85 after three, 0.8 after six, 0.88 after three of which the first leaves the surface; 0.7 where it was
/// meshed so finely at once.
const RELAXATIONS: usize = 3;

/// A mesh with four faces for each of a coarser one: those of face `k` are `4k` to `4k + 3`.
pub struct Subdivided {
    /// The mesh.
    pub mesh: TriMesh,
    /// The ends of the coarser edge in whose middle a vertex began; twice the same where it is that vertex.
    pub parents: Vec<[u32; 2]>,
}

/// Puts a vertex into the middle of every edge, relaxes all within their tangent planes and moves them onto `surface`, but for
/// those on the border. `sides` numbers each face's edges, from corner 0 to 1, 1 to 2 and 2 to 0, below `n_edges`.
pub fn subdivide(
    coarse: &TriMesh,
    sides: &[[u32; 3]],
    n_edges: usize,
    surface: &TriangleBvh,
) -> Subdivided {
    let mut vertices = vec![NONE; coarse.vertices.len()];
    let mut middles = vec![NONE; n_edges];
    let mut parents: Vec<[u32; 2]> = Vec::with_capacity(4 * vertices.len());
    // Numbered as they are met, so that neighbours lie close together in memory.
    let mut number = |slot: &mut u32, of: [u32; 2]| {
        if *slot == NONE {
            *slot = parents.len() as u32;
            parents.push(of);
        }
        *slot
    };
    let mut faces = Vec::with_capacity(4 * coarse.faces.len());
    for (&corners, &sides) in coarse.faces.iter().zip(sides) {
        let [a, b, c] =
            corners.map(|vertex| number(&mut vertices[vertex as usize], [vertex, vertex]));
        let [ab, bc, ca] = [0, 1, 2].map(|side| {
            let ends = [corners[side], corners[(side + 1) % 3]];
            number(&mut middles[sides[side] as usize], ends)
        });
        faces.extend([[a, ab, ca], [ab, b, bc], [ca, bc, c], [ab, bc, ca]]);
    }
    let middle = |ends: &[u32; 2]| {
        let [p, q] = ends.map(|vertex| coarse.vertices[vertex as usize]);
        nalgebra::center(&p, &q)
    };
    let vertices = parents.iter().map(middle).collect();
    let flat = TriMesh { vertices, faces };
    let mut relaxed = DynamicMesh::new(&flat);
    // Where vertices lie on the surface matters only for where they end.
    relax(&mut relaxed, |target, _| target);
    for _ in 1..RELAXATIONS {
        relax_onto(&mut relaxed, surface);
    }
    Subdivided {
        mesh: TriMesh {
            vertices: relaxed.positions,
            ..flat
        },
        parents,
    }
}
