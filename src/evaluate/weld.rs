//! Vertices at one place made one: measured meshes come cut along the seams of a texture, or as single triangles.
//!
//! Welded is what is equal to the last bit. Not handled: places that differ by rounding, and sheets that lie back to back, whose
//! vertices become those of both.

use crate::geometry::TriMesh;
use nalgebra::Point3;
use std::collections::HashMap;

/// The mesh with one vertex at each place, numbered by the first; faces that are left without area by that are left out.
pub(super) fn welded(mesh: &TriMesh) -> TriMesh {
    let mut vertices: Vec<Point3<f64>> = Vec::new();
    let mut numbers: HashMap<[u64; 3], u32> = HashMap::new();
    let number = |vertex: &Point3<f64>| {
        *numbers.entry(place(vertex)).or_insert_with(|| {
            vertices.push(*vertex);
            vertices.len() as u32 - 1
        })
    };
    let number_of_vertex: Vec<u32> = mesh.vertices.iter().map(number).collect();
    let faces = mesh.faces.iter();
    let faces = faces.map(|face| face.map(|vertex| number_of_vertex[vertex as usize]));
    let faces = faces
        .filter(|[a, b, c]| a != b && b != c && c != a)
        .collect();
    TriMesh { vertices, faces }
}

/// What is equal where places are; the sum takes the sign off a zero.
fn place(vertex: &Point3<f64>) -> [u64; 3] {
    [vertex.x, vertex.y, vertex.z].map(|x| (x + 0.0).to_bits())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn single_triangles_become_the_mesh_that_they_were() {
        let point = |x: f64, y: f64| Point3::new(x, y, 0.1 * x * y);
        let whole = TriMesh {
            vertices: vec![
                point(0.0, 0.0),
                point(1.0, 0.0),
                point(0.0, 1.0),
                point(1.0, 1.0),
            ],
            faces: vec![[0, 1, 2], [2, 1, 3]],
        };
        assert_eq!(welded(&whole), whole);
        let mut cut = TriMesh {
            vertices: (0..2).flat_map(|face| whole.corners(face)).collect(),
            faces: vec![[0, 1, 2], [3, 4, 5]],
        };
        cut.vertices[3].x = -0.0;
        // Two of its corners are one place.
        cut.faces.push([1, 4, 5]);
        assert_eq!(welded(&cut), whole);
    }
}
