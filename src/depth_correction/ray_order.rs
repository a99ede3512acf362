//! Whether depth was computed with the rays of its image upside down.
//!
//! A Kinect II measures how far a surface is along the ray of each pixel, and depth is that over the ray's length. libfreenect2's CPU
//! and OpenGL decoders take the rays of the rows upside down, which bends depth the more the farther the principal point lies from the
//! middle row: by 54 mm from the top row to the bottom one at a metre, for 10 pixels. What is decoded here is not bent so; recordings
//! that others have decoded may be.
//!
//! Views of one surface disagree by it. Where they were tracked, most of it passes for a turn of the camera, so that they are first
//! brought to where they agree best, as they are and put right.

use crate::{
    fusion::Keyframe,
    geometry::{
        CellGrid, DepthPatch, MotionEquations, Pose, RayGrid, increment, point_to_plane_row,
    },
    robust::median,
};
use depth_camera::Image;
use nalgebra::Vector3;
use rayon::prelude::*;
use std::fmt;

/// How the depth of a scan was computed, where that is not by the rays of its pixels.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum WrongRays {
    /// With those of the image upside down, as libfreenect2's CPU and OpenGL decoders do.
    UpsideDown,
    /// With the right ones, after which `fusion.rays_upside_down` bent it.
    PutRightInVain,
}

impl fmt::Display for WrongRays {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            WrongRays::UpsideDown => {
                "depth was computed with the rays of its image upside down, as libfreenect2's CPU and OpenGL decoders do, and was put \
                 right; `fusion.rays_upside_down = true` lets tracking know"
            }
            WrongRays::PutRightInVain => {
                "depth was computed with the right rays and bent by `fusion.rays_upside_down = true`, and was put right; false lets \
                 tracking know"
            }
        })
    }
}

/// Depth whose rays were upside down, and which is put right.
#[derive(Clone, Debug)]
pub(super) struct RayOrder {
    /// By how much depth becomes longer, pixel by pixel; 1 where the lens has no ray.
    factors: Image<f32>,
    rays: RayGrid,
    cells: CellGrid,
}

/// Columns of patches in an image.
const COLUMNS: usize = 32;
/// Pixels of a patch between those that are looked at.
const STEP_PX: usize = 2;
/// A bend of no more than this share of depth anywhere is not asked for: 3 mm at a metre.
const MIN_BEND: f32 = 0.003;
/// Most views that are compared, each with each.
const MAX_VIEWS: usize = 40;
/// Fewer pairs of patches tell nothing.
const MIN_PAIRS: usize = 500;
/// Patches farther apart are not of one surface, metres: a bend of 54 mm, and what else depth is off by.
const MAX_APART_M: f64 = 0.08;
/// Nor are those that are turned against one another by more: 37°.
const MIN_COSINE: f64 = 0.8;
/// Depth is put right if views then disagree by no more than this share: 0.36 to 0.89 where it was bent, 1.03 to 2.8 where it was not.
const MAX_LEFT_SHARE: f64 = 0.93;
/// Turns of motions and planes until a view lies as well as it can on itself put right.
const MOTION_ROUNDS: usize = 3;
/// Turns of all views that were tracked until they agree as well as they can.
const SETTLING_ROUNDS: usize = 4;
/// Patches that lie farther apart count for less than half while views are settled, metres: three times what agreeing ones scatter by.
const SETTLING_SCALE_M: f64 = 0.002;
/// Motions that patches do not hold, as along a wall, are damped by this share of all that they hold.
const DAMPING: f64 = 1e-6;

/// A view's patches by their cell.
struct View {
    world_from_camera: Pose,
    patches: Vec<Option<DepthPatch>>,
}

impl RayOrder {
    /// That of the rays of an image whose depth was computed with them upside down.
    pub(super) fn upside_down(rays: &RayGrid) -> Self {
        let (width, height) = (rays.rays().width(), rays.rays().height());
        let length = |u: usize, v: usize| rays.direction(u, v).norm();
        let pixels = (0..height).flat_map(|v| (0..width).map(move |u| (u, v)));
        let factors = pixels.map(|(u, v)| {
            let factor = length(u, height - 1 - v) / length(u, v);
            if factor.is_finite() { factor } else { 1.0 }
        });
        RayOrder {
            factors: Image::from_vec(width, height, factors.collect()),
            rays: rays.clone(),
            cells: CellGrid::new(width, height, COLUMNS),
        }
    }

    /// What undoes it, where there was nothing to put right.
    pub(super) fn undone(&self) -> Self {
        RayOrder {
            factors: self.factors.map(|factor| factor.recip()),
            ..self.clone()
        }
    }

    /// A depth image (metres, 0 is none) put right.
    pub(super) fn righted(&self, depth_m: &Image<f32>) -> Image<f32> {
        let pairs = depth_m.data().iter().zip(self.factors.data());
        let righted = pairs.map(|(z, factor)| z * factor);
        Image::from_vec(depth_m.width(), depth_m.height(), righted.collect())
    }

    /// Whether the frames of a scan, at given poses or tracked ones, tell that their depth is to be put right so: not if views agree as
    /// well as they are, or too few see one surface.
    pub(super) fn is_told_by(&self, frames: &[Keyframe], are_given: bool) -> bool {
        let bends = self.factors.data().iter();
        if bends.fold(0.0f32, |most, factor| most.max((factor - 1.0).abs())) < MIN_BEND {
            return false;
        }
        let every = frames.len().div_ceil(MAX_VIEWS).max(1);
        let views: Vec<(Image<f32>, Pose)> = frames
            .iter()
            .step_by(every)
            .map(|frame| {
                let given = frame.given.as_ref();
                (frame.depth_m(), *given.unwrap_or(&frame.world_from_camera))
            })
            .collect();
        let Some([as_is_m, righted_m]) = self.apart_m(&views, are_given) else {
            return false;
        };
        tracing::info!(
            views = views.len(),
            apart_mm = 1e3 * as_is_m,
            righted_mm = 1e3 * righted_m,
            "order of rays: how far views of one surface lie apart"
        );
        let is_told = righted_m <= MAX_LEFT_SHARE * as_is_m;
        // A turn that all given poses are off by looks like a bend, until views are settled.
        let agrees = || {
            let settled = self.apart_m(&views, false);
            settled.is_some_and(|[as_is_m, righted_m]| righted_m < as_is_m)
        };
        is_told && (!are_given || agrees())
    }

    /// How far views (depth in metres, world from camera) of one surface lie apart as they are, and put right, metres; `None` if too few
    /// see one.
    fn apart_m(&self, views: &[(Image<f32>, Pose)], are_given: bool) -> Option<[f64; 2]> {
        let both = views.par_iter().map(|(depth_m, pose)| {
            let (as_is, mut righted) = self.both(depth_m, pose);
            if !are_given {
                righted.world_from_camera = pose * righted.motion_onto(&as_is);
            }
            (as_is, righted)
        });
        let (as_is, righted): (Vec<View>, Vec<View>) = both.unzip();
        if are_given {
            return Some([self.median_apart_m(&as_is)?, self.median_apart_m(&righted)?]);
        }
        let settled_m = |mut views: Vec<View>| {
            for _ in 0..SETTLING_ROUNDS {
                self.settle(&mut views);
            }
            self.median_apart_m(&views)
        };
        let (as_is_m, righted_m) = rayon::join(|| settled_m(as_is), || settled_m(righted));
        Some([as_is_m?, righted_m?])
    }

    /// The motion in the camera's frame by which a depth image put right lies best on the image as it was, by which it was tracked.
    pub(super) fn motion_of(&self, depth_m: &Image<f32>) -> Pose {
        let (as_is, righted) = self.both(depth_m, &Pose::identity());
        righted.motion_onto(&as_is)
    }

    /// A view as it is and put right, at one pose.
    fn both(&self, depth_m: &Image<f32>, world_from_camera: &Pose) -> (View, View) {
        let view = |depth_m: &Image<f32>| {
            let square = |cell: usize| self.cells.square(cell, STEP_PX);
            let patch = |cell: usize| DepthPatch::fit(depth_m, &self.rays, square(cell));
            View {
                world_from_camera: *world_from_camera,
                patches: (0..self.cells.n_cells()).map(patch).collect(),
            }
        };
        (view(depth_m), view(&self.righted(depth_m)))
    }

    /// Moves one view after the other to where its patches lie best on the planes of the others.
    fn settle(&self, views: &mut [View]) {
        for index in 0..views.len() {
            let (mut rows, mut apart) = (Vec::new(), Vec::new());
            self.each_pair(views, index, |patch, normal, apart_m| {
                let weight = 1.0 / (1.0 + (apart_m / SETTLING_SCALE_M).powi(2));
                rows.push((point_to_plane_row(&patch.centre.coords, &normal), weight));
                apart.push(-apart_m);
            });
            if let Some(equations) = MotionEquations::new(rows, DAMPING) {
                views[index].world_from_camera *=
                    increment(&equations.explaining(apart.into_iter()));
            }
        }
    }

    /// Median distance of the patches of views from the planes of those of other views, metres; `None` if there are too few.
    fn median_apart_m(&self, views: &[View]) -> Option<f64> {
        let of_view = |index: usize| {
            let mut apart = Vec::new();
            self.each_pair(views, index, |_, _, apart_m| apart.push(apart_m.abs()));
            apart
        };
        let mut apart: Vec<f64> = (0..views.len())
            .into_par_iter()
            .flat_map_iter(of_view)
            .collect();
        (apart.len() >= MIN_PAIRS).then(|| median(&mut apart))?
    }

    /// Tells of each patch of a view, and each other view that has a patch of the same surface where it is seen: that one's normal in the
    /// frame of the first, and how far before its plane the patch lies, metres.
    fn each_pair(
        &self,
        views: &[View],
        index: usize,
        mut tell: impl FnMut(&DepthPatch, Vector3<f64>, f64),
    ) {
        let (view, camera) = (&views[index], self.rays.camera());
        for (_, other) in views.iter().enumerate().filter(|(k, _)| *k != index) {
            let other_from_view = other.world_from_camera.inverse() * view.world_from_camera;
            for patch in view.patches.iter().flatten() {
                let centre = other_from_view * patch.centre;
                let pixel = camera.project(&centre);
                let pixel = pixel.filter(|pixel| camera.contains(pixel, 0.0));
                let cell = pixel.and_then(|p| self.cells.cell_of((p.x as usize, p.y as usize)));
                let Some(seen) = cell.and_then(|cell| other.patches[cell].as_ref()) else {
                    continue;
                };
                let apart_m = seen.normal.dot(&(centre - seen.centre));
                let normal = other_from_view.rotation.inverse() * seen.normal;
                if normal.dot(&patch.normal) >= MIN_COSINE && apart_m.abs() <= MAX_APART_M {
                    tell(patch, normal, apart_m);
                }
            }
        }
    }
}

impl View {
    /// The motion in the camera's frame that brings patches onto those of another view in the same cells.
    fn motion_onto(&self, other: &View) -> Pose {
        let pairs = self.patches.iter().zip(&other.patches);
        let pairs: Vec<(DepthPatch, DepthPatch)> =
            pairs.filter_map(|(a, b)| (*a).zip(*b)).collect();
        let mut motion = Pose::identity();
        for _ in 0..MOTION_ROUNDS {
            let moved = |patch: &DepthPatch| (motion * patch.centre).coords;
            let row = |(from, onto): &(DepthPatch, DepthPatch)| {
                (point_to_plane_row(&moved(from), &onto.normal), 1.0)
            };
            let Some(equations) = MotionEquations::new(pairs.iter().map(row).collect(), DAMPING)
            else {
                break;
            };
            let apart = |(from, onto): &(DepthPatch, DepthPatch)| {
                onto.normal.dot(&(onto.centre.coords - moved(from)))
            };
            motion = increment(&equations.explaining(pairs.iter().map(apart))) * motion;
        }
        motion
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::CameraModel;
    use depth_camera::Intrinsics;
    use nalgebra::{Point3, Translation3, Vector6};

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
            let aside = Translation3::new(0.3 * x, 0.3 * y, -0.1 * (k % 3) as f64);
            aside * turn
        };
        (0..12).map(pose).collect()
    }

    #[test]
    fn views_tell_of_bent_depth_at_given_poses_and_at_those_that_it_was_tracked_by() {
        let rays = rays();
        let order = RayOrder::upside_down(&rays);
        let bending = order.undone();
        let straight: Vec<(Image<f32>, Pose)> = poses()
            .iter()
            .map(|pose| (seen(&rays, pose), *pose))
            .collect();
        let given: Vec<(Image<f32>, Pose)> = straight
            .iter()
            .map(|(depth_m, pose)| (bending.righted(depth_m), *pose))
            .collect();
        // Tracking takes what it can of the bend for a motion.
        let tracked = given
            .iter()
            .map(|(depth_m, pose)| (depth_m.clone(), pose * order.motion_of(depth_m).inverse()));
        let tracked: Vec<(Image<f32>, Pose)> = tracked.collect();
        let share = |views: &[(Image<f32>, Pose)], are_given: bool| {
            let [as_is_m, righted_m] = order.apart_m(views, are_given).expect("a wall");
            righted_m / as_is_m
        };
        let of_bent = [share(&given, true), share(&tracked, false)];
        assert!(of_bent[0] < 0.5 && of_bent[1] < 0.8, "{of_bent:?}");
        let of_straight = [share(&straight, true), share(&straight, false)];
        assert!(
            of_straight[0] > 1.5 && of_straight[1] > 1.2,
            "{of_straight:?}"
        );
        for ((depth_m, _), (before_m, _)) in given.iter().zip(&straight) {
            let righted = order.righted(depth_m);
            let pairs = righted.data().iter().zip(before_m.data());
            assert!(pairs.into_iter().all(|(a, b)| (a - b).abs() < 1e-6));
        }
        assert_eq!(order.apart_m(&given[..1], true), None);
    }
}
