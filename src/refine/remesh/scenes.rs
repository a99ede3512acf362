//! Meshes for the tests: closed-form surfaces, triangulated as badly as scans are.

use crate::geometry::TriMesh;
use nalgebra::{Point3, Vector3};
use std::collections::BTreeMap;

/// A number in [−1, 1) that depends on three integers only.
pub(super) fn scatter(key: [i64; 3]) -> f64 {
    let mut state = 0x9e37_79b9_7f4a_7c15u64;
    for part in key {
        state = (state ^ part as u64).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        state ^= state >> 29;
    }
    (state >> 11) as f64 / (1u64 << 52) as f64 - 1.0
}

/// The zero level of a distance `field` (negative inside), sampled on a grid over [−1, 1]³ with `n` cells a side: six
/// tetrahedra a cell, hence triangles of every shape down to slivers, and a border where the surface leaves the grid.
pub(super) fn level_set(n: i64, field: impl Fn(&Point3<f64>) -> f64) -> TriMesh {
    let mut builder = LevelSet {
        cell: 2.0 / n as f64,
        field,
        vertex_on: BTreeMap::new(),
        mesh: TriMesh::default(),
    };
    for cell in (0..n * n * n).map(|cell| [cell % n, cell / n % n, cell / (n * n)]) {
        // The tetrahedra of Kuhn: the six ways from one corner of the cell to the opposite one along its edges.
        for [i, j, k] in [
            [0, 1, 2],
            [0, 2, 1],
            [1, 0, 2],
            [1, 2, 0],
            [2, 0, 1],
            [2, 1, 0],
        ] {
            let mut corners = [cell; 4];
            for (step, axis) in [i, j, k].into_iter().enumerate() {
                for corner in &mut corners[step + 1..] {
                    corner[axis] += 1;
                }
            }
            builder.cut(corners);
        }
    }
    builder.mesh
}

struct LevelSet<F> {
    cell: f64,
    field: F,
    vertex_on: BTreeMap<[[i64; 3]; 2], u32>,
    mesh: TriMesh,
}

impl<F: Fn(&Point3<f64>) -> f64> LevelSet<F> {
    fn position(&self, corner: [i64; 3]) -> Point3<f64> {
        Point3::from(corner.map(|index| index as f64 * self.cell - 1.0))
    }

    /// Adds the one or two triangles that separate the inside corners of a tetrahedron from the outside ones.
    fn cut(&mut self, corners: [[i64; 3]; 4]) {
        let (inside, outside): (Vec<_>, Vec<_>) = corners
            .into_iter()
            .partition(|&corner| (self.field)(&self.position(corner)) < 0.0);
        match (&inside[..], &outside[..]) {
            (&[a], &[p, q, r]) => self.push([[a, p], [a, q], [a, r]], a, p),
            (&[a, b, c], &[p]) => self.push([[a, p], [b, p], [c, p]], a, p),
            (&[a, b], &[p, q]) => {
                self.push([[a, p], [a, q], [b, q]], a, p);
                self.push([[a, p], [b, q], [b, p]], a, p);
            }
            _ => {}
        }
    }

    /// Adds the triangle on three edges of the grid, so turned that it faces from `inside` to `outside`.
    fn push(&mut self, edges: [[[i64; 3]; 2]; 3], inside: [i64; 3], outside: [i64; 3]) {
        let [a, b, c] = edges.map(|edge| self.vertex(edge));
        let face = self.mesh.faces.len();
        self.mesh.faces.push([a, b, c]);
        let normal = self.mesh.face_normal(face);
        let through = self.mesh.centroid(face);
        let outwards = self.position(outside) - through;
        let inwards = self.position(inside) - through;
        if normal.dot(&outwards) < normal.dot(&inwards) {
            self.mesh.faces[face] = [a, c, b];
        }
    }

    fn vertex(&mut self, [inside, outside]: [[i64; 3]; 2]) -> u32 {
        let (p, q) = (self.position(inside), self.position(outside));
        let (at_p, at_q) = ((self.field)(&p), (self.field)(&q));
        // Off the corners by a millionth of a cell, so that no triangle is a point.
        let s = (at_p / (at_p - at_q)).clamp(1e-6, 1.0 - 1e-6);
        let vertices = &mut self.mesh.vertices;
        *self.vertex_on.entry([inside, outside]).or_insert_with(|| {
            vertices.push(p + (q - p) * s);
            vertices.len() as u32 - 1
        })
    }
}

/// Distance of a point from the sphere of a centre and radius, negative inside.
pub(super) fn sphere(point: &Point3<f64>, centre: [f64; 3], radius: f64) -> f64 {
    (point - Point3::from(centre)).norm() - radius
}

/// Distance of a point from the torus about the z axis, negative inside.
pub(super) fn torus(point: &Point3<f64>, ring_radius: f64, tube_radius: f64) -> f64 {
    let from_ring = point.x.hypot(point.y) - ring_radius;
    from_ring.hypot(point.z) - tube_radius
}

/// The rectangle [0, 1]×[0, 0.7] of the plane z = 0, its inner vertices scattered within their cells.
pub(super) fn plane(n: i64) -> TriMesh {
    let at = |index: i64, offset: f64| {
        let inner = index > 0 && index < n;
        (index as f64 + if inner { 0.4 * offset } else { 0.0 }) / n as f64
    };
    let mut mesh = TriMesh::default();
    for j in 0..=n {
        for i in 0..=n {
            let (x, y) = (at(i, scatter([i, j, 0])), at(j, scatter([i, j, 1])));
            mesh.vertices
                .push(Point3::from(Vector3::new(x, 0.7 * y, 0.0)));
        }
    }
    for j in 0..n {
        for i in 0..n {
            let v = (j * (n + 1) + i) as u32;
            let up = v + n as u32 + 1;
            mesh.faces.extend([[v, v + 1, up], [v + 1, up + 1, up]]);
        }
    }
    mesh
}
