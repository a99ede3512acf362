//! What every mesh writer demands of its input before the first byte is written.

use super::ExportError;
use crate::geometry::TriMesh;
use nalgebra::Vector3;
use std::path::Path;

/// Checks that a mesh with its attributes can stand in a file: one finite normal and one finite, non-negative albedo a
/// vertex, finite positions, and faces that name existing vertices.
///
/// # Errors
/// [`ExportError::Unfit`] naming the first offender.
pub(super) fn check_surface(
    path: &Path,
    mesh: &TriMesh,
    normals: &[Vector3<f64>],
    albedo: Option<&[f64]>,
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
    albedo.map_or(Ok(()), |albedo| check_albedo(path, n_vertices, albedo))
}

fn check_albedo(path: &Path, n_vertices: usize, albedo: &[f64]) -> Result<(), ExportError> {
    if albedo.len() != n_vertices {
        let reason = format!("{} albedos for {n_vertices} vertices", albedo.len());
        return Err(ExportError::unfit(path, reason));
    }
    match albedo
        .iter()
        .position(|&rho| !((rho as f32).is_finite() && rho >= 0.0))
    {
        Some(vertex) => Err(ExportError::unfit(
            path,
            format!(
                "the albedo of vertex {vertex} is {}, must be finite and at least 0",
                albedo[vertex]
            ),
        )),
        None => Ok(()),
    }
}
