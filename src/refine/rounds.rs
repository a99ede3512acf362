//! One turn of an outer round: visibility, the views' poses and gains, albedo, then displacements.

use super::albedo::{Albedo, AlbedoMode, AlbedoParams, Groups};
use super::alignment::{AlignmentTarget, align_view};
use super::energy::Problem;
use super::level::Level;
use super::observations::Observations;
use super::params::RefineParams;
use super::priors::PriorWeights;
use super::rendering::Rendered;
use super::site_motion::SiteMotion;
use super::sites::{Sites, ViewSet};
use super::solver::{Iteration, Minimum, RefineStatus, Solver, SolverParams};
use super::surface::Surface;
use super::view::View;
use crate::geometry::TriMesh;
use crate::robust::Tukey;
use nalgebra::Point3;
use rayon::prelude::*;

/// What stays the same over all rounds.
pub struct Rounds<'a> {
    /// Parameters.
    pub params: &'a RefineParams,
    /// The mesh.
    pub level: &'a Level,
}

/// What the rounds refine.
#[derive(Clone)]
pub struct State {
    /// The surface.
    pub surface: Surface,
    /// The views with their poses and gains.
    pub views: Vec<View>,
    /// Albedo.
    pub albedo: Albedo,
}

/// A surface as views told of it, for one that was not among them.
pub struct UnseenSurface<'a> {
    /// Its mesh.
    pub mesh: &'a TriMesh,
    sites: Sites,
    /// Whether any of those views saw each site.
    is_told: &'a [bool],
    /// Albedo of each site.
    pub albedo: &'a [f64],
    /// Mean of the vertices.
    centre: Point3<f64>,
}

/// Tukey cut-offs of the first round, those after it, and the last: true relief is a large residual at first, and what a finer mesh
/// tells of it is again.
const CUTOFFS: [f64; 3] = [9.0, 6.5, Tukey::EFFICIENT_CUTOFF];

/// Times that albedos of one surface, and its tints, are estimated anew without what the last estimate shows to be outliers. Arbitrary.
const REWEIGHTINGS: usize = 3;
/// The solve of a turn ends with the step that lowers the energy by less than this share, since the next one weighs the images anew.
/// Arbitrary.
const MIN_DECREASE: f64 = 1e-4;
/// No vertex moves farther in one step, along its normal, than so many lengths of an edge: one whose ends go opposite ways then turns
/// by 39°, less than the 60° at which steps are held back. Arbitrary within that.
const MAX_STEP_EDGES: f64 = 0.4;

/// The loss at the end, for residuals of a given scale in sigmas.
pub fn final_loss(scale: f64) -> Tukey {
    let [.., cutoff] = CUTOFFS;
    Tukey { scale, cutoff }
}

impl Rounds<'_> {
    /// The albedo of the base surface, robust to what the base gets wrong. `None` where nobody sees anything.
    pub fn first_albedo(&self, surface: &Surface, sites: &Sites, views: &[View]) -> Option<Albedo> {
        let observations = Observations::new(sites, views, None, None);
        let mut albedo = self.estimate_albedo(sites, &observations, None)?;
        for _ in 0..REWEIGHTINGS {
            let loss = final_loss(observations.residual_scale(sites, &albedo.by_site));
            let current = Some((&albedo, loss));
            albedo = self.estimate_albedo(sites, &observations, current)?;
        }
        Some(self.tinted(surface, sites, &observations, albedo))
    }

    /// The same groups with the tints that a surface has by what its sites are seen to show.
    pub fn tinted(
        &self,
        surface: &Surface,
        sites: &Sites,
        observations: &Observations,
        mut albedo: Albedo,
    ) -> Albedo {
        if !self.finds_tints() {
            return albedo;
        }
        // What is printed is an outlier at first.
        for _ in 0..REWEIGHTINGS {
            let loss = final_loss(observations.residual_scale(sites, &albedo.by_site));
            let problem = self.problem(observations, &albedo, loss);
            let found = problem.evaluate(surface, &albedo.groups).tints;
            let tints = problem.factors(&found);
            albedo.repaint(albedo.groups.clone(), tints);
        }
        albedo
    }

    /// Whether tints follow the surface.
    pub fn finds_tints(&self) -> bool {
        let AlbedoParams { mode, tints } = self.params.albedo;
        tints && mode == AlbedoMode::Mixture
    }

    /// Groups and albedos of a surface; `current` gives the residuals whose outliers do not count.
    pub fn estimate_albedo(
        &self,
        sites: &Sites,
        observations: &Observations,
        current: Option<(&Albedo, Tukey)>,
    ) -> Option<Albedo> {
        let groups = Groups {
            mode: self.params.albedo.mode,
            at_most: self.params.max_albedos,
        };
        Albedo::estimate(
            sites,
            self.level.neighbours(),
            observations,
            groups,
            current,
        )
    }

    /// Runs a turn of a round with a set of views, on its surface's sites that they see; the others stay at their tracked poses. `accepted`
    /// is told of each step and returns false to cancel.
    pub fn turn(
        &self,
        round: usize,
        learning: ViewSet,
        sites: &Sites,
        state: &mut State,
        accepted: &mut impl FnMut(Iteration) -> bool,
    ) -> RefineStatus {
        let State {
            surface,
            views,
            albedo,
        } = state;
        surface.directions = surface.mesh.vertex_normals();
        let [first, middle, last] = CUTOFFS;
        let is_last = round >= self.params.n_rounds;
        let cutoff = match round {
            0 => first,
            _ if is_last => last,
            _ => middle,
        };
        let mesh = &surface.mesh;
        let loss_of = |observations: &Observations, albedo: &Albedo| Tukey {
            scale: observations.residual_scale(sites, &albedo.by_site),
            cutoff,
        };
        let loss = loss_of(&Observations::for_scale(sites, views), albedo);
        self.align(mesh, sites, views, albedo, loss);
        let mean_gain = take_mean_gain(views, learning);
        *albedo = albedo.clone().scaled(mean_gain);
        let observations = {
            let rendered = (is_last && self.params.integrate_pixels)
                .then(|| Rendered::new(mesh, sites, views, &albedo.by_site));
            self.observe(sites, surface, views, rendered.as_ref())
        };
        let loss = loss_of(&observations, albedo);
        let current = Some((&*albedo, loss));
        if let Some(next) = self.estimate_albedo(sites, &observations, current) {
            *albedo = next;
        }
        let problem = self.problem(&observations, albedo, loss);
        let solver = Solver {
            problem: &problem,
            pattern: &self.level.pattern,
            params: SolverParams {
                max_steps: self.max_steps(),
                min_decrease: MIN_DECREASE,
                max_step_m: MAX_STEP_EDGES * self.level.edge_length_m,
            },
        };
        let mut groups = albedo.groups.clone();
        let Minimum { status, tints } = solver.minimise(surface, &mut groups, |iteration| {
            accepted(Iteration { round, ..iteration })
        });
        let tints = problem.factors(&tints);
        albedo.repaint(groups, tints);
        status
    }

    /// Accepted steps of a turn at most.
    fn max_steps(&self) -> usize {
        let on_finest = self.params.max_steps;
        match self.level.edge_length_m > self.params.edge_length_m {
            // Farther from where it ends, and soon done.
            true => on_finest + on_finest.div_ceil(2),
            false => on_finest,
        }
    }

    /// The priors of its mesh.
    pub fn prior_weights(&self) -> PriorWeights {
        PriorWeights::new(self.params, self.level.edge_length_m)
    }

    /// Aligns one view with a surface that it did not help to find: pose, gain and gain field, the surface held. Returns the
    /// surface's sites with those that the view sees of what others told of: of the rest not even the albedo is known.
    pub fn settle(&self, view: &mut View, subject: &UnseenSurface) -> Sites {
        let UnseenSurface {
            sites,
            is_told,
            albedo,
            ..
        } = subject;
        let mut sites = sites.clone().seen_by(std::slice::from_ref(view), 1);
        for (visible, is_told) in sites.visible.iter_mut().zip(*is_told) {
            *visible &= ViewSet::from(*is_told);
        }
        let (chosen, stands_for) = sites_to_align_by(sites.of_view(0));
        for cutoff in CUTOFFS {
            let observations = Observations::for_scale(&sites, std::slice::from_ref(view));
            let scale = observations.residual_scale(&sites, albedo);
            let loss = Tukey { scale, cutoff };
            let target = AlignmentTarget {
                sites: &sites,
                chosen: &chosen,
                stands_for,
                albedo,
                centre: subject.centre,
                loss,
            };
            align_view(view, &target, &self.params.alignment);
            fit_gain_field(view, &target);
        }
        sites
    }

    /// Aligns the views and takes up what slow differences of brightness they then have.
    fn align(
        &self,
        mesh: &TriMesh,
        sites: &Sites,
        views: &mut [View],
        albedo: &Albedo,
        loss: Tukey,
    ) {
        let centre = mesh.centre();
        let views = views.par_iter_mut().with_max_len(1);
        views.enumerate().for_each(|(k, view)| {
            let (chosen, stands_for) = sites_to_align_by(sites.of_view(k));
            let target = AlignmentTarget {
                sites,
                chosen: &chosen,
                stands_for,
                albedo: &albedo.by_site,
                centre,
                loss,
            };
            align_view(view, &target, &self.params.alignment);
            fit_gain_field(view, &target);
        });
    }
}

impl<'a> Rounds<'a> {
    /// The sites of a mesh that a set of views sees, as glossy as their materials.
    pub fn sites(&self, mesh: &TriMesh, views: &[View], set: ViewSet, albedo: &Albedo) -> Sites {
        Sites::new(self.params.sites, mesh, views, set).with_gloss(albedo.site_gloss())
    }

    /// A surface for views that did not help to find it, and of which sites others told.
    pub fn unseen<'s>(
        &self,
        mesh: &'s TriMesh,
        albedo: &'s Albedo,
        is_told: &'s [bool],
    ) -> UnseenSurface<'s> {
        UnseenSurface {
            mesh,
            sites: Sites::unseen(self.params.sites, mesh).with_gloss(albedo.site_gloss()),
            is_told,
            albedo: &albedo.by_site,
            centre: mesh.centre(),
        }
    }

    /// What views show at a surface's sites, and how that changes with its displacements.
    pub fn observe(
        &self,
        sites: &Sites,
        surface: &Surface,
        views: &[View],
        rendered: Option<&Rendered>,
    ) -> Observations {
        let motion = SiteMotion::of(surface, sites.kind, self.params.linearisation);
        Observations::new(sites, views, motion, rendered)
    }

    /// What is solved for displacements, by what views show at the sites.
    pub fn problem<'p>(
        &self,
        observations: &'p Observations,
        albedo: &'p Albedo,
        loss: Tukey,
    ) -> Problem<'p>
    where
        'a: 'p,
    {
        Problem {
            sites: self.params.sites,
            observations,
            labels: &albedo.labels,
            tints: &albedo.tints,
            finds_tints: self.finds_tints(),
            loss,
            priors: self.prior_weights(),
            edges: &self.level.edges,
            patches: &self.level.patches,
            jacobian: self.params.jacobian,
        }
    }
}

/// Sites enough for the seven numbers of a view and its slow gains.
const ALIGNMENT_SITES: usize = 4000;

/// About that many of those that a view sees, spread evenly over the list, and how many each stands for.
fn sites_to_align_by(seen: Vec<u32>) -> (Vec<u32>, f64) {
    let n_seen = seen.len();
    let stride = (n_seen / ALIGNMENT_SITES).max(1);
    let chosen: Vec<u32> = seen.into_iter().step_by(stride).collect();
    let stands_for = n_seen as f64 / chosen.len().max(1) as f64;
    (chosen, stands_for)
}

/// Divides all gains by the geometric mean of a set's and returns it: gains and albedo share one scale, which is the
/// albedo's.
fn take_mean_gain(views: &mut [View], learning: ViewSet) -> f64 {
    let learnt = views.iter().enumerate();
    let learnt = learnt.filter(|(k, _)| learning >> k & 1 == 1);
    let logs = learnt.map(|(_, view)| view.gain.ln());
    let (sum, n) = logs.fold((0.0, 0.0), |(sum, n), log| (sum + log, n + 1.0));
    let mean = f64::exp(sum / f64::max(n, 1.0));
    views.iter_mut().for_each(|view| view.gain /= mean);
    mean
}

/// The gain field is held to 1 as if by so many squared sigmas of prediction: about twenty pixels' worth.
const GAIN_FIELD_PRIOR: f64 = 8000.0;

/// Re-estimates the slow gain over a view's image from the sites that it sees.
fn fit_gain_field(view: &mut View, target: &AlignmentTarget) {
    let mut sums = view.gain_field.sums();
    target.each_sample(view, |site, area, sample| {
        let look = &sample.look;
        let predicted = target.albedo[site] * sample.unit_prediction;
        let without_field = predicted * view.gain / look.gain;
        let robust = target.loss.weight((look.observed - predicted) / look.sigma);
        sums.add(
            &look.pixel,
            without_field,
            look.observed,
            robust * sample.covered(view, area) * target.stands_for / (look.sigma * look.sigma),
        );
    });
    view.gain_field = sums.solve(GAIN_FIELD_PRIOR);
}
