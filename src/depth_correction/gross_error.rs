//! What is wrong with the depth of every frame alike, by up to centimetres, before anything finer can be told: the rays that it was
//! computed by ([`RayOrder`]), and a constant of the range.
//!
//! The phase of a time-of-flight sensor has a constant of its own, 24 mm, say users of a Kinect II, which drifts by millimetres as the
//! device warms up. Scanned from one distance it makes a scene larger; but what is far is made so by less than what is near, and what is
//! aside by less than it is moved, so that views of one surface disagree. (A share of the range would make all of a scene larger, and no
//! scan tells it; the sensor's clock is right to some parts in a million.) Which of all these lets views [agree](Agreement) best is told
//! together: each alone would pass for the other in part.

use super::agreement::{Agreement, View};
use super::ray_order::{RayOrder, WrongRays};
use crate::{
    fusion::Keyframe,
    geometry::{Pose, RangeError, RayGrid},
    robust::quantile,
};
use depth_camera::Image;
use rayon::prelude::*;
use std::{
    collections::{BTreeMap, btree_map::Entry},
    ops::RangeInclusive,
};

/// What is taken off the depth of every frame alike.
#[derive(Clone, Debug, Default)]
pub(super) struct GrossError {
    /// `None` is rays as they should be.
    pub(super) rays: Option<(WrongRays, RayOrder)>,
    /// How much too long ranges are, the same at all of them, metres.
    pub(super) constant_m: f64,
}

/// Most views that are compared, each with each.
const MAX_VIEWS: usize = 40;
/// Rays are others if views then disagree by no more than this share: 0.36 to 0.89 where they were, 0.97 to 2.8 where nothing was wrong;
/// 0.83 to 1.35 where a constant was,
const MAX_SHARE_OF_RAYS: f64 = 0.93;
/// for which, the best constant taken off with either, by no more than this share: 0.90 and 0.95 where they were, 0.99 to 1.08 where not.
const MAX_SHARE_BESIDE_CONSTANT: f64 = 0.97;
/// A constant is one if views then disagree by no more than this share: 0.73 to 0.84 where it was 20 mm, 0.94 at 12.
const MAX_SHARE_OF_CONSTANT: f64 = 0.97;
/// What is believed of one, metres: a smaller one is not told from the multipath that is left before there is a model (by up to 6 mm too
/// much is told), and a larger one no device has.
const BELIEVED_M: RangeInclusive<f64> = 0.008..=0.04;
/// One that seems to be so small need not be looked for more closely, metres.
const PLAINLY_NONE_M: f64 = 0.004;
/// A constant is looked for in steps of so much, metres,
const STEP_M: f64 = 0.005;
/// so many of them to either side of the best one so far, as long as there is a better one,
const REACHES: [i32; 3] = [4, 2, 1];
/// and a best one beyond so many is not pursued.
const MAX_STEPS: i32 = 8;
/// Where nine tenths of the patches lie within less, a wiggle, which goes to and fro in 0.3 m, passes for a constant, metres.
const MIN_SPREAD_M: f64 = 0.4;

/// Views of a scan that are compared.
pub(super) struct Views<'a> {
    /// Depth in metres, and world from camera.
    views: Vec<(Image<f32>, Pose)>,
    are_given: bool,
    grid: &'a RayGrid,
    agreement: Agreement<'a>,
    as_they_were: Vec<View>,
}

/// An order of rays and a constant, metres, that are taken off.
type Errors<'a> = (Option<&'a RayOrder>, f64);

/// The constant with which views agree best.
#[derive(Clone, Copy, Debug)]
struct Told {
    constant_m: f64,
    /// How far views lie apart with it taken off, as a share of their range.
    apart: f64,
    /// And with it left.
    apart_before: f64,
}

impl GrossError {
    /// How much too long ranges are, the same at all of them; `None` where they are not.
    pub(super) fn constant(&self) -> Option<RangeError> {
        (self.constant_m != 0.0).then(|| RangeError::constant(self.constant_m))
    }

    /// The same without a constant.
    pub(super) fn without_constant(self) -> Self {
        GrossError {
            constant_m: 0.0,
            ..self
        }
    }

    /// Whether there is none.
    pub(super) fn is_none(&self) -> bool {
        self.rays.is_none() && self.constant_m == 0.0
    }

    /// A depth image (metres, 0 is none) without it.
    pub(super) fn taken_off(&self, depth_m: &Image<f32>, grid: &RayGrid) -> Option<Image<f32>> {
        let order = self.rays.as_ref().map(|(_, order)| order);
        without_errors(depth_m, (order, self.constant_m), grid)
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

    /// What is wrong with all of them, a constant only where it `asks` for one, and where rays may be others; nothing where they agree as
    /// well as they are, or too few see one surface.
    pub(super) fn gross_error(
        &self,
        rays: Option<(WrongRays, RayOrder)>,
        asks: bool,
    ) -> GrossError {
        let order = rays.as_ref().map(|(_, order)| order);
        // Rays are told beside a constant even where it is not asked for: it passes for others.
        let (as_is, other) = rayon::join(
            || self.told(None),
            || order.and_then(|order| self.told(Some(order))),
        );
        let Some(as_is) = as_is else {
            return GrossError::default();
        };
        tracing::info!(
            ?as_is,
            with_other_rays = ?other,
            "constant of the range, and rays: how far views of one surface lie apart, as a share of their range"
        );
        let spread_m = self.spread_m().unwrap_or(0.0);
        let believed_m = |told: &Told, order| {
            let (with, without) = ((order, 0.0), (order, told.constant_m));
            let is_told = asks
                && spread_m >= MIN_SPREAD_M
                && BELIEVED_M.contains(&told.constant_m.abs())
                && told.apart <= MAX_SHARE_OF_CONSTANT * told.apart_before
                && self.may_be_off(with, without);
            if is_told { told.constant_m } else { 0.0 }
        };
        let other_m = other.map_or(0.0, |other| believed_m(&other, order));
        let are_others = other.is_some_and(|other| {
            let left = if other_m == 0.0 {
                other.apart_before
            } else {
                other.apart
            };
            left <= MAX_SHARE_OF_RAYS * as_is.apart_before
                && other.apart <= MAX_SHARE_BESIDE_CONSTANT * as_is.apart
                && self.may_be_off((None, 0.0), (order, other_m))
        });
        match are_others {
            true => GrossError {
                rays,
                constant_m: other_m,
            },
            false => GrossError {
                rays: None,
                constant_m: believed_m(&as_is, None),
            },
        }
    }

    /// The constant with which they agree best, their rays in an order; `None` if too few see one surface.
    fn told(&self, order: Option<&RayOrder>) -> Option<Told> {
        let nothing = self.apart((order, 0.0))?;
        let mut apart = BTreeMap::from([(0, nothing)]);
        let (mut best, mut constant_m) = (0, 0.0);
        for reach in REACHES {
            loop {
                let before = best;
                for at in [before - reach, before + reach] {
                    let here = match apart.entry(at) {
                        Entry::Occupied(known) => *known.get(),
                        Entry::Vacant(asked) => {
                            let here = self.apart((order, f64::from(at) * STEP_M));
                            *asked.insert(here.unwrap_or(f64::INFINITY))
                        }
                    };
                    if here < apart[&best] {
                        best = at;
                    }
                }
                if best == before || best.abs() > MAX_STEPS {
                    break;
                }
            }
            let beside = lowest_beside(&apart, best, reach);
            constant_m = STEP_M * (f64::from(best) + beside.unwrap_or(0.0));
            let is_none = beside.is_some() && constant_m.abs() < PLAINLY_NONE_M;
            if is_none || best.abs() > MAX_STEPS {
                break;
            }
        }
        Some(Told {
            constant_m,
            apart: apart[&best],
            apart_before: nothing,
        })
    }

    /// Within how much nine tenths of their patches' ranges lie, metres; `None` without patches.
    fn spread_m(&self) -> Option<f64> {
        let views = self.as_they_were.iter();
        let mut ranges: Vec<f64> = views.flat_map(View::ranges_m).collect();
        Some(quantile(&mut ranges, 0.95)? - quantile(&mut ranges, 0.05)?)
    }

    /// Whether one error may be taken off instead of another: at given poses only if they agree better without it wherever they lie, since
    /// a turn, or a way, that all given poses are off by looks like one.
    fn may_be_off(&self, instead_of: Errors, taken_off: Errors) -> bool {
        let settled = |errors| self.agreement.apart_settled(self.without(errors, true));
        let apart = || settled(taken_off).zip(settled(instead_of));
        !self.are_given || apart().is_some_and(|(one, other)| one < other)
    }

    /// How far they lie apart without errors, as a share of their range.
    fn apart(&self, taken_off: Errors) -> Option<f64> {
        let views = self.without(taken_off, !self.are_given);
        match self.are_given {
            true => self.agreement.apart(&views),
            false => self.agreement.apart_settled(views),
        }
    }

    /// They without errors, each moved to where it lies best on itself with them, if they were tracked so.
    fn without(&self, errors: Errors, are_tracked: bool) -> Vec<View> {
        let view = |((depth_m, pose), as_it_was): (&(Image<f32>, Pose), &View)| {
            let Some(without_m) = without_errors(depth_m, errors, self.grid) else {
                return as_it_was.clone();
            };
            let without = self.agreement.view(&without_m, pose);
            match are_tracked {
                true => without.brought_onto(as_it_was),
                false => without,
            }
        };
        let views = self.views.par_iter().zip(&self.as_they_were);
        views.map(view).collect()
    }
}

/// How many steps from the best one of three, which lie a reach apart, views would lie nearest: what is left beside the constant adds
/// up by squares. `None` where they do not tell.
fn lowest_beside(apart: &BTreeMap<i32, f64>, best: i32, reach: i32) -> Option<f64> {
    let squared = |at: i32| apart.get(&at).map_or(f64::INFINITY, |apart| apart * apart);
    let [before, here, after] = [best - reach, best, best + reach].map(squared);
    let curvature = before - 2.0 * here + after;
    let is_told = curvature > 0.0 && curvature.is_finite();
    is_told.then(|| 0.5 * f64::from(reach) * (before - after) / curvature)
}

/// A depth image (metres, 0 is none) without errors; `None` without any.
fn without_errors(
    depth_m: &Image<f32>,
    (order, constant_m): Errors,
    grid: &RayGrid,
) -> Option<Image<f32>> {
    let righted = order.map(|order| order.righted(depth_m));
    if constant_m == 0.0 {
        return righted;
    }
    let from = righted.as_ref().unwrap_or(depth_m);
    Some(RangeError::constant(constant_m).corrected(from, grid))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::{CameraModel, increment};
    use depth_camera::Intrinsics;
    use nalgebra::{Point3, Translation3, Vector3, Vector6};

    /// A camera whose principal point lies off the middle row as a Kinect II's may.
    fn rays() -> RayGrid {
        RayGrid::new(CameraModel::new(Intrinsics {
            width: 256,
            height: 212,
            fx: 183.0,
            fy: 183.0,
            cx: 127.5,
            cy: 100.5,
            k1: 0.0,
            k2: 0.0,
            p1: 0.0,
            p2: 0.0,
            k3: 0.0,
        }))
    }

    /// Depth of a wavy wall at a metre.
    fn seen(rays: &RayGrid, world_from_camera: &Pose) -> Image<f32> {
        let wall = |p: &Point3<f64>| 1.0 + 0.05 * (9.0 * p.x).sin() * (7.0 * p.y).cos();
        let depth = |[x, y]: &[f32; 2]| {
            let ray = world_from_camera.rotation * Vector3::new(f64::from(*x), f64::from(*y), 1.0);
            let origin = Point3::from(world_from_camera.translation.vector);
            let mut depth = 1.0;
            for _ in 0..50 {
                let at = origin + ray * depth;
                depth += (wall(&at) - at.z) / ray.z;
            }
            depth as f32
        };
        rays.rays().map(depth)
    }

    /// Where twelve views of it are taken.
    fn poses() -> Vec<Pose> {
        let pose = |k: usize| {
            let around = k as f64 * 2.4;
            let (x, y) = (around.cos(), around.sin());
            let turn = increment(&Vector6::new(0.25 * y, -0.25 * x, 0.1 * x, 0.0, 0.0, 0.0));
            let aside = Translation3::new(0.3 * x, 0.3 * y, -0.25 * (k % 3) as f64);
            aside * turn
        };
        (0..12).map(pose).collect()
    }

    /// The wall as a sensor with an error sees it, and what was seen without.
    fn seen_with(error: &GrossError, rays: &RayGrid, poses: &[Pose]) -> Vec<(Image<f32>, Pose)> {
        let of = |pose: &Pose| {
            let longer = RangeError::constant(-error.constant_m).corrected(&seen(rays, pose), rays);
            let undone = error.rays.as_ref().map(|(_, order)| order.undone());
            let bent = undone.map_or_else(|| longer.clone(), |order| order.righted(&longer));
            (bent, *pose)
        };
        poses.iter().map(of).collect()
    }

    #[test]
    fn views_tell_of_rays_and_a_constant_at_given_poses_and_at_those_that_they_were_tracked_by() {
        let rays = rays();
        let order = RayOrder::upside_down(&rays);
        let other_rays = || Some((WrongRays::UpsideDown, order.clone()));
        for (is_bent, constant_m) in [
            (false, 0.0),
            (true, 0.0),
            (false, 0.02),
            (false, -0.025),
            (true, 0.02),
            (true, -0.02),
        ] {
            let error = GrossError {
                rays: other_rays().filter(|_| is_bent),
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
                let views = Views::new(views, are_given, &rays);
                let told = views.gross_error(other_rays(), true);
                assert_eq!(told.rays.is_some(), is_bent, "{constant_m} m, {are_given}");
                let off_m = told.constant_m - constant_m;
                assert!(
                    off_m.abs() < 0.005,
                    "{} m for {constant_m} m, bent: {is_bent}, given: {are_given}",
                    told.constant_m
                );
                let not_asked = views.gross_error(other_rays(), false);
                assert_eq!(not_asked.constant_m, 0.0);
                assert!(is_bent || not_asked.rays.is_none(), "{constant_m} m");
            }
        }
    }

    #[test]
    fn what_is_taken_off_leaves_what_would_have_been_seen() {
        let rays = rays();
        let error = GrossError {
            rays: Some((WrongRays::UpsideDown, RayOrder::upside_down(&rays))),
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
            one.gross_error(Some((WrongRays::UpsideDown, order)), true)
                .is_none()
        );
    }
}
