//! What of Eq. (6) follows the surface while displacements are solved for.
//!
//! The paper holds d within an iteration. A surface that is displaced also moves on the images of the views that look at it from
//! aside, which tells where it is beside how it is tilted: brightness has to change from place to place as each view shows it.

use super::sites::SiteKind;
use super::surface::Surface;
use nalgebra::Vector3;
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

/// What of the data term follows the displacements within a round; all of it is found anew at the start of each.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Deserialize, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Linearisation {
    /// Normal, pixel, d and l.
    #[default]
    Full,
    /// The normal alone, as in the paper: pixel, d and l are held.
    Detail,
}

/// How the sites of a surface move with the displacements of its vertices, from where they were when it was looked at.
pub struct SiteMotion {
    kind: SiteKind,
    /// How far each site moves where all that it depends on are displaced by a metre.
    along: Vec<Vector3<f64>>,
    /// Displacement of each site when it was looked at, metres.
    from_m: Vec<f64>,
}

impl SiteMotion {
    /// The motion of a surface's sites from where they are; `None` where nothing but the normals follows.
    pub fn of(
        surface: &Surface,
        kind: SiteKind,
        linearisation: Linearisation,
    ) -> Option<SiteMotion> {
        let along_face = |face: usize| {
            let direction = |vertex: usize| surface.directions[vertex];
            surface.mesh.mean_at_face(face, direction)
        };
        (linearisation == Linearisation::Full).then(|| {
            let along: Vec<Vector3<f64>> = match kind {
                SiteKind::Face => {
                    let faces = (0..surface.mesh.faces.len()).into_par_iter();
                    faces.map(along_face).collect()
                }
                SiteKind::Vertex => surface.directions.clone(),
            };
            let sites = (0..along.len()).into_par_iter();
            SiteMotion {
                kind,
                from_m: sites
                    .map(|site| surface.displacement_m(kind, site))
                    .collect(),
                along,
            }
        })
    }

    /// How far a site moves where all that it depends on are displaced by a metre, world frame.
    pub fn along(&self, site: usize) -> &Vector3<f64> {
        &self.along[site]
    }

    /// How far a site has moved along [`Self::along`], metres.
    #[inline]
    pub fn moved_m(&self, surface: &Surface, site: usize) -> f64 {
        surface.displacement_m(self.kind, site) - self.from_m[site]
    }
}

#[cfg(test)]
mod tests {
    use super::super::RefineParams;
    use super::super::scenes::{ALBEDO, RippledPlane, solved};
    use super::super::solver::SolverParams;
    use super::*;

    /// How far the middle of true relief that lies 0.2 mm too near is displaced along its normals, metres.
    fn displacement(linearisation: Linearisation) -> f64 {
        let hidden = RippledPlane {
            amplitude_m: 0.0003,
        };
        let params = RefineParams {
            edge_length_m: 0.002,
            // Seven views alone are to tell.
            patch_sigma_m: 0.01,
            linearisation,
            ..RefineParams::default()
        };
        let solver = SolverParams {
            max_steps: 6,
            min_decrease: 1e-6,
            max_step_m: 1e-3,
        };
        let mut mesh = hidden.mesh(params.edge_length_m);
        for vertex in &mut mesh.vertices {
            *vertex -= Vector3::new(0.0, 0.0, 2e-4);
        }
        let (surface, _) = solved(&hidden, (mesh, ALBEDO), &params, &solver);
        let vertices = surface.mesh.vertices.iter().zip(&surface.total_m);
        let middle = vertices.filter(|(p, _)| p.x.abs() < 0.025 && p.y.abs() < 0.025);
        let middle: Vec<f64> = middle.map(|(_, total_m)| *total_m).collect();
        middle.iter().sum::<f64>() / middle.len() as f64
    }

    #[test]
    fn views_from_aside_tell_where_relief_lies() {
        let [full, detail] = [Linearisation::Full, Linearisation::Detail].map(displacement);
        // Vertices are held within a millimetre each, which is 0.04 mm for all of them.
        assert!((-2.2e-4..-0.7e-4).contains(&full), "{full}");
        assert!(detail.abs() < 0.2e-4, "{detail}");
    }
}
