//! Views of a wavy wall, to try what views tell by.

use crate::geometry::{CameraModel, Pose, RayGrid, increment};
use depth_camera::{Image, Intrinsics};
use nalgebra::{Point3, Translation3, Vector3, Vector6};

/// A camera whose principal point lies off the middle row as a Kinect II's may.
pub(super) fn rays() -> RayGrid {
    RayGrid::new(CameraModel::new(Intrinsics {
        width: 256,
        height: 212,
        fx: 183.0,
        fy: 183.0,
        cx: 127.5,
        cy: 100.5,
        k1: 0.0,
        k2: 0.0,
        p1: 0.0,
        p2: 0.0,
        k3: 0.0,
    }))
}

/// Depth of a wavy wall at a metre.
pub(super) fn seen(rays: &RayGrid, world_from_camera: &Pose) -> Image<f32> {
    let wall = |p: &Point3<f64>| 1.0 + 0.05 * (9.0 * p.x).sin() * (7.0 * p.y).cos();
    let depth = |[x, y]: &[f32; 2]| {
        let ray = world_from_camera.rotation * Vector3::new(f64::from(*x), f64::from(*y), 1.0);
        let origin = Point3::from(world_from_camera.translation.vector);
        let mut depth = 1.0;
        for _ in 0..50 {
            let at = origin + ray * depth;
            depth += (wall(&at) - at.z) / ray.z;
        }
        depth as f32
    };
    rays.rays().map(depth)
}

/// Where twelve views of it are taken.
pub(super) fn poses() -> Vec<Pose> {
    let pose = |k: usize| {
        let around = k as f64 * 2.4;
        let (x, y) = (around.cos(), around.sin());
        let turn = increment(&Vector6::new(0.25 * y, -0.25 * x, 0.1 * x, 0.0, 0.0, 0.0));
        let aside = Translation3::new(0.3 * x, 0.3 * y, -0.25 * (k % 3) as f64);
        aside * turn
    };
    (0..12).map(pose).collect()
}
