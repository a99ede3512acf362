//! Derivatives of a facet's residuals by central differences: what the paper compares exact ones with (Fig. 12).
//!
//! The residual is evaluated with one corner of the facet displaced at a time, which the sparsity of Eq. (6) allows; pixel,
//! distance and light are held as they are for the exact derivatives, so that both are of the same function.

use super::energy::Surface;
use super::observations::Observation;
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

    /// Derivatives of a residual by the displacements of the corners, per metre; 0 where a displaced facet faces away from
    /// the light.
    pub fn row(&self, seen: &Observation, albedo: f64) -> Vector3<f64> {
        let by_corner = self.0.map(|sides| {
            let [Some(back), Some(forth)] = sides.map(|normal| seen.residual(&normal, albedo))
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
    use super::super::couplings::Couplings;
    use super::super::energy::Problem;
    use super::super::observations::Observations;
    use super::super::rounds::{final_loss, prior_weights};
    use super::super::scenes::{ALBEDO, RippledPlane, calibration, optics, poses, rays, views};
    use super::super::sites::Sites;
    use super::super::solver::{Pattern, SolverParams, minimise};
    use super::super::{RefineParams, patches};
    use super::*;
    use crate::geometry::EdgeAdjacency;

    /// Displacements and albedo after so many steps from a plane towards the ripples that the views show.
    fn displaced(jacobian: JacobianMode, max_steps: usize) -> (Vec<f64>, f64) {
        let (rays, calibration) = (rays(), calibration());
        let optics = optics(&rays, &calibration);
        let mesh = RippledPlane { amplitude_m: 0.0 }.mesh(0.003);
        let hidden = RippledPlane {
            amplitude_m: 0.0003,
        };
        let views = views(&hidden, &mesh, &optics, &poses(0.5));
        let n_vertices = mesh.vertices.len();
        let mut surface = Surface {
            directions: mesh.vertex_normals(),
            mesh,
            total_m: vec![0.0; n_vertices],
        };
        let sites = Sites::new(&surface.mesh, &views, u64::MAX);
        let edges = EdgeAdjacency::new(&surface.mesh);
        let patches = patches::cut(&surface.mesh, &surface.directions, 0.02);
        let couplings = Couplings::new(&surface.mesh, &edges, &patches);
        let params = RefineParams {
            edge_length_m: 0.003,
            ..RefineParams::default()
        };
        let problem = Problem {
            observations: &Observations::new(&sites, &views),
            labels: &vec![0; surface.mesh.faces.len()],
            loss: final_loss(3.0),
            priors: prior_weights(&params),
            patches: &patches,
            edges: &edges,
            jacobian,
        };
        let solver = SolverParams {
            max_steps,
            min_decrease: 0.0,
            max_step_m: 0.001,
        };
        let pattern = Pattern::new(n_vertices, couplings).unwrap();
        let mut albedos = vec![1.02 * ALBEDO];
        minimise(
            &mut surface,
            &mut albedos,
            &problem,
            &pattern,
            &solver,
            |_| true,
        );
        (surface.total_m, albedos[0])
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
