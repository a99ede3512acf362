//! The displaced surface, the normals of its faces, and how these turn as vertices are displaced: `∂N/∂δ_a = m_a × (b − c)` for
//! `N = (b − a) × (c − a)`, and `∂n = (I − n nᵀ)/|N| ∂N`.

use super::sites::SiteKind;
use crate::geometry::TriMesh;
use nalgebra::Vector3;

/// The surface and what the displacements mean.
#[derive(Clone, Debug)]
pub struct Surface {
    /// The mesh as displaced so far.
    pub mesh: TriMesh,
    /// Directions of the displacements, unit length, one a vertex.
    pub directions: Vec<Vector3<f64>>,
    /// Displacement from the base mesh so far, along the directions, metres.
    pub total_m: Vec<f64>,
}

impl Surface {
    /// A base mesh, not displaced.
    pub fn of_base(mesh: &TriMesh) -> Surface {
        Surface {
            directions: mesh.vertex_normals(),
            total_m: vec![0.0; mesh.vertices.len()],
            mesh: mesh.clone(),
        }
    }

    /// Displacement of a site from the base mesh so far, metres.
    #[inline]
    pub fn displacement_m(&self, kind: SiteKind, site: usize) -> f64 {
        match kind {
            SiteKind::Face => self.mesh.mean_at_face(site, |vertex| self.total_m[vertex]),
            SiteKind::Vertex => self.total_m[site],
        }
    }

    /// The surface with every vertex moved along its direction.
    pub fn displaced(&self, step_m: &[f64]) -> Surface {
        let mut next = self.clone();
        for (vertex, &step) in step_m.iter().enumerate() {
            next.mesh.vertices[vertex] += self.directions[vertex] * step;
            next.total_m[vertex] += step;
        }
        next
    }
}

/// Unit normal and area (m²) of a face; `None` where it has no area.
pub fn unit_normal(mesh: &TriMesh, face: usize) -> Option<(Vector3<f64>, f64)> {
    let normal = mesh.face_normal(face);
    let norm = normal.norm();
    (norm > 0.0).then(|| (normal / norm, 0.5 * norm))
}

/// Derivatives of a facet's unit normal by the displacements of its corners, per metre.
pub fn normal_by_displacement(
    surface: &Surface,
    face: usize,
    normal: &Vector3<f64>,
) -> [Vector3<f64>; 3] {
    let inv_norm = 1.0 / surface.mesh.face_normal(face).norm();
    area_vector_by_displacement(surface, face)
        .map(|change| (change - normal * normal.dot(&change)) * inv_norm)
}

/// Derivatives of [`area_vector`](crate::geometry::area_vector) of a face by the displacements of its corners, m.
pub fn area_vector_by_displacement(surface: &Surface, face: usize) -> [Vector3<f64>; 3] {
    let corners = surface.mesh.corners(face);
    std::array::from_fn(|corner| {
        let direction = surface.directions[surface.mesh.faces[face][corner] as usize];
        direction.cross(&(corners[(corner + 1) % 3] - corners[(corner + 2) % 3]))
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::Point3;

    #[test]
    fn derivative_of_the_normal_matches_central_differences() {
        let mesh = TriMesh {
            vertices: vec![
                Point3::new(0.0, 0.1, 0.6),
                Point3::new(0.0013, 0.1002, 0.6004),
                Point3::new(0.0005, 0.1011, 0.5997),
            ],
            faces: vec![[0, 1, 2]],
        };
        let directions = [[0.1, 0.2, -1.0], [-0.3, 0.1, -0.9], [0.2, -0.4, -0.8]]
            .map(|d| Vector3::from(d).try_normalize(0.0).expect("not zero"));
        let surface = Surface {
            mesh,
            directions: directions.to_vec(),
            total_m: vec![0.0; 3],
        };
        let normal_of = |surface: &Surface| unit_normal(&surface.mesh, 0).expect("has an area").0;
        let analytic = normal_by_displacement(&surface, 0, &normal_of(&surface));
        for corner in 0..3 {
            let moved = |step: f64| {
                let mut steps = [0.0; 3];
                steps[corner] = step;
                normal_of(&surface.displaced(&steps))
            };
            let numeric = (moved(1e-7) - moved(-1e-7)) / 2e-7;
            assert!((numeric - analytic[corner]).norm() < 1e-7 * analytic[corner].norm());
        }
    }
}
