//! Making a mesh a manifold, and the loops that bound it: cutting as in Guéziec et al. 2001.
//!
//! A manifold here is a mesh of which every edge has one face or two that run along it in opposite directions, and every
//! vertex one fan of faces. Its border then falls into loops that meet neither themselves nor one another.

use super::TriMesh;
use super::disjoint_sets::DisjointSets;

/// A mesh cut into a manifold.
#[derive(Clone, Debug, PartialEq)]
pub struct Manifold {
    /// The mesh; faces in their old order, without those that have a vertex twice.
    pub mesh: TriMesh,
    /// The vertex of the old mesh that each vertex was.
    pub from: Vec<u32>,
}

/// The side of a face from vertex `start` to vertex `end`.
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
struct Side {
    /// The vertices of the edge, the smaller first.
    edge: [u32; 2],
    /// Whether the side runs from the larger to the smaller.
    is_reversed: bool,
    /// Three times the face, and which of its sides.
    corner: u32,
}

/// The sides of all faces, those of one edge together.
fn sides(faces: &[[u32; 3]]) -> Vec<Side> {
    let mut sides: Vec<Side> = faces
        .as_flattened()
        .iter()
        .enumerate()
        .map(|(corner, &start)| {
            let end = faces[corner / 3][(corner + 1) % 3];
            Side {
                edge: [start.min(end), start.max(end)],
                is_reversed: start > end,
                corner: corner as u32,
            }
        })
        .collect();
    sides.sort_unstable();
    sides
}

/// Cuts a mesh into a manifold: faces stay joined at an edge that two of them share in opposite directions and nowhere else,
/// and each fan of faces about a vertex gets that vertex for itself. Vertices without faces are left out.
pub fn cut_to_manifold(mesh: &TriMesh) -> Manifold {
    let mut faces = mesh.faces.clone();
    faces.retain(|&[a, b, c]| a != b && b != c && c != a);
    let sides = sides(&faces);
    // Corners of faces that are joined at an edge belong to one vertex, at both of its ends.
    let mut joined = DisjointSets::new(3 * faces.len());
    for pair in sides.chunk_by(|a, b| a.edge == b.edge) {
        if let [forth, back] = pair
            && forth.is_reversed != back.is_reversed
        {
            let next = |corner: u32| corner / 3 * 3 + (corner + 1) % 3;
            joined.join(forth.corner, next(back.corner));
            joined.join(next(forth.corner), back.corner);
        }
    }
    let mut vertex_of_root = vec![u32::MAX; 3 * faces.len()];
    let (mut vertices, mut from) = (Vec::new(), Vec::new());
    for (corner, vertex) in faces.as_flattened_mut().iter_mut().enumerate() {
        let number = &mut vertex_of_root[joined.root(corner as u32) as usize];
        if *number == u32::MAX {
            *number = vertices.len() as u32;
            vertices.push(mesh.vertices[*vertex as usize]);
            from.push(*vertex);
        }
        *vertex = *number;
    }
    Manifold {
        mesh: TriMesh { vertices, faces },
        from,
    }
}

/// The loops that bound a manifold, each by its vertices in the direction of the faces that are missing, beginning with its
/// least; in the order of these.
pub fn border_loops(mesh: &TriMesh) -> Vec<Vec<u32>> {
    let mut next = vec![u32::MAX; mesh.vertices.len()];
    for side in sides(&mesh.faces).chunk_by(|a, b| a.edge == b.edge) {
        if let [side] = side {
            // The missing face runs against the one that is there.
            let [small, large] = side.edge;
            let (start, end) = match side.is_reversed {
                true => (small, large),
                false => (large, small),
            };
            next[start as usize] = end;
        }
    }
    let mut loops = Vec::new();
    for first in 0..next.len() as u32 {
        let mut border = Vec::new();
        let mut vertex = first;
        while next[vertex as usize] != u32::MAX {
            border.push(vertex);
            vertex = std::mem::replace(&mut next[vertex as usize], u32::MAX);
        }
        if !border.is_empty() {
            loops.push(border);
        }
    }
    loops
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::Point3;

    fn fan(faces: Vec<[u32; 3]>, n_vertices: u32) -> TriMesh {
        let vertices = (0..n_vertices).map(|i| Point3::new(f64::from(i), f64::from(i * i), 0.0));
        TriMesh {
            vertices: vertices.collect(),
            faces,
        }
    }

    #[test]
    fn triangles_that_meet_in_a_point_are_cut_apart() {
        let manifold = cut_to_manifold(&fan(vec![[0, 1, 2], [2, 3, 4]], 5));
        assert_eq!(manifold.mesh.faces, vec![[0, 1, 2], [3, 4, 5]]);
        assert_eq!(manifold.from, vec![0, 1, 2, 2, 3, 4]);
        assert_eq!(
            border_loops(&manifold.mesh),
            vec![vec![0, 2, 1], vec![3, 5, 4]]
        );
    }

    #[test]
    fn three_faces_on_one_edge_are_cut_apart_and_degenerate_ones_left_out() {
        let mesh = fan(vec![[0, 1, 2], [1, 0, 3], [0, 1, 4], [3, 3, 1]], 5);
        let manifold = cut_to_manifold(&mesh);
        assert_eq!(manifold.mesh.faces.len(), 3);
        assert_eq!(manifold.mesh.vertices.len(), 9);
        assert_eq!(border_loops(&manifold.mesh).len(), 3);
    }

    #[test]
    fn two_faces_make_a_loop_of_four() {
        let mesh = fan(vec![[0, 1, 2], [0, 2, 3]], 4);
        assert_eq!(cut_to_manifold(&mesh).mesh, mesh);
        assert_eq!(border_loops(&mesh), vec![vec![0, 3, 2, 1]]);
    }
}
