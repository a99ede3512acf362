//! Reads the meshes of PLY files, ours and those of other tools.
//!
//! Handled: ascii and binary little-endian, any further elements and properties (skipped), polygons (cut into fans of
//! triangles, exact for convex ones). Not handled: big-endian files, triangle strips.

use super::{
    ExportError,
    ply_header::{Element, Encoding, Property, Scalar, parse_header},
};
use crate::geometry::TriMesh;
use nalgebra::Point3;
use std::{fs, path::Path, str::SplitAsciiWhitespace};

/// Reads vertices and faces of an ascii or binary little-endian PLY file; all other properties are skipped.
///
/// # Errors
/// [`ExportError::Read`] if the file cannot be read; [`ExportError::Malformed`] if it is not a PLY file, ends too early,
/// has a vertex that is not finite, or a face that names a vertex that does not exist.
pub fn read_ply(path: &Path) -> Result<TriMesh, ExportError> {
    let bytes = fs::read(path).map_err(|cause| ExportError::read(path, cause))?;
    parse(&bytes).map_err(|reason| ExportError::malformed(path, reason))
}

fn parse(bytes: &[u8]) -> Result<TriMesh, String> {
    let (header, body) = parse_header(bytes)?;
    let mut body = match header.encoding {
        Encoding::BinaryLittleEndian => Body::Binary(body),
        Encoding::Ascii => Body::Ascii(
            std::str::from_utf8(body)
                .map_err(|_| "an ascii file with bytes that are not text")?
                .split_ascii_whitespace(),
        ),
    };
    let mut mesh = TriMesh::default();
    for element in &header.elements {
        match element.name.as_str() {
            "vertex" => mesh.vertices = read_vertices(element, &mut body)?,
            "face" => mesh.faces = read_faces(element, &mut body)?,
            _ => for_each_row(element, &mut body, |_, _, _| Ok(()))?,
        }
    }
    let n_vertices = mesh.vertices.len();
    match mesh
        .faces
        .iter()
        .flatten()
        .find(|&&vertex| vertex as usize >= n_vertices)
    {
        Some(vertex) => Err(format!(
            "a face names vertex {vertex}, there are {n_vertices} vertices"
        )),
        None => Ok(mesh),
    }
}

fn read_vertices(element: &Element, body: &mut Body) -> Result<Vec<Point3<f64>>, String> {
    let column = |name: &str| {
        let is_it = |p: &Property| p.name == name && p.count.is_none();
        let column = element.properties.iter().position(is_it);
        column.ok_or_else(|| format!("vertices have no property {name}"))
    };
    let columns = [column("x")?, column("y")?, column("z")?];
    let mut vertices: Vec<Point3<f64>> = Vec::new();
    for_each_row(element, body, |row, column, values| {
        if column == 0 {
            vertices.push(Point3::origin());
        }
        if let Some(axis) = columns.iter().position(|&c| c == column) {
            if !values[0].is_finite() {
                return Err(format!("vertex {row} is not finite"));
            }
            vertices[row][axis] = values[0];
        }
        Ok(())
    })?;
    Ok(vertices)
}

fn read_faces(element: &Element, body: &mut Body) -> Result<Vec<[u32; 3]>, String> {
    let is_corners = |p: &Property| {
        p.count.is_some() && matches!(p.name.as_str(), "vertex_indices" | "vertex_index")
    };
    let corners_column = element
        .properties
        .iter()
        .position(is_corners)
        .ok_or("faces have no list vertex_indices")?;
    let mut faces = Vec::new();
    for_each_row(element, body, |row, column, values| {
        if column != corners_column {
            return Ok(());
        }
        if values.len() < 3 {
            return Err(format!(
                "face {row} has {} corners, at least 3",
                values.len()
            ));
        }
        let mut corners = Vec::with_capacity(values.len());
        for &value in values {
            corners
                .push(as_index(value).ok_or_else(|| format!("face {row} names vertex {value}"))?);
        }
        faces.extend((2..corners.len()).map(|k| [corners[0], corners[k - 1], corners[k]]));
        Ok(())
    })?;
    Ok(faces)
}

/// The index that a number is, if it is one.
fn as_index(value: f64) -> Option<u32> {
    (value >= 0.0 && value <= u32::MAX as f64 && value.fract() == 0.0).then_some(value as u32)
}

/// Calls `take(row, column, values)` for every property of every row of an element.
fn for_each_row(
    element: &Element,
    body: &mut Body,
    mut take: impl FnMut(usize, usize, &[f64]) -> Result<(), String>,
) -> Result<(), String> {
    // An element without properties takes no room, however many rows it claims.
    let n_rows = if element.properties.is_empty() {
        0
    } else {
        element.n_rows
    };
    let mut values = Vec::new();
    for row in 0..n_rows {
        for (column, property) in element.properties.iter().enumerate() {
            body.read(property, &mut values)
                .map_err(|what| format!("{} {row} of {n_rows}: {what}", element.name))?;
            take(row, column, &values)?;
        }
    }
    Ok(())
}

/// The part of the file that has not been read yet.
enum Body<'a> {
    Binary(&'a [u8]),
    Ascii(SplitAsciiWhitespace<'a>),
}

impl Body<'_> {
    /// Replaces `values` by the value or values of the next property.
    fn read(&mut self, property: &Property, values: &mut Vec<f64>) -> Result<(), String> {
        values.clear();
        let n = match property.count {
            None => 1,
            Some(count) => {
                let n = self.number(count)?;
                as_index(n).ok_or_else(|| format!("{} has {n} entries", property.name))?
            }
        };
        for _ in 0..n {
            values.push(self.number(property.value)?);
        }
        Ok(())
    }

    fn number(&mut self, scalar: Scalar) -> Result<f64, String> {
        match self {
            Body::Ascii(words) => {
                let word = words.next().ok_or("truncated, the file ends here")?;
                word.parse()
                    .map_err(|_| format!("`{word}` is not a number"))
            }
            Body::Binary(bytes) => binary_number(bytes, scalar)
                .ok_or_else(|| "truncated, the file ends here".to_string()),
        }
    }
}

fn binary_number(bytes: &mut &[u8], scalar: Scalar) -> Option<f64> {
    fn take<const N: usize>(bytes: &mut &[u8]) -> Option<[u8; N]> {
        let (head, tail) = bytes.split_first_chunk::<N>()?;
        *bytes = tail;
        Some(*head)
    }
    Some(match scalar {
        Scalar::I8 => i8::from_le_bytes(take(bytes)?).into(),
        Scalar::U8 => u8::from_le_bytes(take(bytes)?).into(),
        Scalar::I16 => i16::from_le_bytes(take(bytes)?).into(),
        Scalar::U16 => u16::from_le_bytes(take(bytes)?).into(),
        Scalar::I32 => i32::from_le_bytes(take(bytes)?).into(),
        Scalar::U32 => u32::from_le_bytes(take(bytes)?).into(),
        Scalar::F32 => f32::from_le_bytes(take(bytes)?).into(),
        Scalar::F64 => f64::from_le_bytes(take(bytes)?),
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    const QUAD: &str = "ply\r\nformat ascii 1.0\r\ncomment made by hand\r\nelement vertex 4\r\n\
        property uchar red\r\nproperty double x\r\nproperty double y\r\nproperty double z\r\n\
        element face 1\r\nproperty list uchar uint vertex_index\r\nproperty short group\r\n\
        element note 1\r\nproperty list int char text\r\nend_header\r\n\
        9 0 0 0\r\n9 1 0 0\r\n9 1 1 0.5\r\n9 0 1 0\r\n4 0 1 2 3 7\r\n2 104 105\r\n";

    #[test]
    fn an_ascii_quad_with_strange_properties_becomes_two_triangles() {
        let mesh = parse(QUAD.as_bytes()).unwrap();
        assert_eq!(mesh.faces, [[0, 1, 2], [0, 2, 3]]);
        assert_eq!(mesh.vertices[2], Point3::new(1.0, 1.0, 0.5));
    }

    #[test]
    fn a_comment_may_be_in_any_encoding() {
        let (before, after) = QUAD.split_once("hand").unwrap();
        // René in Latin-1.
        let name = &b"Ren\xe9"[..];
        let file = [before.as_bytes(), name, after.as_bytes()].concat();
        assert_eq!(parse(&file), parse(QUAD.as_bytes()));
    }

    #[test]
    fn every_defect_is_named() {
        let fault = |bytes: &[u8]| parse(bytes).unwrap_err();
        assert!(fault(b"solid cube\n").contains("not a PLY"));
        assert!(fault(b"").contains("not a PLY"));
        assert!(fault(b"ply\nformat ascii 1.0\n").contains("end_header"));
        assert!(fault(b"ply\nformat ascii 1.0\n\xff\x80\n").contains("end_header"));
        let edited = |from: &str, to: &str| fault(QUAD.replace(from, to).as_bytes());
        assert!(edited("4 0 1 2 3 7", "4 0 1 2 4 7").contains("names vertex 4"));
        assert!(edited("4 0 1 2 3 7", "4 0 1 2 -1 7").contains("names vertex -1"));
        assert!(edited("4 0 1 2 3 7", "2 0 1 7").contains("2 corners"));
        assert!(edited("9 1 0 0", "9 nan 0 0").contains("vertex 1 is not finite"));
        assert!(edited("9 1 0 0", "9 one 0 0").contains("`one`"));
        assert!(edited("2 104 105", "2 104").contains("note 0 of 1: truncated"));
        assert!(edited("ascii", "binary_big_endian").contains("big_endian"));
        assert!(edited("double x", "double w").contains("no property x"));
        assert!(edited("element vertex 4", "element vertex many").contains("many"));
    }

    #[test]
    fn a_binary_file_cut_anywhere_is_an_error_and_never_a_panic() {
        let mut file =
            b"ply\nformat binary_little_endian 1.0\nelement vertex 3\nproperty float x\n\
            property float y\nproperty float z\nproperty uchar quality\nelement face 1\n\
            property list uchar ushort vertex_indices\nend_header\n"
                .to_vec();
        for vertex in 0..3u8 {
            for value in [vertex as f32, 0.5, (vertex * vertex) as f32] {
                file.extend(value.to_le_bytes());
            }
            file.push(200);
        }
        file.extend([3, 0, 0, 1, 0, 2, 0]);
        let mesh = parse(&file).unwrap();
        assert_eq!(mesh.faces, [[0, 1, 2]]);
        assert_eq!(mesh.vertices[2], Point3::new(2.0, 0.5, 4.0));
        for length in 0..file.len() {
            assert!(parse(&file[..length]).is_err(), "{length}");
        }
    }
}
