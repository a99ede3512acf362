//! The model's surface as a camera sees it: points and normals in the world frame, by marching rays through the volume.

use super::volume::{BLOCK_SIDE, TsdfVolume};
use crate::geometry::{Pose, RayGrid};
use depth_camera::Image;
use nalgebra::Vector3;
use rayon::prelude::*;

/// The model seen from a pose.
#[derive(Clone, Debug)]
pub struct ModelMap {
    /// Surface points, world frame, metres; meaningless where the normal is zero.
    pub points: Image<Vector3<f32>>,
    /// Unit normals out of the surface, world frame; zero where no surface is seen.
    pub normals: Image<Vector3<f32>>,
}

/// Nearest and farthest depth at which rays look for a surface, metres.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct DepthRange {
    /// Where rays start.
    pub near_m: f32,
    /// Where rays end.
    pub far_m: f32,
}

/// Casts one ray a pixel. `live_depth`, an image that is a whole multiple larger, says where to start: a band before the
/// surface that was just fused; rays without a live depth march all the way.
pub fn raycast(
    volume: &TsdfVolume,
    rays: &RayGrid,
    live_depth: &Image<f32>,
    world_from_camera: &Pose,
    range: DepthRange,
) -> ModelMap {
    let (width, height) = (rays.rays().width(), rays.rays().height());
    let factor = live_depth.width() / width;
    let rotation = world_from_camera
        .rotation
        .to_rotation_matrix()
        .matrix()
        .cast::<f32>();
    let origin = world_from_camera.translation.vector.cast::<f32>();
    let mut points = Image::filled(width, height, Vector3::zeros());
    let mut normals = Image::filled(width, height, Vector3::zeros());
    points
        .data_mut()
        .par_chunks_mut(width)
        .zip(normals.data_mut().par_chunks_mut(width))
        .enumerate()
        .for_each(|(v, (points, normals))| {
            for u in 0..width {
                let ray = rays.direction(u, v);
                if ray.x.is_nan() {
                    continue;
                }
                let live = *live_depth.at(u * factor + factor / 2, v * factor + factor / 2);
                let direction = rotation * ray;
                let band = 2.0 * volume.truncation_m();
                let seeded = (live > 0.0).then(|| DepthRange {
                    near_m: (live - band).max(range.near_m),
                    far_m: (live + band).min(range.far_m),
                });
                let hit = seeded
                    .and_then(|range| march(volume, &origin, &direction, range))
                    .or_else(|| march(volume, &origin, &direction, range));
                if let Some((point, normal)) = hit {
                    points[u] = point;
                    normals[u] = normal;
                }
            }
        });
    ModelMap { points, normals }
}

/// First crossing from the front to the back of the surface along `origin + z·direction`, with the normal there.
fn march(
    volume: &TsdfVolume,
    origin: &Vector3<f32>,
    direction: &Vector3<f32>,
    range: DepthRange,
) -> Option<(Vector3<f32>, Vector3<f32>)> {
    let length = direction.norm();
    let block_step = volume.voxel_size_m() * BLOCK_SIDE as f32 * 0.5 / length;
    let voxel_step = volume.voxel_size_m() / length;
    let mut z = range.near_m;
    let mut last: Option<(f32, f32)> = None;
    while z < range.far_m {
        let point = origin + direction * z;
        if volume.find(volume.block_of(&point)).is_none() {
            last = None;
            z += block_step;
            continue;
        }
        let Some((distance, _)) = volume.sample_with_gradient(&point) else {
            last = None;
            z += voxel_step;
            continue;
        };
        if distance <= 0.0 {
            let (z_front, front) = last?;
            return refine_crossing(volume, origin, direction, (z_front, front), (z, distance));
        }
        last = Some((z, distance));
        // Distances are true to the surface, not to the ray: 0.8 of it never oversteps a surface met head-on.
        z += (distance * 0.8 / length).max(voxel_step * 0.5);
    }
    None
}

/// Two secant steps between a point in front of the surface and one behind it.
fn refine_crossing(
    volume: &TsdfVolume,
    origin: &Vector3<f32>,
    direction: &Vector3<f32>,
    mut front: (f32, f32),
    mut back: (f32, f32),
) -> Option<(Vector3<f32>, Vector3<f32>)> {
    let crossing = |front: (f32, f32), back: (f32, f32)| {
        front.0 + (back.0 - front.0) * front.1 / (front.1 - back.1)
    };
    for _ in 0..2 {
        let z = crossing(front, back);
        let (distance, _) = volume.sample_with_gradient(&(origin + direction * z))?;
        if distance > 0.0 {
            front = (z, distance);
        } else {
            back = (z, distance);
        }
        if distance == 0.0 {
            break;
        }
    }
    let z = if back.1 == 0.0 {
        back.0
    } else {
        crossing(front, back)
    };
    let point = origin + direction * z;
    let (_, gradient) = volume.sample_with_gradient(&point)?;
    let normal = gradient.try_normalize(0.1)?;
    (normal.dot(direction) < 0.0).then_some((point, normal))
}
