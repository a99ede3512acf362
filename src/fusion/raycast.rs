//! The model's surface as a camera sees it: points and normals in the world frame, by rays through the volume.
//!
//! Rays start at the depth that was just fused, which lies within its noise of the model's surface, and mostly find the
//! surface in two or three steps. Where that fails they march through the band, and pixels without depth of their own look
//! where the nearest depth beside them lies; where there is none, the model is not looked for.

use super::preprocess::DepthRange;
use super::pyramid::Level;
use super::volume::TsdfVolume;
use crate::geometry::Pose;
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

impl ModelMap {
    /// A map of a level's size in which nothing is seen.
    pub fn of_level(level: &Level) -> Self {
        let (width, height) = (level.rays.width, level.rays.height);
        ModelMap {
            points: Image::filled(width, height, Vector3::zeros()),
            normals: Image::filled(width, height, Vector3::zeros()),
        }
    }
}

/// A point of the surface with its normal.
type Hit = (Vector3<f32>, Vector3<f32>);

/// Casts a ray for each pixel of a level that was fused from the same pose.
pub fn raycast(
    volume: &TsdfVolume,
    level: &Level,
    world_from_camera: &Pose,
    range: DepthRange,
    map: &mut ModelMap,
) {
    let caster = Caster::new(volume, world_from_camera, range);
    for_each_ray(
        level,
        world_from_camera,
        map,
        |u, v, direction| match level.depth[v * level.rays.width + u] {
            depth if depth > 0.0 => caster.near_depth(direction, depth),
            _ => depth_near(level, u, v).and_then(|depth| caster.march_near(direction, depth)),
        },
    );
}

/// Casts a ray for each pixel of a level, whatever its depth, through the whole range. Far slower than [`raycast`].
pub fn raycast_anywhere(
    volume: &TsdfVolume,
    level: &Level,
    world_from_camera: &Pose,
    range: DepthRange,
) -> ModelMap {
    let mut map = ModelMap::of_level(level);
    let caster = Caster::new(volume, world_from_camera, range);
    for_each_ray(level, world_from_camera, &mut map, |_, _, direction| {
        caster.march(direction, range)
    });
    map
}

/// Fills a map by `cast(u, v, direction)`, the direction in the world frame with unit depth; nothing is seen where the lens
/// has no ray.
fn for_each_ray(
    level: &Level,
    world_from_camera: &Pose,
    map: &mut ModelMap,
    cast: impl Fn(usize, usize, &Vector3<f32>) -> Option<Hit> + Sync,
) {
    let width = level.rays.width;
    let rotation = world_from_camera.rotation.to_rotation_matrix();
    let rotation = rotation.matrix().cast::<f32>();
    map.points
        .data_mut()
        .par_chunks_mut(width)
        .zip(map.normals.data_mut().par_chunks_mut(width))
        .enumerate()
        .for_each(|(v, (points, normals))| {
            for u in 0..width {
                let pixel = v * width + u;
                let ray = Vector3::new(level.rays.x[pixel], level.rays.y[pixel], 1.0);
                let hit = match ray.x.is_nan() {
                    true => None,
                    false => cast(u, v, &(rotation * ray)),
                };
                (points[u], normals[u]) = hit.unwrap_or_default();
            }
        });
}

/// The depth of the nearest pixel that has one, up to four pixels away; the first in reading order of those equally near.
fn depth_near(level: &Level, u: usize, v: usize) -> Option<f32> {
    const RADIUS: isize = 4;
    let (width, height) = (level.rays.width as isize, level.rays.height as isize);
    let (u, v) = (u as isize, v as isize);
    let mut nearest = (isize::MAX, None);
    for y in (v - RADIUS).max(0)..(v + RADIUS + 1).min(height) {
        for x in (u - RADIUS).max(0)..(u + RADIUS + 1).min(width) {
            let depth = level.depth[(y * width + x) as usize];
            let squared = (x - u) * (x - u) + (y - v) * (y - v);
            if depth > 0.0 && squared < nearest.0 {
                nearest = (squared, Some(depth));
            }
        }
    }
    nearest.1
}

struct Caster<'a> {
    volume: &'a TsdfVolume,
    origin: Vector3<f32>,
    range: DepthRange,
}

impl<'a> Caster<'a> {
    fn new(volume: &'a TsdfVolume, world_from_camera: &Pose, range: DepthRange) -> Self {
        Caster {
            volume,
            origin: world_from_camera.translation.vector.cast::<f32>(),
            range,
        }
    }

    /// The surface near a measured depth.
    fn near_depth(&self, direction: &Vector3<f32>, depth: f32) -> Option<Hit> {
        self.converge(direction, depth)
            .or_else(|| self.march_near(direction, depth))
    }

    /// Newton's method along the ray, for starts well inside the band.
    fn converge(&self, direction: &Vector3<f32>, depth: f32) -> Option<Hit> {
        /// The last step is no longer than this: over half a voxel the distance is as good as linear.
        const LAST_STEP_VOXELS: f32 = 0.5;
        let last_step_m = LAST_STEP_VOXELS * self.volume.voxel_size_m();
        let reach = self.volume.truncation_m() / direction.norm();
        let mut z = depth;
        for _ in 0..4 {
            let point = self.origin + direction * z;
            let (distance, gradient) = self.volume.sample_with_gradient(&point)?;
            let slope = gradient.dot(direction);
            // Seen from behind, or grazing: such rays march.
            if slope > -0.1 {
                return None;
            }
            let step = -distance / slope;
            z += step;
            if (z - depth).abs() > reach {
                return None;
            }
            if step.abs() < last_step_m {
                return Some((self.origin + direction * z, gradient.try_normalize(0.1)?));
            }
        }
        None
    }

    /// The first surface from two truncation distances before a depth to as much behind it.
    fn march_near(&self, direction: &Vector3<f32>, depth: f32) -> Option<Hit> {
        let band = 2.0 * self.volume.truncation_m();
        let range = DepthRange {
            near_m: (depth - band).max(self.range.near_m),
            far_m: (depth + band).min(self.range.far_m),
        };
        self.march(direction, range)
    }

    /// First crossing from the front to the back of the surface along the ray, with the normal there.
    fn march(&self, direction: &Vector3<f32>, range: DepthRange) -> Option<Hit> {
        let voxel_step = self.volume.voxel_size_m() / direction.norm();
        let mut z = range.near_m;
        let mut last: Option<(f32, f32)> = None;
        while z < range.far_m {
            let point = self.origin + direction * z;
            let Some((distance, _)) = self.volume.sample_with_gradient(&point) else {
                last = None;
                let is_empty = self.volume.find(self.volume.block_of(&point)).is_none();
                // Half a block's side at once where there is no block.
                z += if is_empty {
                    4.0 * voxel_step
                } else {
                    voxel_step
                };
                continue;
            };
            if distance <= 0.0 {
                let (z_front, front) = last?;
                return self.refine_crossing(direction, (z_front, front), (z, distance));
            }
            last = Some((z, distance));
            // Distances are true to the surface, not to the ray: 0.8 of it never oversteps a surface met head-on.
            z += (distance * 0.8 / direction.norm()).max(voxel_step * 0.5);
        }
        None
    }

    /// Two secant steps between a point in front of the surface and one behind it.
    fn refine_crossing(
        &self,
        direction: &Vector3<f32>,
        mut front: (f32, f32),
        mut back: (f32, f32),
    ) -> Option<Hit> {
        let crossing = |front: (f32, f32), back: (f32, f32)| {
            front.0 + (back.0 - front.0) * front.1 / (front.1 - back.1)
        };
        for _ in 0..2 {
            let z = crossing(front, back);
            let (distance, _) = self
                .volume
                .sample_with_gradient(&(self.origin + direction * z))?;
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
        let point = self.origin + direction * z;
        let (_, gradient) = self.volume.sample_with_gradient(&point)?;
        let normal = gradient.try_normalize(0.1)?;
        (normal.dot(direction) < 0.0).then_some((point, normal))
    }
}
