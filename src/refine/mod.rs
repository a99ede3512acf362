//! Refinement from shading images: Section 4 of the paper.
//!
//! The base mesh is cut to the object, remeshed to a uniform edge length, and displaced along its normals until Eq. (1)
//! predicts what every shading image shows. Each turn of an outer round re-estimates visibility, the pose and gain of each view,
//! the albedo and the scale of the residuals, then solves for the displacements; Eq. (9) moves the surface along refreshed
//! normals.
//!
//! Light that arrives over other surfaces is predicted beside the lamp's. A calibration that the images contradict is replaced by what they
//! say, and the gloss of each material is predicted where they show it ([`Gloss`](crate::shading::Gloss)). Narrow highlights are left to
//! the robust loss.

mod albedo;
mod alignment;
mod calibration_trial;
mod cholesky;
mod clusters;
#[cfg(test)]
mod corner_tests;
mod couplings;
mod crop;
mod dissection;
mod edge_mask;
#[cfg(test)]
mod endings_tests;
mod energy;
mod error;
mod evaluation;
mod evidence;
mod expansion;
mod gain_field;
mod gaze;
#[cfg(test)]
mod guard_tests;
mod held_out;
mod label_spread;
mod level;
mod light_camera;
mod materials;
mod max_flow;
mod median_albedo;
mod mixture;
mod neighbourhood;
mod numeric;
mod object;
mod observations;
mod optics;
mod params;
mod patches;
mod pattern;
mod preparation;
mod priors;
pub mod remesh;
mod rendering;
mod rounds;
#[cfg(test)]
mod scenes;
mod self_calibration;
mod side_by_side;
mod single_view;
mod site_blocks;
mod site_gloss;
mod site_motion;
mod sites;
mod solver;
pub mod stages;
mod subject;
mod surface;
#[cfg(test)]
mod tests;
mod tiles;
mod tint;
mod vertex_system;
mod view;

pub use albedo::{AlbedoMode, AlbedoParams, Material};
pub use alignment::AlignmentParams;
pub use calibration_trial::contradiction_as_tracked;
pub use crop::{Crop, ObjectParams};
pub use energy::{GroupTerms, NormalMatrix};
pub use error::RefineError;
pub use evidence::{Evidence, EvidenceSummary};
pub use held_out::{HeldOut, ImageError, JudgedView, Judgement};
pub use materials::Swallowed;
pub use numeric::JacobianMode;
pub use object::{Roi, select_object, select_roi};
pub use optics::Optics;
pub use params::RefineParams;
pub use pattern::Step;
pub use self_calibration::{Contradiction, MAX_MISFIT, SelfCalibrationParams};
pub use single_view::surface_of_view;
pub use site_motion::Linearisation;
pub use sites::SiteKind;
pub use solver::{Iteration, RefineStatus};
pub use subject::Subject;
pub use view::{HIDING_CELL_M, ImageTrust};

use crate::geometry::{Pose, TriMesh};
use depth_camera::Image;
use error::MAX_BELIEVABLE_RMSE;
use held_out::{every, hold_out};
use nalgebra::Point3;
use preparation::{Preparation, first_views};
use remesh::RemeshDistance;
use rounds::State;
use sites::{ViewError, ViewSet};
use view::View;

/// Most views that one refinement takes.
pub const MAX_VIEWS: usize = ViewSet::BITS as usize;

/// What a view ended as.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ViewFit {
    /// Brightness against the other views.
    pub gain: f64,
    /// Its pose as the images have it.
    pub world_from_camera: Pose,
    /// How far the images moved the object's centre on this view, pixels.
    pub shift_px: [f64; 2],
    /// Sites that the view saw.
    pub n_sites: usize,
    /// Root mean square of observed less rendered linear intensity, relative to the mean observed one, on the coarsest mesh of the base
    /// surface with poses from tracking.
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
    /// The groups of one albedo, in the order of the labels.
    pub materials: Vec<Material>,
    /// Group of each vertex.
    pub labels: Vec<u8>,
    /// What the images say of each vertex.
    pub evidence: Evidence,
    /// Edge length of the mesh, metres.
    pub edge_length_m: f64,
    /// How far the remeshed surface lay from the base mesh before anything was displaced.
    pub remeshing: RemeshDistance,
    /// How it ended.
    pub status: RefineStatus,
    /// Every accepted step.
    pub iterations: Vec<Iteration>,
    /// Spread of the sites' own albedos about those of their groups, robust standard deviation of the logarithm.
    pub albedo_spread: f64,
    /// Image error over the sites of all views, before and after: see [`ViewFit`].
    pub rmse_before: f64,
    /// After.
    pub rmse_after: f64,
    /// The views, in the order of the snapshots.
    pub views: Vec<ViewFit>,
    /// What the views that were held out say.
    pub judgement: Judgement,
    /// For each view the pixels that could be used: 255, others 0.
    pub masks: Vec<Image<u8>>,
    /// How much patches of the surface disagree with what the light makes of them, in standard deviations: 1.0 on most scans; 0 where they were
    /// not asked.
    pub misfit: f64,
    /// What the images say against the calibration; then the surface was refined by what they say.
    pub contradiction: Option<Contradiction>,
}

/// Refines the surface of an object.
///
/// A quarter of the views that look at it is held out while the surface is found and then judges it ([`Judgement`]), a quarter of those that
/// see it where none of that quarter or none of the others does; a last round then takes all views in, and turns until the surface rests. What
/// they refuse before that is taken to rest and judged once more. A single view judges nothing. After each accepted step `progress` is called;
/// it returns false to cancel, which keeps what was reached.
///
/// # Errors
/// Where there is nothing to refine or to learn from, where the images cannot be explained, and where those held out fit the
/// base surface better: then the base mesh is the result.
pub fn refine(
    subject: &Subject,
    params: &RefineParams,
    mut progress: impl FnMut(&Iteration) -> bool,
) -> Result<Refinement, RefineError> {
    let all = first_views(subject.snapshots.len());
    let mut held_out = hold_out(subject.looking());
    let mut prepared = Preparation::new(subject, params, all & !held_out)?;
    let seeing = prepared.seeing();
    let among_seeing = hold_out(seeing);
    let is_blind = held_out & seeing == 0 || seeing & !held_out == 0;
    if seeing != 0 && is_blind && held_out != among_seeing {
        held_out = among_seeing;
        // Two of them are large.
        drop(prepared);
        prepared = Preparation::new(subject, params, all & !held_out)?;
    }
    let learning = all & !held_out;
    let (base, errors_before) = prepared.base(subject, learning)?;
    // A mixture that may be of more labels and is of one tells no second material.
    let is_forced = params.max_albedos == 1 || params.albedo.mode == AlbedoMode::Paper;
    if base.albedo.groups.len() == 1
        && is_forced
        && let Some(swallowed) = prepared.swallowed(learning)
    {
        return Err(RefineError::OneLabel(swallowed));
    }
    let mut state = base.clone();
    let mut iterations = Vec::new();
    let mut accepted = |iteration| {
        iterations.push(iteration);
        progress(&iteration)
    };
    let first = 0..params.n_rounds;
    let mut status = prepared.run(first, learning, &mut state, &mut accepted);
    let limit = slow_gain_limit(&params.trust, prepared.indirect_share());
    let judge = |state: &mut State| {
        let judged = prepared.judge(base.clone(), state, learning, held_out);
        Judgement::of(&judged)
    };
    let mut judgement = judge(&mut state);
    if refused(&judgement, limit).is_some() && !status.is_final() {
        // What does not rest yet may be refused for that alone.
        status = prepared.rest(learning, &mut state, &mut accepted);
        judgement = judge(&mut state);
    }
    if let Some(error) = refused(&judgement, limit) {
        return Err(error);
    }
    drop(base);
    if !status.is_final() {
        let last = params.n_rounds..params.n_rounds + 1;
        status = prepared.run(last, all, &mut state, &mut accepted);
    }
    let finest = prepared.finest();
    let sites = finest.sites(&state.surface.mesh, &state.views, all, &state.albedo);
    let errors = sites.view_errors(&state.views, &state.albedo.by_site);
    let views = view_fits(&state.views, prepared.centre(), &errors_before, &errors);
    let rmse = over_all(&views, |view| view.rmse_after);
    if rmse > MAX_BELIEVABLE_RMSE {
        return Err(RefineError::Contradicted { rmse });
    }
    let evidence = finest.evidence(&state, &sites);
    let State {
        surface, albedo, ..
    } = &state;
    Ok(Refinement {
        evidence: evidence.ok_or(RefineError::OutOfMemory)?,
        labels: albedo.labels_by_vertex(params.sites, &surface.mesh),
        albedo: albedo.by_vertex(params.sites, &surface.mesh),
        materials: albedo.materials(),
        albedo_spread: albedo.spread,
        edge_length_m: prepared.edge_length_m(),
        remeshing: RemeshDistance::between(subject.object, &finest.level.mesh),
        status,
        iterations,
        rmse_before: over_all(&views, |view| view.rmse_before),
        rmse_after: rmse,
        views,
        judgement,
        masks: state.views.iter().map(View::mask).collect(),
        misfit: prepared.told().misfit,
        contradiction: prepared.told().contradiction.clone(),
        mesh: state.surface.mesh,
    })
}

/// Why a refined surface is not delivered, by what the views that were held out say; `None` where it is.
fn refused(judgement: &Judgement, limit: f64) -> Option<RefineError> {
    let overall = judgement.overall;
    let slow_gain = overall.slow_gain;
    if judgement.prefers_base() {
        Some(RefineError::WorseThanBase(overall))
    } else if slow_gain > limit {
        Some(RefineError::SlowlyContradicted { slow_gain, limit })
    } else {
        None
    }
}

/// Slow gains that are believed where so large a share of the light is indirect.
fn slow_gain_limit(trust: &ImageTrust, indirect_share: f64) -> f64 {
    /// How far indirect light is off, as a share of it: a quarter in a deep bowl, most of what the image does not show.
    const INDIRECT_ERROR: f64 = 0.25;
    trust.max_slow_gain.hypot(INDIRECT_ERROR * indirect_share)
}

/// Refines as often as there are folds, each time without every `n_folds`-th view, which then judge: leave-one-out where
/// there are as many folds as views. `done` is called after each fold and returns false to stop.
///
/// # Errors
/// As for [`refine`], but that a worse surface is no error here, nor is a fold whose views see nothing while others see something.
///
/// # Panics
/// If there are fewer than two folds.
pub fn cross_validate(
    subject: &Subject,
    params: &RefineParams,
    n_folds: usize,
    mut done: impl FnMut(usize) -> bool,
) -> Result<Vec<JudgedView>, RefineError> {
    assert!(n_folds > 1, "{n_folds} folds, must be at least 2");
    let n_views = subject.snapshots.len();
    let mut judged = Vec::with_capacity(n_views);
    let mut unseen = None;
    for fold in 0..n_folds.min(n_views) {
        let judges = every(fold, n_folds, n_views);
        let learning = first_views(n_views) & !judges;
        match judged_by(subject, params, learning, judges) {
            Ok(views) => judged.extend(views),
            Err(error @ (RefineError::NothingVisible { .. } | RefineError::Saturated { .. })) => {
                unseen = Some(error)
            }
            Err(error) => return Err(error),
        }
        if !done(fold) {
            break;
        }
    }
    judged.sort_by_key(|view| view.index);
    match unseen {
        Some(error) if judged.is_empty() => Err(error),
        _ => Ok(judged),
    }
}

/// Refines from some of the views, given by their numbers, and lets others judge.
///
/// # Errors
/// As for [`cross_validate`].
pub fn validate(
    subject: &Subject,
    params: &RefineParams,
    learning: &[usize],
    judges: &[usize],
) -> Result<Vec<JudgedView>, RefineError> {
    // More views than a set holds are refused.
    let bit = |view: &usize| (1 as ViewSet).checked_shl(*view as u32).unwrap_or(0);
    let set = |views: &[usize]| views.iter().fold(0, |set, view| set | bit(view));
    judged_by(subject, params, set(learning), set(judges))
}

/// Those that judge tell nothing, not even of response, light and gloss.
fn judged_by(
    subject: &Subject,
    params: &RefineParams,
    learning: ViewSet,
    judges: ViewSet,
) -> Result<Vec<JudgedView>, RefineError> {
    Preparation::new(subject, params, learning)?.validate(subject, learning, judges)
}

/// How every view fits the base surface at its tracked pose, and the refined one.
fn view_fits(
    views: &[View],
    centre: &Point3<f64>,
    before: &[ViewError],
    after: &[ViewError],
) -> Vec<ViewFit> {
    let errors = before.iter().zip(after);
    let fit = |(view, (before, after)): (&View, (&ViewError, &ViewError))| ViewFit {
        gain: view.gain,
        world_from_camera: view.camera_from_world.inverse(),
        shift_px: shift_px(view, centre),
        n_sites: after.n_sites,
        rmse_before: before.rmse,
        rmse_after: after.rmse,
    };
    views.iter().zip(errors).map(fit).collect()
}

/// Root mean square over the sites of all views; 0 where nothing is seen.
fn over_all(views: &[ViewFit], rmse: impl Fn(&ViewFit) -> f64) -> f64 {
    let n_sites: usize = views.iter().map(|view| view.n_sites).sum();
    let square: f64 = views
        .iter()
        .map(|view| view.n_sites as f64 * rmse(view) * rmse(view))
        .sum();
    (square / n_sites.max(1) as f64).sqrt()
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
