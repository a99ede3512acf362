//! Directions in which the geometry lets the camera slide: along a plane, about the axis of a cylinder or a ball on a table.
//!
//! They are the eigenvectors of JᵀWJ whose eigenvalues are small (Zhang et al. 2016). So that angles and lengths compare, the
//! increment is taken about the middle of the points, and angles are multiplied by how far the points lie from it.
//!
//! Noise of the normals holds what no shape does: it adds as much to the turn of a ball on a table as the shape of a bust from
//! behind. So each point's two normals, that of the frame and that of the model there, make one factor each of its part, as
//! (a bᵀ + b aᵀ)/2: their noise has nothing in common and has no mean in the product, whose eigenvalues may come out below 0.
//! What is left of it in one frame, some 0.0003, is a third of that in the mean of the last ones.
//!
//! The frame's normals are those of a coarse level.

use super::eye::Eye;
use super::noise::DepthNoise;
use super::normal_equations::{NormalEquations, Rows};
use super::points::{self, Points, Residuals};
use super::pyramid::{Level, N_REDUCED};
use super::sdf_alignment::{Answer, Ask};
use super::volume::TsdfVolume;
use crate::geometry::lanes::LANES;
use crate::geometry::{Pose, increment};
use nalgebra::{Matrix3, Matrix6, Vector3, Vector6};

/// Below this mean square share of the residuals' direction a motion is not held by the geometry. A simulated ball and a cylinder on
/// a table have 0.0002 at most, a wall 0.0001; recorded objects and a desk 0.0033 at least.
pub const MAX_DEGENERATE_SHARE: f64 = 0.001;

/// Below this share a view is kept to hold the frames to come: geometry is lost over several frames.
pub const HARDLY_HELD_SHARE: f64 = 3.0 * MAX_DEGENERATE_SHARE;

/// How far a hand lets the camera be from where its motion leads within a frame, metres, along directions that nothing holds.
const START_SIGMA_M: f64 = 0.005;

/// A change of variables: increments about the middle of the points, angles times their spread (m).
#[derive(Clone, Copy, Debug)]
struct Scaling {
    /// An increment about the camera's centre from a scaled one.
    centre_from_scaled: Matrix6<f64>,
}

impl Scaling {
    /// The scaling of points with their middle so far from the camera's centre (world axes, m) and so widely spread (m).
    fn new(lever: &Vector3<f64>, spread_m: f64) -> Self {
        // About the middle m, ω × (x − m) + t; about the centre, with the lever m: t grows by m × ω.
        let mut centre_from_scaled = Matrix6::identity();
        let turn = Matrix3::identity() / spread_m;
        centre_from_scaled
            .fixed_view_mut::<3, 3>(0, 0)
            .copy_from(&turn);
        centre_from_scaled
            .fixed_view_mut::<3, 3>(3, 0)
            .copy_from(&(lever.cross_matrix() * turn));
        Scaling { centre_from_scaled }
    }

    fn hessian(&self, equations: &NormalEquations) -> Matrix6<f64> {
        self.centre_from_scaled.transpose() * equations.jtj() * self.centre_from_scaled
    }

    fn gradient(&self, equations: &NormalEquations) -> Vector6<f64> {
        self.centre_from_scaled.transpose() * equations.jtr()
    }
}

/// Frames in the mean: the camera sees the same by then, from a little farther on.
const N_FRAMES: f64 = 10.0;
/// With fewer frames nothing is said to be free: a model of two frames is mostly noise.
const MIN_FRAMES: f64 = 3.0;

/// How the geometry of the last frames held the camera.
#[derive(Clone, Copy, Debug)]
pub struct Degeneracy {
    /// Of the last frame.
    scaling: Scaling,
    /// JᵀWJ by scaled increments as a share of the weight, mean of so many frames.
    shares: Matrix6<f64>,
    n_frames: f64,
    /// Projects scaled increments onto the directions that are not held.
    free: Matrix6<f64>,
    is_free: bool,
    /// The least eigenvalue of the shares, 0 to 1.
    least_share: f64,
}

impl Degeneracy {
    /// Whether there are directions that are not held.
    pub fn is_free(&self) -> bool {
        self.is_free
    }

    /// The least share with which a motion is held, 0 to 1.
    pub fn least_share(&self) -> f64 {
        self.least_share
    }

    /// With the frame in hand, seen from its pose, and the model, which does not have that frame yet; `None` as long as nothing is
    /// seen of the model.
    pub fn after(
        before: Option<&Self>,
        eye: &Eye,
        volume: &TsdfVolume,
        world_from_camera: &Pose,
    ) -> Option<Self> {
        let (arch, noise, level) = (eye.arch, &eye.noise, shape_level(&eye.frame.reduced));
        let rotation = world_from_camera.rotation.to_rotation_matrix();
        let normals = |of_model| TwoNormals {
            ask: Ask::new(volume, world_from_camera),
            noise,
            of_model,
        };
        let half_sum = points::equations(arch, level, &normals(0.5));
        if half_sum.weight() == 0.0 {
            return before.copied();
        }
        let half_difference = points::equations(arch, level, &normals(-0.5));
        let points = || {
            (0..level.depth.len()).filter_map(|pixel| {
                let point = Vector3::from(level.point(pixel));
                // Facing the camera, or none.
                (level.normals[2][pixel] < 0.0).then(|| {
                    let weight = f64::from(noise.sigma_m(point.z)).powi(-2);
                    (rotation * point.cast(), weight)
                })
            })
        };
        let weight: f64 = points().map(|(_, weight)| weight).sum();
        let middle: Vector3<f64> = points().map(|(p, w)| p * w).sum::<Vector3<f64>>() / weight;
        let square: f64 = points().map(|(p, w)| (p - middle).norm_squared() * w).sum();
        let scaling = Scaling::new(&middle, (square / weight).sqrt().max(1e-3));
        let common = scaling.hessian(&half_sum) - scaling.hessian(&half_difference);
        let now = common / half_sum.weight();
        let (shares, n_frames) = match before {
            Some(before) => {
                let n_frames = (before.n_frames + 1.0).min(N_FRAMES);
                (before.shares + (now - before.shares) / n_frames, n_frames)
            }
            None => (now, 1.0),
        };
        let eigen = shares.symmetric_eigen();
        let is_known = n_frames >= MIN_FRAMES;
        let pairs = eigen
            .eigenvalues
            .iter()
            .zip(eigen.eigenvectors.column_iter());
        let free = pairs.filter(|(share, _)| is_known && **share < MAX_DEGENERATE_SHARE);
        let free: Vec<Matrix6<f64>> = free
            .map(|(_, vector)| vector * vector.transpose())
            .collect();
        Some(Degeneracy {
            scaling,
            shares,
            n_frames,
            free: free.iter().sum(),
            is_free: !free.is_empty(),
            least_share: match is_known {
                true => eigen.eigenvalues.min().max(0.0),
                false => 1.0,
            },
        })
    }

    /// The left increment that lowers the geometry's residuals in the directions that it holds, and those of the images in
    /// the others; about the centre of the camera.
    pub fn solve(
        &self,
        geometry: &NormalEquations,
        images: &NormalEquations,
        centre: &Vector3<f64>,
    ) -> Option<Pose> {
        let held = Matrix6::identity() - self.free;
        let hessian =
            held * self.scaling.hessian(geometry) + self.free * self.scaling.hessian(images);
        let gradient =
            held * self.scaling.gradient(geometry) + self.free * self.scaling.gradient(images);
        // A direction that the images do not hold either stays where the geometry has left it.
        let prior = Matrix6::identity() * START_SIGMA_M.powi(-2);
        let scaled = -(hessian + prior).lu().solve(&gradient)?;
        let about_centre = increment(&(self.scaling.centre_from_scaled * scaled));
        let shift = centre - about_centre.rotation * centre;
        let mut pose = about_centre;
        pose.translation.vector += shift;
        Some(pose)
    }
}

/// The level whose normals tell what the geometry holds: the coarsest that still shows the scene's shape.
fn shape_level(levels: &[Level; N_REDUCED]) -> &Level {
    /// A Kinect II has 3392 pixels reduced by 8; with a quarter of that a plaque looks like a wall.
    const MIN_PIXELS: usize = 2000;
    let coarse = levels.iter().rev();
    let mut detailed = coarse.filter(|level| level.depth.len() >= MIN_PIXELS);
    detailed.next().unwrap_or(&levels[0])
}

/// Half the sum of a point's normals, or half their difference, as the direction of a residual that is 0.
struct TwoNormals<'a> {
    ask: Ask<'a>,
    noise: &'a DepthNoise,
    /// Factor of the model's normal, ±½; the frame's has ½.
    of_model: f32,
}

impl Residuals for TwoNormals<'_> {
    #[inline(always)]
    fn residuals(&self, points: &Points, rows: &mut Rows) {
        let Answer { model, normals } = self.ask.about(points, &mut rows.lever);
        let [gx, gy, gz] = &model.gradient;
        let [nx, ny, nz] = &normals;
        let mut scale = [0.0; LANES];
        for i in 0..LANES {
            let squared = gx[i] * gx[i] + gy[i] * gy[i] + gz[i] * gz[i];
            let along = gx[i] * nx[i] + gy[i] * ny[i] + gz[i] * nz[i];
            // Beyond the band, and on the other side of something thin, there is no second normal.
            let counts = (squared >= 0.25) & (along > 0.0);
            let sigma = self.noise.sigma_m(points.point[2][i]);
            rows.weight[i] = if counts { 1.0 / (sigma * sigma) } else { 0.0 };
            let unit = self.of_model / squared.sqrt();
            scale[i] = if counts { unit } else { 0.0 };
        }
        let planes = rows.normal.iter_mut().zip(&normals).zip(&model.gradient);
        for ((sum, normal), gradient) in planes {
            for i in 0..LANES {
                sum[i] = 0.5 * normal[i] + scale[i] * gradient[i];
            }
        }
        rows.residual = [0.0; LANES];
    }
}
