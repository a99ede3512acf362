//! Whether the calibration that a scan's images tell of is better than the one believed: a quarter of them judges.
//!
//! These are settled on the base surface; a slow gain takes up what is left of their brightness, and a wrong response or light leaves
//! more of it. How well patches fit does not show that: light that goes from wall to wall of a bowl, which is predicted to a quarter
//! at best, passes for another gamma.

use super::error::RefineError;
use super::held_out::{hold_out, slow_gain};
use super::level::{Level, coarsest};
use super::params::RefineParams;
use super::preparation::{Subject, first_views, views_of};
use super::rounds::Rounds;
use super::self_calibration::{Contradiction, Told, Tolerance, told_by_images};
use super::site_gloss::SiteGloss;
use super::sites::{SiteKind, Sites, ViewSet};
use super::surface::Surface;
use super::view::View;
use crate::geometry::TriMesh;

/// Views that are asked for the calibration that they were taken with.
pub struct CalibrationTrial<'a> {
    /// The scan.
    pub subject: &'a Subject<'a>,
    /// Parameters.
    pub params: &'a RefineParams,
    /// The views that are asked, of all.
    pub asked: ViewSet,
    /// What is no contradiction yet.
    pub tolerance: Tolerance,
}

impl CalibrationTrial<'_> {
    /// What views say on a mesh of the calibration that they were made with, and of gloss.
    pub fn ask(&self, mesh: &TriMesh, views: &[View]) -> Told {
        let params = &self.params.self_calibration;
        if !params.enabled {
            return Told::default();
        }
        let sites = Sites::new(SiteKind::Face, mesh, views, self.asked);
        told_by_images(&sites, views, self.subject.optics, params, self.tolerance)
    }

    /// Makes the views anew by what they told against the calibration, unless that leaves more slow gain on a level than what is
    /// believed: then it is not told.
    pub fn judge(&self, mut told: Told, level: &Level, mut views: Vec<View>) -> (Told, Vec<View>) {
        let Some(Contradiction { calibration, .. }) = &told.contradiction else {
            return (told, views);
        };
        let gloss = SiteGloss::uniform(told.gloss);
        let believed = self.slow_gain(level, &views, &gloss);
        // Both sets of views are large.
        views.clear();
        let relit = Subject {
            optics: &self.subject.optics.with(calibration),
            ..*self.subject
        };
        views = views_of(&relit, self.params);
        let found = self.slow_gain(level, &views, &gloss);
        tracing::info!(believed, found, "slow gain by either calibration");
        let is_worse = believed
            .zip(found)
            .is_some_and(|(believed, found)| found > believed);
        if is_worse {
            views.clear();
            views = views_of(self.subject, self.params);
            told.contradiction = None;
        }
        (told, views)
    }

    /// Of the views that judge, on the albedo that the others tell; `None` where these see nothing.
    fn slow_gain(&self, level: &Level, views: &[View], gloss: &SiteGloss) -> Option<f64> {
        let judges = hold_out(self.asked);
        let (params, mesh) = (self.params, &level.mesh);
        let rounds = Rounds { params, level };
        let sites = Sites::new(params.sites, mesh, views, self.asked & !judges);
        let sites = sites.with_gloss(gloss.clone());
        let surface = Surface::of_base(mesh);
        let albedo = rounds.first_albedo(&surface, &sites, views)?;
        Some(slow_gain(&rounds, mesh, &albedo, views, judges))
    }
}

/// What the images of a scan say against its calibration before its depth is corrected for good.
///
/// # Errors
/// Where nothing is left of the surface.
pub fn contradiction_as_tracked(
    subject: &Subject,
    params: &RefineParams,
) -> Result<Option<Contradiction>, RefineError> {
    let trial = CalibrationTrial {
        subject,
        params: &params.for_object(subject.object),
        asked: first_views(subject.snapshots.len()),
        tolerance: Tolerance::AS_TRACKED,
    };
    let views = views_of(subject, trial.params);
    let told = trial.ask(subject.object, &views);
    if told.contradiction.is_none() {
        return Ok(None);
    }
    let level = coarsest(subject.object, trial.params)?;
    Ok(trial.judge(told, &level, views).0.contradiction)
}
