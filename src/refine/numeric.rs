//! Derivatives of a facet's residuals by central differences: what the paper compares exact ones with (Fig. 12).
//!
//! The residual is evaluated with one corner of the facet displaced at a time, which the sparsity of Eq. (6) allows; pixel,
//! distance and light follow or are held as they are for the exact derivatives, so that both are of the same function.

use super::observations::Moved;
use super::surface::Surface;
use crate::geometry::area_vector;
use nalgebra::Vector3;
use serde::{Deserialize, Serialize};

/// How the derivatives of the data term are found.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Deserialize, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum JacobianMode {
    /// In closed form.
    #[default]
    Analytic,
    /// By central differences, for comparison.
    Numeric,
}

/// Displacement to either side, metres. Beside an edge of 0.3 mm and more the difference is exact to 1e-7, and coordinates
/// within a few metres are exact to 1e-8 of it.
const STEP_M: f64 = 1e-7;

/// Unit normals of a facet with each of its corners displaced to either side.
pub struct DisplacedNormals([[Vector3<f64>; 2]; 3]);

impl DisplacedNormals {
    /// Displaces the corners of a face along their directions; `None` where that leaves it no area.
    pub fn of(surface: &Surface, face: usize) -> Option<Self> {
        let mut normals = [[Vector3::zeros(); 2]; 3];
        for (corner, sides) in normals.iter_mut().enumerate() {
            let direction = surface.directions[surface.mesh.faces[face][corner] as usize];
            for (normal, step_m) in sides.iter_mut().zip([-STEP_M, STEP_M]) {
                let mut corners = surface.mesh.corners(face);
                corners[corner] += direction * step_m;
                *normal = area_vector(corners).try_normalize(0.0)?;
            }
        }
        Some(DisplacedNormals(normals))
    }

    /// Derivatives of a residual by the displacements of the corners, per metre, where the site has moved already; 0 where a
    /// displaced facet faces away from the light.
    pub fn row(&self, seen: &Moved, albedo: f64) -> Vector3<f64> {
        let by_corner = self.0.map(|[back, forth]| {
            let residual = |normal: &Vector3<f64>, step_m: f64| {
                // A corner takes the centroid a third of its way.
                seen.farther(step_m / 3.0).residual(normal, albedo)
            };
            let (Some(back), Some(forth)) = (residual(&back, -STEP_M), residual(&forth, STEP_M))
            else {
                return 0.0;
            };
            (forth - back) / (2.0 * STEP_M)
        });
        Vector3::from(by_corner)
    }
}

#[cfg(test)]
mod tests {
    use super::super::RefineParams;
    use super::super::scenes::{ALBEDO, RippledPlane, solved};
    use super::super::sites::SiteKind;
    use super::super::solver::SolverParams;
    use super::*;

    /// Displacements and albedo after so many steps from a plane towards the ripples that the views show.
    fn displaced(jacobian: JacobianMode, max_steps: usize) -> (Vec<f64>, f64) {
        let hidden = RippledPlane {
            amplitude_m: 0.0003,
        };
        let solver = SolverParams {
            max_steps,
            min_decrease: 0.0,
            max_step_m: 0.001,
        };
        let params = RefineParams {
            edge_length_m: 0.003,
            sites: SiteKind::Face,
            jacobian,
            ..RefineParams::default()
        };
        let plane = RippledPlane { amplitude_m: 0.0 };
        let start = (plane.mesh(params.edge_length_m), 1.02 * ALBEDO);
        let (surface, albedo) = solved(&hidden, start, &params, &solver);
        (surface.total_m, albedo)
    }

    #[test]
    fn differences_lead_where_exact_derivatives_lead() {
        for max_steps in [1, 4] {
            let (exact, exact_albedo) = displaced(JacobianMode::Analytic, max_steps);
            let (numeric, numeric_albedo) = displaced(JacobianMode::Numeric, max_steps);
            let largest = exact.iter().fold(0.0f64, |max, x| max.max(x.abs()));
            assert!(largest > 1e-4, "{largest}");
            let apart = exact.iter().zip(&numeric);
            let apart = apart.fold(0.0f64, |max, (a, b)| max.max((a - b).abs()));
            // The differences are good to 1e-7; the solve makes of that what the condition of its matrix lets it.
            assert!(apart < 1e-5 * largest, "{apart} of {largest}");
            assert!((numeric_albedo / exact_albedo - 1.0).abs() < 1e-6);
        }
    }
}
