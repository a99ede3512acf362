//! Scenes shared by the tests of all writers.

use super::VertexAttributes;
use crate::geometry::TriMesh;
use nalgebra::{Point3, Vector3};
use std::f64::consts::{PI, TAU};

/// A closed sphere of 100 mm radius, 0.6 m before the camera, with bumps of 6 mm; `n` rings of `2 n` vertices.
pub(super) fn bumpy_sphere(n: usize) -> TriMesh {
    let centre = Vector3::new(0.0, 0.0, 0.6);
    let vertex = |theta: f64, phi: f64| {
        let bump = (6.0 * phi).cos() * (5.0 * theta).sin() * theta.sin();
        let radius_m = 0.1 + 0.006 * bump;
        let direction = Vector3::new(
            theta.sin() * phi.sin(),
            -theta.cos(),
            -theta.sin() * phi.cos(),
        );
        Point3::from(centre + direction * radius_m)
    };
    let n_around = 2 * n;
    let mut mesh = TriMesh::default();
    mesh.vertices.push(vertex(0.0, 0.0));
    for ring in 1..n {
        for k in 0..n_around {
            mesh.vertices.push(vertex(
                PI * ring as f64 / n as f64,
                TAU * k as f64 / n_around as f64,
            ));
        }
    }
    mesh.vertices.push(vertex(PI, 0.0));
    let at = |ring: usize, k: usize| (1 + (ring - 1) * n_around + k % n_around) as u32;
    let last = mesh.vertices.len() as u32 - 1;
    for k in 0..n_around {
        mesh.faces.push([0, at(1, k), at(1, k + 1)]);
        for ring in 1..n - 1 {
            mesh.faces
                .push([at(ring, k), at(ring + 1, k), at(ring, k + 1)]);
            mesh.faces
                .push([at(ring, k + 1), at(ring + 1, k), at(ring + 1, k + 1)]);
        }
        mesh.faces.push([at(n - 1, k), last, at(n - 1, k + 1)]);
    }
    mesh
}

/// Attributes of so many vertices, all different.
pub(super) struct Columns {
    pub albedo: Vec<f64>,
    pub sigma_m: Vec<f64>,
    pub confidence: Vec<f64>,
    pub coverage: Vec<f64>,
    pub n_views: Vec<u8>,
    pub label: Vec<u8>,
}

impl Columns {
    pub fn of(n: usize) -> Self {
        let ramp = |factor: f64| (0..n).map(|k| factor * k as f64).collect();
        Columns {
            albedo: ramp(0.01),
            sigma_m: ramp(1e-6),
            confidence: ramp(1.0 / n as f64),
            coverage: ramp(0.5 / n as f64),
            n_views: (0..n).map(|k| (k % 64) as u8).collect(),
            label: (0..n).map(|k| (k % 3) as u8).collect(),
        }
    }

    pub fn attributes(&self) -> VertexAttributes<'_> {
        VertexAttributes {
            albedo: &self.albedo,
            sigma_m: &self.sigma_m,
            confidence: &self.confidence,
            coverage: &self.coverage,
            n_views: &self.n_views,
            label: &self.label,
        }
    }
}

#[test]
fn the_bumpy_sphere_points_outside() {
    let mesh = bumpy_sphere(12);
    let centre = Point3::new(0.0, 0.0, 0.6);
    for face in 0..mesh.faces.len() {
        let outwards = mesh.centroid(face) - centre;
        assert!(mesh.face_normal(face).dot(&outwards) > 0.0, "face {face}");
    }
}
