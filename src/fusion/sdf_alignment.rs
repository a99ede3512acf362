//! Direct alignment of a frame to the signed distances (Bylow et al. 2013; Canelhas et al. 2013).
//!
//! The residual of a point is the distance that the volume keeps at its place, the derivative the gradient there, so that
//! neither a raycast nor a pairing comes between frame and model. It needs a start within the truncation distance.

use super::icp::is_small;
use super::noise::DepthNoise;
use super::normal_equations::{NormalEquations, Rows, huber_weight};
use super::points::{self, Points, Residuals};
use super::pyramid::{Level, N_REDUCED};
use super::sampling::Samples;
use super::volume::TsdfVolume;
use crate::geometry::lanes::{LANES, Lane};
use crate::geometry::{Pose, Rigid};
use pulp::Arch;

/// Aligns a frame to the volume from a first guess, on the images reduced by 8 and then by 4, with so many iterations at
/// most on each. Returns the pose and the equations of the last iteration; `None` where nothing matches at all.
// A symbol of its own, by which tests/bench/instructions.sh counts.
#[inline(never)]
pub fn align(
    arch: Arch,
    levels: &[Level; N_REDUCED],
    volume: &TsdfVolume,
    guess: &Pose,
    noise: &DepthNoise,
    iterations: [usize; 2],
) -> Option<(Pose, NormalEquations)> {
    let mut world_from_camera = *guess;
    let mut last = None;
    for (level, n) in [&levels[2], &levels[1]].into_iter().zip(iterations) {
        for _ in 0..n {
            let equations = equations(
                arch,
                level,
                volume,
                &world_from_camera,
                noise,
                Slopes::Model,
            );
            let step = equations.solve(&world_from_camera.translation.vector)?;
            world_from_camera = step * world_from_camera;
            last = Some(equations);
            if is_small(&step) {
                break;
            }
        }
    }
    last.map(|equations| (world_from_camera, equations))
}

/// Whose normals say how a distance changes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Slopes {
    /// The gradients of the model's distances: exact to the voxel, but a young model's are 20° and more off.
    Model,
    /// The frame's normals, 2° off on a coarse level: what is held a little is found by them in a few steps.
    Frame,
}

/// The residuals of a level at a pose.
pub fn equations(
    arch: Arch,
    level: &Level,
    volume: &TsdfVolume,
    world_from_camera: &Pose,
    noise: &DepthNoise,
    slopes: Slopes,
) -> NormalEquations {
    let target = PointToDistance {
        ask: Ask::new(volume, world_from_camera),
        noise,
        slopes,
    };
    points::equations(arch, level, &target)
}

/// A volume that is asked about the points of a frame.
pub struct Ask<'a> {
    volume: &'a TsdfVolume,
    world_from_camera: Rigid,
}

impl<'a> Ask<'a> {
    /// About frames taken from a pose.
    pub fn new(volume: &'a TsdfVolume, world_from_camera: &Pose) -> Self {
        Ask {
            volume,
            world_from_camera: Rigid::new(world_from_camera),
        }
    }

    /// Distances and their gradients at some points; sets their places from the camera's centre, world axes.
    #[inline(always)]
    pub fn about(&self, points: &Points, lever: &mut [Lane; 3]) -> Samples {
        *lever = self.in_world(&points.point);
        let mut places = *lever;
        for (place, centre) in places.iter_mut().zip(self.world_from_camera.shift) {
            place.iter_mut().for_each(|place| *place += centre);
        }
        let mut wanted = [false; LANES];
        for (wanted, z) in wanted.iter_mut().zip(&points.normal[2]) {
            *wanted = *z < 0.0;
        }
        self.volume.sample_lanes(&places, &wanted)
    }

    /// Vectors of the camera's axes by those of the world.
    #[inline(always)]
    pub fn in_world(&self, vectors: &[Lane; 3]) -> [Lane; 3] {
        let mut turned = [[0.0; LANES]; 3];
        for i in 0..LANES {
            let vector = [vectors[0][i], vectors[1][i], vectors[2][i]];
            let vector = self.world_from_camera.turn(vector);
            for axis in 0..3 {
                turned[axis][i] = vector[axis];
            }
        }
        turned
    }

    /// Whether a distance is measured, by it and the square of its gradient: at the band's ends it is cut off and its gradient
    /// falls; where nothing was seen it is 0.
    #[inline(always)]
    pub fn is_in_band(&self, distance: f32, squared_gradient: f32) -> bool {
        (distance.abs() <= 0.9 * self.volume.truncation_m()) & (squared_gradient >= 0.25)
    }
}

struct PointToDistance<'a> {
    ask: Ask<'a>,
    noise: &'a DepthNoise,
    slopes: Slopes,
}

impl Residuals for PointToDistance<'_> {
    #[inline(always)]
    fn residuals(&self, points: &Points, rows: &mut Rows) {
        let model = self.ask.about(points, &mut rows.lever);
        for (i, squared) in model.squared_gradient().into_iter().enumerate() {
            let distance = model.distance[i];
            let sigma = self.noise.sigma_m(points.point[2][i]);
            rows.weight[i] = if self.ask.is_in_band(distance, squared) {
                huber_weight(distance, sigma)
            } else {
                0.0
            };
        }
        rows.residual = model.distance;
        rows.normal = match self.slopes {
            Slopes::Model => model.gradient,
            Slopes::Frame => self.ask.in_world(&points.normal),
        };
    }
}
