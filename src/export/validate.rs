//! What every mesh writer demands of its input before the first byte is written.

use super::{ExportError, VertexAttributes};
use crate::geometry::TriMesh;
use nalgebra::Vector3;
use std::path::Path;

/// Checks that a mesh with its attributes can stand in a file: one finite normal and one finite, non-negative value of every
/// attribute a vertex, finite positions, and faces that name existing vertices.
///
/// # Errors
/// [`ExportError::Unfit`] naming the first offender.
pub(super) fn check_surface(
    path: &Path,
    mesh: &TriMesh,
    normals: &[Vector3<f64>],
    attributes: Option<&VertexAttributes>,
) -> Result<(), ExportError> {
    let unfit = |reason: String| Err(ExportError::unfit(path, reason));
    let n_vertices = mesh.vertices.len();
    if normals.len() != n_vertices {
        return unfit(format!(
            "{} normals for {n_vertices} vertices",
            normals.len()
        ));
    }
    let finite = |x: &f64| (*x as f32).is_finite();
    if let Some(vertex) = mesh.vertices.iter().position(|p| !p.iter().all(finite)) {
        return unfit(format!("vertex {vertex} is not finite"));
    }
    if let Some(vertex) = normals.iter().position(|n| !n.iter().all(finite)) {
        return unfit(format!("the normal of vertex {vertex} is not finite"));
    }
    let out_of_range = |face: &[u32; 3]| face.iter().any(|&vertex| vertex as usize >= n_vertices);
    if let Some(face) = mesh.faces.iter().position(out_of_range) {
        let corners = mesh.faces[face];
        return unfit(format!(
            "face {face} is {corners:?}, there are {n_vertices} vertices"
        ));
    }
    attributes.map_or(Ok(()), |attributes| attributes.check(path, n_vertices))
}
