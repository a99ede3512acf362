//! What is made once before the rounds: the remeshed object, the views, the pattern of the normal equations.

use super::MAX_VIEWS;
use super::albedo::{Albedo, labels_by_face};
use super::calibration_trial::CalibrationTrial;
use super::error::{MAX_NON_MANIFOLD_SHARE, RefineError};
use super::held_out::{JudgedView, Judgement, every, judge};
use super::level::{Level, levels};
use super::materials::Swallowed;
use super::observations::Observations;
use super::optics::Optics;
use super::params::RefineParams;
use super::rounds::{Rounds, State, final_loss};
use super::self_calibration::{Told, gloss_of_materials};
use super::site_gloss::SiteGloss;
use super::sites::{SiteKind, Sites, ViewError, ViewSet};
use super::solver::{Iteration, RefineStatus};
use super::subject::Subject;
use super::surface::Surface;
use super::view::{HIDING_CELL_M, View, ViewContext};
use crate::geometry::{EdgeAdjacency, TriMesh, coarsened};
use crate::interreflection::WhiteLevel;
use crate::shading::{Gloss, SATURATION};
use crate::snapshot::ShadingSnapshot;
use nalgebra::Point3;
use rayon::prelude::*;
use std::ops::Range;

/// Longest edges of a mesh that tells of response and light, metres, if there is such a level: by facets of 2.6 mm gamma comes out
/// 1.9 % low on the recorded scans, by those of 1.3 mm 1 %.
const ASKED_EDGE_M: f64 = 0.0015;

/// Fewer faces are a crumb, or what is left of a surface whose faces share no vertices; arbitrary.
const MIN_FACES: usize = 64;

/// A surface rests when a turn of a round turns it by less, root mean square over its edges: 1.7°. Arbitrary; the recorded scans rest after one to
/// three turns, grooves of 32° that the base mesh lacks after eight. Where a twentieth of the edges still turns by 0.13 and the rest by
/// nothing it rests, too.
const RESTING_RAD: f64 = 0.03;

/// All that the rounds need and do not change.
pub struct Preparation {
    params: RefineParams,
    /// The coarsest first.
    levels: Vec<Level>,
    /// The one that tells of response, light and gloss.
    asked: usize,
    centre: Point3<f64>,
    views: Vec<View>,
    /// Of the coarsest level's base surface, and all views that see them.
    base_sites: Sites,
    told: Told,
}

impl Preparation {
    /// Prepares a refinement from a set of views: what they say of calibration and gloss holds for all.
    ///
    /// # Errors
    /// For too many views, for what is no surface, and if memory does not suffice.
    pub fn new(
        subject: &Subject,
        params: &RefineParams,
        learning: ViewSet,
    ) -> Result<Self, RefineError> {
        let Subject {
            object,
            snapshots,
            optics,
            ..
        } = *subject;
        if snapshots.len() > MAX_VIEWS {
            return Err(RefineError::TooManyViews {
                n_views: snapshots.len(),
            });
        }
        if object.faces.len() < MIN_FACES {
            return Err(RefineError::NoSurface);
        }
        check_manifold(object)?;
        let params = params.for_object(object, subject.footprint_m());
        let centre = object.centre();
        // Meshing keeps one thread busy.
        let (levels, views) =
            rayon::join(|| levels(object, &params), || views_of(subject, &params));
        let levels = levels?;
        let mut fine = levels
            .iter()
            .map(|level| level.edge_length_m <= ASKED_EDGE_M);
        let asked = fine.position(|is_fine| is_fine);
        let asked = asked.unwrap_or(levels.len() - 1);
        let trial = CalibrationTrial {
            subject,
            params: &params,
            mesh: &levels[asked].mesh,
            asked: learning,
        };
        let told = trial.ask(&views);
        let (told, views) = trial.judge(told, &levels[0], views);
        let views = match optics.white_level() {
            Some(_) => views,
            None => trial.judge_indirect(&told, &levels[0], views),
        };
        let mesh = &levels[0].mesh;
        let base_sites = Sites::new(params.sites, mesh, &views, first_views(views.len()))
            .with_gloss(SiteGloss::uniform(told.gloss));
        Ok(Preparation {
            params,
            levels,
            asked,
            centre,
            views,
            base_sites,
            told,
        })
    }

    /// Rounds over the finest mesh.
    pub fn finest(&self) -> Rounds<'_> {
        self.rounds(self.levels.len() - 1)
    }

    fn rounds(&self, level: usize) -> Rounds<'_> {
        Rounds {
            params: &self.params,
            level: &self.levels[level],
        }
    }

    /// The level of a round: the last two have the finest, each before it a coarser one, as far as there are.
    fn level_of(&self, round: usize) -> usize {
        (self.levels.len() + round)
            .saturating_sub(self.params.n_rounds)
            .min(self.levels.len() - 1)
    }

    /// Takes a state from one level to a finer one.
    fn prolong(&self, state: &mut State, from: usize, to: usize) {
        for pair in self.levels[from..=to].windows(2) {
            *state = pair[1].prolonged(&pair[0], self.params.sites, state);
        }
    }

    /// The base surface on the coarsest mesh, with the albedo that a set of views gives it at their tracked poses, and how all views
    /// fit it.
    ///
    /// # Errors
    /// If none of them sees it.
    pub fn base(
        &self,
        subject: &Subject,
        learning: ViewSet,
    ) -> Result<(State, Vec<ViewError>), RefineError> {
        let (mesh, views, sites) = (&self.levels[0].mesh, &self.views, &self.base_sites);
        let learnt = sites.only(learning);
        let surface = Surface::of_base(mesh);
        let albedo = self.rounds(0).first_albedo(&surface, &learnt, views);
        let mut albedo = albedo.ok_or_else(|| self.why_nothing_is_visible(subject))?;
        let errors = sites.view_errors(views, &albedo.by_site);
        let gloss = self.gloss_of_materials(&albedo, subject.optics, learning);
        albedo.gloss = gloss.unwrap_or_else(|| vec![self.told.gloss; albedo.groups.len()]);
        let state = State {
            surface,
            views: views.clone(),
            albedo,
        };
        Ok((state, errors))
    }

    /// Two materials that a set of views tells apart on the base surface, where only one label may be given.
    pub fn swallowed(&self, learning: ViewSet) -> Option<Swallowed> {
        let sites = self.base_sites.only(learning);
        let observations = Observations::new(&sites, &self.views, None, None);
        Swallowed::of(&sites, self.levels[0].neighbours(), &observations)
    }

    /// What a set of views says of the gloss of each material of the base surface; `None` where they say nothing of each.
    fn gloss_of_materials(
        &self,
        albedo: &Albedo,
        optics: &Optics,
        learning: ViewSet,
    ) -> Option<Vec<Gloss>> {
        let params = &self.params.self_calibration;
        let n_materials = albedo.groups.len();
        if !params.enabled || n_materials < 2 {
            return None;
        }
        let kind = self.params.sites;
        let finer = self.levels[1..=self.asked].iter();
        let labels = finer.fold(albedo.labels.clone(), |labels, level| {
            level.of_children(kind, &labels)
        });
        let mesh = &self.levels[self.asked].mesh;
        let labels = labels_by_face(kind, labels, mesh);
        let sites = Sites::new(SiteKind::Face, mesh, &self.views, learning);
        let relit = self.told.contradiction.as_ref();
        let relit = relit.map(|contradiction| optics.with(&contradiction.calibration));
        let optics = relit.as_ref().unwrap_or(optics);
        let materials = (&labels[..], n_materials);
        let shared = self.told.gloss;
        gloss_of_materials(&sites, &self.views, optics, params, materials, shared)
    }

    /// Refines from a set of views, the last round among it, and lets another judge.
    ///
    /// # Errors
    /// If none of the views learnt from sees the base surface.
    pub fn validate(
        &self,
        subject: &Subject,
        learning: ViewSet,
        judges: ViewSet,
    ) -> Result<Vec<JudgedView>, RefineError> {
        let (base, _) = self.base(subject, learning)?;
        let mut state = base.clone();
        self.run(
            0..self.params.n_rounds + 1,
            learning,
            &mut state,
            &mut |_| true,
        );
        Ok(self.judge(base, &mut state, learning, judges))
    }

    /// Runs rounds with a set of views, from a state of the first one's level to the finest; the other views stay at their tracked poses.
    /// The last round of a level takes turns until the surface rests. `accepted` is told of each step and returns false to cancel.
    pub fn run(
        &self,
        rounds: Range<usize>,
        learning: ViewSet,
        state: &mut State,
        accepted: &mut impl FnMut(Iteration) -> bool,
    ) -> RefineStatus {
        let mut status = RefineStatus::IterationLimit;
        let mut level = self.level_of(rounds.start);
        for round in rounds {
            self.prolong(state, level, self.level_of(round));
            level = self.level_of(round);
            let goes_on = round < self.params.n_rounds && self.level_of(round + 1) == level;
            let n_turns = if goes_on { 1 } else { self.params.max_turns };
            status = self.take_turns(round, 0..n_turns, learning, state, accepted);
            if status.is_final() {
                break;
            }
        }
        self.prolong(state, level, self.levels.len() - 1);
        status
    }

    /// Takes a state as [`Self::run`] leaves it before the last round to rest, by further turns of the round that it is of.
    pub fn rest(
        &self,
        learning: ViewSet,
        state: &mut State,
        accepted: &mut impl FnMut(Iteration) -> bool,
    ) -> RefineStatus {
        let turns = 1..self.params.max_turns;
        self.take_turns(self.params.n_rounds - 1, turns, learning, state, accepted)
    }

    /// Runs a round on its level until it hardly turns the surface any more, or has taken these turns: poses, gains and albedo are found
    /// with the surface held and the surface with them, so that steep relief needs many.
    fn take_turns(
        &self,
        round: usize,
        turns: Range<usize>,
        learning: ViewSet,
        state: &mut State,
        accepted: &mut impl FnMut(Iteration) -> bool,
    ) -> RefineStatus {
        let rounds = self.rounds(self.level_of(round));
        let mut status = RefineStatus::IterationLimit;
        for turn in turns {
            let sites = match (round, turn) {
                (0, 0) => {
                    let sites = self.base_sites.only(learning);
                    sites.with_gloss(state.albedo.site_gloss())
                }
                _ => rounds.sites(&state.surface.mesh, &state.views, learning, &state.albedo),
            };
            let before_m = state.surface.total_m.clone();
            status = rounds.turn(round, learning, &sites, state, accepted);
            let turned_rad = rounds.level.turned_rad(&before_m, &state.surface.total_m);
            if status.is_final() || turned_rad < RESTING_RAD {
                break;
            }
        }
        status
    }

    /// Lets a set of views judge the base state and a refined one of the finest level, both learnt from another set; they are left
    /// aligned with the refined surface. Of the base surface, too, albedo and tints are told by the views that the images have aligned.
    /// They judge what the others saw; if they see nothing of that, what they do see.
    pub fn judge(
        &self,
        mut base: State,
        refined: &mut State,
        learning: ViewSet,
        judges: ViewSet,
    ) -> Vec<JudgedView> {
        self.prolong(&mut base, 0, self.levels.len() - 1);
        let rounds = self.finest();
        let State {
            surface, albedo, ..
        } = &base;
        let views = &refined.views;
        let sites = rounds.sites(&surface.mesh, views, learning, albedo);
        let observations = Observations::new(&sites, views, None, None);
        let loss = final_loss(observations.residual_scale(&sites, &albedo.by_site));
        let current = Some((albedo, loss));
        if let Some(albedo) = rounds.estimate_albedo(&sites, &observations, current) {
            base.albedo = rounds.tinted(surface, &sites, &observations, albedo);
        }
        let judged = judge(&rounds, &base, refined, &sites.are_seen(), judges);
        if judges == 0 || Judgement::of(&judged).n_comparing() > 0 {
            return judged;
        }
        let all = vec![true; sites.points.len()];
        judge(&rounds, &base, refined, &all, judges)
    }

    /// The views that see any of the base surface.
    pub fn seeing(&self) -> ViewSet {
        self.base_sites.seeing()
    }

    /// Share of the light that is predicted to come over other surfaces.
    pub fn indirect_share(&self) -> f64 {
        self.base_sites.indirect_share(&self.views)
    }

    /// Mean of the object's vertices as they were fused, world frame.
    pub fn centre(&self) -> &Point3<f64> {
        &self.centre
    }

    /// Edge length of the mesh, metres.
    pub fn edge_length_m(&self) -> f64 {
        self.params.edge_length_m
    }

    /// What the images said of calibration and gloss; then the views were made with that.
    pub fn told(&self) -> &Told {
        &self.told
    }

    fn why_nothing_is_visible(&self, subject: &Subject) -> RefineError {
        let full_scale = subject.optics.full_scale;
        // Pixels on the object, and those of them that are white.
        let looks = |(view, snapshot): (&View, &ShadingSnapshot)| {
            let counts = &snapshot.ir_counts;
            let pixels = self.levels[0].mesh.vertices.iter();
            let pixels =
                pixels.filter_map(|point| view.pixel(point, &view.tracked_camera_from_world));
            let inside = pixels.filter(|pixel| view.camera().contains(pixel, 0.0));
            inside.fold((0, 0), |(n, n_white), pixel| {
                let value = f64::from(*counts.at(pixel.x as usize, pixel.y as usize));
                let is_white = value >= SATURATION * full_scale;
                (n + 1, n_white + usize::from(is_white))
            })
        };
        let n_views = self.views.len();
        let looks = self.views.iter().zip(subject.snapshots).map(looks);
        let looking: Vec<(usize, usize)> = looks.filter(|(n, _)| *n > 0).collect();
        let is_saturated = |(n, n_white): &&(usize, usize)| 2 * n_white > *n;
        let n_saturated = looking.iter().filter(is_saturated).count();
        // Few of them do not explain why the others that look at it show nothing.
        match 2 * n_saturated > looking.len() {
            true => RefineError::Saturated {
                n_saturated,
                n_views,
            },
            false => RefineError::NothingVisible { n_views },
        }
    }
}

/// All shading images made ready.
pub fn views_of(subject: &Subject, params: &RefineParams) -> Vec<View> {
    let Subject {
        scene,
        object,
        snapshots,
        optics,
    } = *subject;
    let centre = object.centre();
    let context = ViewContext {
        scene: &coarsened(scene, HIDING_CELL_M),
        centre,
        radius_m: object.radius_about(&centre),
        optics,
        trust: &params.trust,
        flat: &optics.flat_image(),
        patches: &optics.patch_grid(),
    };
    let mut views: Vec<View> = snapshots
        .par_iter()
        .with_max_len(1)
        .map(|snapshot| View::new(snapshot, &context))
        .collect();
    if params.interreflection {
        let plausible = views.iter().filter_map(|view| view.plausible_white);
        let of_all = || WhiteLevel::of_one_light(plausible.collect());
        let white = optics.white_level().or_else(of_all);
        views.iter_mut().for_each(|view| view.white = white);
    }
    views
}

/// The first so many views.
pub fn first_views(n_views: usize) -> ViewSet {
    every(0, 1, n_views)
}

fn check_manifold(object: &TriMesh) -> Result<(), RefineError> {
    let edges = EdgeAdjacency::new(object);
    let of = edges.edges.len();
    let n_edges = edges.n_faces.iter().filter(|&&n| n > 2).count();
    match n_edges as f64 > MAX_NON_MANIFOLD_SHARE * of as f64 {
        true => Err(RefineError::NotManifold { n_edges, of }),
        false => Ok(()),
    }
}
