//! Meshes as binary glTF 2.0, which browsers, phones and presentation programs open.
//!
//! The mesh keeps its own coordinates (metres, frame `world`: x right, y down, z forward); the root node turns the scene by
//! 180° about x, so that it stands upright in glTF's y-up frame. Where the frame is that of given poses nobody says which way is
//! up in it, and it is turned all the same: a reader that knows leaves the root node's rotation out.

use super::{ExportError, VertexAttributes, atomic::write_atomically, validate::check_surface};
use crate::geometry::TriMesh;
use nalgebra::Vector3;
use serde_json::{Value, json};
use std::{io::Write, path::Path};

const MAGIC: u32 = u32::from_le_bytes(*b"glTF");
const CHUNK_JSON: u32 = u32::from_le_bytes(*b"JSON");
const CHUNK_BINARY: u32 = u32::from_le_bytes(*b"BIN\0");
/// Buffer view targets and component types, by their OpenGL numbers.
const ARRAY_BUFFER: u32 = 34962;
const ELEMENT_ARRAY_BUFFER: u32 = 34963;
const UNSIGNED_BYTE: u32 = 5121;
const UNSIGNED_INT: u32 = 5125;
const FLOAT: u32 = 5126;
/// This share of the vertices is no brighter than white. The brightest of a refined scan is up to three and a half times as bright as
/// that, and would leave all others dark.
const WHITE_SHARE: f64 = 0.995;

/// Writes a mesh as binary glTF 2.0 with one rough, non-metallic, double-sided material.
///
/// Albedo, if given, becomes the linear vertex colour in grey. It contains the light's strength: white is the albedo that 0.5 % of
/// the vertices pass, which are white too, and stands in the file as `meshes[0].extras.albedo_full_scale`. The other attributes are
/// the application's own:
/// `_SIGMA` (metres), `_CONFIDENCE`, `_COVERAGE` (0 to 1), `_VIEWS` and `_LABEL`, all floats. Where a vertex has no normal (zero length),
/// the file says (0, 0, −1), towards the first camera, since glTF demands unit length.
///
/// # Errors
/// [`ExportError::Unfit`] if the mesh has no faces, attributes and vertices differ in number, a value is not finite, a face
/// names a vertex that does not exist, or the file would pass 4 GiB; [`ExportError::Write`] if it cannot be written.
pub fn write_glb(
    path: &Path,
    mesh: &TriMesh,
    normals: &[Vector3<f64>],
    attributes: Option<&VertexAttributes>,
) -> Result<(), ExportError> {
    check_surface(path, mesh, normals, attributes)?;
    if mesh.faces.is_empty() {
        let reason = "the mesh has no faces, glTF knows no empty mesh".into();
        return Err(ExportError::unfit(path, reason));
    }
    let (document, binary) = describe(mesh, normals, attributes);
    let glb = assemble(&document, binary.bytes)
        .ok_or_else(|| ExportError::unfit(path, "the file would pass 4 GiB".into()))?;
    write_atomically(path, |file| file.write_all(&glb))
}

/// The binary chunk while it grows; everything in it is made of four-byte words, so that all views are aligned.
#[derive(Default)]
struct Binary {
    bytes: Vec<u8>,
    views: Vec<Value>,
}

impl Binary {
    /// Appends one buffer view and returns its index.
    fn push(&mut self, target: u32, words: impl Iterator<Item = [u8; 4]>) -> usize {
        let offset = self.bytes.len();
        self.bytes.extend(words.flatten());
        self.views.push(json!({
            "buffer": 0, "byteOffset": offset, "byteLength": self.bytes.len() - offset, "target": target,
        }));
        self.views.len() - 1
    }
}

/// The glTF document and the buffer that it speaks of.
fn describe(
    mesh: &TriMesh,
    normals: &[Vector3<f64>],
    known: Option<&VertexAttributes>,
) -> (Value, Binary) {
    let words = |v: Vector3<f64>| [v.x, v.y, v.z].map(|x| (x as f32).to_le_bytes());
    let unit = |n: &Vector3<f64>| n.try_normalize(1e-12).unwrap_or(-Vector3::z());
    let n_vertices = mesh.vertices.len();
    let mut binary = Binary::default();
    let indices = mesh
        .faces
        .iter()
        .flatten()
        .map(|vertex| vertex.to_le_bytes());
    let indices = binary.push(ELEMENT_ARRAY_BUFFER, indices);
    let positions = mesh.vertices.iter().flat_map(|p| words(p.coords));
    let positions = binary.push(ARRAY_BUFFER, positions);
    let normals = binary.push(ARRAY_BUFFER, normals.iter().flat_map(|n| words(unit(n))));
    let (low, high) = bounds(mesh);
    let mut accessors = vec![
        json!({"bufferView": indices, "componentType": UNSIGNED_INT, "count": 3 * mesh.faces.len(), "type": "SCALAR"}),
        json!({"bufferView": positions, "componentType": FLOAT, "count": n_vertices, "type": "VEC3", "min": low, "max": high}),
        json!({"bufferView": normals, "componentType": FLOAT, "count": n_vertices, "type": "VEC3"}),
    ];
    let mut attributes = json!({"POSITION": 1, "NORMAL": 2});
    let mut extras = json!({"unit": "metre"});
    if let Some(known) = known {
        let albedo = known.albedo;
        let full_scale = white(albedo);
        let grey = |rho: &f64| [(255.0 * rho / full_scale).round() as u8; 3];
        let colours = albedo.iter().map(grey).map(|[r, g, b]| [r, g, b, 255]);
        let colours = binary.push(ARRAY_BUFFER, colours);
        accessors.push(json!({
            "bufferView": colours, "componentType": UNSIGNED_BYTE, "normalized": true, "count": n_vertices, "type": "VEC4",
        }));
        attributes["COLOR_0"] = json!(3);
        extras["albedo_full_scale"] = json!(full_scale);
        let floats = known
            .floats()
            .into_iter()
            .filter(|(name, _)| *name != "albedo");
        let floats = floats.map(|(name, column)| (name, column.to_vec()));
        let counts = known.counts().into_iter();
        let counts =
            counts.map(|(name, column)| (name, column.iter().copied().map(f64::from).collect()));
        for (name, column) in floats.chain(counts) {
            let values = column.iter().map(|&value| (value as f32).to_le_bytes());
            let view = binary.push(ARRAY_BUFFER, values);
            attributes[format!("_{}", name.to_uppercase())] = json!(accessors.len());
            accessors.push(json!({
                "bufferView": view, "componentType": FLOAT, "count": n_vertices, "type": "SCALAR",
            }));
        }
    }
    let document = json!({
        "asset": {"version": "2.0", "generator": "relief"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        // The quaternion (x, y, z, w) of 180° about x.
        "nodes": [{"mesh": 0, "name": "scan", "rotation": [1.0, 0.0, 0.0, 0.0]}],
        "meshes": [{
            "name": "scan",
            "primitives": [{"attributes": attributes, "indices": 0, "material": 0, "mode": 4}],
            "extras": extras,
        }],
        "materials": [{
            "name": "surface",
            "pbrMetallicRoughness": {"baseColorFactor": [1.0, 1.0, 1.0, 1.0], "metallicFactor": 0.0, "roughnessFactor": 1.0},
            "doubleSided": true,
        }],
        "accessors": accessors,
        "bufferViews": binary.views,
        "buffers": [{"byteLength": binary.bytes.len()}],
    });
    (document, binary)
}

/// The albedo that is shown white; 1 where all is black. There is at least one.
fn white(albedo: &[f64]) -> f64 {
    let mut sorted = albedo.to_vec();
    let rank = ((sorted.len() - 1) as f64 * WHITE_SHARE) as usize;
    let (_, white, _) = sorted.select_nth_unstable_by(rank, f64::total_cmp);
    match *white > 0.0 {
        true => *white,
        false => 1.0,
    }
}

/// The smallest and largest coordinates as they stand in the file.
fn bounds(mesh: &TriMesh) -> ([f32; 3], [f32; 3]) {
    let (mut low, mut high) = ([f32::INFINITY; 3], [f32::NEG_INFINITY; 3]);
    for vertex in &mesh.vertices {
        for axis in 0..3 {
            low[axis] = low[axis].min(vertex[axis] as f32);
            high[axis] = high[axis].max(vertex[axis] as f32);
        }
    }
    (low, high)
}

/// The whole file: header, JSON chunk padded by spaces, binary chunk. `None` beyond 4 GiB.
fn assemble(document: &Value, binary: Vec<u8>) -> Option<Vec<u8>> {
    let mut text = document.to_string().into_bytes();
    text.resize(text.len().next_multiple_of(4), b' ');
    let length = 12 + 8 + text.len() + 8 + binary.len();
    let mut glb = Vec::with_capacity(length);
    let header = [MAGIC, 2, u32::try_from(length).ok()?];
    let text_header = [text.len() as u32, CHUNK_JSON];
    let binary_header = [binary.len() as u32, CHUNK_BINARY];
    glb.extend(
        header
            .iter()
            .chain(&text_header)
            .flat_map(|word| word.to_le_bytes()),
    );
    glb.extend(text);
    glb.extend(binary_header.iter().flat_map(|word| word.to_le_bytes()));
    glb.extend(binary);
    Some(glb)
}

#[cfg(test)]
mod tests {
    use super::super::tests::{Columns, bumpy_sphere};
    use super::*;

    /// Takes a file apart, checking every length on the way.
    fn dissect(glb: &[u8]) -> (Value, Vec<u8>) {
        let word = |at: usize| u32::from_le_bytes(glb[at..at + 4].try_into().unwrap());
        assert_eq!((word(0), word(4), word(8) as usize), (MAGIC, 2, glb.len()));
        let n_text = word(12) as usize;
        assert_eq!((n_text % 4, word(16)), (0, CHUNK_JSON));
        let n_binary = word(20 + n_text) as usize;
        assert_eq!((n_binary % 4, word(24 + n_text)), (0, CHUNK_BINARY));
        assert_eq!(28 + n_text + n_binary, glb.len());
        let document = serde_json::from_slice(&glb[20..20 + n_text]).unwrap();
        (document, glb[28 + n_text..].to_vec())
    }

    fn bytes_of<'a>(document: &Value, binary: &'a [u8], accessor: usize) -> &'a [u8] {
        let accessor = &document["accessors"][accessor];
        let view = &document["bufferViews"][accessor["bufferView"].as_u64().unwrap() as usize];
        let (offset, length) = (
            view["byteOffset"].as_u64().unwrap(),
            view["byteLength"].as_u64().unwrap(),
        );
        let component = if accessor["componentType"] == json!(UNSIGNED_BYTE) {
            1
        } else {
            4
        };
        let n = match accessor["type"].as_str().unwrap() {
            "SCALAR" => 1,
            "VEC3" => 3,
            _ => 4,
        };
        assert_eq!(length, accessor["count"].as_u64().unwrap() * n * component);
        assert_eq!(offset % 4, 0);
        &binary[offset as usize..(offset + length) as usize]
    }

    fn floats(bytes: &[u8]) -> Vec<f32> {
        let words = bytes.chunks_exact(4);
        words
            .map(|word| f32::from_le_bytes(word.try_into().unwrap()))
            .collect()
    }

    #[test]
    fn chunks_accessors_and_bounds_agree_with_the_mesh() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("sphere.glb");
        let mesh = bumpy_sphere(16);
        let mut normals = mesh.vertex_normals();
        normals[0] = Vector3::zeros();
        let columns = Columns::of(mesh.vertices.len());
        write_glb(&path, &mesh, &normals, Some(&columns.attributes())).unwrap();
        let (document, binary) = dissect(&std::fs::read(&path).unwrap());
        assert_eq!(document["buffers"][0]["byteLength"], json!(binary.len()));

        let indices = bytes_of(&document, &binary, 0).chunks_exact(4);
        let indices: Vec<u32> = indices
            .map(|w| u32::from_le_bytes(w.try_into().unwrap()))
            .collect();
        assert_eq!(indices, mesh.faces.concat());
        let positions = floats(bytes_of(&document, &binary, 1));
        for axis in 0..3 {
            let along = positions.iter().skip(axis).step_by(3).copied();
            // As floats: the parser may be off by the last bit of a double.
            let bound =
                |which: &str| document["accessors"][1][which][axis].as_f64().unwrap() as f32;
            assert_eq!(bound("min"), along.clone().fold(f32::MAX, f32::min));
            assert_eq!(bound("max"), along.fold(f32::MIN, f32::max));
        }
        for normal in floats(bytes_of(&document, &binary, 2)).chunks_exact(3) {
            assert!((Vector3::from_column_slice(normal).norm() - 1.0).abs() < 1e-6);
        }
        let attributes = &document["meshes"][0]["primitives"][0]["attributes"];
        let column = |name: &str| {
            let accessor = attributes[name].as_u64().unwrap() as usize;
            floats(bytes_of(&document, &binary, accessor))
        };
        let narrow = |values: &[f64]| values.iter().map(|&x| x as f32).collect::<Vec<f32>>();
        assert_eq!(column("_SIGMA"), narrow(&columns.sigma_m));
        assert_eq!(column("_CONFIDENCE"), narrow(&columns.confidence));
        assert_eq!(column("_COVERAGE"), narrow(&columns.coverage));
        assert_eq!(column("_LABEL")[5], f32::from(columns.label[5]));
        assert_eq!(column("_VIEWS")[5], f32::from(columns.n_views[5]));
    }

    #[test]
    fn greys_are_apart_under_weak_light_and_beside_bright_sites() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("sphere.glb");
        let mesh = bumpy_sphere(16);
        let n = mesh.vertices.len();
        let mut columns = Columns::of(n);
        columns.albedo = (0..n).map(|k| 0.1 + 0.1 * k as f64 / n as f64).collect();
        columns.albedo[7] = 1.0;
        let normals = mesh.vertex_normals();
        write_glb(&path, &mesh, &normals, Some(&columns.attributes())).unwrap();
        let (document, binary) = dissect(&std::fs::read(&path).unwrap());
        let extras = &document["meshes"][0]["extras"];
        let full_scale = extras["albedo_full_scale"].as_f64().unwrap();
        assert!((0.195..0.2).contains(&full_scale), "{full_scale}");
        let colours = bytes_of(&document, &binary, 3).chunks_exact(4);
        for (colour, &albedo) in colours.zip(&columns.albedo) {
            let [r, g, b, alpha] = [colour[0], colour[1], colour[2], colour[3]];
            assert_eq!((r, g, alpha), (b, b, 255));
            let shown = f64::from(r) / 255.0 * full_scale;
            // Half a step, and what is brighter than white.
            let expected = albedo.min(full_scale);
            assert!((shown - expected).abs() < 0.51 / 255.0 * full_scale);
        }
    }

    #[test]
    fn an_all_black_mesh_has_a_scale() {
        assert_eq!(white(&[0.0; 3]), 1.0);
    }

    #[test]
    fn an_empty_mesh_is_refused() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("empty.glb");
        assert!(write_glb(&path, &TriMesh::default(), &[], None).is_err());
        assert!(!path.exists());
    }
}
