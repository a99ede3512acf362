//! The model's surface as a camera sees it: points and normals in the world frame, by rays through the volume.
//!
//! Rays start at the depth that was just fused, which lies within its noise of the model's surface, and mostly find the
//! surface in two or three steps; where that fails they march through the band. Pixels without depth of their own start at
//! the nearest depth beside them; where there is none, the model is not looked for.

use super::preprocess::DepthRange;
use super::pyramid::{Level, lane};
use super::sampling::{Met, Samples, Walk};
use super::sight::Sight;
use super::volume::TsdfVolume;
use crate::geometry::lanes::{LANES, Lane};
use crate::geometry::{Pose, Rigid};
use depth_camera::Image;
use nalgebra::{Point3, Vector3};
use pulp::{Arch, Simd, WithSimd};
use rayon::prelude::*;
use std::ops::Range;

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

    /// Moves all that is seen.
    pub fn move_by(&mut self, motion: &Pose) {
        for point in self.points.data_mut() {
            *point = (motion * Point3::from(point.cast::<f64>()))
                .coords
                .cast::<f32>();
        }
        for normal in self.normals.data_mut() {
            *normal = (motion.rotation * normal.cast::<f64>()).cast::<f32>();
        }
    }

    /// Points and normals of some pixels, 0 where there is no such pixel.
    #[inline(always)]
    pub fn planes(&self, pixels: &[u32; LANES]) -> [[Lane; 3]; 2] {
        let mut planes = [[[0.0; LANES]; 3]; 2];
        let (map_points, map_normals) = (self.points.data(), self.normals.data());
        for i in 0..LANES {
            let pixel = pixels[i] as usize;
            let found = map_points.get(pixel).zip(map_normals.get(pixel));
            for axis in 0..3 {
                planes[0][axis][i] = found.map_or(0.0, |(point, _)| point[axis]);
                planes[1][axis][i] = found.map_or(0.0, |(_, normal)| normal[axis]);
            }
        }
        planes
    }
}

/// A point of the surface with its normal.
type Hit = (Vector3<f32>, Vector3<f32>);

/// The pixels that are cast: whole lanes of some rows.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Window {
    lanes: Range<usize>,
    rows: Range<usize>,
}

impl Window {
    /// All pixels of a level.
    pub fn whole(level: &Level) -> Self {
        Window {
            lanes: 0..level.rays.width.div_ceil(LANES),
            rows: 0..level.rays.height,
        }
    }

    /// The least window with all rays of a level that are so near to the optical axis, radians below a right angle.
    pub fn near_axis(level: &Level, from_axis_rad: f64) -> Self {
        /// A ray that is rounded out of reach is within it.
        const ROUNDING: f32 = 1e-5;
        let reach = from_axis_rad.tan() as f32 + ROUNDING;
        let rays = level.rays.x.iter().zip(&level.rays.y);
        let is_near = |(_, (x, y)): &(usize, (&f32, &f32))| **x * **x + **y * **y <= reach * reach;
        let near = rays.enumerate().filter(is_near);
        let nothing = Window {
            lanes: 0..0,
            rows: 0..0,
        };
        near.fold(nothing, |window, (pixel, _)| {
            let (u, v) = (pixel % level.rays.width, pixel / level.rays.width);
            Window {
                lanes: with(window.lanes, u / LANES),
                rows: with(window.rows, v),
            }
        })
    }

    /// Whether all of another's pixels are among these.
    pub fn contains(&self, other: &Window) -> bool {
        let lies_in = |inner: &Range<usize>, outer: &Range<usize>| {
            inner.is_empty() || outer.start <= inner.start && inner.end <= outer.end
        };
        lies_in(&other.lanes, &self.lanes) && lies_in(&other.rows, &self.rows)
    }
}

/// A range and an index beside it.
fn with(range: Range<usize>, index: usize) -> Range<usize> {
    match range.is_empty() {
        true => index..index + 1,
        false => range.start.min(index)..range.end.max(index + 1),
    }
}

/// Casts a ray for each pixel in a window of a level that was fused from the same pose; nothing is seen beside it.
// A symbol of its own, by which tests/bench/instructions.sh counts.
#[inline(never)]
pub fn raycast(
    arch: Arch,
    volume: &TsdfVolume,
    (level, window): (&Level, &Window),
    world_from_camera: &Pose,
    range: DepthRange,
    map: &mut ModelMap,
) {
    let caster = Caster::new(volume, world_from_camera, range);
    for_each_row(level, map, |v, points, normals| {
        let lanes = match window.rows.contains(&v) {
            true => window.lanes.clone(),
            false => 0..0,
        };
        arch.dispatch(CastRow {
            caster: &caster,
            level,
            v,
            lanes,
            points,
            normals,
        });
    });
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
    let sight = Sight::of(volume, &level.rays, world_from_camera, range);
    for_each_row(level, &mut map, |v, points, normals| {
        for (u, (point, normal)) in points.iter_mut().zip(normals).enumerate() {
            let pixel = v * level.rays.width + u;
            let range = sight.along([level.rays.x[pixel], level.rays.y[pixel]]);
            let direction = caster.direction(level, pixel);
            let hit = direction.and_then(|direction| caster.march(&direction, range));
            (*point, *normal) = hit.unwrap_or_default();
        }
    });
    map
}

/// Calls `cast(v, points, normals)` for every row of a map.
fn for_each_row(
    level: &Level,
    map: &mut ModelMap,
    cast: impl Fn(usize, &mut [Vector3<f32>], &mut [Vector3<f32>]) + Sync,
) {
    let width = level.rays.width;
    map.points
        .data_mut()
        .par_chunks_mut(width)
        .zip(map.normals.data_mut().par_chunks_mut(width))
        .enumerate()
        .for_each(|(v, (points, normals))| cast(v, points, normals));
}

struct CastRow<'a> {
    caster: &'a Caster<'a>,
    level: &'a Level,
    v: usize,
    lanes: Range<usize>,
    points: &'a mut [Vector3<f32>],
    normals: &'a mut [Vector3<f32>],
}

impl WithSimd for CastRow<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, _: S) {
        let CastRow {
            caster,
            level,
            v,
            lanes,
            ..
        } = self;
        let parts = self.points.chunks_mut(LANES);
        for (part, (points, normals)) in parts.zip(self.normals.chunks_mut(LANES)).enumerate() {
            if !lanes.contains(&part) {
                normals.fill(Vector3::zeros());
                continue;
            }
            let (first_u, first) = (part * LANES, v * level.rays.width + part * LANES);
            let depth = depth_near(level, first_u, v);
            let found = caster.converge(level, first, &depth);
            for (i, (point, normal)) in points.iter_mut().zip(normals).enumerate() {
                if found.hit[i] {
                    *point = Vector3::from(found.point.map(|lane| lane[i]));
                    *normal = Vector3::from(found.normal.map(|lane| lane[i]));
                } else {
                    (*point, *normal) = caster
                        .search(level, first + i, depth[i])
                        .unwrap_or_default();
                }
            }
        }
    }
}

/// Hits of many rays.
struct Hits {
    point: [Lane; 3],
    normal: [Lane; 3],
    hit: [bool; LANES],
}

/// How far from a pixel without depth another one's is taken, pixels.
const RADIUS: usize = 4;
const WINDOW: usize = 2 * RADIUS + 1;

/// The pixels around one, row and column from the window's corner: nearest first, in reading order those equally near.
const NEAREST_FIRST: [(usize, usize); WINDOW * WINDOW] = nearest_first();

const fn nearest_first() -> [(usize, usize); WINDOW * WINDOW] {
    let mut places = [(0, 0); WINDOW * WINDOW];
    let (mut n, mut squared) = (0, 0);
    while n < WINDOW * WINDOW {
        let mut place = 0;
        while place < WINDOW * WINDOW {
            let (row, column) = (place / WINDOW, place % WINDOW);
            if row.abs_diff(RADIUS).pow(2) + column.abs_diff(RADIUS).pow(2) == squared {
                places[n] = (row, column);
                n += 1;
            }
            place += 1;
        }
        squared += 1;
    }
    places
}

/// Depth of `LANES` pixels of row `v` from column `u` on, or where one has none that of the nearest pixel that has one; 0 if
/// there is none within [`RADIUS`].
#[inline(always)]
fn depth_near(level: &Level, u: usize, v: usize) -> Lane {
    let (width, height) = (level.rays.width, level.rays.height);
    let mut depth = lane(&level.depth, v * width + u);
    if depth.iter().all(|&z| z > 0.0) {
        return depth;
    }
    // The rows around, with a margin on both sides; 0 beyond the image.
    let mut window = [[0.0f32; LANES + 2 * RADIUS]; WINDOW];
    let columns = u.saturating_sub(RADIUS)..(u + LANES + RADIUS).min(width);
    let margin = RADIUS - (u - columns.start);
    for (row, window) in window.iter_mut().enumerate() {
        if let Some(y) = (v + row).checked_sub(RADIUS).filter(|&y| y < height) {
            let cells = &level.depth[y * width..][columns.clone()];
            window[margin..margin + cells.len()].copy_from_slice(cells);
        }
    }
    for (row, column) in NEAREST_FIRST {
        let mut missing = false;
        for i in 0..LANES {
            let found = window[row][column + i];
            depth[i] = if depth[i] > 0.0 { depth[i] } else { found };
            missing |= depth[i] <= 0.0;
        }
        if !missing {
            break;
        }
    }
    depth
}

struct Caster<'a> {
    volume: &'a TsdfVolume,
    world_from_camera: Rigid,
    range: DepthRange,
}

impl<'a> Caster<'a> {
    fn new(volume: &'a TsdfVolume, world_from_camera: &Pose, range: DepthRange) -> Self {
        Caster {
            volume,
            world_from_camera: Rigid::new(world_from_camera),
            range,
        }
    }

    /// The ray of a pixel in the world frame, with unit depth; `None` where the lens has none.
    #[inline(always)]
    fn direction(&self, level: &Level, pixel: usize) -> Option<Vector3<f32>> {
        let (x, y) = (level.rays.x[pixel], level.rays.y[pixel]);
        let direction = self.world_from_camera.turn([x, y, 1.0]);
        (!x.is_nan()).then_some(Vector3::from(direction))
    }

    /// Newton's method along the rays of `LANES` pixels from `first` on, from depths well inside the band; 0 is none.
    #[allow(
        clippy::needless_range_loop,
        reason = "one index runs through all the lanes, which is what becomes vector code"
    )]
    #[inline(always)]
    fn converge(&self, level: &Level, first: usize, depth: &Lane) -> Hits {
        /// The last step is no longer than this: over half a voxel the distance is as good as linear.
        const LAST_STEP_VOXELS: f32 = 0.5;
        let last_step_m = LAST_STEP_VOXELS * self.volume.voxel_size_m();
        let truncation_m = self.volume.truncation_m();
        let origin = &self.world_from_camera.shift;
        let (x, y) = (lane(&level.rays.x, first), lane(&level.rays.y, first));
        let (mut direction, mut reach) = ([[0.0; LANES]; 3], [0.0; LANES]);
        let (mut z, mut active) = (*depth, [false; LANES]);
        for i in 0..LANES {
            let ray = self.world_from_camera.turn([x[i], y[i], 1.0]);
            for axis in 0..3 {
                direction[axis][i] = ray[axis];
            }
            reach[i] = truncation_m / (ray[0] * ray[0] + ray[1] * ray[1] + ray[2] * ray[2]).sqrt();
            active[i] = (depth[i] > 0.0) & !x[i].is_nan();
        }
        let mut hits = Hits {
            point: [[0.0; LANES]; 3],
            normal: [[0.0; LANES]; 3],
            hit: [false; LANES],
        };
        for _ in 0..4 {
            let mut points = [[0.0; LANES]; 3];
            for axis in 0..3 {
                for i in 0..LANES {
                    points[axis][i] = origin[axis] + direction[axis][i] * z[i];
                }
            }
            let Samples { distance, gradient } = self.volume.sample_lanes(&points, &active);
            for i in 0..LANES {
                let (mut slope, mut squared) = (0.0, 0.0);
                for axis in 0..3 {
                    slope += gradient[axis][i] * direction[axis][i];
                    squared += gradient[axis][i] * gradient[axis][i];
                }
                let step = -distance[i] / slope;
                z[i] += step;
                // Unseen, seen from behind, or grazing: such rays march.
                let goes_on = active[i] & (slope <= -0.1) & ((z[i] - depth[i]).abs() <= reach[i]);
                let arrives = goes_on & (step.abs() < last_step_m);
                let length = squared.sqrt();
                let hit = arrives & (length > 0.1);
                for axis in 0..3 {
                    let point = origin[axis] + direction[axis][i] * z[i];
                    let normal = gradient[axis][i] / length;
                    hits.point[axis][i] = if hit { point } else { hits.point[axis][i] };
                    hits.normal[axis][i] = if hit { normal } else { hits.normal[axis][i] };
                }
                hits.hit[i] |= hit;
                active[i] = goes_on & !arrives;
            }
            if active == [false; LANES] {
                break;
            }
        }
        hits
    }

    /// The surface near a depth (m) along a pixel's ray; 0 is no depth.
    fn search(&self, level: &Level, pixel: usize, depth: f32) -> Option<Hit> {
        if depth <= 0.0 {
            return None;
        }
        self.march_near(&self.direction(level, pixel)?, depth)
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

    /// The point of a ray at a depth, metres.
    #[inline(always)]
    fn at(&self, direction: &Vector3<f32>, z: f32) -> Vector3<f32> {
        Vector3::from(self.world_from_camera.shift) + direction * z
    }

    /// First crossing from the front to the back of the surface along the ray, with the normal there.
    fn march(&self, direction: &Vector3<f32>, range: DepthRange) -> Option<Hit> {
        let voxel_step = self.volume.voxel_size_m() / direction.norm();
        let mut z = range.near_m;
        let mut last: Option<(f32, f32)> = None;
        let mut walk = Walk::from(self.volume, &self.at(direction, z));
        while z < range.far_m {
            let distance = match walk.at(&self.at(direction, z)) {
                Met::Distance(distance) => distance,
                unknown => {
                    last = None;
                    // Half a block's side at once where there is no block.
                    z += if unknown == Met::Nothing {
                        4.0 * voxel_step
                    } else {
                        voxel_step
                    };
                    continue;
                }
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
            let (distance, _) = self.volume.sample_with_gradient(&self.at(direction, z))?;
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
        let point = self.at(direction, z);
        let (_, gradient) = self.volume.sample_with_gradient(&point)?;
        let normal = gradient.try_normalize(0.1)?;
        (normal.dot(direction) < 0.0).then_some((point, normal))
    }
}
