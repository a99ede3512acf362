//! How far views of one surface lie apart: by what is wrong with all of them alike.
//!
//! Where views were tracked, most of what they are off by alike passes for a motion of the camera, so that they are first brought to where
//! they agree best.

use crate::{
    geometry::{
        CellGrid, DepthPatch, MotionEquations, Pose, RayGrid, increment, point_to_plane_row,
    },
    robust::median,
};
use depth_camera::Image;
use nalgebra::Vector3;
use rayon::prelude::*;

/// Columns of patches in an image.
const COLUMNS: usize = 32;
/// Pixels of a patch between those that are looked at.
const STEP_PX: usize = 2;
/// Fewer pairs of patches tell nothing.
const MIN_PAIRS: usize = 500;
/// Patches farther apart are not of one surface, metres: a bend of 54 mm, and what else depth is off by.
const MAX_APART_M: f64 = 0.08;
/// Nor are those that are turned against one another by more: 37°.
const MIN_COSINE: f64 = 0.8;
/// Turns of motions and planes until a view lies as well as it can on itself as it was.
const MOTION_ROUNDS: usize = 3;
/// Turns of all views that were tracked until they agree as well as they can.
const SETTLING_ROUNDS: usize = 4;
/// Patches that lie farther apart count for less than half while views are settled, metres: three times what agreeing ones scatter by.
const SETTLING_SCALE_M: f64 = 0.002;
/// Motions that patches do not hold, as along a wall, are damped by this share of all that they hold.
const DAMPING: f64 = 1e-6;

/// Compares the views of one camera.
pub(super) struct Agreement<'a> {
    rays: &'a RayGrid,
    cells: CellGrid,
}

/// A view's patches by their cell.
#[derive(Clone)]
pub(super) struct View {
    world_from_camera: Pose,
    patches: Vec<Option<DepthPatch>>,
}

impl<'a> Agreement<'a> {
    pub(super) fn of(rays: &'a RayGrid) -> Self {
        let grid = rays.rays();
        Agreement {
            rays,
            cells: CellGrid::new(grid.width(), grid.height(), COLUMNS),
        }
    }

    /// A view whose depth (m) was taken at a pose.
    pub(super) fn view(&self, depth_m: &Image<f32>, world_from_camera: &Pose) -> View {
        let square = |cell: usize| self.cells.square(cell, STEP_PX);
        let patch = |cell: usize| DepthPatch::fit(depth_m, self.rays, square(cell));
        View {
            world_from_camera: *world_from_camera,
            patches: (0..self.cells.n_cells()).map(patch).collect(),
        }
    }

    /// How far views of one surface lie apart where they are, as a share of their range; `None` if too few see one.
    pub(super) fn apart(&self, views: &[View]) -> Option<f64> {
        let of_view = |index: usize| {
            let mut apart = Vec::new();
            self.each_pair(views, index, |patch, _, apart_m| {
                apart.push(apart_m.abs() / patch.centre.coords.norm());
            });
            apart
        };
        let mut apart: Vec<f64> = (0..views.len())
            .into_par_iter()
            .flat_map_iter(of_view)
            .collect();
        (apart.len() >= MIN_PAIRS).then(|| median(&mut apart))?
    }

    /// The same where they agree best.
    pub(super) fn apart_settled(&self, mut views: Vec<View>) -> Option<f64> {
        for _ in 0..SETTLING_ROUNDS {
            self.settle(&mut views);
        }
        self.apart(&views)
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
    /// How far its patches are, metres.
    pub(super) fn ranges_m(&self) -> impl Iterator<Item = f64> + '_ {
        let patches = self.patches.iter().flatten();
        patches.map(|patch| patch.centre.coords.norm())
    }

    /// This view moved to where its patches lie best on those of another one, of the same pose, in the same cells.
    pub(super) fn brought_onto(self, other: &View) -> Self {
        View {
            world_from_camera: self.world_from_camera * self.motion_onto(other),
            ..self
        }
    }

    /// The motion in the camera's frame that brings patches onto those of another view in the same cells.
    pub(super) fn motion_onto(&self, other: &View) -> Pose {
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
