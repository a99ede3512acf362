//! A scan that is fused again with its depth corrected otherwise, as often as it then tells of errors that were not taken off.

use super::DepthCorrection;
use super::carry::Carry;
use super::gross_error::{GrossError, Views};
use super::lens::Lens;
use super::ray_order::{RayOrder, WrongRays};
use crate::{
    fusion::{
        DepthField, DepthNoise, Fusion, GoesOn, Keyframe, PoseCorrection, RollingShutter,
        TrackingOutcome, Waypoint, Work, velocities,
    },
    geometry::{Motion, Pose, RangeError, RayGrid},
    interreflection::WhiteLevel,
    multipath::{Evidence, WhiteSearch},
};
use depth_camera::{Intrinsics, Sensor};
use rayon::prelude::*;

/// A scan fused again with its depth corrected otherwise.
pub struct Revised {
    /// The model.
    pub fusion: Fusion,
    /// How far every pose is moved, by time.
    pub correction: PoseCorrection,
    pub(super) known: Known,
}

impl Revised {
    /// The error by range alone that the scan showed, beside what is known of the device.
    pub fn range_error(&self) -> Option<&RangeError> {
        self.known.gross.range.as_ref()
    }

    /// How much of that is the same at all ranges, metres.
    pub fn constant_m(&self) -> f64 {
        self.known.gross.constant_m
    }

    /// What was wrong with the depth of all frames alike, and was put right, in sentences for the operator.
    pub fn put_right(&self) -> Vec<String> {
        let rays = self.wrong_rays().map(|wrong| wrong.to_string());
        let of_range = self.range_error().map(|error| {
            let constant_m = self.constant_m();
            let too = if constant_m > 0.0 { "long" } else { "short" };
            let constant = (constant_m != 0.0)
                .then(|| format!("{:.1} mm too {too} at all distances", 1e3 * constant_m.abs()));
            let beside_m = error.plus(&RangeError::constant(-constant_m)).largest_m();
            let by_turns = format!("up to {:.1} mm too long or short by turns", 1e3 * beside_m);
            let wiggle = match constant_m == 0.0 {
                true => {
                    let (from_m, to_m) = (error.from_m(), error.to_m());
                    Some(format!("{by_turns} from {from_m:.2} to {to_m:.2} m"))
                }
                false => Some(by_turns).filter(|_| beside_m >= MIN_TOLD_M),
            };
            let both: Vec<String> = constant.into_iter().chain(wiggle).collect();
            format!(
                "depth was {}, and was put right: `relief calibrate depth` with a recording of this \
                 scan lets tracking know",
                both.join(", and ")
            )
        });
        let of_lens = self.known.lens.as_ref().map(Lens::put_right);
        rays.into_iter().chain(of_range).chain(of_lens).collect()
    }

    /// The camera, where its lens was found to be another than it is said to be.
    pub fn intrinsics(&self) -> Option<&Intrinsics> {
        self.known.lens.as_ref().map(Lens::intrinsics)
    }

    /// How depth was computed, where that was not by the rays of its pixels, and it was put right.
    pub fn wrong_rays(&self) -> Option<WrongRays> {
        self.known.gross.rays.as_ref().map(|(wrong, _)| *wrong)
    }
}

/// What is taken off the depth of a scan, beside what was while it went on.
#[derive(Clone, Default)]
pub(super) struct Known {
    pub(super) gross: GrossError,
    /// `None` is no multipath.
    pub(super) white: Option<WhiteLevel>,
    /// `None` is no slow error.
    pub(super) field: Option<DepthField>,
    /// `None` is all rows at once.
    pub(super) shutter: Option<RollingShutter>,
    /// `None` is the lens that it is said to be.
    pub(super) lens: Option<Lens>,
}

/// How far revising a scan came.
pub(super) struct Settled {
    pub(super) revised: Option<Revised>,
    pub(super) search: Option<WhiteSearch>,
    /// What the scan tells as it now is; `None` if that was not asked since it was fused last.
    pub(super) evidence: Option<Evidence>,
}

/// The first so many revisions free depth of multipath on the model, whatever the views tell: the first model still shows what the
/// live prediction left, and each that is freed of more of it tells its own slant better.
const MODEL_ROUNDS: usize = 4;
/// What a sensor gets wrong beside multipath is asked for before the first so many revisions. After three, what the frames still
/// show of it is noise: with a fourth the base mesh of `pot-k1` (Kinect I) lies 0.40 mm off for 0.38.
const SENSOR_ROUNDS: usize = 3;
/// So many frames tell the white level as well as all of a long scan, in less time. All are fused again in the end.
pub(super) const MAX_SOUGHT_BY: usize = 300;
/// A revision after which frames lie farther from the model, by this factor, is not used. On the recorded sessions they lie nearer by 5 to
/// 23 %.
const MAX_MISFIT_GROWTH: f64 = 1.02;
/// Focal lengths that are told are used if frames lie nearer to the model than without; in the first round also if farther by no more than
/// this factor, since the slow error that is told beside them has taken off some of what they explain. Right ones made it 0.955 to 0.999, and
/// 1.008 in a first round; wrong ones, of a hand that trembled, 1.012 in a second. Arbitrary beyond that.
const MAX_MISFIT_GROWTH_BY_FIRST_LENS: f64 = 1.01;
/// A revision that loses more than this share of the frames is not used.
const MAX_LOST_SHARE: f64 = 0.05;
/// A wiggle of less, metres, is not worth a word beside a constant.
const MIN_TOLD_M: f64 = 1e-4;
/// A field that changes by less, metres at a metre, is not worth fusing again.
const MIN_FIELD_M: f64 = 1e-4;
/// How far a frame may lie from where it would by its motion since the one before, where rows or a lens are put right or an error of range
/// was taken off: tracking had slid along a far surface for want of a rigid image by 4 cm and 0.08 rad, and had turned a head that a wiggle
/// of 3 mm had bent by 12° in a whole turn.
pub(super) const TRACKED_ANEW_REACH: Motion = Motion {
    rotation_rad: 0.15,
    translation_m: 0.08,
};

impl DepthCorrection {
    /// Revises a scan until it tells of no more, or `goes_on` says no.
    pub(super) fn settled(&self, fusion: &Fusion, goes_on: &GoesOn) -> Settled {
        let mut revised: Option<Revised> = None;
        let mut told = None;
        // Without memory for them no frames are kept; and a white level may be known of a sensor whose depth is not freed of multipath.
        let all = fusion.keyframes();
        let has_multipath = self.multipath.is_some() && self.live.is_some() && !all.is_empty();
        let is_long = has_multipath && all.len() > self.max_sought_by;
        let few = is_long.then(|| fusion.keyframes_at_most(self.max_sought_by));
        let frames = few.as_deref().unwrap_or(all);
        let first = Work::CorrectDepth(1).at(0, frames.len());
        let may_revise = self.fusion.max_revisions > 0 && goes_on(first);
        let asks_frames = may_revise && !self.is_measured;
        let plausible = asks_frames.then(|| self.plausible_white(fusion)).flatten();
        let start = plausible.or(self.recalibrated).or(self.live);
        let mut search = start.map(WhiteSearch::from);
        let is_freed_of_multipath = has_multipath && !self.predictions.0.is_empty();
        let asked = may_revise.then(|| self.gross_error(fusion, is_freed_of_multipath));
        let mut gross = asked.flatten().unwrap_or_default();
        // What is wrong with all frames alike is put right before anything else is asked: a bent model tells nothing.
        let mut begins_at = usize::from(!gross.is_none());
        let (mut round, mut n_passes) = (0, 0);
        while round < self.fusion.max_revisions + begins_at {
            let work = Work::CorrectDepth(round + 1);
            if !goes_on(work.at(0, frames.len())) {
                break;
            }
            let current = revised.as_ref().map_or(fusion, |revised| &revised.fusion);
            let mut known = revised.as_ref().map_or_else(
                || Known {
                    white: start,
                    gross: gross.clone(),
                    ..Known::default()
                },
                |revised| revised.known.clone(),
            );
            let is_gross = revised.is_none() && !known.gross.is_none();
            let mut has_more = is_gross || has_multipath && round < MODEL_ROUNDS + begins_at;
            let asks_sensor = !is_gross && round < SENSOR_ROUNDS + begins_at;
            has_more |= asks_sensor && self.add_what_frames_show(current, &mut known);
            let lens = asks_sensor.then(|| self.lens(current, &known)).flatten();
            if round > begins_at && revised.is_some() && has_multipath && !self.is_measured {
                told = self.evidence(current, known.white);
                if let Some((evidence, search)) = told.zip(search.as_mut()) {
                    let next = search.next(known.white, evidence);
                    has_more |= !next.will_do;
                    known.white = next.white;
                }
            }
            if !has_more && lens.is_none() {
                break;
            }
            n_passes = round + 1;
            let fused_by =
                |known| self.fuse_again(frames, fusion, revised.as_ref(), known, work, goes_on);
            let again = has_more.then(|| fused_by(known.clone())).flatten();
            let growth = match round == begins_at {
                true => MAX_MISFIT_GROWTH_BY_FIRST_LENS,
                false => 1.0,
            };
            let without = again.as_ref().map_or(current, |again| &again.fusion);
            let without = (without, &known);
            let again = self
                .by_closer_lens(without, lens, growth, fused_by)
                .or(again);
            let is_good = |again: &Revised| {
                !is_gross || self.lies_as_close(fusion, &again.fusion, &again.known)
            };
            match again.filter(is_good) {
                Some(again) => (revised, told) = (Some(again), None),
                // Put right it loses its track or lies farther apart, and is taken with less of it put right, or as it is.
                None if is_gross => {
                    gross = match gross.rays.is_some() && gross.range.is_some() {
                        true => gross.rays_alone(),
                        false => GrossError::default(),
                    };
                    begins_at = round + 1 + usize::from(!gross.is_none());
                }
                None => break,
            }
            round += 1;
        }
        if let (true, Some(found)) = (is_long, &revised) {
            let (known, work) = (found.known.clone(), Work::CorrectDepth(n_passes + 1));
            revised = self.fuse_again(all, fusion, revised.as_ref(), known, work, goes_on);
        }
        revised =
            revised.filter(|revised| self.lies_as_close(fusion, &revised.fusion, &revised.known));
        if revised.is_none() {
            // What was asked was of a scan that there is not.
            (search, told) = (self.live.map(WhiteSearch::from), None);
        }
        Settled {
            revised,
            search,
            evidence: told,
        }
    }

    /// Whether the frames of a scan lie as close to the model that they made when they were fused again, by what is known, as to the one
    /// before.
    pub(super) fn lies_as_close(&self, before: &Fusion, after: &Fusion, known: &Known) -> bool {
        let before_m = before.misfit_m(&self.rays);
        let after_m = after.misfit_m(self.rays_of(known));
        let Some((before_m, after_m)) = before_m.zip(after_m) else {
            return true;
        };
        let is_as_close = after_m <= MAX_MISFIT_GROWTH * before_m;
        let (before_mm, after_mm) = (1e3 * before_m, 1e3 * after_m);
        match is_as_close {
            true => tracing::info!(before_mm, after_mm, "how far frames lie from the model"),
            false => tracing::warn!(
                before_mm,
                after_mm,
                "fused again with its depth corrected, the scan's frames lie farther from the model, which stays as it was"
            ),
        }
        is_as_close
    }

    /// The scan fused again by another lens beside what is known, if frames then lie closer to the model than to one `without` it, or farther by
    /// no more than a factor.
    pub(super) fn by_closer_lens(
        &self,
        (without, known): (&Fusion, &Known),
        lens: Option<Lens>,
        growth: f64,
        fused_by: impl Fn(Known) -> Option<Revised>,
    ) -> Option<Revised> {
        let by_lens = fused_by(Known {
            lens: Some(lens?),
            ..known.clone()
        })?;
        let without_m = without.misfit_m(self.rays_of(known))?;
        let by_lens_m = by_lens.fusion.misfit_m(self.rays_of(&by_lens.known))?;
        let is_closer = by_lens_m < growth * without_m;
        tracing::info!(
            by_lens_mm = 1e3 * by_lens_m,
            without_mm = 1e3 * without_m,
            is_closer,
            "focal lengths: how far frames lie from the model by those that views tell, and by those so far"
        );
        is_closer.then_some(by_lens)
    }

    /// What the depth of a Kinect II's scan gets wrong before anything finer can be told; by range only where multipath is taken off, which
    /// looks like it.
    fn gross_error(&self, fusion: &Fusion, is_freed_of_multipath: bool) -> Option<GrossError> {
        if self.info.sensor != Sensor::Kinect2 {
            return None;
        }
        let other_rays = match &self.rays_upside_down {
            Some(order) => (WrongRays::PutRightInVain, order.undone()),
            None => (WrongRays::UpsideDown, RayOrder::upside_down(&self.rays)),
        };
        let other_rays = Some(other_rays).filter(|(_, order)| order.shows());
        let asks_range = is_freed_of_multipath && self.fusion.range_error;
        if other_rays.is_none() && !asks_range {
            return None;
        }
        let (frames, are_given) = (fusion.keyframes(), fusion.is_at_given_poses());
        let views = Views::of(frames, are_given, &self.rays);
        Some(views.gross_error(other_rays, asks_range))
    }

    /// Where frames lie before any of them is fused again: put right, one that was tracked lies otherwise, and the first stays where it
    /// was.
    fn start_of(&self, frames: &[Keyframe], known: &Known, is_given: bool) -> Vec<Pose> {
        let tracked = |frame: &Keyframe| frame.world_from_camera;
        if known.gross.is_none() {
            return frames.iter().map(tracked).collect();
        }
        if is_given {
            // Polished they lie as bent depth did.
            let given = |frame: &Keyframe| frame.given.unwrap_or(frame.world_from_camera);
            return frames.iter().map(given).collect();
        }
        let righted =
            |frame: &Keyframe| tracked(frame) * known.gross.motion_of(&frame.depth_m(), &self.rays);
        let mut poses: Vec<Pose> = frames.par_iter().map(righted).collect();
        if let Some((first, frame)) = poses.first().zip(frames.first()) {
            let back = tracked(frame) * first.inverse();
            for pose in &mut poses {
                *pose = back * *pose;
            }
        }
        poses
    }

    /// The rays of pixels by what is known.
    fn rays_of<'a>(&'a self, known: &'a Known) -> &'a RayGrid {
        known.lens.as_ref().map_or(&self.rays, Lens::rays)
    }

    /// Adds to what is known of a Kinect I what the frames of a scan that was fused by it still show of its slow error and of its rows;
    /// whether they do. Where its lens is another one the slow error is some of that, which the next round takes off again.
    fn add_what_frames_show(&self, fusion: &Fusion, known: &mut Known) -> bool {
        let rays = self.rays_of(known);
        let field = self.field(fusion, rays).map(|shown| shown.in_full());
        let shutter = self.shutter(fusion, rays);
        let shows = field.is_some() || shutter.is_some();
        known.field = together(known.field.as_ref(), field.as_ref(), DepthField::plus);
        known.shutter = together(
            known.shutter.as_ref(),
            shutter.as_ref(),
            RollingShutter::plus,
        );
        shows
    }

    /// The lens that the views of a scan agree with, where that is another one than they were fused by.
    fn lens(&self, fusion: &Fusion, known: &Known) -> Option<Lens> {
        let is_wanted = self.fusion.focal_length && self.info.sensor == Sensor::Kinect1;
        if !is_wanted || fusion.is_at_given_poses() {
            return None;
        }
        let views = Views::of(fusion.keyframes(), false, self.rays_of(known));
        let longer = views.longer_focus(known.lens.is_some())?;
        let lens = match &known.lens {
            Some(lens) => lens.plus(longer),
            None => Lens::new(&self.info.intrinsics, longer),
        };
        if lens.is_none() {
            tracing::warn!(
                ?longer,
                "focal lengths so far from what they are said to be are not believed"
            );
        }
        lens
    }

    /// The sensor's slow error that the frames of a scan still show.
    fn field(&self, fusion: &Fusion, rays: &RayGrid) -> Option<DepthField> {
        let is_wanted = self.fusion.depth_field && self.info.sensor == Sensor::Kinect1;
        let field = is_wanted.then(|| fusion.depth_field(rays));
        field.flatten().filter(|field| field.rms() > MIN_FIELD_M)
    }

    /// How long the sensor takes to read its rows, as far as the frames of a scan still show it.
    fn shutter(&self, fusion: &Fusion, rays: &RayGrid) -> Option<RollingShutter> {
        let is_wanted = self.fusion.rolling_shutter && self.info.sensor == Sensor::Kinect1;
        is_wanted.then(|| fusion.rolling_shutter(rays)).flatten()
    }

    /// Fuses frames again, near where they lie by now, with what is known taken off; `None` if too many are lost that way, or it
    /// shall not go on.
    pub(super) fn fuse_again(
        &self,
        frames: &[Keyframe],
        original: &Fusion,
        revised: Option<&Revised>,
        known: Known,
        work: Work,
        goes_on: &GoesOn,
    ) -> Option<Revised> {
        let model = revised.map_or(original, |revised| &revised.fusion);
        let rays = self.rays_of(&known);
        let noise = DepthNoise::of_sensor(self.info.sensor);
        let mut fusion = Fusion::new(*rays.camera(), noise, self.fusion.clone());
        let mut knots = Vec::new();
        let mut n_lost = 0;
        let is_given = original.is_at_given_poses();
        let moved = |revised: &Revised, frame: &Keyframe| {
            let correction = &revised.correction;
            correction.apply(frame.time_secs, &frame.world_from_camera)
        };
        let here: Vec<Pose> = match revised {
            Some(revised) => frames.iter().map(|frame| moved(revised, frame)).collect(),
            None => self.start_of(frames, &known, is_given),
        };
        let path = frames.iter().zip(here);
        let path: Vec<Waypoint> = path
            .map(|(frame, here)| Waypoint::of(frame, here))
            .collect();
        let velocities = velocities(&path);
        // Later ones lie near where they did, but in a long scan, of which some were asked so far.
        let is_first = revised.is_none() || frames.len() > self.max_sought_by;
        let was_wrong = is_first && !known.gross.is_none();
        let slid = was_wrong || known.shutter.is_some() || known.lens.is_some();
        let reach = (slid && !is_given).then_some(TRACKED_ANEW_REACH);
        let corrected = |index: usize| {
            let (frame, before) = (frames.get(index)?, &path[index].world_from_camera);
            let seen = frame.depth_m();
            // On a bent model multipath is predicted no better than it was.
            let righted = revised
                .is_none()
                .then(|| known.gross.taken_off(&seen, &self.rays));
            let depth = righted.flatten().unwrap_or_else(|| {
                let seen = (&seen, self.corrected_by(frame.time_secs));
                self.anew(seen, frame.time_secs, before, model, &known)
            });
            Some(match &known.shutter {
                Some(shutter) => shutter.corrected(&depth, &velocities[index], rays, &noise),
                None => depth,
            })
        };
        let mut carry = Carry::default();
        let mut next = corrected(0);
        for (n_done, frame) in frames.iter().enumerate() {
            if !goes_on(work.at(n_done, frames.len())) {
                return None;
            }
            let (time_secs, tracked) = (frame.time_secs, &frame.world_from_camera);
            let before = path[n_done].world_from_camera;
            let depth = next.take()?;
            let here = carry.to(frame.stretch, &before) * before;
            let fuse = || match is_given && !self.fusion.polish.enabled {
                true => fusion.fuse_anew_at(&depth, frame, &here),
                false => fusion.fuse_anew(&depth, frame, &here, reach),
            };
            let outcome;
            (outcome, next) = rayon::join(fuse, || corrected(n_done + 1));
            let TrackingOutcome::Tracked {
                world_from_camera,
                fit,
            } = outcome
            else {
                n_lost += 1;
                continue;
            };
            n_lost += usize::from(fit.is_none() && !knots.is_empty() && !is_given);
            if reach.is_some() {
                carry.note(frame.stretch, before, &world_from_camera);
            }
            knots.push((time_secs, world_from_camera * tracked.inverse()));
        }
        if n_lost as f64 > MAX_LOST_SHARE * frames.len() as f64 {
            tracing::warn!(
                n_lost,
                "fused again with its depth corrected, the scan loses its track, and stays as it was"
            );
            return None;
        }
        tracing::info!(
            white_level = known.white.map(|white| white.0),
            rays_righted = known.gross.rays.is_some(),
            constant_mm = 1e3 * known.gross.constant_m,
            range_error_mm = known
                .gross
                .range
                .as_ref()
                .map(|error| 1e3 * error.largest_m()),
            field_rms_mm = known.field.as_ref().map(|field| 1e3 * field.rms()),
            readout_ms = known.shutter.map(|shutter| 1e3 * shutter.readout_secs),
            focus_longer_percent = known
                .lens
                .as_ref()
                .map(|lens| tracing::field::debug(lens.longer_percent())),
            "fused again with its depth corrected"
        );
        Some(Revised {
            fusion,
            correction: PoseCorrection::of_knots(knots),
            known,
        })
    }
}

/// What was known of an error and what shows beside it, as one; `None` if there is neither.
pub(super) fn together<T: Clone>(
    known: Option<&T>,
    shown: Option<&T>,
    plus: fn(&T, &T) -> T,
) -> Option<T> {
    match (known, shown) {
        (Some(known), Some(shown)) => Some(plus(known, shown)),
        (known, shown) => known.or(shown).cloned(),
    }
}
