//! Tangential relaxation, and projection back onto the scanned surface.

use super::dynamic_mesh::{DynamicMesh, VertexKind};
use crate::geometry::TriangleBvh;
use nalgebra::{Point3, Vector3};
use rayon::prelude::*;

/// Times that vertices of folded faces are put back before the rest is accepted. Arbitrary.
const MAX_REPAIRS: usize = 4;

/// Cosine of the angle by which a face may turn before its corners are put back, 75°.
const MIN_TURN_COSINE: f64 = 0.25;

/// Height over longest side below which a face may turn as it likes: its normal says nothing.
const SLIVER_HEIGHT: f64 = 0.05;

/// Moves interior vertices to the area-weighted means of their neighbours, within their tangent planes, and from there
/// to the closest points of the surface. Vertices on the border stay, and so do those that would fold the surface.
pub(super) fn relax_onto(mesh: &mut DynamicMesh, surface: &TriangleBvh) {
    let areas: Vec<f64> = per_vertex(mesh, |vertex| {
        mesh.fan(vertex).map(|face| mesh.normal(face).norm()).sum()
    });
    let moved = per_vertex(mesh, |vertex| {
        if mesh.kind(vertex) != VertexKind::Interior || mesh.n_faces_of(vertex) == 0 {
            return *mesh.position(vertex);
        }
        let target = relaxed(mesh, vertex, &areas);
        surface
            .closest_point(&target, f64::INFINITY)
            .map_or(target, |closest| closest.point)
    });
    let old = std::mem::replace(&mut mesh.positions, moved);
    put_back_folds(mesh, &old);
}

fn per_vertex<T: Send>(mesh: &DynamicMesh, value: impl Fn(u32) -> T + Sync + Send) -> Vec<T> {
    (0..mesh.positions.len() as u32)
        .into_par_iter()
        .map(value)
        .collect()
}

/// The weighted mean of the neighbours, moved along the normal to the tangent plane of the vertex.
fn relaxed(mesh: &DynamicMesh, vertex: u32, areas: &[f64]) -> Point3<f64> {
    let p = mesh.position(vertex);
    let mut normal = Vector3::zeros();
    let (mut offset, mut weight) = (Vector3::zeros(), 0.0);
    for face in mesh.fan(vertex) {
        normal += mesh.normal(face);
        for neighbour in [face[1], face[2]] {
            let area = areas[neighbour as usize];
            offset += (mesh.position(neighbour) - p) * area;
            weight += area;
        }
    }
    match normal.try_normalize(0.0) {
        Some(n) if weight > 0.0 => {
            let offset = offset / weight;
            p + offset - n * n.dot(&offset)
        }
        _ => *p,
    }
}

/// Puts vertices back to `old` wherever a face around them has turned too far.
fn put_back_folds(mesh: &mut DynamicMesh, old: &[Point3<f64>]) {
    for _ in 0..MAX_REPAIRS {
        let folded = per_vertex(mesh, |vertex| {
            mesh.position(vertex) != &old[vertex as usize]
                && mesh.fan(vertex).any(|face| has_turned(mesh, face, old))
        });
        if !folded.contains(&true) {
            return;
        }
        for (vertex, _) in folded.iter().enumerate().filter(|(_, folded)| **folded) {
            mesh.positions[vertex] = old[vertex];
        }
    }
}

fn has_turned(mesh: &DynamicMesh, face: [u32; 3], old: &[Point3<f64>]) -> bool {
    let [a, b, c] = face.map(|vertex| old[vertex as usize]);
    let before = (b - a).cross(&(c - a));
    let longest = (b - a)
        .norm_squared()
        .max((c - b).norm_squared())
        .max((a - c).norm_squared());
    let after = mesh.normal(face);
    before.norm() > SLIVER_HEIGHT * longest
        && after.dot(&before) < MIN_TURN_COSINE * after.norm() * before.norm()
}
