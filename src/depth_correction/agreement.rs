//! How far views of one surface lie apart.

use super::slow_field::SlowField;
use crate::geometry::{
    CellGrid, DepthPatch, MotionEquations, Pose, RayGrid, increment, point_to_plane_row,
};
use depth_camera::Image;
use nalgebra::{Point3, Vector3};
use rayon::prelude::*;

/// Columns of patches in an image.
const COLUMNS: usize = 32;
/// Pixels of a patch between those that are looked at.
const STEP_PX: usize = 2;
/// Fewer pairs of patches tell nothing.
const MIN_PAIRS: usize = 250;
/// Patches farther apart are not of one surface, metres: a bend of 54 mm, and what else depth is off by.
const MAX_APART_M: f64 = 0.08;
/// Nor are those that are turned against one another by more: 37°.
const MIN_COSINE: f64 = 0.8;
/// Patches that lie farther apart count for less than half, metres: three times what agreeing ones scatter by.
pub(super) const SCALE_M: f64 = 0.002;
/// Turns of motions and planes until a view lies as well as it can on itself as it was.
const MOTION_ROUNDS: usize = 3;
/// Motions that patches do not hold, as along a wall, are damped by this share of all that they hold.
pub(super) const DAMPING: f64 = 1e-6;

/// Along which normal the patches of a pair are compared.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Along {
    /// The other view's. A constant of the range is told more exactly so: 20.3 and 18.6 mm of 20, midway 19.1 and 16.9 (`bust-k2`, without
    /// and beside a wiggle).
    Other,
    /// The one midway between both, by which two places of a round surface do not lie apart (the symmetric objective of Rusinkiewicz, ACM
    /// Transactions on Graphics 38(4), 2019): either lies behind the plane of the other, which looks like a longer lens.
    Midway,
}

/// Compares the views of one camera.
pub(super) struct Agreement<'a> {
    rays: &'a RayGrid,
    cells: CellGrid,
}

/// A view's patches by their cell.
pub(super) struct View {
    world_from_camera: Pose,
    patches: Vec<Option<DepthPatch>>,
    /// By what shares of themselves the focal lengths by which patches were put where they are are longer than the camera's, across and down.
    longer_focus: [f64; 2],
}

/// A patch of one view, and that of another one on the same surface. Where there are two, the first is in the frame of the one view, the
/// second in that of the other.
pub(super) struct Pair {
    /// The other view.
    pub(super) other: usize,
    /// Where each view's own patch is.
    pub(super) centres: [Point3<f64>; 2],
    /// The normal along which they are compared.
    pub(super) normals: [Vector3<f64>; 2],
    /// By where motions move them along it: as views turn, so does a normal midway, which makes that the place midway.
    pub(super) levers: [Point3<f64>; 2],
    /// How far the first one's patch lies before the other one along it, metres.
    pub(super) apart_m: f64,
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
            longer_focus: [0.0; 2],
            patches: (0..self.cells.n_cells()).map(patch).collect(),
        }
    }

    /// How far views of one surface lie apart where they are: the mean of a cost that grows with the square of what is small beside the
    /// scale that agreeing ones scatter by, and hardly with what is large; `None` if too few see one.
    pub(super) fn disagreement(&self, views: &[View], along: Along) -> Option<f64> {
        let of_view = |index: usize| {
            let costs = self
                .pairs(views, index, along)
                .map(|pair| cost(pair.apart_m));
            costs.fold((0.0, 0), |(sum, n), cost| (sum + cost, n + 1))
        };
        let each: Vec<(f64, usize)> = (0..views.len()).into_par_iter().map(of_view).collect();
        let (sum, n) = each.iter().fold((0.0, 0), |(a, m), (b, n)| (a + b, m + n));
        (n >= MIN_PAIRS).then(|| sum / n as f64)
    }

    /// The patches of a view that other views have a patch of the same surface of, where they are seen, with each of these. Of two views
    /// one is asked, so that all of them are asked for every pair once.
    pub(super) fn pairs<'v>(
        &'v self,
        views: &'v [View],
        index: usize,
        along: Along,
    ) -> impl Iterator<Item = Pair> + 'v {
        let view = &views[index];
        let is_seen_in = move |k: usize| (k > index) == (k + index).is_multiple_of(2);
        let others = views.iter().enumerate();
        let others = others.filter(move |(k, _)| *k != index && is_seen_in(*k));
        others.flat_map(move |(k, other)| {
            let other_from_view = other.world_from_camera.inverse() * view.world_from_camera;
            let patches = view.patches.iter().flatten();
            patches.filter_map(move |patch| {
                let at = other_from_view * patch.centre;
                let camera = self.rays.camera();
                let [x, y] = other.longer_focus.map(|by| 1.0 + by);
                let pixel = camera.project(&Point3::new(x * at.x, y * at.y, at.z));
                let pixel = pixel.filter(|pixel| camera.contains(pixel, 0.0))?;
                let cell = self.cells.cell_of((pixel.x as usize, pixel.y as usize))?;
                let seen = other.patches[cell].as_ref()?;
                let turned = other_from_view.rotation.inverse() * seen.normal;
                if turned.dot(&patch.normal) < MIN_COSINE {
                    return None;
                }
                let (normals, levers) = match along {
                    Along::Other => ([turned, seen.normal], [patch.centre, at]),
                    Along::Midway => {
                        let normal = (turned + patch.normal) / (turned + patch.normal).norm();
                        let between = nalgebra::center(&at, &seen.centre);
                        let levers = [other_from_view.inverse() * between, between];
                        ([normal, other_from_view * normal], levers)
                    }
                };
                let pair = Pair {
                    other: k,
                    centres: [patch.centre, seen.centre],
                    apart_m: normals[1].dot(&(at - seen.centre)),
                    normals,
                    levers,
                };
                (pair.apart_m.abs() <= MAX_APART_M).then_some(pair)
            })
        })
    }
}

/// What it costs that a patch lies apart from another one, metres.
fn cost(apart_m: f64) -> f64 {
    (apart_m / SCALE_M).powi(2).ln_1p()
}

impl View {
    /// The same without a slow error of depth; planes stay as they are turned.
    pub(super) fn without(mut self, field: &SlowField) -> Self {
        for patch in self.patches.iter_mut().flatten() {
            patch.centre.coords *= 1.0 - field.share_at(&patch.centre);
        }
        self
    }

    /// The same seen with focal lengths that are longer by shares, across and down: narrower, and as deep.
    pub(super) fn with_longer_focus(mut self, by: [f64; 2]) -> Self {
        let [x, y] = by.map(|by| 1.0 + by);
        let across = Vector3::new(x, y, 1.0);
        for patch in self.patches.iter_mut().flatten() {
            patch.centre.coords.component_div_assign(&across);
            patch.normal.component_mul_assign(&across);
            patch.normal /= patch.normal.norm();
        }
        self.longer_focus = by;
        self
    }

    /// How far its patches are, metres.
    pub(super) fn ranges_m(&self) -> impl Iterator<Item = f64> + '_ {
        let patches = self.patches.iter().flatten();
        patches.map(|patch| patch.centre.coords.norm())
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
