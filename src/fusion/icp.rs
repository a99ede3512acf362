//! Tracking: projective point-to-plane ICP against the raycast model (Newcombe et al. 2011), then direct alignment to the
//! signed distances themselves (Bylow et al. 2013; Canelhas et al. 2013).
//!
//! Both accumulate 6×6 normal equations over fixed tiles of rows, summed in order, so that the result does not depend on
//! the number of threads.

use super::noise::DepthNoise;
use super::preprocess::{N_REDUCED, VertexMap};
use super::raycast::ModelMap;
use super::volume::TsdfVolume;
use crate::geometry::{CameraModel, Pose, increment};
use nalgebra::{Matrix6, Point3, Vector3, Vector6};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

/// Gates and iterations of the alignment.
#[derive(Clone, Debug, PartialEq, Deserialize, Serialize)]
#[serde(default, deny_unknown_fields)]
pub struct IcpParams {
    /// Iterations on the images reduced by 8, 4 and 2.
    pub iterations: [usize; 3],
    /// Farthest a pair of points may be apart, metres, at the images reduced by 8, 4 and 2.
    pub max_distance_m: [f64; 3],
    /// Largest angle between the normals of a pair, radians.
    pub max_normal_angle_rad: f64,
    /// Iterations of the direct alignment to the signed distances.
    pub sdf_iterations: usize,
}

impl Default for IcpParams {
    fn default() -> Self {
        IcpParams {
            iterations: [8, 6, 3],
            max_distance_m: [0.08, 0.04, 0.02],
            max_normal_angle_rad: 0.6,
            sdf_iterations: 6,
        }
    }
}

/// Normal equations of one iteration.
#[derive(Clone, Copy, Debug)]
pub(super) struct NormalEquations {
    pub(super) jtj: Matrix6<f64>,
    jtr: Vector6<f64>,
    /// Sum of weights and of weighted squared residuals (m²).
    pub(super) weight: f64,
    weighted_square: f64,
    n_points: usize,
    n_inliers: usize,
}

impl NormalEquations {
    pub(super) const ZERO: NormalEquations = NormalEquations {
        jtj: Matrix6::new(
            0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0,
            0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0,
            0.0, 0.0,
        ),
        jtr: Vector6::new(0.0, 0.0, 0.0, 0.0, 0.0, 0.0),
        weight: 0.0,
        weighted_square: 0.0,
        n_points: 0,
        n_inliers: 0,
    };

    fn merge(mut self, other: &NormalEquations) -> Self {
        self.jtj += other.jtj;
        self.jtr += other.jtr;
        self.weight += other.weight;
        self.weighted_square += other.weighted_square;
        self.n_points += other.n_points;
        self.n_inliers += other.n_inliers;
        self
    }

    /// Adds the residual `n·(p − q)` of a point p (relative to `centre`) with the plane normal n.
    pub(super) fn add(
        &mut self,
        lever: &Vector3<f64>,
        normal: &Vector3<f64>,
        residual: f64,
        weight: f64,
    ) {
        let torque = lever.cross(normal);
        let row = Vector6::new(torque.x, torque.y, torque.z, normal.x, normal.y, normal.z);
        self.jtj.syger(weight, &row, &row, 1.0);
        self.jtr += row * (weight * residual);
        self.weight += weight;
        self.weighted_square += weight * residual * residual;
        self.n_inliers += 1;
    }

    /// The left increment about `centre` that lowers the residuals, with a prior that holds what the data do not see.
    pub(super) fn solve(&self, centre: &Vector3<f64>) -> Option<Pose> {
        let mut jtj = self.jtj;
        jtj.fill_upper_triangle_with_lower_triangle();
        // A thousandth of a point's worth of prior: 1 rad and 1 m are far beyond any frame's motion.
        let prior = 1e-3 * self.weight / self.n_inliers.max(1) as f64;
        jtj += Matrix6::identity() * prior;
        let step = -jtj.cholesky()?.solve(&self.jtr);
        let about_centre = increment(&step);
        let shift = centre - about_centre.rotation * centre;
        let mut pose = about_centre;
        pose.translation.vector += shift;
        Some(pose)
    }

    /// Smallest over largest eigenvalue, levers scaled by `scale_m` so that angles and lengths compare.
    fn conditioning(&self, scale_m: f64) -> f64 {
        let mut jtj = self.jtj;
        jtj.fill_upper_triangle_with_lower_triangle();
        let s = 1.0 / scale_m;
        let scale = Matrix6::from_diagonal(&Vector6::new(s, s, s, 1.0, 1.0, 1.0));
        let eigenvalues = (scale * jtj * scale).symmetric_eigenvalues();
        eigenvalues.min().max(0.0) / eigenvalues.max().max(f64::MIN_POSITIVE)
    }
}

/// How well a frame fits the model.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Fit {
    /// Share of the frame's points that found their place on the model.
    pub inlier_share: f64,
    /// Weighted root mean square distance of the inliers to the model, metres.
    pub rmse_m: f64,
    /// Smallest over largest eigenvalue of the normal equations: near zero the geometry lets the camera slide.
    pub conditioning: f64,
    /// Share of the frame's points that lie behind a surface of the model: the camera would look through it.
    pub see_through_share: f64,
}

/// What the frame is aligned to.
pub struct Model<'a> {
    /// The model raycast from `world_from_camera`.
    pub map: &'a ModelMap,
    /// Camera of the map's pixels.
    pub map_camera: &'a CameraModel,
    /// The pose from which the map was cast.
    pub world_from_camera: &'a Pose,
    /// The volume itself.
    pub volume: &'a TsdfVolume,
}

/// Aligns a frame's vertex maps (finest first) to the model, from a first guess; `None` where nothing matches at all.
pub fn align(
    levels: &[VertexMap; N_REDUCED],
    model: &Model,
    guess: &Pose,
    noise: &DepthNoise,
    params: &IcpParams,
) -> Option<(Pose, Fit)> {
    let mut world_from_camera = *guess;
    for (coarse, &iterations) in params.iterations.iter().enumerate() {
        let level = &levels[N_REDUCED - 1 - coarse];
        for _ in 0..iterations {
            let gates = Gates {
                max_distance_m: params.max_distance_m[coarse] as f32,
                min_normal_cosine: params.max_normal_angle_rad.cos() as f32,
            };
            let equations = point_to_plane(level, model, &world_from_camera, noise, gates);
            let step = equations.solve(&world_from_camera.translation.vector)?;
            world_from_camera = step * world_from_camera;
            if is_small(&step) {
                break;
            }
        }
    }
    let mut equations = NormalEquations::ZERO;
    for _ in 0..params.sdf_iterations.max(1) {
        equations = point_to_distance(&levels[0], model.volume, &world_from_camera, noise);
        let step = equations.solve(&world_from_camera.translation.vector)?;
        world_from_camera = step * world_from_camera;
        if is_small(&step) {
            break;
        }
    }
    let fit = Fit {
        inlier_share: equations.n_inliers as f64 / equations.n_points.max(1) as f64,
        rmse_m: (equations.weighted_square / equations.weight.max(f64::MIN_POSITIVE)).sqrt(),
        conditioning: equations.conditioning(0.5),
        see_through_share: see_through_share(&levels[1], model, &world_from_camera),
    };
    Some((world_from_camera, fit))
}

/// Points this many truncation distances behind the model's surface count as seen through it.
const BEHIND_TRUNCATIONS: f64 = 2.0;

/// Share of a frame's points that lie behind the model's surface, as seen from where the model was raycast.
fn see_through_share(live: &VertexMap, model: &Model, world_from_camera: &Pose) -> f64 {
    let map_from_world = model.world_from_camera.inverse();
    let map_from_camera = map_from_world * world_from_camera;
    let margin = BEHIND_TRUNCATIONS * model.volume.truncation_m() as f64;
    let (mut n_seen, mut n_behind) = (0usize, 0usize);
    for point in live.points.data().iter().filter(|point| point.z > 0.0) {
        let point_map = map_from_camera * Point3::from(point.cast::<f64>());
        let Some(pixel) = model.map_camera.project(&point_map) else {
            continue;
        };
        if !model.map_camera.contains(&pixel, 0.0) {
            continue;
        }
        let (u, v) = ((pixel.x + 0.5) as usize, (pixel.y + 0.5) as usize);
        if *model.map.normals.at(u, v) == Vector3::zeros() {
            continue;
        }
        let surface = map_from_world * Point3::from(model.map.points.at(u, v).cast::<f64>());
        n_seen += 1;
        n_behind += usize::from(point_map.z > surface.z + margin);
    }
    n_behind as f64 / n_seen.max(1) as f64
}

/// A step below 1 µm and 1 µrad changes nothing that depth could see.
pub(super) fn is_small(step: &Pose) -> bool {
    step.translation.vector.norm() < 1e-6 && step.rotation.angle() < 1e-6
}

#[derive(Clone, Copy)]
struct Gates {
    max_distance_m: f32,
    min_normal_cosine: f32,
}

/// Huber weight: residuals beyond `delta` pull with constant force.
pub(super) fn huber(residual: f32, delta: f32) -> f32 {
    if residual.abs() <= delta {
        1.0
    } else {
        delta / residual.abs()
    }
}

/// Sums `tile_of(v)` over all rows, tile by tile in order.
pub(super) fn sum_rows(
    height: usize,
    row: impl Fn(usize, &mut NormalEquations) + Sync,
) -> NormalEquations {
    const TILE_ROWS: usize = 8;
    let tiles: Vec<NormalEquations> = (0..height.div_ceil(TILE_ROWS))
        .into_par_iter()
        .map(|tile| {
            let mut sum = NormalEquations::ZERO;
            for v in tile * TILE_ROWS..((tile + 1) * TILE_ROWS).min(height) {
                row(v, &mut sum);
            }
            sum
        })
        .collect();
    tiles
        .iter()
        .fold(NormalEquations::ZERO, NormalEquations::merge)
}

/// Residuals are Huber-weighted beyond this many sigmas of the depth noise.
pub(super) const HUBER_SIGMAS: f32 = 2.0;

fn point_to_plane(
    live: &VertexMap,
    model: &Model,
    world_from_camera: &Pose,
    noise: &DepthNoise,
    gates: Gates,
) -> NormalEquations {
    let map_from_world = model.world_from_camera.inverse();
    let map_from_camera = map_from_world * world_from_camera;
    let rotation = world_from_camera.rotation.to_rotation_matrix();
    let centre = world_from_camera.translation.vector;
    sum_rows(live.points.height(), |v, sum| {
        for (point, normal) in live.points.row(v).iter().zip(live.normals.row(v)) {
            if point.z <= 0.0 || *normal == Vector3::zeros() {
                continue;
            }
            sum.n_points += 1;
            let point_camera = Point3::from(point.cast::<f64>());
            let Some(pixel) = model.map_camera.project(&(map_from_camera * point_camera)) else {
                continue;
            };
            if !model.map_camera.contains(&pixel, 0.0) {
                continue;
            }
            let (u, v) = ((pixel.x + 0.5) as usize, (pixel.y + 0.5) as usize);
            let model_normal = *model.map.normals.at(u, v);
            let normal_world = rotation * normal.cast::<f64>();
            if (normal_world.dot(&model_normal.cast())) < gates.min_normal_cosine as f64 {
                continue;
            }
            let lever = rotation * point_camera.coords;
            let offset = lever + centre - model.map.points.at(u, v).cast::<f64>();
            if offset.norm_squared() > (gates.max_distance_m * gates.max_distance_m) as f64 {
                continue;
            }
            let normal = model_normal.cast::<f64>();
            let residual = normal.dot(&offset);
            let sigma = noise.sigma_m(point.z);
            let weight = huber(residual as f32, HUBER_SIGMAS * sigma) / (sigma * sigma);
            sum.add(&lever, &normal, residual, weight as f64);
        }
    })
}

fn point_to_distance(
    live: &VertexMap,
    volume: &TsdfVolume,
    world_from_camera: &Pose,
    noise: &DepthNoise,
) -> NormalEquations {
    let rotation = world_from_camera.rotation.to_rotation_matrix();
    let centre = world_from_camera.translation.vector;
    let reach = 0.9 * volume.truncation_m();
    sum_rows(live.points.height(), |v, sum| {
        for (point, normal) in live.points.row(v).iter().zip(live.normals.row(v)) {
            if point.z <= 0.0 || *normal == Vector3::zeros() {
                continue;
            }
            sum.n_points += 1;
            let lever = rotation * point.cast::<f64>();
            let point_world = lever + centre;
            let Some((distance, gradient)) = volume.sample_with_gradient(&point_world.cast())
            else {
                continue;
            };
            if distance.abs() > reach || gradient.norm_squared() < 0.25 {
                continue;
            }
            let sigma = noise.sigma_m(point.z);
            let weight = huber(distance, HUBER_SIGMAS * sigma) / (sigma * sigma);
            sum.add(&lever, &gradient.cast(), distance as f64, weight as f64);
        }
    })
}
