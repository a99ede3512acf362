//! Refinement from shading images: Section 4 of the paper.
//!
//! The base mesh is cut to the object, remeshed to a uniform edge length, and displaced along its normals until Eq. (1)
//! predicts what every shading image shows. Each outer round re-estimates visibility, the pose and gain of each view, the
//! albedo and the scale of the residuals, then solves for the displacements; Eq. (9) moves the surface along refreshed normals.
//!
//! Not handled: the emitter's own offset, interreflection beyond what the gain field takes up, specular highlights beyond
//! what the robust loss rejects.

mod albedo;
mod alignment;
mod couplings;
mod crop;
mod energy;
mod gain_field;
mod mixture;
mod object;
mod params;
mod patches;
pub mod remesh;
mod rounds;
#[cfg(test)]
mod scenes;
mod sites;
mod solver;
#[cfg(test)]
mod tests;
mod view;

pub use alignment::AlignmentParams;
pub use crop::{Crop, ObjectParams};
pub use object::{Plane, Roi, select_object, select_roi};
pub use params::RefineParams;
pub use solver::{Iteration, RefineStatus};
pub use view::{ImageTrust, Optics};

use crate::geometry::{EdgeAdjacency, TriMesh};
use crate::snapshot::ShadingSnapshot;
use couplings::Couplings;
use depth_camera::Image;
use energy::Surface;
use nalgebra::Point3;
use rayon::prelude::*;
use remesh::{RemeshParams, remesh};
use rounds::{Rounds, State, centre_of};
use serde::Serialize;
use sites::Sites;
use solver::Pattern;
use view::{View, ViewContext};

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
    /// Albedo of each group of facets and the share of the facets in it.
    pub albedo_groups: Vec<(f64, f64)>,
    /// Edge length of the mesh, metres.
    pub edge_length_m: f64,
    /// How it ended.
    pub status: RefineStatus,
    /// Every accepted step.
    pub iterations: Vec<Iteration>,
    /// The views, in the order of the snapshots.
    pub views: Vec<ViewFit>,
    /// For each view the pixels that could be used: 255, others 0.
    pub masks: Vec<Image<u8>>,
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
    let params = &RefineParams {
        edge_length_m: params.edge_length_for(object.area_m2()),
        ..params.clone()
    };
    let remeshed = remesh(object, &RemeshParams::new(params.edge_length_m));
    if remeshed.faces.is_empty() {
        return Err(RefineError::NoSurface);
    }
    let centre = centre_of(&remeshed);
    let context = ViewContext {
        scene,
        centre,
        optics,
        trust: &params.trust,
    };
    let views: Vec<View> = snapshots
        .par_iter()
        .map(|snapshot| View::new(snapshot, &context))
        .collect();
    let edges = EdgeAdjacency::new(&remeshed);
    let directions = remeshed.vertex_normals();
    let patches = patches::cut(&remeshed, &directions, params.patch_m);
    let couplings = Couplings::new(&remeshed, &edges, &patches);
    let neighbours = albedo::face_neighbours(&couplings.of_faces, couplings.pairs.len());
    let pattern =
        Pattern::new(remeshed.vertices.len(), couplings).ok_or(RefineError::OutOfMemory)?;
    let rounds = Rounds {
        params,
        edges: &edges,
        patches: &patches,
        neighbours: &neighbours,
        pattern: &pattern,
    };
    let base_sites = Sites::new(&remeshed, &views);
    let nothing_visible = RefineError::NothingVisible {
        n_views: views.len(),
    };
    let albedo = rounds
        .first_albedo(&remeshed, &base_sites, &views)
        .ok_or(nothing_visible)?;
    let before = base_sites.view_errors(&remeshed, &views, &albedo.by_face);
    let total_m = vec![0.0; remeshed.vertices.len()];
    let mut state = State {
        surface: Surface {
            mesh: remeshed,
            directions,
            total_m,
        },
        views,
        albedo,
    };
    let mut iterations = Vec::new();
    let mut status = RefineStatus::IterationLimit;
    for round in 0..params.n_rounds {
        status = rounds.run(round, &mut state, |iteration| {
            iterations.push(iteration);
            progress(&iteration)
        });
        if matches!(status, RefineStatus::Cancelled | RefineStatus::Singular) {
            break;
        }
    }
    let State {
        surface,
        views,
        albedo,
    } = state;
    let after =
        Sites::new(&surface.mesh, &views).view_errors(&surface.mesh, &views, &albedo.by_face);
    let fits = views
        .iter()
        .zip(before.iter().zip(&after))
        .map(|(view, (before, after))| ViewFit {
            gain: view.gain,
            shift_px: shift_px(view, &centre),
            n_sites: after.n_sites,
            rmse_before: before.rmse,
            rmse_after: after.rmse,
        });
    Ok(Refinement {
        albedo: albedo.by_vertex(&surface.mesh),
        albedo_groups: albedo.groups.iter().copied().zip(albedo.shares()).collect(),
        edge_length_m: params.edge_length_m,
        status,
        iterations,
        views: fits.collect(),
        masks: views.iter().map(View::mask).collect(),
        mesh: surface.mesh,
    })
}

/// How far the images moved a point on a view, pixels.
fn shift_px(view: &View, centre: &Point3<f64>) -> [f64; 2] {
    let tracked = view.pixel(centre, &view.tracked_camera_from_world);
    let refined = view.pixel(centre, &view.camera_from_world);
    match (tracked, refined) {
        (Some(tracked), Some(refined)) => [refined.x - tracked.x, refined.y - tracked.y],
        _ => [0.0, 0.0],
    }
}
