//! One outer round: visibility, the views' poses and gains, albedo, then displacements.

use super::albedo::Albedo;
use super::alignment::{AlignmentTarget, align_view};
use super::energy::{PriorWeights, Problem, Surface, unit_normal};
use super::params::RefineParams;
use super::patches::Patch;
use super::sites::Sites;
use super::solver::{Iteration, Pattern, RefineStatus, SolverParams, minimise};
use super::view::View;
use crate::geometry::{EdgeAdjacency, TriMesh};
use crate::shading::Tukey;
use nalgebra::{Point3, Vector3};
use rayon::prelude::*;

/// What stays the same over all rounds.
pub struct Rounds<'a> {
    /// Parameters.
    pub params: &'a RefineParams,
    /// Edges of the mesh.
    pub edges: &'a EdgeAdjacency,
    /// Patches that depth holds.
    pub patches: &'a [Patch],
    /// Faces across each face's sides.
    pub neighbours: &'a [[u32; 3]],
    /// Pattern of the normal matrix.
    pub pattern: &'a Pattern,
}

/// What the rounds refine.
pub struct State {
    /// The surface.
    pub surface: Surface,
    /// The views with their poses and gains.
    pub views: Vec<View>,
    /// Albedo.
    pub albedo: Albedo,
}

/// Tukey cut-offs of the rounds: true relief is a large residual at first.
const CUTOFFS: [f64; 3] = [9.0, 6.5, 4.685];

impl Rounds<'_> {
    /// The albedo of the base surface, robust to what the base gets wrong. `None` where nobody sees anything.
    pub fn first_albedo(&self, mesh: &TriMesh, sites: &Sites, views: &[View]) -> Option<Albedo> {
        let mut albedo = Albedo::estimate(mesh, self.neighbours, sites, views, None)?;
        for _ in 0..3 {
            let scale = sites.residual_scale(mesh, views, &albedo.by_face);
            let loss = Tukey {
                scale,
                cutoff: CUTOFFS[2],
            };
            albedo = Albedo::estimate(mesh, self.neighbours, sites, views, Some((&albedo, loss)))?;
        }
        Some(albedo)
    }

    /// Runs one round.
    pub fn run(
        &self,
        round: usize,
        state: &mut State,
        mut accepted: impl FnMut(Iteration) -> bool,
    ) -> RefineStatus {
        let State {
            surface,
            views,
            albedo,
        } = state;
        surface.directions = surface.mesh.vertex_normals();
        let sites = Sites::new(&surface.mesh, views);
        let cutoff = CUTOFFS[round.min(CUTOFFS.len() - 1)];
        let loss_of = |views: &[View], albedo: &Albedo| Tukey {
            scale: sites.residual_scale(&surface.mesh, views, &albedo.by_face),
            cutoff,
        };
        let loss = loss_of(views, albedo);
        self.align(&surface.mesh, &sites, views, albedo, loss);
        let mean_gain = take_mean_gain(views);
        *albedo = albedo.clone().scaled(mean_gain);
        let loss = loss_of(views, albedo);
        if let Some(next) = Albedo::estimate(
            &surface.mesh,
            self.neighbours,
            &sites,
            views,
            Some((albedo, loss)),
        ) {
            *albedo = next;
        }
        views.par_iter_mut().enumerate().for_each(|(k, view)| {
            fit_gain_field(
                view,
                &surface.mesh,
                &sites,
                &sites.faces_of(k),
                &albedo.by_face,
                loss,
            );
        });
        let problem = Problem {
            views,
            visible: &sites.visible,
            sites: &sites.points,
            albedo: &albedo.by_face,
            loss,
            priors: prior_weights(self.params),
            edges: self.edges,
            patches: self.patches,
        };
        let solver = SolverParams {
            max_steps: self.params.max_steps,
            min_decrease: 1e-4,
            max_step_m: 0.4 * self.params.edge_length_m,
        };
        minimise(surface, &problem, self.pattern, &solver, |iteration| {
            accepted(Iteration { round, ..iteration })
        })
    }

    fn align(
        &self,
        mesh: &TriMesh,
        sites: &Sites,
        views: &mut [View],
        albedo: &Albedo,
        loss: Tukey,
    ) {
        let centre = centre_of(mesh);
        views.par_iter_mut().enumerate().for_each(|(k, view)| {
            let target = AlignmentTarget {
                mesh,
                sites: &sites.points,
                faces: &sites.faces_of(k),
                albedo: &albedo.by_face,
                centre,
                loss,
            };
            align_view(view, &target, &self.params.alignment);
        });
    }
}

/// Divides all gains by their geometric mean and returns it: gains and albedo share one scale, which is the albedo's.
fn take_mean_gain(views: &mut [View]) -> f64 {
    let mean = (views.iter().map(|view| view.gain.ln()).sum::<f64>() / views.len() as f64).exp();
    views.iter_mut().for_each(|view| view.gain /= mean);
    mean
}

/// The gain field is held to 1 as if by so many squared sigmas of prediction: about twenty pixels' worth.
const GAIN_FIELD_PRIOR: f64 = 8000.0;

/// Re-estimates the slow gain over a view's image from the sites that it sees.
fn fit_gain_field(
    view: &mut View,
    mesh: &TriMesh,
    sites: &Sites,
    faces: &[u32],
    albedo: &[f64],
    loss: Tukey,
) {
    let mut sums = view.gain_field.sums();
    for &face in faces {
        let face = face as usize;
        let Some((normal, area)) = unit_normal(mesh, face) else {
            continue;
        };
        let Some(sample) = view.sample(&sites.points[face], &normal) else {
            continue;
        };
        let predicted = albedo[face] * sample.unit_prediction;
        let without_field = predicted * view.gain / sample.gain;
        let covered = view
            .pixels_covered(&sites.points[face], &normal, area)
            .min(1.0);
        let robust = loss.weight((sample.observed - predicted) / sample.sigma);
        sums.add(
            &sample.pixel,
            without_field,
            sample.observed,
            robust * covered / (sample.sigma * sample.sigma),
        );
    }
    view.gain_field = sums.solve(GAIN_FIELD_PRIOR);
}

/// The priors in the solver's units, for a mesh of equilateral faces: a vertex has the area √3/2 h², cotangent weights are
/// 1/√3.
fn prior_weights(params: &RefineParams) -> PriorWeights {
    /// Distance over which the detail of the fused surface goes together, metres: a pixel's footprint or two.
    const DETAIL_M: f64 = 0.003;
    /// Standard deviation of a vertex that nothing else holds, metres.
    const REST_SIGMA_M: f64 = 0.001;
    let inv_detail2 = 1.0 / (DETAIL_M * DETAIL_M);
    let area = 0.866 * params.edge_length_m * params.edge_length_m;
    PriorWeights {
        anchor: 1.0 / (params.patch_sigma_m * params.patch_sigma_m),
        rest: area * inv_detail2 / (REST_SIGMA_M * REST_SIGMA_M),
        smoothness: 0.577 * inv_detail2 / (params.slope_sigma_rad * params.slope_sigma_rad),
    }
}

/// Mean of the vertices.
pub fn centre_of(mesh: &TriMesh) -> Point3<f64> {
    let sum = mesh
        .vertices
        .iter()
        .fold(Vector3::zeros(), |sum, vertex| sum + vertex.coords);
    Point3::from(sum / mesh.vertices.len() as f64)
}
