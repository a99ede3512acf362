//! Tangential relaxation, and projection back onto the scanned surface.

use super::dynamic_mesh::{DynamicMesh, VertexKind, is_sliver};
use crate::geometry::TriangleBvh;
use crate::refine::tiles::in_tiles;
use nalgebra::{Point3, Vector3};
use rayon::prelude::*;

/// Times that vertices of folded faces are put back before the rest is accepted. Arbitrary.
const MAX_REPAIRS: usize = 4;

/// Cosine of the angle by which a face may turn before its corners are put back, 75°.
const MIN_TURN_COSINE: f64 = 0.25;

/// More than a place on the surface is off by, metres.
const ROUNDING_M: f64 = 1e-9;

/// Moves interior vertices to the area-weighted means of their neighbours, within their tangent planes, and from there
/// to the closest points of the surface. Vertices on the border stay, and so do those that would fold the surface.
pub(super) fn relax_onto(mesh: &mut DynamicMesh, surface: &TriangleBvh) {
    relax(mesh, |target, from| {
        // The vertex lies on the surface itself but for rounding, if it has been moved there before.
        let reach = 1.001 * (target - from).norm() + ROUNDING_M;
        surface
            .closest_point(&target, reach)
            .or_else(|| surface.closest_point(&target, f64::INFINITY))
            .map_or(target, |closest| closest.point)
    });
}

/// Moves interior vertices to the area-weighted means of their neighbours, within their tangent planes, and where `onto` then puts
/// them, which is told where they were. Vertices on the border stay, and so do those that would fold the surface.
pub(super) fn relax(
    mesh: &mut DynamicMesh,
    onto: impl Fn(Point3<f64>, &Point3<f64>) -> Point3<f64> + Sync + Send,
) {
    let normals: Vec<Vector3<f64>> = (0..mesh.n_face_slots())
        .into_par_iter()
        .map(|face| {
            mesh.face(face)
                .map_or_else(Vector3::zeros, |corners| mesh.normal(corners))
        })
        .collect();
    let around = |vertex: u32| {
        mesh.faces_of(vertex)
            .iter()
            .map(|&face| &normals[face as usize])
    };
    let areas: Vec<f64> = per_vertex(mesh, |vertex| around(vertex).map(Vector3::norm).sum());
    let moved = per_vertex(mesh, |vertex| {
        if mesh.kind(vertex) != VertexKind::Interior || mesh.faces_of(vertex).is_empty() {
            return *mesh.position(vertex);
        }
        let target = relaxed(mesh, vertex, &areas, &around(vertex).sum());
        onto(target, mesh.position(vertex))
    });
    let old = std::mem::replace(&mut mesh.positions, moved);
    put_back_folds(mesh, &old);
}

fn per_vertex<T: Send>(mesh: &DynamicMesh, value: impl Fn(u32) -> T + Sync + Send) -> Vec<T> {
    in_tiles(mesh.positions.len())
        .map(|vertex| value(vertex as u32))
        .collect()
}

/// The weighted mean of the neighbours, moved along the normal (of any length) to the tangent plane of the vertex.
fn relaxed(mesh: &DynamicMesh, vertex: u32, areas: &[f64], normal: &Vector3<f64>) -> Point3<f64> {
    let p = mesh.position(vertex);
    let (mut offset, mut weight) = (Vector3::zeros(), 0.0);
    for [_, next, last] in mesh.fan(vertex) {
        for neighbour in [next, last] {
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
    let mut suspects: Vec<u32> = (0..mesh.n_face_slots() as u32).collect();
    for _ in 0..MAX_REPAIRS {
        let corners = |&face: &u32| mesh.face(face as usize);
        let turned = suspects.par_iter().filter_map(corners);
        let turned: Vec<[u32; 3]> = turned.filter(|&face| has_turned(mesh, face, old)).collect();
        suspects.clear();
        for vertex in turned.into_iter().flatten() {
            let place = &mut mesh.positions[vertex as usize];
            if *place != old[vertex as usize] {
                *place = old[vertex as usize];
                // Only a face with a corner that was put back can have turned again.
                suspects.extend_from_slice(mesh.faces_of(vertex));
            }
        }
        if suspects.is_empty() {
            return;
        }
        suspects.sort_unstable();
        suspects.dedup();
    }
}

fn has_turned(mesh: &DynamicMesh, face: [u32; 3], old: &[Point3<f64>]) -> bool {
    let corners = face.map(|vertex| &old[vertex as usize]);
    let [a, b, c] = corners;
    let (before, after) = ((b - a).cross(&(c - a)), mesh.normal(face));
    let along = after.dot(&before);
    let least = MIN_TURN_COSINE.powi(2) * after.norm_squared() * before.norm_squared();
    let stands = along > 0.0 && along * along >= least;
    // A sliver may turn as it likes.
    !stands && !is_sliver(corners, &before)
}
