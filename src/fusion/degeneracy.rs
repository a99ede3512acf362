//! Directions in which the geometry lets the camera slide: those along a plane.
//!
//! They are the eigenvectors of JᵀWJ whose eigenvalues are small (Zhang et al. 2016). So that angles and lengths compare, the
//! increment is taken about the middle of the points, and angles are multiplied by how far the points lie from it.
//!
//! The normals are those of a coarse level of the frame. Gradients of the signed distances will not do: the noise of a young model
//! tilts them by 20°, and makes a bare wall look as firm as a plaque.
//!
//! Not told: the turn of a ball on a table about its upright axis, which holds no less than a bust on a plinth.

use super::noise::DepthNoise;
use super::normal_equations::NormalEquations;
use super::pyramid::Level;
use crate::geometry::{Pose, increment};
use nalgebra::{Matrix3, Matrix6, Vector3, Vector6};

/// Below this mean square share of the residuals' direction a motion is not held by the geometry: sensor noise alone makes
/// 0.0003 of a wall. Recorded objects have 0.0011 (a bust from behind), 0.0019 (a relief) and more; with 0.002 here, images
/// took the relief's path from 2.14 to 2.45 mm of error. A ball on a table has 0.0010 to 0.0013.
pub const MAX_DEGENERATE_SHARE: f64 = 0.0008;

/// Below this share a view is kept to hold the frames to come: geometry is lost over several frames.
pub const HARDLY_HELD_SHARE: f64 = 3.0 * MAX_DEGENERATE_SHARE;

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

/// How the geometry holds the camera.
#[derive(Clone, Copy, Debug)]
pub struct Degeneracy {
    scaling: Scaling,
    /// Projects scaled increments onto the directions that are not held.
    free: Matrix6<f64>,
    /// The least eigenvalue as a share of the residuals' weight, 0 to 1.
    pub least_share: f64,
    /// How many directions are not held.
    pub n_free: usize,
}

impl Degeneracy {
    /// Which directions a level's points and normals hold, seen from a pose; `None` without points.
    pub fn of(level: &Level, noise: &DepthNoise, world_from_camera: &Pose) -> Option<Self> {
        let rotation = world_from_camera.rotation.to_rotation_matrix();
        let points = || {
            (0..level.depth.len()).filter_map(|pixel| {
                let normal = Vector3::from([0, 1, 2].map(|axis| level.normals[axis][pixel]));
                let point = Vector3::from(level.point(pixel));
                // Facing the camera, or none.
                (normal.z < 0.0).then(|| {
                    let weight = f64::from(noise.sigma_m(point.z)).powi(-2);
                    (rotation * point.cast(), rotation * normal.cast(), weight)
                })
            })
        };
        let weight: f64 = points().map(|(_, _, weight)| weight).sum();
        if weight == 0.0 {
            return None;
        }
        let middle: Vector3<f64> = points().map(|(p, _, w)| p * w).sum::<Vector3<f64>>() / weight;
        let square: f64 = points()
            .map(|(p, _, w)| (p - middle).norm_squared() * w)
            .sum();
        let spread_m = (square / weight).sqrt().max(1e-3);
        let mut hessian = Matrix6::zeros();
        for (point, normal, weight) in points() {
            let turn = (point - middle).cross(&normal) / spread_m;
            let row = Vector6::new(turn.x, turn.y, turn.z, normal.x, normal.y, normal.z);
            hessian += row * row.transpose() * weight;
        }
        let eigen = (hessian / weight).symmetric_eigen();
        let mut free = Matrix6::zeros();
        let mut n_free = 0;
        for (value, vector) in eigen
            .eigenvalues
            .iter()
            .zip(eigen.eigenvectors.column_iter())
        {
            if *value < MAX_DEGENERATE_SHARE {
                free += vector * vector.transpose();
                n_free += 1;
            }
        }
        Some(Degeneracy {
            scaling: Scaling::new(&middle, spread_m),
            free,
            least_share: eigen.eigenvalues.min().max(0.0),
            n_free,
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
        let within = |part: &Matrix6<f64>, equations: &NormalEquations| {
            let hessian = part * self.scaling.hessian(equations) * part;
            (hessian, part * self.scaling.gradient(equations))
        };
        let (held_hessian, held_gradient) = within(&held, geometry);
        let (free_hessian, free_gradient) = within(&self.free, images);
        // A direction that the images do not hold either stays where the geometry has left it.
        let prior = Matrix6::identity() * (1e-3 * geometry.weight());
        let hessian = held_hessian + free_hessian + prior;
        let scaled = -hessian.cholesky()?.solve(&(held_gradient + free_gradient));
        let about_centre = increment(&(self.scaling.centre_from_scaled * scaled));
        let shift = centre - about_centre.rotation * centre;
        let mut pose = about_centre;
        pose.translation.vector += shift;
        Some(pose)
    }
}
