//! Whether the calibration that a scan's images tell of is better than the one believed: a quarter of them judges.
//!
//! These are settled on the base surface; a slow gain takes up what is left of their brightness, and a wrong response or light leaves
//! more of it. How well patches fit does not show that: light that goes from wall to wall of a bowl, which is predicted to a quarter
//! at best, passes for another gamma.

use super::error::RefineError;
use super::held_out::{hold_out, slow_gain};
use super::level::{Level, coarsest};
use super::optics::Optics;
use super::params::RefineParams;
use super::preparation::{first_views, views_of};
use super::rounds::Rounds;
use super::self_calibration::{Contradiction, SelfCalibrationParams, Told, told_by_images};
use super::site_gloss::SiteGloss;
use super::sites::{SiteKind, Sites, ViewSet};
use super::subject::Subject;
use super::surface::Surface;
use super::view::View;
use crate::geometry::TriMesh;
use crate::interreflection::WhiteLevel;
use crate::shading::{Calibration, Gloss};
use crate::snapshot::ShadingSnapshot;

/// The calibration that is found has to leave no more than this share of the slow gain that is left by what is believed. Where that was right
/// the best on the way to what images told left 0.90 to 1.0; where gamma was 4 to 15 % off 0.36 to 0.87, but on two scans 0.91.
const MAX_LEFT_SHARE: f64 = 0.88;
/// Shares of the way to what images tell that are tried first, and the farthest one: what they tell is held towards what is believed.
const FIRST_SHARES: [f64; 2] = [0.5, 1.0];
const FARTHEST_SHARE: f64 = 1.5;
/// A share as near to one that was tried, or to none, is not tried: all views are cast anew for each.
const APART: f64 = 0.1;
/// So often they are asked, each time beside what was found the time before.
const MAX_TIMES_ASKED: usize = 3;
/// Factors on indirect light nearer to 1 are taken without a judge, logarithm: they change little.
const MIN_JUDGED_LOG: f64 = 0.1;
/// Such a factor is left where it leaves more than this times the slow gain: 1.15 to 1.3 times were left where refinement got worse by
/// it, 1.006 times where it got better by a fifth.
const MAX_MORE_OF_INDIRECT: f64 = 1.05;
/// Images that are asked at most: all of them need a hundred megabytes while the scan's frames are still held.
const MAX_ASKED: usize = 16;

/// Views that are asked for the calibration that they were taken with.
pub struct CalibrationTrial<'a> {
    /// The scan.
    pub subject: &'a Subject<'a>,
    /// Parameters.
    pub params: &'a RefineParams,
    /// Mesh on which they are asked.
    pub mesh: &'a TriMesh,
    /// The views that are asked, of all.
    pub asked: ViewSet,
}

impl CalibrationTrial<'_> {
    /// What views say of the calibration that they were made with, and of gloss.
    pub fn ask(&self, views: &[View]) -> Told {
        let params = &self.params.self_calibration;
        self.ask_with(params, views, self.subject.optics)
    }

    fn ask_with(&self, params: &SelfCalibrationParams, views: &[View], optics: &Optics) -> Told {
        if !params.enabled {
            return Told::default();
        }
        let sites = Sites::new(SiteKind::Face, self.mesh, views, self.asked);
        told_by_images(&sites, views, optics, params)
    }

    /// Makes the views anew by a calibration on the way to what they told, if it leaves clearly less slow gain on a level than what is
    /// believed; by that one they are asked again. With the one that stands they tell the rest.
    pub fn judge(&self, mut told: Told, level: &Level, mut views: Vec<View>) -> (Told, Vec<View>) {
        let believed = self.subject.optics;
        let free = &self.params.self_calibration;
        let mut stands = believed.calibration.clone();
        for _ in 0..MAX_TIMES_ASKED {
            let Some(contradiction) = &told.contradiction else {
                break;
            };
            let optics = believed.with(&stands);
            let better = self.better(&optics, contradiction, (views, told.gloss), level);
            let asked = match better {
                Some(_) => free.clone(),
                None => free.held(),
            };
            stands = better.unwrap_or(stands);
            let optics = believed.with(&stands);
            views = self.views_by(&optics);
            told = self.ask_with(&asked, &views, &optics);
        }
        if told.contradiction.is_some() {
            told = self.ask_with(&free.held(), &views, &believed.with(&stands));
        }
        let is_another = stands != *believed.calibration;
        told.contradiction = is_another.then(|| Contradiction::of(believed, stands));
        (told, views)
    }

    /// The calibration on the way from the one that stands to what views by it told that leaves least slow gain on a level, if that is clearly
    /// less than with the one that stands.
    fn better(
        &self,
        stands: &Optics,
        told: &Contradiction,
        (views, gloss): (Vec<View>, Gloss),
        level: &Level,
    ) -> Option<Calibration> {
        let as_it_stands = self.slow_gain(level, &views, gloss)?;
        // One set at a time: they are large.
        drop(views);
        let gain_at = |share: f64| {
            let views = self.views_by(&stands.with(&told.part(stands, share)?));
            let gain = self.slow_gain(level, &views, gloss)?;
            gain.is_finite().then_some(gain)
        };
        let mut tried = vec![(0.0, as_it_stands)];
        tried.extend(
            FIRST_SHARES
                .iter()
                .filter_map(|&share| Some((share, gain_at(share)?))),
        );
        if let [(_, start), (_, half), (_, whole)] = tried[..]
            && let Some(share) = vertex_of_parabola([start, half, whole])
        {
            let share = share.clamp(0.0, FARTHEST_SHARE);
            let is_apart = tried.iter().all(|(at, _)| (share - at).abs() > APART);
            let gain = is_apart.then(|| gain_at(share)).flatten();
            tried.extend(gain.map(|gain| (share, gain)));
        }
        tracing::info!(
            shares_and_gains = ?tried,
            "slow gain on the way from the calibration to what the images tell"
        );
        let (share, least) = tried.into_iter().min_by(|a, b| a.1.total_cmp(&b.1))?;
        let is_clearly_less = least < MAX_LEFT_SHARE * as_it_stands;
        is_clearly_less.then(|| told.part(stands, share)).flatten()
    }

    /// Views of the scan by other optics.
    fn views_by(&self, optics: &Optics) -> Vec<View> {
        let relit = Subject {
            optics,
            ..*self.subject
        };
        views_of(&relit, self.params)
    }

    /// Gives the views as much more indirect light as was told, unless that leaves clearly more slow gain on a level.
    pub fn judge_indirect(&self, told: &Told, level: &Level, views: Vec<View>) -> Vec<View> {
        let brighter = views.iter().map(|view| {
            let strength = view.white.map(WhiteLevel::strength);
            let found = strength.map(|strength| told.log_indirect.exp() * strength);
            let mut brighter = view.clone();
            brighter.white = found.and_then(WhiteLevel::of_strength);
            brighter
        });
        let brighter: Vec<View> = brighter.collect();
        if told.log_indirect.abs() < MIN_JUDGED_LOG {
            return brighter;
        }
        let believed = self.slow_gain(level, &views, told.gloss);
        let found = self.slow_gain(level, &brighter, told.gloss);
        tracing::info!(
            believed,
            found,
            "slow gain by either strength of indirect light"
        );
        match believed.zip(found) {
            Some((believed, found)) if found > MAX_MORE_OF_INDIRECT * believed => views,
            _ => brighter,
        }
    }

    /// Of the views that judge, on the albedo that the others tell; `None` where either see nothing.
    fn slow_gain(&self, level: &Level, views: &[View], gloss: Gloss) -> Option<f64> {
        let (params, mesh) = (self.params, &level.mesh);
        let rounds = Rounds { params, level };
        let sites = Sites::new(params.sites, mesh, views, self.asked);
        let judges = hold_out(sites.seeing());
        let sites = sites.only(self.asked & !judges);
        let sites = sites.with_gloss(SiteGloss::uniform(gloss));
        let surface = Surface::of_base(mesh);
        let mut albedo = rounds.first_albedo(&surface, &sites, views)?;
        // The views that judge see the highlights that the albedo was told by, too.
        albedo.gloss = vec![gloss; albedo.groups.len()];
        slow_gain(&rounds, (mesh, &albedo), &sites.are_seen(), views, judges)
    }
}

/// What some images of a scan, spread over all that look at the object, say against its calibration before its depth is corrected for good.
///
/// # Errors
/// Where nothing is left of the surface.
pub fn contradiction_as_tracked(
    subject: &Subject,
    params: &RefineParams,
) -> Result<Option<Contradiction>, RefineError> {
    let looking = subject.images_of_it();
    let every = looking.len().div_ceil(MAX_ASKED).max(1);
    let spread = looking.into_iter().step_by(every).cloned();
    let spread: Vec<ShadingSnapshot> = spread.collect();
    let subject = &Subject {
        snapshots: &spread,
        ..*subject
    };
    let trial = CalibrationTrial {
        subject,
        params: &params.for_object(subject.object, subject.footprint_m()),
        mesh: subject.object,
        asked: first_views(subject.snapshots.len()),
    };
    let views = views_of(subject, trial.params);
    let told = trial.ask(&views);
    if told.contradiction.is_none() {
        return Ok(None);
    }
    let level = coarsest(subject.object, trial.params)?;
    Ok(trial.judge(told, &level, views).0.contradiction)
}

/// Where a parabola through the squares of slow gains, at shares of 0, a half and 1, is least; `None` if it is nowhere.
fn vertex_of_parabola(gains: [f64; 3]) -> Option<f64> {
    let [start, half, whole] = gains.map(|gain| gain * gain);
    let slope = 4.0 * half - 3.0 * start - whole;
    let curvature = 2.0 * (start - 2.0 * half + whole);
    (curvature > 0.0).then(|| -0.5 * slope / curvature)
}

#[cfg(test)]
mod tests {
    use super::super::scenes::{RippledPlane, calibration, optics, poses_all_round, rays};
    use super::*;
    use crate::shading::Calibration;

    const EDGE_M: f64 = 0.0025;
    const RIPPLED: RippledPlane = RippledPlane {
        amplitude_m: 0.0004,
    };

    fn params() -> RefineParams {
        RefineParams {
            edge_length_m: EDGE_M,
            ..RefineParams::default()
        }
    }

    /// The trial of a finished scan by all its views.
    fn trial<'a>(
        subject: &'a Subject,
        params: &'a RefineParams,
        level: &'a Level,
    ) -> CalibrationTrial<'a> {
        CalibrationTrial {
            subject,
            params,
            mesh: &level.mesh,
            asked: first_views(subject.snapshots.len()),
        }
    }

    #[test]
    fn what_leaves_more_slow_gain_than_what_is_believed_or_hardly_less_is_not_told() {
        let (rays, truth) = (rays(), calibration());
        let true_optics = optics(&rays, &truth);
        let base = RippledPlane { amplitude_m: 0.0 }.mesh(EDGE_M);
        let poses = poses_all_round();
        let rendered = poses
            .iter()
            .map(|pose| RIPPLED.snapshot(&true_optics, pose));
        let snapshots: Vec<_> = rendered.collect();
        let params = params();
        let level = coarsest(&base, &params).expect("a surface");
        let of_gamma = |share: f64| Calibration {
            gamma: share * truth.gamma,
            ..truth.clone()
        };
        let (wrong, hardly_better) = (of_gamma(0.8), of_gamma(0.81));
        for (believed, found, stands) in [
            (&truth, &wrong, false),
            (&wrong, &hardly_better, false),
            (&wrong, &truth, true),
        ] {
            let subject_of = |optics| Subject {
                scene: &base,
                object: &base,
                snapshots: &snapshots,
                optics,
            };
            let optics = true_optics.with(believed);
            let subject = subject_of(&optics);
            let trial = trial(&subject, &params, &level);
            let told = Told {
                contradiction: Some(Contradiction::of(&optics, found.clone())),
                ..Told::default()
            };
            let (told, views) = trial.judge(told, &level, views_of(&subject, &params));
            assert_eq!(told.contradiction.is_some(), stands);
            let found = told.contradiction.map(|told| told.calibration);
            let holds = found.as_ref().unwrap_or(believed);
            let optics = true_optics.with(holds);
            let expected = views_of(&subject_of(&optics), &params);
            let is_true = (holds.gamma / truth.gamma - 1.0).abs() < 0.02;
            assert_eq!(is_true, stands || believed == &truth, "{}", holds.gamma);
            let linear = |view: &View| -> Vec<u32> {
                let values = view.linear().value.data().iter();
                values.map(|value| value.to_bits()).collect()
            };
            for (view, expected) in views.iter().zip(&expected) {
                assert!(linear(view) == linear(expected), "by another calibration");
            }
        }
    }

    #[test]
    fn a_parabola_has_its_least_where_it_is_level() {
        let gains_about = |least: f64| {
            [0.0, 0.5, 1.0].map(|share: f64| (0.01 + 0.2 * (share - least).powi(2)).sqrt())
        };
        for least in [-0.3, 0.2, 0.5, 1.3] {
            let found = vertex_of_parabola(gains_about(least)).expect("open above");
            assert!((found - least).abs() < 1e-9, "{found} for {least}");
        }
        assert_eq!(vertex_of_parabola([1.0; 3]), None);
        assert_eq!(vertex_of_parabola([1.0, 2.0, 1.0]), None);
        assert_eq!(vertex_of_parabola([1.0, f64::NAN, 1.0]), None);
    }

    #[test]
    fn views_that_judge_see_the_gloss_that_was_told() {
        let (rays, truth) = (rays(), calibration());
        let optics = optics(&rays, &truth);
        let flat = RippledPlane { amplitude_m: 0.0 };
        let base = flat.mesh(EDGE_M);
        let gloss = Gloss {
            strength: 0.5,
            power: 20.0,
        };
        let poses = poses_all_round();
        let rendered = poses.iter().map(|pose| {
            let mut snapshot = flat.snapshot(&optics, pose);
            flat.polish(&mut snapshot, gloss, &optics);
            snapshot
        });
        let snapshots: Vec<_> = rendered.collect();
        let params = params();
        let level = coarsest(&base, &params).expect("a surface");
        let subject = Subject {
            scene: &base,
            object: &base,
            snapshots: &snapshots,
            optics: &optics,
        };
        let trial = trial(&subject, &params, &level);
        let views = views_of(&subject, &params);
        let left = |gloss: Gloss| trial.slow_gain(&level, &views, gloss).expect("seen");
        let (told, matte) = (left(gloss), left(Gloss::default()));
        assert!(told < 0.3 * matte, "{told} of {matte}");
    }
}
