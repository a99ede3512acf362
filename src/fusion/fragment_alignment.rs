//! Where one fragment stands against another: point-to-plane alignment, and whether both can be true of one scene.

use super::eye::Eye;
use super::fragments::{FRAGMENT_LEVEL, Fragment};
use super::icp::{is_small, rows, turn};
use super::normal_equations::{NormalEquations, Rows, TileSums, huber_weight};
use super::raycast::ModelMap;
use crate::geometry::Lens;
use crate::geometry::Pose;
use crate::geometry::lanes::LANES;
use nalgebra::{Matrix6, Vector3};

/// How a fragment stands against another.
#[derive(Clone, Debug)]
pub(super) struct Alignment {
    /// Where the source's anchor stands in the frame of the target's.
    pub target_from_source: Pose,
    /// Mean square distance, point to plane, by a left increment of the pose: m² per (rad, m)².
    pub curvature: Matrix6<f64>,
    /// What both see.
    pub overlap: Overlap,
}

/// What two fragments see of one another's surface.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(super) struct Overlap {
    /// Points of the one fragment.
    pub n_points: usize,
    /// Points that lie on the other's surface.
    pub n_shared: usize,
    /// Points through which the other one has looked: they stand in front of what it measured.
    pub n_looked_through: usize,
}

impl Overlap {
    /// Share of the points that lie on the other's surface.
    pub fn shared_share(&self) -> f64 {
        self.n_shared as f64 / self.n_points.max(1) as f64
    }

    /// Share of the points that the other one has looked through among those that it could judge.
    pub fn looked_through_share(&self) -> f64 {
        self.n_looked_through as f64 / (self.n_shared + self.n_looked_through).max(1) as f64
    }

    fn plus(self, other: Overlap) -> Overlap {
        Overlap {
            n_points: self.n_points + other.n_points,
            n_shared: self.n_shared + other.n_shared,
            n_looked_through: self.n_looked_through + other.n_looked_through,
        }
    }
}

/// Largest distance of a pair of points, metres: what a full turn drifts, then what noise and slant leave.
const MAX_DISTANCE_M: [f32; 3] = [0.04, 0.02, 0.01];
/// Iterations at each of them, at most.
const ITERATIONS: usize = 8;
/// One row in so many, and one column: averaged surfaces have little noise left that more points would take off.
const POINT_STEP: usize = 2;
/// Largest angle between the normals of a pair: 40°.
const MIN_NORMAL_COSINE: f32 = 0.766;

/// Aligns one fragment to another from a first guess; `None` where they have no surface in common.
pub(super) fn align(
    source: &Fragment,
    target: &Fragment,
    guess: &Pose,
    eye: &Eye,
    margin_m: f32,
) -> Option<Alignment> {
    let mut target_from_source = *guess;
    let mut last = None;
    for max_distance_m in MAX_DISTANCE_M {
        for _ in 0..ITERATIONS {
            let moved = Moved::new(&target_from_source);
            let equations = point_to_plane(&source.map, &target.map, &moved, eye, max_distance_m);
            let step = equations.solve(&Vector3::zeros())?;
            target_from_source = step * target_from_source;
            last = Some(equations);
            if is_small(&step) {
                break;
            }
        }
    }
    Some(Alignment {
        target_from_source,
        curvature: last?.mean_curvature(),
        overlap: mutual_overlap(source, target, &target_from_source, eye, margin_m),
    })
}

/// A relative pose in single precision.
struct Moved {
    rotation: [[f32; 3]; 3],
    translation: [f32; 3],
}

impl Moved {
    fn new(pose: &Pose) -> Self {
        Moved {
            rotation: rows(pose.rotation.to_rotation_matrix().matrix()),
            translation: pose.translation.vector.cast::<f32>().into(),
        }
    }

    fn point(&self, point: &Vector3<f32>) -> Vector3<f32> {
        turn(&self.rotation, point.as_ref(), &self.translation).into()
    }

    fn normal(&self, normal: &Vector3<f32>) -> Vector3<f32> {
        turn(&self.rotation, normal.as_ref(), &[0.0; 3]).into()
    }
}

/// Rows of points that are summed in one go.
const TILE_ROWS: usize = 8;

fn point_to_plane(
    source: &ModelMap,
    target: &ModelMap,
    moved: &Moved,
    eye: &Eye,
    max_distance_m: f32,
) -> NormalEquations {
    let (width, height) = (source.points.width(), source.points.height());
    let n_rows = height.div_ceil(POINT_STEP);
    NormalEquations::of_tiles(n_rows.div_ceil(TILE_ROWS), |tile| {
        let (mut sums, mut rows, mut n_filled) = (TileSums::ZERO, Rows::EMPTY, 0);
        for row in tile * TILE_ROWS..((tile + 1) * TILE_ROWS).min(n_rows) {
            for u in (0..width).step_by(POINT_STEP) {
                let pixel = row * POINT_STEP * width + u;
                let pair = pair_of(source, pixel, target, moved, eye, max_distance_m);
                let Some((point, normal, residual, weight)) = pair else {
                    continue;
                };
                rows.set(n_filled, &point, &normal, residual, weight);
                n_filled += 1;
                if n_filled == LANES {
                    sums.add(&rows);
                    (rows, n_filled) = (Rows::EMPTY, 0);
                }
            }
        }
        sums.add(&rows);
        sums
    })
}

/// The moved point of a pixel, the normal of the target where it comes to lie, its distance and weight.
fn pair_of(
    source: &ModelMap,
    pixel: usize,
    target: &ModelMap,
    moved: &Moved,
    eye: &Eye,
    max_distance_m: f32,
) -> Option<(Vector3<f32>, Vector3<f32>, f32, f32)> {
    let (point, normal) = (&source.points.data()[pixel], &source.normals.data()[pixel]);
    if *normal == Vector3::zeros() {
        return None;
    }
    let place = moved.point(point);
    let (plane_point, plane_normal) = seen_at(target, lens(eye), &place)?;
    let offset = place - plane_point;
    if moved.normal(normal).dot(plane_normal) < MIN_NORMAL_COSINE
        || offset.norm_squared() > max_distance_m * max_distance_m
    {
        return None;
    }
    let residual = plane_normal.dot(&offset);
    let incidence = cosine(point, normal) * cosine(plane_point, plane_normal);
    let weight = incidence * huber_weight(residual, eye.noise.sigma_m(point.z));
    Some((place, *plane_normal, residual, weight))
}

fn lens(eye: &Eye) -> &Lens {
    &eye.level(FRAGMENT_LEVEL).lens
}

/// Point and normal of a map in the pixel in which a point lies, if it has a surface there.
fn seen_at<'a>(
    map: &'a ModelMap,
    lens: &Lens,
    point: &Vector3<f32>,
) -> Option<(&'a Vector3<f32>, &'a Vector3<f32>)> {
    let pixel = lens.pixel_index((*point).into()) as usize;
    let normal = map.normals.data().get(pixel)?;
    (*normal != Vector3::zeros()).then(|| (&map.points.data()[pixel], normal))
}

/// Cosine of the incidence at which a point was seen.
fn cosine(point: &Vector3<f32>, normal: &Vector3<f32>) -> f32 {
    (-normal.dot(point) / point.norm()).max(0.0)
}

/// What two fragments see of one another at a relative pose, both ways. Points within `margin_m` of what the other one
/// measured are shared, points farther in front of it were looked through; what is hidden behind it tells nothing.
pub(super) fn mutual_overlap(
    source: &Fragment,
    target: &Fragment,
    target_from_source: &Pose,
    eye: &Eye,
    margin_m: f32,
) -> Overlap {
    let (forth, back) = (target_from_source, target_from_source.inverse());
    overlap(&source.map, &target.map, forth, lens(eye), margin_m).plus(overlap(
        &target.map,
        &source.map,
        &back,
        lens(eye),
        margin_m,
    ))
}

fn overlap(
    source: &ModelMap,
    target: &ModelMap,
    target_from_source: &Pose,
    lens: &Lens,
    margin_m: f32,
) -> Overlap {
    /// One row in so many, and one column, tells as much as all.
    const STEP: usize = 4;
    let moved = Moved::new(target_from_source);
    let mut overlap = Overlap::default();
    for v in (0..source.points.height()).step_by(STEP) {
        for u in (0..source.points.width()).step_by(STEP) {
            if *source.normals.at(u, v) == Vector3::zeros() {
                continue;
            }
            overlap.n_points += 1;
            let place = moved.point(source.points.at(u, v));
            let Some((surface, _)) = seen_at(target, lens, &place) else {
                continue;
            };
            let in_front_m = surface.z - place.z;
            overlap.n_looked_through += usize::from(in_front_m > margin_m);
            overlap.n_shared += usize::from(in_front_m.abs() <= margin_m);
        }
    }
    overlap
}
