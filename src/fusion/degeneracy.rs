//! Directions in which the geometry lets the camera slide: along a plane, about the axis of a cylinder or a ball on a table.
//!
//! They are the eigenvectors of JᵀWJ whose eigenvalues are small (Zhang et al. 2016). So that angles and lengths compare, the
//! increment is taken about the middle of the points, and angles are multiplied by how far the points lie from it.
//!
//! A frame's normals tell at once, but their noise holds what no shape does: it adds as much to the turn of a ball on a table as
//! the shape of a bust from behind. So where they find the camera held, what they have in common with the model's is asked as
//! well ([`CommonShape`]). All normals are those of a coarse level.

use super::eye::Eye;
use super::noise::DepthNoise;
use super::normal_equations::{NormalEquations, Rows};
use super::points::{self, Points, Residuals};
use super::pyramid::{Level, N_REDUCED};
use super::sdf_alignment::Ask;
use super::volume::TsdfVolume;
use crate::geometry::lanes::LANES;
use crate::geometry::{Pose, increment_about, point_to_plane_row};
use nalgebra::{Matrix3, Matrix6, Vector3, Vector6};

/// Below this mean square share of the residuals' direction a motion is not held by the geometry. By the frame's normals sensor noise
/// alone makes 0.0003 of a wall and 0.0008 to 0.0012 of a ball on a table; recorded objects have 0.0010 at least. By what they have in
/// common with the model's these have 0.0033 at least, a simulated ball and a cylinder on a table 0.0004 at most.
pub const MAX_DEGENERATE_SHARE: f64 = 0.0008;

/// Below this share a view is kept to hold the frames to come: geometry is lost over several frames.
pub const HARDLY_HELD_SHARE: f64 = 3.0 * MAX_DEGENERATE_SHARE;

/// Steps are damped as if they were known to be no longer than this, metres: where the images hold nothing, either, nothing moves.
const DAMPING_M: f64 = 0.005;

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

/// Weighted points of a frame, world axes: where their middle is and how far they lie from it.
#[derive(Clone, Copy, Debug)]
struct Extent {
    /// World frame, metres.
    middle: Vector3<f64>,
    spread_m: f64,
}

impl Extent {
    /// Of points of the world, with their normals and weights; `None` of nothing.
    fn of(points: impl Iterator<Item = Weighted>) -> Option<Self> {
        let (mut sum, mut square, mut weight) = (Vector3::zeros(), 0.0, 0.0);
        for (point, _, w) in points {
            sum += point * w;
            square += point.norm_squared() * w;
            weight += w;
        }
        let middle = sum / weight;
        (weight > 0.0).then(|| Extent {
            middle,
            spread_m: (square / weight - middle.norm_squared()).max(1e-6).sqrt(),
        })
    }

    /// The scaling about it for increments about a camera's centre.
    fn scaling(&self, centre: &Vector3<f64>) -> Scaling {
        Scaling::new(&(self.middle - centre), self.spread_m)
    }

    /// Scaled increments about this from the same ones about another.
    fn from(&self, other: &Extent) -> Matrix6<f64> {
        let mut this_from_other = Matrix6::identity();
        let turn = Matrix3::identity() / other.spread_m;
        this_from_other
            .fixed_view_mut::<3, 3>(0, 0)
            .copy_from(&(turn * self.spread_m));
        this_from_other
            .fixed_view_mut::<3, 3>(3, 0)
            .copy_from(&((other.middle - self.middle).cross_matrix() * turn));
        this_from_other
    }
}

/// What the frames' normals and the model's have in common, over the last frames.
///
/// Each point's two normals make one factor each of its part of JᵀWJ, as (a bᵀ + b aᵀ)/2: their noise has nothing in common and has
/// no mean in the product, whose eigenvalues may come out below 0. What is left of it in one frame, some 0.0003, is less in a mean.
#[derive(Clone, Copy, Debug)]
pub struct CommonShape {
    extent: Extent,
    /// JᵀWJ by scaled increments as a share of the weight, mean of so many frames, and then one that forgets.
    shares: Matrix6<f64>,
    n_frames: f64,
}

impl CommonShape {
    /// Frames in the mean: the camera sees the same by then, from a little farther on.
    const N_FRAMES: f64 = 10.0;
    /// With fewer frames nothing is said: a model of two frames is mostly noise.
    const MIN_FRAMES: f64 = 3.0;

    /// With the frame in hand, seen from its pose, and the model, which does not have that frame yet; `None` as long as nothing is
    /// seen of the model.
    pub fn after(
        before: Option<&Self>,
        eye: &Eye,
        volume: &TsdfVolume,
        world_from_camera: &Pose,
    ) -> Option<Self> {
        let (arch, noise, level) = (eye.arch, &eye.noise, shape_level(&eye.frame.reduced));
        let extent = Extent::of(points(level, noise, world_from_camera))?;
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
        let scaling = extent.scaling(&world_from_camera.translation.vector);
        let common = scaling.hessian(&half_sum) - scaling.hessian(&half_difference);
        let now = common / half_sum.weight();
        let (shares, n_frames) = match before {
            Some(before) => {
                let n_frames = (before.n_frames + 1.0).min(Self::N_FRAMES);
                let from_now = before.extent.from(&extent);
                let before = from_now.transpose() * before.shares * from_now;
                (before + (now - before) / n_frames, n_frames)
            }
            None => (now, 1.0),
        };
        Some(CommonShape {
            extent,
            shares,
            n_frames,
        })
    }
}

/// How the geometry holds the camera.
#[derive(Clone, Copy, Debug)]
pub struct Degeneracy {
    scaling: Scaling,
    /// Projects scaled increments onto the directions that are not held.
    free: Matrix6<f64>,
    /// How many directions are not held.
    pub n_free: usize,
    /// The least eigenvalue of the shares, 0 to 1.
    pub least_share: f64,
}

impl Degeneracy {
    /// Which directions the frame in hand holds, seen from a pose, and those before it; `None` without points.
    pub fn of(eye: &Eye, common: Option<&CommonShape>, world_from_camera: &Pose) -> Option<Self> {
        let (noise, level) = (&eye.noise, shape_level(&eye.frame.reduced));
        let points = points(level, noise, world_from_camera);
        let extent = Extent::of(points.clone())?;
        let (mut shares, mut sum) = (Matrix6::zeros(), 0.0);
        for (point, normal, weight) in points {
            let mut row = point_to_plane_row(&(point - extent.middle), &normal);
            let mut turn = row.fixed_rows_mut::<3>(0);
            turn /= extent.spread_m;
            shares += row * row.transpose() * weight;
            sum += weight;
        }
        let centre = &world_from_camera.translation.vector;
        let at_once = Degeneracy::by(&(shares / sum), extent.scaling(centre));
        let common = common.filter(|common| common.n_frames >= CommonShape::MIN_FRAMES);
        let Some(CommonShape { shares, extent, .. }) = common else {
            return Some(at_once);
        };
        let in_common = Degeneracy::by(shares, extent.scaling(centre));
        let least_share = in_common.least_share.min(at_once.least_share);
        // What is come upon this very frame is told by its own normals.
        let freer = match at_once.n_free > in_common.n_free {
            true => at_once,
            false => in_common,
        };
        Some(Degeneracy {
            least_share,
            ..freer
        })
    }

    fn by(shares: &Matrix6<f64>, scaling: Scaling) -> Self {
        let eigen = shares.symmetric_eigen();
        let (mut free, mut n_free) = (Matrix6::zeros(), 0);
        let pairs = eigen
            .eigenvalues
            .iter()
            .zip(eigen.eigenvectors.column_iter());
        for (_, vector) in pairs.filter(|(share, _)| **share < MAX_DEGENERATE_SHARE) {
            free += vector * vector.transpose();
            n_free += 1;
        }
        Degeneracy {
            scaling,
            free,
            n_free,
            least_share: eigen.eigenvalues.min().max(0.0),
        }
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
        let damping = Matrix6::identity() * DAMPING_M.powi(-2);
        let scaled = -(hessian + damping).lu().solve(&gradient)?;
        Some(increment_about(
            centre,
            &(self.scaling.centre_from_scaled * scaled),
        ))
    }
}

/// A point, its normal and its weight, world frame.
type Weighted = (Vector3<f64>, Vector3<f64>, f64);

/// Points of a level that have a normal, with that and their weight, seen from a pose: world frame.
fn points<'a>(
    level: &'a Level,
    noise: &'a DepthNoise,
    world_from_camera: &Pose,
) -> impl Iterator<Item = Weighted> + Clone + 'a {
    let rotation = world_from_camera.rotation.to_rotation_matrix();
    let centre = world_from_camera.translation.vector;
    (0..level.depth.len()).filter_map(move |pixel| {
        let normal = Vector3::from([0, 1, 2].map(|axis| level.normals[axis][pixel]));
        let point = Vector3::from(level.point(pixel));
        // Facing the camera, or none.
        (normal.z < 0.0).then(|| {
            let weight = f64::from(noise.sigma_m(point.z)).powi(-2);
            let point = rotation * point.cast() + centre;
            (point, rotation * normal.cast(), weight)
        })
    })
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
        let model = self.ask.about(points, &mut rows.lever);
        let normals = self.ask.in_world(&points.normal);
        let [gx, gy, gz] = &model.gradient;
        let [nx, ny, nz] = &normals;
        let squared = model.squared_gradient();
        let mut scale = [0.0; LANES];
        for i in 0..LANES {
            let along = gx[i] * nx[i] + gy[i] * ny[i] + gz[i] * nz[i];
            // On the other side of something thin there is no second normal.
            let counts = self.ask.is_in_band(model.distance[i], squared[i]) & (along > 0.0);
            let sigma = self.noise.sigma_m(points.point[2][i]);
            rows.weight[i] = if counts { 1.0 / (sigma * sigma) } else { 0.0 };
            let unit = self.of_model / squared[i].sqrt();
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
