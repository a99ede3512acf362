//! The steps of an outer round one at a time: what benches time, and the linear problem that other solvers are given.
//!
//! [`refine`](super::refine) goes through the same functions by itself.

use super::RefineError;
use super::albedo::Albedo;
use super::energy::{NormalMatrix, Problem};
use super::evaluation::Evaluation;
use super::observations::Observations;
use super::params::RefineParams;
use super::pattern::Step;
use super::preparation::{Preparation, first_views};
use super::priors::PriorWeights;
use super::rounds::{State, final_loss};
use super::site_blocks::{Block, Estimate};
use super::sites::{SiteKind, Sites, ViewSet};
use super::subject::Subject;
use super::tint::Tint;
use super::view::View;
use crate::geometry::{Pose, TriMesh};
use crate::robust::Tukey;
use crate::shading::LinearImage;
use depth_camera::Image;
use nalgebra::{Matrix4, Vector2};
use serde::Serialize;

/// A refinement that stands still in the middle of a round, before its displacements are solved for.
pub struct Stages {
    prepared: Preparation,
    state: State,
    learning: ViewSet,
    sites: Sites,
    observations: Observations,
    loss: Tukey,
    /// As the surface has them.
    tints: Vec<Option<Tint>>,
}

impl Stages {
    /// Prepares a refinement and runs some of its rounds, so that the views are aligned as they are when it is solved.
    ///
    /// # Errors
    /// As for [`refine`](super::refine), but that nothing is judged.
    pub fn after_rounds(
        subject: &Subject,
        params: &RefineParams,
        n_rounds: usize,
    ) -> Result<Stages, RefineError> {
        let learning = first_views(subject.snapshots.len());
        let prepared = Preparation::new(subject, params, learning)?;
        let (mut state, _) = prepared.base(subject, learning)?;
        prepared.run(0..n_rounds, learning, &mut state, &mut |_| true);
        state.surface.directions = state.surface.mesh.vertex_normals();
        let rounds = prepared.finest();
        let sites = rounds.sites(&state.surface.mesh, &state.views, learning, &state.albedo);
        let observations = rounds.observe(&sites, &state.surface, &state.views, None);
        let scale = observations.residual_scale(&sites, &state.albedo.by_site);
        let mut stages = Stages {
            prepared,
            state,
            learning,
            sites,
            observations,
            loss: final_loss(scale),
            tints: Vec::new(),
        };
        stages.tints = stages.evaluate().tints;
        Ok(stages)
    }

    /// Vertices of the mesh.
    pub fn n_vertices(&self) -> usize {
        self.state.surface.mesh.vertices.len()
    }

    /// Finds out which view sees which site; returns the number of such pairs.
    pub fn hide(&self) -> usize {
        let State {
            surface,
            views,
            albedo,
        } = &self.state;
        let rounds = self.prepared.finest();
        let sites = rounds.sites(&surface.mesh, views, self.learning, albedo);
        let pairs = sites
            .visible
            .iter()
            .map(|views| views.count_ones() as usize);
        pairs.sum()
    }

    /// Samples every image at every site that it sees; returns the robust scale of the residuals, in sigmas.
    pub fn observe(&self) -> f64 {
        let State { surface, views, .. } = &self.state;
        let observations = self
            .prepared
            .finest()
            .observe(&self.sites, surface, views, None);
        observations.residual_scale(&self.sites, &self.state.albedo.by_site)
    }

    /// Estimates groups and albedos anew; returns the groups' albedos.
    pub fn estimate_albedo(&self) -> Option<Vec<f64>> {
        let current = Some((&self.state.albedo, self.loss));
        let rounds = self.prepared.finest();
        let albedo: Option<Albedo> =
            rounds.estimate_albedo(&self.sites, &self.observations, current);
        albedo.map(|albedo| albedo.groups)
    }

    /// The robust energy of Eq. (5), every residual once, and the tints that it is least for.
    pub fn energy(&self) -> f64 {
        self.evaluate().energy
    }

    fn evaluate(&self) -> Evaluation {
        let State {
            surface, albedo, ..
        } = &self.state;
        self.problem().evaluate(surface, &albedo.groups)
    }

    /// Residuals, their derivatives, and the normal equations; the tints are found with the energy.
    pub fn linearise(&self) -> NormalMatrix {
        let pattern = &self.prepared.finest().level.pattern;
        self.problem().linearise(
            &self.state.surface,
            &self.state.albedo.groups,
            &self.tints,
            pattern.couplings(),
        )
    }

    /// One step, the factorisation among it; `None` where the matrix is not positive definite.
    pub fn solve(&self, matrix: &NormalMatrix, damping: f64) -> Option<Step> {
        let pattern = &self.prepared.finest().level.pattern;
        pattern.solve(&self.problem(), matrix, damping)
    }

    /// The step's problem as sums of squares; `None` where sites are at vertices, which couple more than a facet's corners.
    pub fn least_squares(&self) -> Option<LeastSquares> {
        let problem = self.problem();
        if problem.sites != SiteKind::Face {
            return None;
        }
        let State {
            surface, albedo, ..
        } = &self.state;
        let n_vertices = self.n_vertices();
        let estimate = Estimate {
            surface,
            albedos: &albedo.groups,
            tints: &self.tints,
        };
        let faces = surface.mesh.faces.iter().zip(&albedo.labels).enumerate();
        let seen = faces.filter(|(face, _)| !self.observations.of(*face).is_empty());
        let terms = seen.map(|(face, (&[a, b, c], &label))| {
            let [block, ..] = problem.face_blocks(&estimate, face..face + 1, &mut Vec::new());
            let unknowns = [a, b, c, n_vertices as u32 + u32::from(label)];
            FaceTerm::new(unknowns, &block)
        });
        let PriorWeights {
            anchor,
            rest,
            smoothness,
        } = problem.priors;
        Some(LeastSquares {
            n_vertices,
            n_groups: albedo.groups.len(),
            faces: terms.collect(),
            total_m: surface.total_m.clone(),
            edges: problem.edges.edges.clone(),
            patches: problem.patches.to_vec(),
            smoothness,
            anchor,
            rest,
        })
    }

    /// The views as they were aligned.
    pub fn views(&self) -> Vec<AlignedView> {
        let views = self.state.views.iter();
        views.map(AlignedView::new).collect()
    }

    /// The surface as displaced so far.
    pub fn mesh(&self) -> &TriMesh {
        &self.state.surface.mesh
    }

    /// Albedo of each vertex, times the light's strength, m².
    pub fn albedo_by_vertex(&self) -> Vec<f64> {
        let State {
            surface, albedo, ..
        } = &self.state;
        albedo.by_vertex(self.sites.kind, &surface.mesh)
    }

    fn problem(&self) -> Problem<'_> {
        let rounds = self.prepared.finest();
        rounds.problem(&self.observations, &self.state.albedo, self.loss)
    }
}

/// What is known of a view after some rounds.
#[derive(Clone, Debug)]
pub struct AlignedView {
    /// Its pose as refined by the images.
    pub world_from_camera: Pose,
    /// Linear intensity as the pixel integrated it, gain and slow gains taken off; NaN where the pixel is not used.
    pub linear: Image<f32>,
}

impl AlignedView {
    fn new(view: &View) -> Self {
        let LinearImage {
            value, integrated, ..
        } = view.linear();
        let (width, height) = (value.width(), value.height());
        let pixels = (0..height).flat_map(|v| (0..width).map(move |u| (u, v)));
        let linear = pixels.map(|(u, v)| {
            let gain = view.gain * view.gain_field.at(&Vector2::new(u as f64, v as f64));
            match value.at(u, v).is_nan() {
                true => f32::NAN,
                false => *integrated.at(u, v) / gain as f32,
            }
        });
        AlignedView {
            world_from_camera: view.camera_from_world.inverse(),
            linear: Image::from_vec(width, height, linear.collect()),
        }
    }
}

/// One Gauss-Newton step of Eq. (5) as a linear least-squares problem, tints taken out: unknown are the displacements of the vertices (m) and,
/// behind them, the logarithms of the groups' albedos.
#[derive(Clone, Debug, Serialize)]
pub struct LeastSquares {
    /// Displacements.
    pub n_vertices: usize,
    /// Albedos.
    pub n_groups: usize,
    /// Eq. (6), all views of a facet together, robust weights held.
    pub faces: Vec<FaceTerm>,
    /// Displacement of each vertex from the base surface so far, metres, to which the priors refer.
    pub total_m: Vec<f64>,
    /// Eq. (7): pairs of vertices whose difference of displacements is weighed by `smoothness`.
    pub edges: Vec<[u32; 2]>,
    /// Eq. (8): vertices whose mean displacement is weighed by `anchor`.
    pub patches: Vec<Vec<u32>>,
    /// Per m².
    pub smoothness: f64,
    /// Per m².
    pub anchor: f64,
    /// Weight of each vertex's own displacement, per m².
    pub rest: f64,
}

/// What the views of a facet add to the normal equations.
#[derive(Clone, Copy, Debug, Serialize)]
pub struct FaceTerm {
    /// Displacements of its corners and the albedo of its group.
    pub unknowns: [u32; 4],
    /// Second derivatives by them, row by row.
    pub hessian: [[f64; 4]; 4],
    /// First derivatives.
    pub gradient: [f64; 4],
}

impl FaceTerm {
    fn new(unknowns: [u32; 4], block: &Block<3>) -> Self {
        let (coupling, diagonal, slope) = block.by_albedo;
        let mut hessian = Matrix4::zeros();
        hessian.fixed_view_mut::<3, 3>(0, 0).copy_from(&block.jtj);
        hessian.fixed_view_mut::<3, 1>(0, 3).copy_from(&coupling);
        hessian
            .fixed_view_mut::<1, 3>(3, 0)
            .copy_from(&coupling.transpose());
        hessian[(3, 3)] = diagonal;
        FaceTerm {
            unknowns,
            // Symmetric but for last bits, so that its columns are its rows.
            hessian: hessian.into(),
            gradient: block.jtr.push(slope).into(),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::super::scenes::{RippledPlane, calibration, optics, poses, rays};
    use super::*;
    use nalgebra::{DMatrix, DVector};

    #[test]
    fn sums_of_squares_have_the_minimum_that_the_solver_finds() {
        let (rays, calibration) = (rays(), calibration());
        let optics = optics(&rays, &calibration);
        let mesh = RippledPlane { amplitude_m: 0.0 }.mesh(0.008);
        let hidden = RippledPlane {
            amplitude_m: 0.0003,
        };
        let poses = poses(0.5);
        let snapshots: Vec<_> = poses
            .iter()
            .map(|pose| hidden.snapshot(&optics, pose))
            .collect();
        let subject = Subject {
            scene: &mesh,
            object: &mesh,
            snapshots: &snapshots,
            optics: &optics,
        };
        let params = RefineParams {
            edge_length_m: 0.008,
            sites: SiteKind::Face,
            ..RefineParams::default()
        };
        let stages = Stages::after_rounds(&subject, &params, 1).unwrap();
        let problem = stages.least_squares().expect("sites are at facets");
        let n = problem.n_vertices + problem.n_groups;
        let mut hessian = DMatrix::<f64>::zeros(n, n);
        let mut gradient = DVector::<f64>::zeros(n);
        for face in &problem.faces {
            for (row, &i) in face.unknowns.iter().enumerate() {
                gradient[i as usize] += face.gradient[row];
                for (column, &j) in face.unknowns.iter().enumerate() {
                    hessian[(i as usize, j as usize)] += face.hessian[row][column];
                }
            }
        }
        let mut square = |weight: f64, row: &[(u32, f64)]| {
            let at_present: f64 = row
                .iter()
                .map(|&(i, factor)| factor * problem.total_m[i as usize])
                .sum();
            for &(i, factor) in row {
                gradient[i as usize] += weight * factor * at_present;
                for &(j, other) in row {
                    hessian[(i as usize, j as usize)] += weight * factor * other;
                }
            }
        };
        for vertex in 0..problem.n_vertices as u32 {
            square(problem.rest, &[(vertex, 1.0)]);
        }
        for &[i, j] in &problem.edges {
            square(problem.smoothness, &[(i, 1.0), (j, -1.0)]);
        }
        for patch in &problem.patches {
            let share = 1.0 / patch.len() as f64;
            let row: Vec<(u32, f64)> = patch.iter().map(|&vertex| (vertex, share)).collect();
            square(problem.anchor, &row);
        }
        let dense = hessian.cholesky().unwrap().solve(&-gradient);
        let step = stages.solve(&stages.linearise(), 0.0).unwrap();
        let largest = dense.amax();
        assert!(largest > 1e-6, "{largest}");
        for (dense, sparse) in dense.iter().zip(&step.displacement) {
            assert!((dense - sparse).abs() < 1e-6 * largest, "{dense} {sparse}");
        }
    }
}
