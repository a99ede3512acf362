//! Where one fragment stands against another: point-to-plane alignment, and whether both can be true of one scene.

use super::Eye;
use super::fragments::{FRAGMENT_LEVEL, Fragment};
use super::icp::{HUBER_SIGMAS, NormalEquations, huber, is_small, sum_rows};
use super::preprocess::VertexMap;
use crate::geometry::{CameraModel, Pose};
use nalgebra::{Matrix6, Point3, Vector3};

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
const MAX_DISTANCE_M: [f64; 3] = [0.04, 0.02, 0.01];
/// Iterations at each of them, at most.
const ITERATIONS: usize = 8;
/// One row in so many, and one column: averaged surfaces have little noise left that more points would take off.
const POINT_STEP: usize = 2;
/// Largest angle between the normals of a pair: 40°.
const MIN_NORMAL_COSINE: f64 = 0.766;

/// Aligns one fragment to another from a first guess; `None` where they have no surface in common.
pub(super) fn align(
    source: &Fragment,
    target: &Fragment,
    guess: &Pose,
    eye: &Eye,
    margin_m: f64,
) -> Option<Alignment> {
    let mut target_from_source = *guess;
    let mut equations = NormalEquations::ZERO;
    for max_distance_m in MAX_DISTANCE_M {
        for _ in 0..ITERATIONS {
            let pose = &target_from_source;
            equations = point_to_plane(&source.map, &target.map, pose, eye, max_distance_m);
            let step = equations.solve(&Vector3::zeros())?;
            target_from_source = step * target_from_source;
            if is_small(&step) {
                break;
            }
        }
    }
    let mut curvature = equations.jtj / equations.weight;
    curvature.fill_upper_triangle_with_lower_triangle();
    Some(Alignment {
        target_from_source,
        curvature,
        overlap: mutual_overlap(source, target, &target_from_source, eye, margin_m),
    })
}

fn point_to_plane(
    source: &VertexMap,
    target: &VertexMap,
    target_from_source: &Pose,
    eye: &Eye,
    max_distance_m: f64,
) -> NormalEquations {
    let camera = eye.rays.reduced(FRAGMENT_LEVEL).camera();
    let rotation = target_from_source.rotation.to_rotation_matrix();
    sum_rows(source.points.height() / POINT_STEP, |v, sum| {
        let (points, normals) = (
            source.points.row(v * POINT_STEP),
            source.normals.row(v * POINT_STEP),
        );
        for (point, normal) in points.iter().zip(normals).step_by(POINT_STEP) {
            if *normal == Vector3::zeros() {
                continue;
            }
            let moved = target_from_source * Point3::from(point.cast::<f64>());
            let Some((u, v)) = pixel_of(camera, &moved) else {
                continue;
            };
            let plane_normal = target.normals.at(u, v).cast::<f64>();
            if (rotation * normal.cast::<f64>()).dot(&plane_normal) < MIN_NORMAL_COSINE {
                continue;
            }
            let plane_point = target.points.at(u, v).cast::<f64>();
            let offset = moved.coords - plane_point;
            if offset.norm_squared() > max_distance_m * max_distance_m {
                continue;
            }
            let residual = plane_normal.dot(&offset);
            let sigma = eye.noise.sigma_m(point.z);
            let incidence =
                cosine(point, normal) * cosine(target.points.at(u, v), target.normals.at(u, v));
            let weight = incidence * huber(residual as f32, HUBER_SIGMAS * sigma) / (sigma * sigma);
            sum.add(&moved.coords, &plane_normal, residual, weight as f64);
        }
    })
}

/// Cosine of the incidence at which a point was seen.
fn cosine(point: &Vector3<f32>, normal: &Vector3<f32>) -> f32 {
    (-normal.dot(point) / point.norm()).max(0.0)
}

fn pixel_of(camera: &CameraModel, point: &Point3<f64>) -> Option<(usize, usize)> {
    let pixel = camera.project(point)?;
    camera
        .contains(&pixel, 0.0)
        .then(|| ((pixel.x + 0.5) as usize, (pixel.y + 0.5) as usize))
}

/// What two fragments see of one another at a relative pose, both ways. Points within `margin_m` of what the other one
/// measured are shared, points farther in front of it were looked through; what is hidden behind it tells nothing.
pub(super) fn mutual_overlap(
    source: &Fragment,
    target: &Fragment,
    target_from_source: &Pose,
    eye: &Eye,
    margin_m: f64,
) -> Overlap {
    let camera = eye.rays.reduced(FRAGMENT_LEVEL).camera();
    let forth = overlap(
        &source.map,
        &target.map,
        target_from_source,
        camera,
        margin_m,
    );
    let back = target_from_source.inverse();
    forth.plus(overlap(&target.map, &source.map, &back, camera, margin_m))
}

fn overlap(
    source: &VertexMap,
    target: &VertexMap,
    target_from_source: &Pose,
    camera: &CameraModel,
    margin_m: f64,
) -> Overlap {
    /// One row in so many, and one column, tells as much as all.
    const STEP: usize = 4;
    let mut overlap = Overlap::default();
    for v in (0..source.points.height()).step_by(STEP) {
        for u in (0..source.points.width()).step_by(STEP) {
            if *source.normals.at(u, v) == Vector3::zeros() {
                continue;
            }
            overlap.n_points += 1;
            let moved = target_from_source * Point3::from(source.points.at(u, v).cast::<f64>());
            let Some((u, v)) = pixel_of(camera, &moved) else {
                continue;
            };
            if *target.normals.at(u, v) == Vector3::zeros() {
                continue;
            }
            let in_front_m = f64::from(target.points.at(u, v).z) - moved.z;
            overlap.n_looked_through += usize::from(in_front_m > margin_m);
            overlap.n_shared += usize::from(in_front_m.abs() <= margin_m);
        }
    }
    overlap
}
