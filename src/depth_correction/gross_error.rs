//! What is wrong with the depth of every frame alike, before anything finer can be told: the rays that it was computed by
//! ([`RayOrder`]), a constant of the range, and a wiggle.
//!
//! The phase of a time-of-flight sensor has a constant of its own, 24 mm, say users of a Kinect II, which drifts by millimetres as the
//! device warms up. Scanned from one distance it makes a scene larger; but what is far is made so by less than what is near, and what is
//! aside by less than it is moved, so that views of one surface disagree. (A share of the range would make all of a scene larger, and no
//! scan tells it; the sensor's clock is right to some parts in a million.) A wiggle passes for a constant, and either for other rays, so
//! that all are told together, by how well views [agree](Agreement) without them.

use super::agreement::{Agreement, View};
use super::ray_order::{RayOrder, WrongRays};
use super::settling::{Asked, Curve, Settling};
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
/// none was.
const MAX_SHARE_OF_WIGGLE: f64 = 0.92;
/// There is a constant if they disagree by no more than this share of what a wiggle alone leaves: 0.88 to 0.98 where it was of 12 to 20 mm,
/// 0.991 to 1.004 where none was.
const MAX_SHARE_OF_CONSTANT: f64 = 0.99;
/// What is believed of one, metres: a smaller one is not told from the multipath that is left before there is a model (which looks like one
/// of up to 3.5 mm, in a bowl of 7), and a larger one no device has.
const BELIEVED_M: RangeInclusive<f64> = 0.008..=0.04;

/// Views of a scan that are compared.
pub(super) struct Views<'a> {
    /// Depth in metres, and world from camera.
    views: Vec<(Image<f32>, Pose)>,
    are_given: bool,
    grid: &'a RayGrid,
    agreement: Agreement<'a>,
    as_they_were: Vec<View>,
}

/// An error by range, and how far views disagree without it.
#[derive(Clone, Copy, Debug)]
struct Fit {
    curve: Curve,
    disagreement: f64,
}

/// What views tell, their rays in one order.
#[derive(Clone, Copy, Debug)]
struct Told {
    nothing: Fit,
    wiggle: Fit,
    with_constant: Fit,
    /// Whether the constant is one.
    shows_constant: bool,
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
        let Some(as_is) = self.told(None) else {
            return GrossError::default();
        };
        // Rays are told beside an error by range even where that is not asked for: it passes for others.
        let order = rays.as_ref().map(|(_, order)| order);
        let other = order.and_then(|order| {
            let near = MAX_SHARE_WORTH_ASKING * as_is.wiggle.disagreement;
            let wiggle = self.fit(Some(order), Asked::Wiggle, !self.are_given)?;
            (wiggle.disagreement <= near).then(|| self.told(Some(order)))?
        });
        tracing::info!(
            ?as_is,
            with_other_rays = ?other,
            "rays, and error by range: how far views of one surface disagree"
        );
        let are_others = |other: &Told| {
            let share = other.best().disagreement / as_is.best().disagreement;
            share <= MAX_SHARE_OF_RAYS && self.hold_wherever_views_lie(order)
        };
        let others = other.filter(are_others);
        let rays = rays.filter(|_| others.is_some());
        let told = others.unwrap_or(as_is);
        let curve = told.believed().filter(|_| asks);
        GrossError {
            rays,
            range: curve.map(|curve| curve.error(self.ranges_m())),
            constant_m: curve.map_or(0.0, Curve::constant_m),
        }
    }

    /// What they tell, their rays in an order; `None` if too few see one surface.
    fn told(&self, order: Option<&RayOrder>) -> Option<Told> {
        let fit = |asked| self.fit(order, asked, !self.are_given);
        let mut told = Told {
            nothing: fit(Asked::Nothing)?,
            wiggle: fit(Asked::Wiggle)?,
            with_constant: fit(Asked::ConstantAndWiggle)?,
            shows_constant: false,
        };
        let constant_m = told.with_constant.curve.constant_m();
        let share = told.with_constant.disagreement / told.wiggle.disagreement;
        // A turn, or a way, that all given poses are off by looks like a constant: views must agree better without it wherever they lie.
        let settled = |asked| self.fit(order, asked, true);
        let both = || settled(Asked::ConstantAndWiggle).zip(settled(Asked::Wiggle));
        let holds =
            || both().is_some_and(|(with, without)| with.disagreement < without.disagreement);
        told.shows_constant = BELIEVED_M.contains(&constant_m.abs())
            && share <= MAX_SHARE_OF_CONSTANT
            && (!self.are_given || holds());
        if told.shows_constant {
            // Alone it is told more exactly.
            let alone = fit(Asked::Constant)?;
            if told.with_constant.disagreement > MAX_SHARE_OF_WIGGLE * alone.disagreement {
                told.with_constant = alone;
            }
        }
        Some(told)
    }

    /// Whether given views agree better with other rays wherever they lie, too: a turn that all of these are off by looks like them.
    fn hold_wherever_views_lie(&self, order: Option<&RayOrder>) -> bool {
        let settled = |order| self.fit(order, Asked::ConstantAndWiggle, true);
        let both = || settled(order).zip(settled(None));
        let better =
            || both().is_some_and(|(other, as_is)| other.disagreement < as_is.disagreement);
        !self.are_given || better()
    }

    /// The error by range with which they agree best, their rays in an order, where they lie or moved to where they agree best; `None` if
    /// too few see one surface.
    fn fit(&self, order: Option<&RayOrder>, asked: Asked, are_moved: bool) -> Option<Fit> {
        let views = self.views.par_iter().zip(&self.as_they_were);
        let righted = views.map(|(view, as_it_was)| self.righted(order, view, as_it_was));
        let (depths_m, poses): (Vec<_>, Vec<_>) = righted.unzip();
        let settling = Settling {
            agreement: &self.agreement,
            are_moved,
            asked,
        };
        let (curve, views) = settling.settled(poses, |curve, poses| {
            let error = curve.at_all_ranges();
            let view = |(depth_m, pose): (&Cow<Image<f32>>, &Pose)| {
                self.agreement
                    .view(&error.corrected(depth_m, self.grid), pose)
            };
            depths_m.par_iter().zip(poses).map(view).collect()
        })?;
        Some(Fit {
            curve,
            disagreement: self.agreement.disagreement(&views)?,
        })
    }

    /// Depth (m) of a view with its rays in an order, and where that lies: moved onto itself as it was, if it was tracked so.
    fn righted<'v>(
        &self,
        order: Option<&RayOrder>,
        (depth_m, pose): &'v (Image<f32>, Pose),
        as_it_was: &View,
    ) -> (Cow<'v, Image<f32>>, Pose) {
        let Some(order) = order else {
            return (Cow::Borrowed(depth_m), *pose);
        };
        let righted_m = order.righted(depth_m);
        let motion = match self.are_given {
            true => Pose::identity(),
            false => self.agreement.view(&righted_m, pose).motion_onto(as_it_was),
        };
        (Cow::Owned(righted_m), pose * motion)
    }

    /// How far their patches are, metres.
    fn ranges_m(&self) -> Vec<f64> {
        self.as_they_were.iter().flat_map(View::ranges_m).collect()
    }
}

impl Told {
    /// The fit that is worth most.
    fn best(&self) -> &Fit {
        if self.shows_constant {
            &self.with_constant
        } else {
            &self.wiggle
        }
    }

    /// The error that there is.
    fn believed(&self) -> Option<&Curve> {
        let share = self.best().disagreement / self.nothing.disagreement;
        (self.shows_constant || share <= MAX_SHARE_OF_WIGGLE).then_some(&self.best().curve)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::{CameraModel, increment};
    use depth_camera::Intrinsics;
    use nalgebra::{Point3, Translation3, Vector3, Vector6};
    use std::f64::consts::TAU;

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

    /// The wall as a sensor with an error sees it.
    fn seen_with(error: &GrossError, rays: &RayGrid, poses: &[Pose]) -> Vec<(Image<f32>, Pose)> {
        let of = |pose: &Pose| {
            let right = seen(rays, pose);
            let added = error
                .range
                .as_ref()
                .map(|error| RangeError::of(|m| -error.at_m(m)));
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
        (constant_m != 0.0 || wiggle_m != 0.0).then(|| RangeError::of(at_m))
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
                    let squares: f64 = (0..30).map(|k| off_m(k).powi(2)).sum();
                    let off_m = (squares / 30.0).sqrt();
                    assert!(off_m < 0.004, "{case}: {off_m} m of a wiggle");
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
