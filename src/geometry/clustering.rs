//! A coarser mesh for a quick look, by clustering vertices: Rossignac and Borrel, *Multi-resolution 3D approximations for
//! rendering complex scenes*, 1993.
//!
//! Every cell of a grid keeps one of its vertices, so that whatever is known of vertices stays true. Not handled: topology;
//! thin parts may close.

use super::{TriMesh, cell_of};
use nalgebra::Point3;
use std::collections::{HashMap, HashSet};

/// The cell grows by this factor until few enough faces are left: a fifth, so that the result has at least about two thirds
/// of the faces it may have.
const GROWTH: f64 = 1.2;

/// What is left of a mesh.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Clustering {
    /// For each vertex that is left, its index in the full mesh; rising.
    pub kept: Vec<u32>,
    /// Faces over the vertices that are left, counter-clockwise as before.
    pub faces: Vec<[u32; 3]>,
}

/// Reduces a mesh to at most so many faces; positions in metres, finite. A mesh that is small enough stays as it is.
pub fn cluster_vertices(
    positions: &[[f32; 3]],
    faces: &[[u32; 3]],
    max_faces: usize,
) -> Clustering {
    if faces.len() <= max_faces {
        return Clustering {
            kept: (0..positions.len() as u32).collect(),
            faces: faces.to_vec(),
        };
    }
    // A grid of squares of one cell's size over the area would have two faces for each.
    let mut cell_m = (2.0 * area_m2(positions, faces) / max_faces.max(1) as f64).sqrt();
    loop {
        cell_m = GROWTH * cell_m.max(1e-6);
        let clustering = cluster(positions, faces, cell_m);
        if clustering.faces.len() <= max_faces {
            return clustering;
        }
    }
}

/// The mesh with the vertices of each cell of a grid, metres, taken for one.
pub fn coarsened(mesh: &TriMesh, cell_m: f64) -> TriMesh {
    let narrow = |vertex: &Point3<f64>| vertex.coords.cast::<f32>().into();
    let positions: Vec<[f32; 3]> = mesh.vertices.iter().map(narrow).collect();
    let Clustering { kept, faces } = cluster(&positions, &mesh.faces, cell_m);
    let vertex = |&kept: &u32| mesh.vertices[kept as usize];
    TriMesh {
        vertices: kept.iter().map(vertex).collect(),
        faces,
    }
}

fn area_m2(positions: &[[f32; 3]], faces: &[[u32; 3]]) -> f64 {
    let corner = |vertex: u32| {
        let [x, y, z] = positions[vertex as usize].map(f64::from);
        nalgebra::Vector3::new(x, y, z)
    };
    faces
        .iter()
        .map(|&[a, b, c]| {
            let (a, b, c) = (corner(a), corner(b), corner(c));
            0.5 * (b - a).cross(&(c - a)).norm()
        })
        .sum()
}

fn cluster(positions: &[[f32; 3]], faces: &[[u32; 3]], cell_m: f64) -> Clustering {
    let (cell_of_vertex, n_cells) = cells(positions, cell_m);
    let kept_of_cell = representatives(positions, &cell_of_vertex, n_cells);
    let mut kept = kept_of_cell.clone();
    kept.sort_unstable();
    let new_index: HashMap<u32, u32> = kept.iter().copied().zip(0..).collect();
    let index_of_cell: Vec<u32> = kept_of_cell
        .iter()
        .map(|vertex| new_index[vertex])
        .collect();

    let mut seen = HashSet::new();
    let mut coarse = Vec::new();
    for face in faces {
        let [a, b, c] = face.map(|vertex| index_of_cell[cell_of_vertex[vertex as usize] as usize]);
        if a == b || b == c || c == a {
            continue;
        }
        let face = smallest_first([a, b, c]);
        if seen.insert(face) {
            coarse.push(face);
        }
    }
    Clustering {
        kept,
        faces: coarse,
    }
}

/// The cell of each vertex, numbered by their first vertices, and how many there are.
fn cells(positions: &[[f32; 3]], cell_m: f64) -> (Vec<u32>, usize) {
    let mut numbers: HashMap<[i32; 3], u32> = HashMap::new();
    let cell_of_vertex = positions
        .iter()
        .map(|position| {
            let cell = cell_of(&Point3::from(*position).cast(), cell_m);
            let next = numbers.len() as u32;
            *numbers.entry(cell).or_insert(next)
        })
        .collect();
    (cell_of_vertex, numbers.len())
}

/// The vertex of each cell that is nearest to the mean of its vertices; the first of equals.
fn representatives(positions: &[[f32; 3]], cell_of_vertex: &[u32], n_cells: usize) -> Vec<u32> {
    let mut sums = vec![([0.0; 3], 0.0); n_cells];
    for (position, &cell) in positions.iter().zip(cell_of_vertex) {
        let (sum, n) = &mut sums[cell as usize];
        for (sum, x) in sum.iter_mut().zip(position) {
            *sum += f64::from(*x);
        }
        *n += 1.0;
    }
    let mut nearest = vec![(f64::INFINITY, 0); n_cells];
    for (vertex, (position, &cell)) in positions.iter().zip(cell_of_vertex).enumerate() {
        let (sum, n) = &sums[cell as usize];
        let offsets = sum.iter().zip(position).map(|(s, x)| s / n - f64::from(*x));
        let squared: f64 = offsets.map(|offset| offset * offset).sum();
        let nearest = &mut nearest[cell as usize];
        if squared < nearest.0 {
            *nearest = (squared, vertex as u32);
        }
    }
    nearest.into_iter().map(|(_, vertex)| vertex).collect()
}

/// The same face, turned so that its smallest index comes first.
fn smallest_first([a, b, c]: [u32; 3]) -> [u32; 3] {
    if a < b && a < c {
        [a, b, c]
    } else if b < c {
        [b, c, a]
    } else {
        [c, a, b]
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A flat square metre of `n`×`n` squares, two faces each.
    fn grid(n: u32) -> (Vec<[f32; 3]>, Vec<[u32; 3]>) {
        let side = n + 1;
        let positions = (0..side * side)
            .map(|k| {
                [
                    (k % side) as f32 / n as f32,
                    (k / side) as f32 / n as f32,
                    0.5,
                ]
            })
            .collect();
        let corner = |u, v| v * side + u;
        let faces = (0..n * n)
            .flat_map(|k| {
                let (u, v) = (k % n, k / n);
                [
                    [corner(u, v), corner(u + 1, v), corner(u, v + 1)],
                    [corner(u + 1, v), corner(u + 1, v + 1), corner(u, v + 1)],
                ]
            })
            .collect();
        (positions, faces)
    }

    #[test]
    fn a_coarse_plane_keeps_its_area_its_side_and_vertices_of_its_own() {
        let (positions, faces) = grid(100);
        let coarse = cluster_vertices(&positions, &faces, 2000);
        let n = coarse.faces.len();
        assert!((1000..=2000).contains(&n), "{n} faces");
        let coarse_positions: Vec<_> = coarse
            .kept
            .iter()
            .map(|&vertex| positions[vertex as usize])
            .collect();
        // Only half a cell is lost along the border.
        let area = area_m2(&coarse_positions, &coarse.faces);
        assert!((0.85..=1.0).contains(&area), "{area} m²");
        for face in &coarse.faces {
            let [a, b, c] = face.map(|vertex| coarse_positions[vertex as usize]);
            let turn = (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0]);
            assert!(turn > 0.0, "a face was turned over");
        }
        assert!(coarse.kept.is_sorted());
    }

    #[test]
    fn a_coarsened_plane_is_the_same_plane_of_fewer_faces() {
        let (positions, faces) = grid(100);
        let vertex = |p: &[f32; 3]| Point3::from(p.map(f64::from));
        let fine = TriMesh {
            vertices: positions.iter().map(vertex).collect(),
            faces,
        };
        let coarse = coarsened(&fine, 0.04);
        assert!(coarse.faces.len() < fine.faces.len() / 8);
        assert!((coarse.area_m2() / fine.area_m2() - 1.0).abs() < 0.1);
        assert!(
            coarse
                .vertices
                .iter()
                .all(|vertex| fine.vertices.contains(vertex))
        );
    }

    #[test]
    fn a_small_mesh_stays_and_a_tiny_budget_ends() {
        let (positions, faces) = grid(4);
        let whole = cluster_vertices(&positions, &faces, 32);
        assert_eq!((whole.kept.len(), &whole.faces), (25, &faces));
        assert!(cluster_vertices(&positions, &faces, 0).faces.is_empty());
        let none = cluster_vertices(&[], &[], 10);
        assert_eq!(none, Clustering::default());
    }
}
