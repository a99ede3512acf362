//! Meshes as the page reads them, little endian: `"RLM1"`, `u32` revision, vertices, faces; then `f32` positions (metres,
//! world), `i8` normals (x, y, z, 0; times 127), one `u8` for each vertex padded to four bytes, `u32` corners of the faces.

use crate::geometry::TriMesh;
use nalgebra::Vector3;

const MAGIC: &[u8; 4] = b"RLM1";

/// The parts of a mesh; all but the faces have one entry for each vertex.
#[derive(Clone, Copy, Debug)]
pub struct MeshParts<'a> {
    /// Rises with every change.
    pub revision: u32,
    /// Metres.
    pub positions: &'a [[f32; 3]],
    /// Unit normals times 127.
    pub normals: &'a [[i8; 3]],
    /// Coverage, or difference.
    pub amounts: &'a [u8],
    /// Corners.
    pub faces: &'a [[u32; 3]],
}

impl MeshParts<'_> {
    /// The mesh in bytes.
    pub fn encode(&self) -> Vec<u8> {
        let n_vertices = self.positions.len();
        let n_bytes = 16 + n_vertices * 17 + 3 + self.faces.len() * 12;
        let mut bytes = Vec::with_capacity(n_bytes);
        bytes.extend(MAGIC);
        for number in [self.revision, n_vertices as u32, self.faces.len() as u32] {
            bytes.extend(number.to_le_bytes());
        }
        for x in self.positions.as_flattened() {
            bytes.extend(x.to_le_bytes());
        }
        for [x, y, z] in self.normals {
            bytes.extend([*x as u8, *y as u8, *z as u8, 0]);
        }
        bytes.extend(self.amounts);
        bytes.resize(bytes.len().next_multiple_of(4), 0);
        for corner in self.faces.as_flattened() {
            bytes.extend(corner.to_le_bytes());
        }
        bytes
    }
}

/// A whole mesh in bytes, with an amount for each vertex.
pub fn encode_tri_mesh(mesh: &TriMesh, amounts: &[u8]) -> Vec<u8> {
    let positions: Vec<[f32; 3]> = mesh
        .vertices
        .iter()
        .map(|vertex| vertex.coords.map(|x| x as f32).into())
        .collect();
    let normals: Vec<[i8; 3]> = mesh.vertex_normals().iter().map(small_normal).collect();
    MeshParts {
        revision: 0,
        positions: &positions,
        normals: &normals,
        amounts,
        faces: &mesh.faces,
    }
    .encode()
}

fn small_normal(normal: &Vector3<f64>) -> [i8; 3] {
    normal.map(|x| (127.0 * x).round() as i8).into()
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::Point3;

    #[test]
    fn bytes_lie_where_the_page_reads_them() {
        let mesh = TriMesh {
            vertices: vec![
                Point3::new(0.0, 0.0, 1.0),
                Point3::new(0.5, 0.0, 1.0),
                Point3::new(0.0, 0.5, 1.0),
                Point3::new(0.5, 0.5, 1.0),
                Point3::new(9.0, 9.0, 9.0),
            ],
            faces: vec![[0, 1, 2], [1, 3, 2]],
        };
        let bytes = encode_tri_mesh(&mesh, &[1, 2, 3, 4, 5]);
        assert_eq!(&bytes[..4], MAGIC);
        let number = |at: usize| u32::from_le_bytes(bytes[at..at + 4].try_into().unwrap());
        assert_eq!((number(4), number(8), number(12)), (0, 5, 2));
        assert_eq!(number(16 + 12), 0.5f32.to_bits());
        let normals_at = 16 + 5 * 12;
        assert_eq!(bytes[normals_at..normals_at + 4], [0, 0, 127, 0]);
        let amounts_at = normals_at + 5 * 4;
        assert_eq!(bytes[amounts_at..amounts_at + 8], [1, 2, 3, 4, 5, 0, 0, 0]);
        let faces_at = amounts_at + 8;
        assert_eq!((number(faces_at + 4), number(faces_at + 12)), (1, 1));
        assert_eq!(bytes.len(), faces_at + 2 * 12);
    }
}
