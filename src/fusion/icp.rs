//! Tracking: projective point-to-plane ICP against the raycast model (Newcombe et al. 2011).

use super::noise::DepthNoise;
use super::normal_equations::{Rows, huber_weight};
use super::points::{Points, Residuals, equations};
use super::pyramid::{FramePyramid, Level, N_REDUCED};
use super::raycast::ModelMap;
use crate::geometry::lanes::LANES;
use crate::geometry::{Lens, Pose, Rigid};
use nalgebra::Vector3;
use pulp::Arch;
use serde::{Deserialize, Serialize};

/// Gates and iterations of the alignment.
#[derive(Clone, Debug, PartialEq, Deserialize, Serialize)]
#[serde(default, deny_unknown_fields)]
pub struct IcpParams {
    /// Iterations on the images reduced by 8, 4 and 2; up to five times as many while steps are longer than 0.5 mm.
    pub iterations: [usize; 3],
    /// Farthest a pair of points may be apart, metres, at the images reduced by 8, 4 and 2.
    pub max_distance_m: [f64; 3],
    /// Largest angle between the normals of a pair, radians.
    pub max_normal_angle_rad: f64,
    /// Iterations of the direct alignment to the signed distances, on the images reduced by 8 and 4.
    pub sdf_iterations: [usize; 2],
}

impl Default for IcpParams {
    fn default() -> Self {
        IcpParams {
            iterations: [8, 6, 0],
            max_distance_m: [0.08, 0.04, 0.02],
            max_normal_angle_rad: 0.6,
            sdf_iterations: [4, 2],
        }
    }
}

/// The model as the frame is aligned to it.
#[derive(Clone, Copy)]
pub struct CastModel<'a> {
    /// The model raycast from `world_from_camera`.
    pub map: &'a ModelMap,
    /// Camera of the map's pixels.
    pub lens: &'a Lens,
    /// The pose from which the map was cast.
    pub world_from_camera: &'a Pose,
}

/// Aligns a frame to the raycast model from a first guess; `None` where nothing matches at all.
// A symbol of its own, by which tests/bench/instructions.sh counts.
#[inline(never)]
pub fn align(
    arch: Arch,
    frame: &FramePyramid,
    model: &CastModel,
    guess: &Pose,
    noise: &DepthNoise,
    params: &IcpParams,
) -> Option<Pose> {
    let mut world_from_camera = *guess;
    for (coarse, &iterations) in params.iterations.iter().enumerate() {
        let level = &frame.reduced[N_REDUCED - 1 - coarse];
        let gates = Gates {
            max_distance_squared: (params.max_distance_m[coarse] * params.max_distance_m[coarse])
                as f32,
            min_normal_cosine: params.max_normal_angle_rad.cos() as f32,
        };
        for iteration in 0..FAR_TIMES * iterations {
            let target = PointToPlane {
                model,
                world_from_camera: Rigid::new(&world_from_camera),
                map_from_camera: map_from_camera(model, &world_from_camera),
                noise,
                gates,
            };
            let equations = equations(arch, level, &target);
            let step = equations.solve(&world_from_camera.translation.vector)?;
            world_from_camera = step * world_from_camera;
            let last_step = if iteration + 1 < iterations {
                LAST_STEP
            } else {
                FAR_STEP
            };
            if is_below(&step, last_step) {
                break;
            }
        }
    }
    Some(world_from_camera)
}

/// A step below 10 µm and 10 µrad: the next level, or the next frame, sees more.
pub fn is_small(step: &Pose) -> bool {
    is_below(step, 1e-5)
}

/// The next level, or the distances, mend what is left after a step of 0.2 mm and 0.2 mrad.
const LAST_STEP: f64 = 2e-4;
/// After the iterations of a level it goes on only where the camera is still far off, up to so many times as many, until a step
/// is below 0.5 mm and 0.5 mrad: fast motion needs them, and where the shape hardly holds the camera more would let it slide.
const FAR_TIMES: usize = 5;
const FAR_STEP: f64 = 5e-4;

/// Whether a step is shorter than so many metres, and turns by less than as many radians.
fn is_below(step: &Pose, limit: f64) -> bool {
    step.translation.vector.norm() < limit && step.rotation.angle() < limit
}

/// Points this many voxels behind a surface count as seen through it. Not a share of the truncation distance: what depth
/// at the rim of a surface is off by does not shrink with the band.
pub const BEHIND_VOXELS: f32 = 10.0;

/// Share of a frame's points that lie behind the model's surface, as seen from where the model was raycast.
pub fn see_through_share(
    level: &Level,
    model: &CastModel,
    world_from_camera: &Pose,
    voxel_size_m: f32,
) -> f64 {
    let map_from_camera = map_from_camera(model, world_from_camera);
    let map_from_world = Rigid::new(&model.world_from_camera.inverse());
    let axis = Vector3::from(map_from_world.rows[2]);
    let offset = map_from_world.shift[2];
    let margin = BEHIND_VOXELS * voxel_size_m;
    let (mut n_seen, mut n_behind) = (0usize, 0usize);
    for pixel in 0..level.depth.len() {
        let point = level.point(pixel);
        if point[2] <= 0.0 {
            continue;
        }
        let point_map = map_from_camera.point(point);
        let cell = model.lens.pixel_index(point_map) as usize;
        let Some(normal) = model.map.normals.data().get(cell) else {
            continue;
        };
        if *normal == Vector3::zeros() {
            continue;
        }
        let surface_z = axis.dot(&model.map.points.data()[cell]) + offset;
        n_seen += 1;
        n_behind += usize::from(point_map[2] > surface_z + margin);
    }
    n_behind as f64 / n_seen.max(1) as f64
}

#[derive(Clone, Copy)]
struct Gates {
    max_distance_squared: f32,
    min_normal_cosine: f32,
}

/// A frame's pose, towards the camera from which the model was cast.
fn map_from_camera(model: &CastModel, world_from_camera: &Pose) -> Rigid {
    Rigid::new(&(model.world_from_camera.inverse() * world_from_camera))
}

struct PointToPlane<'a> {
    model: &'a CastModel<'a>,
    world_from_camera: Rigid,
    map_from_camera: Rigid,
    noise: &'a DepthNoise,
    gates: Gates,
}

impl Residuals for PointToPlane<'_> {
    #[allow(
        clippy::needless_range_loop,
        reason = "one index runs through all the lanes, which is what becomes vector code"
    )]
    #[inline(always)]
    fn residuals(&self, points: &Points, rows: &mut Rows) {
        let (world, map) = (&self.world_from_camera, &self.map_from_camera);
        let mut cells = [0; LANES];
        for i in 0..LANES {
            let point = [points.point[0][i], points.point[1][i], points.point[2][i]];
            cells[i] = self.model.lens.pixel_index(map.point(point));
            let lever = world.turn(point);
            for axis in 0..3 {
                rows.lever[axis][i] = lever[axis];
            }
        }
        let place;
        [place, rows.normal] = self.model.map.planes(&cells);
        for i in 0..LANES {
            let live = [
                points.normal[0][i],
                points.normal[1][i],
                points.normal[2][i],
            ];
            let live = world.turn(live);
            let (mut cosine, mut residual, mut squared) = (0.0, 0.0, 0.0);
            for axis in 0..3 {
                let offset = rows.lever[axis][i] + world.shift[axis] - place[axis][i];
                cosine += live[axis] * rows.normal[axis][i];
                residual += offset * rows.normal[axis][i];
                squared += offset * offset;
            }
            // Without a normal, of the frame or of the model, the cosine is 0.
            let counts = (cosine >= self.gates.min_normal_cosine)
                & (squared <= self.gates.max_distance_squared);
            let sigma = self.noise.sigma_m(points.point[2][i]);
            rows.residual[i] = residual;
            rows.weight[i] = if counts {
                huber_weight(residual, sigma)
            } else {
                0.0
            };
        }
    }
}
