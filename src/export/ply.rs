//! Meshes as binary PLY, the format that every mesh tool reads.

use super::{ExportError, VertexAttributes, atomic::write_atomically, validate::check_surface};
use crate::geometry::TriMesh;
use nalgebra::Vector3;
use std::{
    io::{self, Write},
    path::Path,
};

/// Writes a mesh as binary little-endian PLY.
///
/// Vertices carry `x y z` (metres, frame `world`), `nx ny nz` and, if given, `albedo` (m²), `sigma` (metres), `confidence` and
/// `coverage` (0 to 1), all 32-bit floats, and `views` and `label` as bytes: see [`VertexAttributes`]. Faces are lists of three
/// vertex indices, counter-clockwise seen from outside. An empty mesh gives an empty but valid file.
///
/// # Errors
/// [`ExportError::Unfit`] if attributes and vertices differ in number, a value is not finite, a face names a vertex that
/// does not exist, or there are more than 2³¹−1 vertices; [`ExportError::Write`] if the file cannot be written.
pub fn write_ply(
    path: &Path,
    mesh: &TriMesh,
    normals: &[Vector3<f64>],
    attributes: Option<&VertexAttributes>,
) -> Result<(), ExportError> {
    check_surface(path, mesh, normals, attributes)?;
    // Indices are written as signed integers, which the oldest readers know.
    if mesh.vertices.len() > i32::MAX as usize {
        let reason = format!("{} vertices, at most {}", mesh.vertices.len(), i32::MAX);
        return Err(ExportError::unfit(path, reason));
    }
    write_atomically(path, |file| {
        file.write_all(header(mesh, attributes).as_bytes())?;
        for (vertex, (position, normal)) in mesh.vertices.iter().zip(normals).enumerate() {
            write_floats(file, position.coords.as_slice())?;
            write_floats(file, normal.as_slice())?;
            if let Some(attributes) = attributes {
                let floats = attributes.floats().map(|(_, column)| column[vertex]);
                write_floats(file, &floats)?;
                file.write_all(&attributes.counts().map(|(_, column)| column[vertex]))?;
            }
        }
        for face in &mesh.faces {
            file.write_all(&[3])?;
            for vertex in face {
                file.write_all(&vertex.to_le_bytes())?;
            }
        }
        Ok(())
    })
}

fn header(mesh: &TriMesh, attributes: Option<&VertexAttributes>) -> String {
    let properties = attributes.map_or_else(String::new, |attributes| {
        let float = |(name, _)| format!("property float {name}\n");
        let count = |(name, _)| format!("property uchar {name}\n");
        let floats = attributes.floats().map(float).concat();
        floats + &attributes.counts().map(count).concat()
    });
    format!(
        "ply\nformat binary_little_endian 1.0\n\
         comment relief: metres, frame of the first camera (x right, y down, z forward), or of the poses given\n\
         element vertex {}\n\
         property float x\nproperty float y\nproperty float z\n\
         property float nx\nproperty float ny\nproperty float nz\n{properties}\
         element face {}\nproperty list uchar int vertex_indices\nend_header\n",
        mesh.vertices.len(),
        mesh.faces.len()
    )
}

fn write_floats(file: &mut impl Write, values: &[f64]) -> io::Result<()> {
    values
        .iter()
        .try_for_each(|&value| file.write_all(&(value as f32).to_le_bytes()))
}

#[cfg(test)]
mod tests {
    use super::super::{
        read_ply,
        tests::{Columns, bumpy_sphere},
    };
    use super::*;

    #[test]
    fn a_mesh_survives_the_round_trip_to_single_precision() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("sphere.ply");
        let mesh = bumpy_sphere(24);
        let columns = Columns::of(mesh.vertices.len());
        for attributes in [None, Some(&columns.attributes())] {
            write_ply(&path, &mesh, &mesh.vertex_normals(), attributes).unwrap();
            let back = read_ply(&path).unwrap();
            assert_eq!(back.faces, mesh.faces);
            for (a, b) in back.vertices.iter().zip(&mesh.vertices) {
                // Half a unit in the last place of a float below 1 m is 30 nm.
                assert!((a - b).amax() < 3e-8 + 1e-12);
            }
        }
        write_ply(&path, &TriMesh::default(), &[], None).unwrap();
        assert_eq!(read_ply(&path).unwrap(), TriMesh::default());
    }

    #[test]
    fn the_comment_is_true_of_poses_that_were_given_as_well() {
        let header = header(&TriMesh::default(), None);
        let comment = header.lines().find(|line| line.starts_with("comment"));
        assert!(comment.unwrap().ends_with(", or of the poses given"));
    }

    #[test]
    fn every_attribute_stands_behind_its_name() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("sphere.ply");
        let mesh = bumpy_sphere(6);
        let columns = Columns::of(mesh.vertices.len());
        let attributes = columns.attributes();
        write_ply(&path, &mesh, &mesh.vertex_normals(), Some(&attributes)).unwrap();
        let bytes = std::fs::read(&path).unwrap();
        let (header, rows) = super::super::ply_header::parse_header(&bytes).unwrap();
        let names: Vec<&str> = header.elements[0]
            .properties
            .iter()
            .map(|property| property.name.as_str())
            .collect();
        let behind = [
            "albedo",
            "sigma",
            "confidence",
            "coverage",
            "views",
            "label",
        ];
        assert_eq!(names[6..], behind);
        // Ten floats and two bytes a vertex.
        let row = &rows[3 * 42..4 * 42];
        let float = |at: usize| f32::from_le_bytes(row[4 * at..4 * at + 4].try_into().unwrap());
        assert_eq!(float(7), columns.sigma_m[3] as f32);
        assert_eq!(float(9), columns.coverage[3] as f32);
        assert_eq!(row[40..], [columns.n_views[3], columns.label[3]]);
    }

    #[test]
    fn unfit_meshes_are_refused_and_leave_no_file() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("bad.ply");
        let good = bumpy_sphere(8);
        let normals = good.vertex_normals();
        let mut not_finite = good.clone();
        not_finite.vertices[3].y = f64::NAN;
        let mut out_of_range = good.clone();
        out_of_range.faces[5][1] = 1_000_000;
        let refused = |mesh: &TriMesh, normals: &[Vector3<f64>], columns: Option<&Columns>| {
            let attributes = columns.map(Columns::attributes);
            let error = write_ply(&path, mesh, normals, attributes.as_ref()).unwrap_err();
            assert!(!path.exists());
            error.to_string()
        };
        assert!(refused(&not_finite, &normals, None).contains("vertex 3"));
        assert!(refused(&out_of_range, &normals, None).contains("face 5"));
        assert!(refused(&good, &normals[1..], None).contains("normals"));
        let n = good.vertices.len();
        let short = Columns::of(n - 1);
        assert!(refused(&good, &normals, Some(&short)).contains("values of albedo"));
        let mut negative = Columns::of(n);
        negative.sigma_m[7] = -0.1;
        assert!(refused(&good, &normals, Some(&negative)).contains("sigma of vertex 7 is -0.1"));
    }
}
