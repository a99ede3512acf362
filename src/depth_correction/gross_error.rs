//! What is wrong with the depth of every frame alike, before anything finer can be told: the rays that it was computed by
//! ([`RayOrder`]), a constant of the range, and a wiggle; and, of a Kinect I, by rays of other focal lengths.
//!
//! The phase of a time-of-flight sensor has a constant of its own, 24 mm, say users of a Kinect II, which drifts by millimetres as the
//! device warms up. Scanned from one distance it makes a scene larger; but what is far is made so by less than what is near, and what is
//! aside by less than it is moved, so that views of one surface disagree. (A share of the range would make all of a scene larger, and no
//! scan tells it; the sensor's clock is right to some parts in a million.) A wiggle passes for a constant, and either for other rays, so
//! that all are told together, by how well views [agree](Agreement) without them.

use super::agreement::{Agreement, View};
use super::ray_order::{RayOrder, WrongRays};
use super::settling::{Asked, Curve, Mistake, Settling};
use crate::{
    fusion::Keyframe,
    geometry::{Pose, RangeError, RayGrid},
};
use depth_camera::Image;
use rayon::prelude::*;
use std::{borrow::Cow, ops::RangeInclusive};

/// What is taken off the depth of every frame alike.
#[derive(Clone, Debug, Default)]
pub(super) struct GrossError {
    /// `None` is rays as they should be.
    pub(super) rays: Option<(WrongRays, RayOrder)>,
    /// How much too long ranges are; `None` where they are not.
    pub(super) range: Option<RangeError>,
    /// How much of that is the same at all of them, metres.
    pub(super) constant_m: f64,
}

/// Most views that are compared, each with each.
const MAX_VIEWS: usize = 40;
/// Rays are others if views then disagree by no more than this share: 0.88 and 0.94 where they were, 1.00 to 1.16 where they were not.
const MAX_SHARE_OF_RAYS: f64 = 0.97;
/// Others are not asked for a constant if with a wiggle alone taken off they let views disagree by more than this share.
const MAX_SHARE_WORTH_ASKING: f64 = 1.05;
/// There is a wiggle if views disagree by no more than this share with it taken off: 0.87 and 0.88 where it was of 1 mm, 0.96 to 0.99 where
/// none was. So there is one beside a constant.
const MAX_SHARE_OF_WIGGLE: f64 = 0.92;
/// There is a constant if they disagree by no more than this share of what a wiggle alone leaves: 0.88 to 0.98 where it was of 12 to 20 mm,
/// 0.991 to 1.004 where none was.
const MAX_SHARE_OF_CONSTANT: f64 = 0.99;
/// What is believed of one, metres: a smaller one is not told from what the live correction of multipath leaves, or takes off too much (which
/// looks like one of up to 4 mm, in a bowl of 7, and in twelve frames of a sensor without multipath of 8), and a larger one no device has.
const BELIEVED_M: RangeInclusive<f64> = 0.01..=0.04;

/// Focal lengths are believed to be others if one is off by this share or more: of lenses that are as they are said to be −1.0 to 0.9 % is told.
const MIN_FOCAL: f64 = 0.012;
/// Once they are, so much more is, too.
const MIN_FURTHER_FOCAL: f64 = 0.004;
/// They are if views disagree by no more than this share of what a slow error alone leaves: 0.90 to 0.9987 where they were, 0.9995 to 1.001
/// where it was luck.
const MAX_SHARE_OF_FOCAL: f64 = 0.9993;

/// Views of a scan that are compared.
pub(super) struct Views<'a> {
    /// Depth in metres, and world from camera.
    views: Vec<(Image<f32>, Pose)>,
    are_given: bool,
    grid: &'a RayGrid,
    agreement: Agreement<'a>,
    as_they_were: Vec<View>,
}

/// What is wrong with views, and how far they disagree without it.
#[derive(Clone, Copy, Debug)]
struct Fit {
    mistake: Mistake,
    disagreement: f64,
}

/// What views tell, their rays in one order.
#[derive(Clone, Copy, Debug)]
struct Told {
    nothing: Fit,
    wiggle: Fit,
    /// Whether there is a wiggle.
    shows_wiggle: bool,
    /// A constant, and a wiggle where there is one beside it; `None` is no constant.
    with_constant: Option<Fit>,
}

/// Depth (m) of views with their rays in one order, and where they lie.
struct Ordered<'v> {
    depths_m: Vec<Cow<'v, Image<f32>>>,
    poses: Vec<Pose>,
}

impl GrossError {
    /// The same without an error by range.
    pub(super) fn rays_alone(self) -> Self {
        GrossError {
            rays: self.rays,
            ..GrossError::default()
        }
    }

    /// Whether there is none.
    pub(super) fn is_none(&self) -> bool {
        self.rays.is_none() && self.range.is_none()
    }

    /// A depth image (metres, 0 is none) without it.
    pub(super) fn taken_off(&self, depth_m: &Image<f32>, grid: &RayGrid) -> Option<Image<f32>> {
        let righted = self.rays.as_ref().map(|(_, order)| order.righted(depth_m));
        match &self.range {
            Some(error) => Some(error.corrected(righted.as_ref().unwrap_or(depth_m), grid)),
            None => righted,
        }
    }

    /// The motion in the camera's frame by which a depth image (m) without it lies best on the image as it was, by which it was tracked.
    pub(super) fn motion_of(&self, depth_m: &Image<f32>, grid: &RayGrid) -> Pose {
        let Some(without_m) = self.taken_off(depth_m, grid) else {
            return Pose::identity();
        };
        let agreement = Agreement::of(grid);
        let [without, as_it_was] =
            [&without_m, depth_m].map(|depth_m| agreement.view(depth_m, &Pose::identity()));
        without.motion_onto(&as_it_was)
    }
}

impl<'a> Views<'a> {
    /// Some frames of a scan, at given poses or tracked ones.
    pub(super) fn of(frames: &[Keyframe], are_given: bool, grid: &'a RayGrid) -> Self {
        let every = frames.len().div_ceil(MAX_VIEWS).max(1);
        let view = |frame: &Keyframe| {
            let given = frame.given.as_ref();
            (frame.depth_m(), *given.unwrap_or(&frame.world_from_camera))
        };
        let views = frames.iter().step_by(every).map(view);
        Views::new(views.collect(), are_given, grid)
    }

    fn new(views: Vec<(Image<f32>, Pose)>, are_given: bool, grid: &'a RayGrid) -> Self {
        let agreement = Agreement::of(grid);
        let fitted = views
            .par_iter()
            .map(|(depth_m, pose)| agreement.view(depth_m, pose));
        Views {
            as_they_were: fitted.collect(),
            views,
            are_given,
            grid,
            agreement,
        }
    }

    /// What is wrong with all of them, by range only where it `asks` for that, and where rays may be others; nothing where they agree as
    /// well as they are, or too few see one surface.
    pub(super) fn gross_error(
        &self,
        rays: Option<(WrongRays, RayOrder)>,
        asks: bool,
    ) -> GrossError {
        let seen = self.in_order(None);
        let wiggle_of = |ordered| self.fit(ordered, Asked::Wiggle, !self.are_given);
        let as_is = wiggle_of(&seen).and_then(|wiggle| self.told(&seen, wiggle));
        let Some(as_is) = as_is else {
            return GrossError::default();
        };
        as_is.log("rays as they are");
        // Rays are told beside an error by range even where that is not asked for: it passes for others.
        let righted = rays.as_ref().map(|(_, order)| self.in_order(Some(order)));
        let others = righted.as_ref().and_then(|righted| {
            let near = MAX_SHARE_WORTH_ASKING * as_is.wiggle.disagreement;
            let wiggle = wiggle_of(righted).filter(|wiggle| wiggle.disagreement <= near)?;
            let other = self.told(righted, wiggle)?;
            other.log("other rays");
            let share = other.best().disagreement / as_is.best().disagreement;
            let asked = Asked::ConstantAndWiggle;
            let are_others =
                share <= MAX_SHARE_OF_RAYS && self.holds((righted, asked), (&seen, asked));
            are_others.then_some(other)
        });
        let rays = rays.filter(|_| others.is_some());
        let told = others.unwrap_or(as_is);
        let curve = told.believed().filter(|_| asks);
        GrossError {
            rays,
            range: curve.map(|curve| curve.error(self.ranges_m())),
            constant_m: curve.map_or(0.0, Curve::constant_m),
        }
    }

    /// By what shares of themselves the focal lengths are longer than those by which they were seen, across and down, which may have been
    /// found to be others than they are said to be; `None` where that is not to be believed.
    pub(super) fn longer_focus(&self, are_others: bool) -> Option<[f64; 2]> {
        let seen = self.in_order(None);
        let told = self.fit(&seen, Asked::FocalLengths, true)?;
        let longer = told.mistake.longer_focus;
        let least = match are_others {
            true => MIN_FURTHER_FOCAL,
            false => MIN_FOCAL,
        };
        // A slow error alone explains a part.
        let share = || {
            let as_they_are = self.fit(&seen, Asked::SlowField, true)?;
            Some(told.disagreement / as_they_are.disagreement)
        };
        let is_more = longer.iter().any(|longer| longer.abs() >= least);
        let share = is_more.then(share).flatten();
        let [across, down] = longer.map(|longer| 100.0 * longer);
        tracing::info!(
            across_percent = across,
            down_percent = down,
            share,
            "focal lengths: how much longer they are by how views of one surface agree, and how far they disagree with them"
        );
        share
            .is_some_and(|share| share <= MAX_SHARE_OF_FOCAL)
            .then_some(longer)
    }

    /// What they tell, their rays in one order, in which they are best fitted by a `wiggle`; `None` if too few see one surface.
    fn told(&self, ordered: &Ordered, wiggle: Fit) -> Option<Told> {
        let fit = |asked| self.fit(ordered, asked, !self.are_given);
        let holds = |one, other| self.holds((ordered, one), (ordered, other));
        let nothing = fit(Asked::Nothing)?;
        let mut told = Told {
            shows_wiggle: wiggle.disagreement <= MAX_SHARE_OF_WIGGLE * nothing.disagreement
                && holds(Asked::Wiggle, Asked::Nothing),
            nothing,
            wiggle,
            with_constant: None,
        };
        let is_constant = |fit: &Fit| {
            BELIEVED_M.contains(&fit.mistake.curve.constant_m().abs())
                && fit.disagreement <= MAX_SHARE_OF_CONSTANT * wiggle.disagreement
        };
        let both = fit(Asked::ConstantAndWiggle).filter(is_constant);
        if let Some(both) = both.filter(|_| holds(Asked::ConstantAndWiggle, Asked::Wiggle)) {
            // Where there is no wiggle beside it, it is told more exactly alone.
            let is_all = |alone: &Fit| {
                is_constant(alone) && both.disagreement > MAX_SHARE_OF_WIGGLE * alone.disagreement
            };
            told.with_constant = Some(fit(Asked::Constant).filter(is_all).unwrap_or(both));
        }
        Some(told)
    }

    /// Whether they agree better with one error taken off than with another wherever they lie, too, if they lie at given poses: a turn, or
    /// a way, that all of these are off by looks like one.
    fn holds(&self, one: (&Ordered, Asked), other: (&Ordered, Asked)) -> bool {
        let settled = |(ordered, asked)| Some(self.fit(ordered, asked, true)?.disagreement);
        let both = || settled(one).zip(settled(other));
        !self.are_given || both().is_some_and(|(one, other)| one < other)
    }

    /// What is asked for with which they agree best, where they lie or moved to where they agree best; `None` if too few see one surface.
    fn fit(&self, ordered: &Ordered, asked: Asked, are_moved: bool) -> Option<Fit> {
        let settling = Settling {
            agreement: &self.agreement,
            are_moved,
            asked,
        };
        let (mistake, views) = settling.settled(ordered.poses.clone(), |mistake, poses| {
            let error = mistake.curve.at_all_ranges();
            let view = |(depth_m, pose): (&Cow<Image<f32>>, &Pose)| {
                let corrected = error.corrected(depth_m, self.grid);
                mistake.undone(self.agreement.view(&corrected, pose))
            };
            let views = ordered.depths_m.par_iter().zip(poses);
            views.map(view).collect()
        })?;
        Some(Fit {
            mistake,
            disagreement: self.agreement.disagreement(&views, asked.along())?,
        })
    }

    /// They with their rays in an order, each moved to where it lies best on itself as it was, if it was tracked so.
    fn in_order(&self, order: Option<&RayOrder>) -> Ordered<'_> {
        let righted = |((depth_m, pose), as_it_was): (&'_ (Image<f32>, Pose), &View)| {
            let righted_m = order?.righted(depth_m);
            let motion = match self.are_given {
                true => Pose::identity(),
                false => self.agreement.view(&righted_m, pose).motion_onto(as_it_was),
            };
            Some((righted_m, pose * motion))
        };
        let views = self.views.par_iter().zip(&self.as_they_were);
        let righted: Vec<Option<(Image<f32>, Pose)>> = views.map(righted).collect();
        let views = righted.into_iter().zip(&self.views);
        let (depths_m, poses) = views
            .map(|(righted, (depth_m, pose))| match righted {
                Some((righted_m, moved)) => (Cow::Owned(righted_m), moved),
                None => (Cow::Borrowed(depth_m), *pose),
            })
            .unzip();
        Ordered { depths_m, poses }
    }

    /// How far their patches are, metres.
    fn ranges_m(&self) -> Vec<f64> {
        self.as_they_were.iter().flat_map(View::ranges_m).collect()
    }
}

impl Told {
    /// The fit that is worth most.
    fn best(&self) -> &Fit {
        self.with_constant.as_ref().unwrap_or(&self.wiggle)
    }

    /// The error that there is.
    fn believed(&self) -> Option<&Curve> {
        let is_any = self.shows_wiggle || self.with_constant.is_some();
        is_any.then_some(&self.best().mistake.curve)
    }

    fn log(&self, rays: &str) {
        let share = |fit: &Fit| fit.disagreement / self.nothing.disagreement;
        let constant = self.with_constant.as_ref();
        tracing::info!(
            rays,
            disagreement = self.nothing.disagreement,
            share_without_wiggle = share(&self.wiggle),
            share_without_constant = constant.map(share),
            constant_mm = constant.map(|fit| 1e3 * fit.mistake.curve.constant_m()),
            "how far views of one surface disagree, and without an error by range"
        );
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::depth_correction::wavy_wall::{poses, rays, seen};
    use std::f64::consts::TAU;

    /// The wall as a sensor with an error sees it.
    fn seen_with(error: &GrossError, rays: &RayGrid, poses: &[Pose]) -> Vec<(Image<f32>, Pose)> {
        let of = |pose: &Pose| {
            let right = seen(rays, pose);
            let added = error
                .range
                .as_ref()
                .map(|error| RangeError::tabulated(|m| -error.at_m(m)));
            let longer = added.map_or_else(|| right.clone(), |added| added.corrected(&right, rays));
            let undone = error.rays.as_ref().map(|(_, order)| order.undone());
            let bent = undone.map_or_else(|| longer.clone(), |order| order.righted(&longer));
            (bent, *pose)
        };
        poses.iter().map(of).collect()
    }

    /// A constant and a wiggle, metres.
    fn error_by_range(constant_m: f64, wiggle_m: f64) -> Option<RangeError> {
        let at_m = |range_m: f64| constant_m + wiggle_m * (TAU * range_m / 0.3123).sin();
        (constant_m != 0.0 || wiggle_m != 0.0).then(|| RangeError::tabulated(at_m))
    }

    #[test]
    fn views_tell_of_focal_lengths_that_are_not_what_they_are_said_to_be() {
        let rays = rays();
        for (truth, bowl_m) in [
            ([-0.03; 2], 0.0),
            ([0.0; 2], 0.0),
            ([0.02; 2], 0.0),
            ([0.03, 0.0], 0.0),
            ([0.01, -0.02], 0.0),
            ([0.0; 2], 0.02),
            ([0.02; 2], -0.02),
        ] {
            let lens = RayGrid::new(rays.camera().with_longer_focus(truth));
            // A slow error that grows with the square of depth, and towards the border of the image.
            let bent = |depth_m: &Image<f32>| {
                let pixels = depth_m.data().iter().zip(lens.rays().data());
                let bent = pixels.map(|(z, [x, y])| z + bowl_m * z * z * (x * x + y * y));
                Image::from_vec(depth_m.width(), depth_m.height(), bent.collect())
            };
            let seen: Vec<_> = poses()
                .iter()
                .map(|pose| (bent(&seen(&lens, pose)), *pose))
                .collect();
            let mut said = [0.0; 2];
            for round in 0..3 {
                let rays = RayGrid::new(rays.camera().with_longer_focus(said));
                let told = Views::new(seen.clone(), false, &rays).longer_focus(said != [0.0; 2]);
                if round == 0 {
                    let case = format!("{truth:?}, {bowl_m} m: {told:?}");
                    assert_eq!(told.is_some(), truth != [0.0; 2], "{case}");
                }
                let by = told.unwrap_or([0.0; 2]);
                said = [said[0] + by[0], said[1] + by[1]];
            }
            for (said, truth) in said.into_iter().zip(truth) {
                assert!(
                    (said - truth).abs() < 0.01,
                    "{said} for {truth}, {bowl_m} m"
                );
            }
        }
    }

    #[test]
    fn views_tell_of_rays_and_range_at_given_poses_and_at_those_that_they_were_tracked_by() {
        let rays = rays();
        let order = RayOrder::upside_down(&rays);
        let other_rays = || Some((WrongRays::UpsideDown, order.clone()));
        for (is_bent, constant_m, wiggle_m) in [
            (false, 0.0, 0.0),
            (true, 0.0, 0.0),
            (false, 0.02, 0.0),
            (false, -0.025, 0.0),
            (false, 0.0, 0.003),
            (false, 0.02, -0.003),
            (true, 0.02, 0.0),
            (true, -0.02, 0.003),
        ] {
            let error = GrossError {
                rays: other_rays().filter(|_| is_bent),
                range: error_by_range(constant_m, wiggle_m),
                constant_m,
            };
            let given = seen_with(&error, &rays, &poses());
            // Tracking takes what it can of it for a motion.
            let tracked = given
                .iter()
                .map(|(depth_m, pose)| {
                    let by = error.motion_of(depth_m, &rays).inverse();
                    (depth_m.clone(), pose * by)
                })
                .collect();
            for (views, are_given) in [(given, true), (tracked, false)] {
                let case = format!("{is_bent}, {constant_m} m, {wiggle_m} m, given: {are_given}");
                let views = Views::new(views, are_given, &rays);
                let told = views.gross_error(other_rays(), true);
                assert_eq!(told.rays.is_some(), is_bent, "{case}");
                let off_m = told.constant_m - constant_m;
                assert!(off_m.abs() < 0.004, "{case}: {} m", told.constant_m);
                assert_eq!(told.range.is_some(), error.range.is_some(), "{case}");
                for (told, error) in told.range.iter().zip(&error.range) {
                    let off_m = |k: u32| {
                        let range_m = 1.0 + 0.01 * f64::from(k);
                        told.at_m(range_m) - error.at_m(range_m)
                    };
                    let mean_m = (0..30).map(off_m).sum::<f64>() / 30.0;
                    let squares: f64 = (0..30).map(|k| (off_m(k) - mean_m).powi(2)).sum();
                    let off_m = (squares / 30.0).sqrt();
                    assert!(off_m < 0.001, "{case}: {off_m} m of a wiggle");
                }
            }
        }
    }

    #[test]
    fn what_is_taken_off_leaves_what_would_have_been_seen() {
        let rays = rays();
        let error = GrossError {
            rays: Some((WrongRays::UpsideDown, RayOrder::upside_down(&rays))),
            range: error_by_range(0.02, 0.0),
            constant_m: 0.02,
        };
        let pose = Pose::identity();
        let (wrong, _) = seen_with(&error, &rays, &[pose]).remove(0);
        let without = error.taken_off(&wrong, &rays).expect("both are wrong");
        for (a, b) in without.data().iter().zip(seen(&rays, &pose).data()) {
            assert!((a - b).abs() < 1e-6, "{a} m for {b} m");
        }
        let nothing = GrossError::default();
        assert!(nothing.is_none() && nothing.taken_off(&wrong, &rays).is_none());
        assert_eq!(nothing.motion_of(&wrong, &rays), Pose::identity());
        // One view tells nothing.
        let one = Views::new(vec![(wrong, pose)], true, &rays);
        let order = RayOrder::upside_down(&rays);
        assert!(
            one.gross_error(Some((WrongRays::UpsideDown, order.clone())), true)
                .is_none()
        );
        // And nothing by range is told that is not asked for.
        let views = Views::new(seen_with(&error, &rays, &poses()), true, &rays);
        let told = views.gross_error(Some((WrongRays::UpsideDown, order)), false);
        assert!(told.rays.is_some() && told.range.is_none());
    }
}
