//! Refinement from shading images: Section 4 of the paper.
//!
//! The base mesh is cut to the object, remeshed to a uniform edge length, and displaced along its normals until Eq. (1)
//! predicts what every shading image shows. Each outer round re-estimates visibility, the pose and gain of each view, the
//! albedo and the scale of the residuals, then solves for the displacements; Eq. (9) moves the surface along refreshed normals.
//!
//! Not handled: several albedos, interreflection, specular highlights beyond what the robust loss rejects.

mod albedo;
mod alignment;
mod energy;
mod object;
pub mod remesh;
mod solver;
mod view;

pub use alignment::AlignmentParams;
pub use object::{Plane, Roi, select_object, select_roi};
pub use solver::{Iteration, RefineStatus};
pub use view::{Optics, View};

use crate::geometry::{EdgeAdjacency, TriMesh};
use crate::snapshot::ShadingSnapshot;
use alignment::{AlignmentTarget, align_view};
use energy::{PriorWeights, Problem, Surface, Tukey, unit_normal, views_of};
use nalgebra::Point3;
use rayon::prelude::*;
use remesh::{RemeshParams, remesh};
use serde::{Deserialize, Serialize};
use solver::{Pattern, SolverParams, minimise};

/// What refinement needs to know.
#[derive(Clone, Debug, PartialEq, Deserialize, Serialize)]
#[serde(default, deny_unknown_fields)]
pub struct RefineParams {
    /// Edge length of the refined mesh, metres; about the footprint of a pixel.
    pub edge_length_m: f64,
    /// Outer rounds, Eq. (9).
    pub n_rounds: usize,
    /// Accepted Levenberg–Marquardt steps a round at most.
    pub max_steps: usize,
    /// Standard deviation of the fused surface's slow error, metres: Eq. (8).
    pub depth_sigma_m: f64,
    /// Standard deviation of the slope of the displacement, radians: Eq. (7).
    pub slope_sigma_rad: f64,
    /// Distance over which errors of the fused surface go together, metres.
    pub correlation_m: f64,
    /// Alignment of the views.
    pub alignment: AlignmentParams,
}

impl Default for RefineParams {
    fn default() -> Self {
        RefineParams {
            edge_length_m: 0.0013,
            n_rounds: 4,
            max_steps: 4,
            depth_sigma_m: 0.001,
            slope_sigma_rad: 0.15,
            correlation_m: 0.003,
            alignment: AlignmentParams::default(),
        }
    }
}

impl RefineParams {
    /// Checks every value against its bound.
    ///
    /// # Errors
    /// Names the key, its value and the bound.
    pub fn validate(&self) -> Result<(), String> {
        for (key, value, low, high) in [
            ("edge_length_m", self.edge_length_m, 0.0003, 0.05),
            ("n_rounds", self.n_rounds as f64, 1.0, 50.0),
            ("max_steps", self.max_steps as f64, 1.0, 50.0),
            ("depth_sigma_m", self.depth_sigma_m, 1e-6, 0.1),
            ("slope_sigma_rad", self.slope_sigma_rad, 1e-4, 2.0),
            ("correlation_m", self.correlation_m, 1e-4, 0.1),
            (
                "alignment.rotation_sigma_rad",
                self.alignment.rotation_sigma_rad,
                1e-6,
                1.0,
            ),
            (
                "alignment.translation_sigma_m",
                self.alignment.translation_sigma_m,
                1e-6,
                1.0,
            ),
            ("alignment.gain_sigma", self.alignment.gain_sigma, 1e-6, 1.0),
        ] {
            if !(value >= low && value <= high) {
                return Err(format!("refine.{key} is {value}, must be {low} to {high}"));
            }
        }
        Ok(())
    }
}

/// Most views that one refinement takes.
pub const MAX_VIEWS: usize = 64;

/// What a view ended as.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct ViewFit {
    /// Brightness against the other views.
    pub gain: f64,
    /// How far the images moved the object's centre on this view, pixels.
    pub shift_px: [f64; 2],
    /// Sites that the view saw.
    pub n_sites: usize,
    /// Root mean square of observed less rendered linear intensity, relative to the mean observed one, on the base mesh with
    /// poses from tracking.
    pub rmse_before: f64,
    /// The same on the refined mesh.
    pub rmse_after: f64,
}

/// The refined surface and how it came about.
#[derive(Clone, Debug)]
pub struct Refinement {
    /// The refined mesh, world frame.
    pub mesh: TriMesh,
    /// Albedo of each vertex, times the light's strength, m².
    pub albedo: Vec<f64>,
    /// How it ended.
    pub status: RefineStatus,
    /// Every accepted step.
    pub iterations: Vec<Iteration>,
    /// The views, in the order of the snapshots.
    pub views: Vec<ViewFit>,
}

/// Why nothing was refined.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum RefineError {
    /// The object's mesh is empty.
    #[error("no surface of the object is left to refine")]
    NoSurface,
    /// No view saw anything of the object.
    #[error("none of the {n_views} shading images sees the object well enough")]
    NothingVisible {
        /// How many images there were.
        n_views: usize,
    },
    /// Too many views.
    #[error("{n_views} shading images given, at most {MAX_VIEWS} can be used")]
    TooManyViews {
        /// How many images there were.
        n_views: usize,
    },
    /// The solver's pattern did not fit into memory.
    #[error("not enough memory for the solver")]
    OutOfMemory,
}

/// Refines the surface of an object.
///
/// `scene` is the whole base mesh, `object` the part of it to refine. After each accepted step `progress` is called; it
/// returns false to cancel, which keeps what was reached.
///
/// # Errors
/// Where there is nothing to refine or to learn from.
pub fn refine(
    scene: &TriMesh,
    object: &TriMesh,
    snapshots: &[ShadingSnapshot],
    optics: &Optics,
    params: &RefineParams,
    mut progress: impl FnMut(&Iteration) -> bool,
) -> Result<Refinement, RefineError> {
    if snapshots.len() > MAX_VIEWS {
        return Err(RefineError::TooManyViews {
            n_views: snapshots.len(),
        });
    }
    let remeshed = remesh(
        object,
        &RemeshParams {
            edge_length_m: params.edge_length_m,
            n_rounds: 5,
        },
    );
    if remeshed.faces.is_empty() {
        return Err(RefineError::NoSurface);
    }
    let mut views: Vec<View> = snapshots
        .par_iter()
        .map(|snapshot| View::new(snapshot, scene, optics))
        .collect();
    let edges = EdgeAdjacency::new(&remeshed);
    let mut surface = Surface {
        directions: remeshed.vertex_normals(),
        total_m: vec![0.0; remeshed.vertices.len()],
        mesh: remeshed,
    };
    let pattern = Pattern::new(&surface, &edges).ok_or(RefineError::OutOfMemory)?;
    let mut rounds = Rounds {
        params,
        edges: &edges,
        pattern: &pattern,
        iterations: Vec::new(),
    };
    let start = Sites::new(&surface.mesh, &views);
    if start.visible.iter().all(|&mask| mask == 0) {
        return Err(RefineError::NothingVisible {
            n_views: views.len(),
        });
    }
    let mut albedo =
        albedo::global_albedo(&surface.mesh, &start.points, &start.visible, &views, None).ok_or(
            RefineError::NothingVisible {
                n_views: views.len(),
            },
        )?;
    for _ in 0..5 {
        let loss = Tukey {
            scale: residual_scale(&surface.mesh, &start, &views, albedo),
            cutoff: CUTOFFS[2],
        };
        let robust = Some((albedo, loss));
        albedo =
            albedo::global_albedo(&surface.mesh, &start.points, &start.visible, &views, robust)
                .unwrap_or(albedo);
    }
    let before = view_errors(&surface.mesh, &start, &views, albedo);
    let mut status = RefineStatus::IterationLimit;
    for round in 0..params.n_rounds {
        status = rounds.run(round, &mut surface, &mut views, &mut albedo, &mut progress);
        if matches!(status, RefineStatus::Cancelled | RefineStatus::Singular) {
            break;
        }
    }
    let end = Sites::new(&surface.mesh, &views);
    let after = view_errors(&surface.mesh, &end, &views, albedo);
    let centre = centre_of(&surface.mesh);
    let views = views
        .iter()
        .zip(before.iter().zip(&after))
        .map(|(view, (before, after))| ViewFit {
            gain: view.gain,
            shift_px: shift_px(view, &centre),
            n_sites: after.n_sites,
            rmse_before: before.rmse,
            rmse_after: after.rmse,
        })
        .collect();
    Ok(Refinement {
        albedo: vec![albedo; surface.mesh.vertices.len()],
        mesh: surface.mesh,
        status,
        iterations: rounds.iterations,
        views,
    })
}

/// Where each face is sampled, and by whom it is seen.
struct Sites {
    points: Vec<Point3<f64>>,
    visible: Vec<u64>,
}

impl Sites {
    fn new(mesh: &TriMesh, views: &[View]) -> Sites {
        let points: Vec<Point3<f64>> = (0..mesh.faces.len())
            .map(|face| mesh.centroid(face))
            .collect();
        let visible = points
            .par_iter()
            .enumerate()
            .map(|(face, point)| {
                let Some((normal, _)) = unit_normal(mesh, face) else {
                    return 0;
                };
                views
                    .iter()
                    .enumerate()
                    .filter(|(_, view)| view.sees(point, &normal))
                    .fold(0, |mask, (k, _)| mask | 1 << k)
            })
            .collect();
        Sites { points, visible }
    }

    fn faces_of(&self, view: usize) -> Vec<u32> {
        (0..self.visible.len() as u32)
            .filter(|&face| self.visible[face as usize] >> view & 1 == 1)
            .collect()
    }
}

struct Rounds<'a> {
    params: &'a RefineParams,
    edges: &'a EdgeAdjacency,
    pattern: &'a Pattern,
    iterations: Vec<Iteration>,
}

/// Tukey cut-offs of the rounds: true relief is a large residual at first.
const CUTOFFS: [f64; 3] = [9.0, 6.5, 4.685];

impl Rounds<'_> {
    /// One outer round: visibility, alignment, albedo, then displacements.
    fn run(
        &mut self,
        round: usize,
        surface: &mut Surface,
        views: &mut [View],
        albedo: &mut f64,
        progress: &mut impl FnMut(&Iteration) -> bool,
    ) -> RefineStatus {
        let params = self.params;
        surface.directions = surface.mesh.vertex_normals();
        let sites = Sites::new(&surface.mesh, views);
        let cutoff = CUTOFFS[round.min(CUTOFFS.len() - 1)];
        let loss = Tukey {
            scale: residual_scale(&surface.mesh, &sites, views, *albedo),
            cutoff,
        };
        let face_albedo = vec![*albedo; surface.mesh.faces.len()];
        let centre = centre_of(&surface.mesh);
        views.par_iter_mut().enumerate().for_each(|(k, view)| {
            let target = AlignmentTarget {
                mesh: &surface.mesh,
                sites: &sites.points,
                faces: &sites.faces_of(k),
                albedo: &face_albedo,
                centre,
                loss,
            };
            align_view(view, &target, &params.alignment);
        });
        // Gains and albedo share one scale: the mean of the gains stays 1.
        let mean_log = views.iter().map(|view| view.gain.ln()).sum::<f64>() / views.len() as f64;
        views
            .iter_mut()
            .for_each(|view| view.gain /= mean_log.exp());
        *albedo *= mean_log.exp();
        let loss = Tukey {
            scale: residual_scale(&surface.mesh, &sites, views, *albedo),
            cutoff,
        };
        let robust = Some((*albedo, loss));
        *albedo =
            albedo::global_albedo(&surface.mesh, &sites.points, &sites.visible, views, robust)
                .unwrap_or(*albedo);
        let face_albedo = vec![*albedo; surface.mesh.faces.len()];
        let problem = Problem {
            views,
            visible: &sites.visible,
            sites: &sites.points,
            albedo: &face_albedo,
            loss,
            priors: prior_weights(params),
            edges: self.edges,
        };
        let solver = SolverParams {
            max_steps: params.max_steps,
            min_decrease: 1e-4,
            max_step_m: 0.4 * params.edge_length_m,
        };
        let iterations = &mut self.iterations;
        minimise(surface, &problem, self.pattern, &solver, |iteration| {
            iterations.push(Iteration { round, ..iteration });
            progress(&Iteration { round, ..iteration })
        })
    }
}

/// The priors in the solver's units: each vertex stands for its area of the fused surface, whose errors go together over
/// `correlation_m`.
fn prior_weights(params: &RefineParams) -> PriorWeights {
    let h2 = params.edge_length_m * params.edge_length_m;
    let correlated = params.correlation_m * params.correlation_m;
    // A vertex of an equilateral mesh has the area √3/2 h², and cotangent weights are 1/√3.
    PriorWeights {
        anchor: 0.866 * h2 / correlated / (params.depth_sigma_m * params.depth_sigma_m),
        smoothness: 0.577 / correlated / (params.slope_sigma_rad * params.slope_sigma_rad),
    }
}

/// Robust standard deviation of all residuals, in sigmas, at least 1: 1.4826 times their median magnitude.
fn residual_scale(mesh: &TriMesh, sites: &Sites, views: &[View], albedo: f64) -> f64 {
    let mut magnitudes: Vec<f64> = (0..mesh.faces.len())
        .into_par_iter()
        .step_by(5)
        .flat_map_iter(|face| {
            let normal = unit_normal(mesh, face).map(|(normal, _)| normal);
            views_of(sites.visible[face], views).filter_map(move |view| {
                let sample = view.sample(&sites.points[face], &normal?)?;
                Some((sample.observed - albedo * sample.unit_prediction).abs() / sample.sigma)
            })
        })
        .collect();
    if magnitudes.is_empty() {
        return 1.0;
    }
    let middle = magnitudes.len() / 2;
    (1.4826 * *magnitudes.select_nth_unstable_by(middle, f64::total_cmp).1).max(1.0)
}

struct ViewError {
    n_sites: usize,
    rmse: f64,
}

/// Rendered against observed linear intensity, by view.
fn view_errors(mesh: &TriMesh, sites: &Sites, views: &[View], albedo: f64) -> Vec<ViewError> {
    views
        .par_iter()
        .enumerate()
        .map(|(k, view)| {
            let (mut square, mut mean, mut n) = (0.0, 0.0, 0usize);
            for face in sites.faces_of(k) {
                let face = face as usize;
                let Some((normal, _)) = unit_normal(mesh, face) else {
                    continue;
                };
                let Some(sample) = view.sample(&sites.points[face], &normal) else {
                    continue;
                };
                square += (sample.observed - albedo * sample.unit_prediction).powi(2);
                mean += sample.observed;
                n += 1;
            }
            let count = n.max(1) as f64;
            ViewError {
                n_sites: n,
                rmse: (square / count).sqrt() / (mean / count).max(f64::MIN_POSITIVE),
            }
        })
        .collect()
}

fn centre_of(mesh: &TriMesh) -> Point3<f64> {
    let sum = mesh
        .vertices
        .iter()
        .fold(nalgebra::Vector3::zeros(), |sum, v| sum + v.coords);
    Point3::from(sum / mesh.vertices.len() as f64)
}

fn shift_px(view: &View, centre: &Point3<f64>) -> [f64; 2] {
    let tracked = view.pixel(centre, &view.tracked_camera_from_world);
    let refined = view.pixel(centre, &view.camera_from_world);
    match (tracked, refined) {
        (Some(tracked), Some(refined)) => [refined.x - tracked.x, refined.y - tracked.y],
        _ => [0.0, 0.0],
    }
}
