//! Frames against the model they were fused into, patch by patch. Every part of the image has contributed to the model everywhere,
//! so that what a part differs by from it in all frames is the sensor's own error; where a frame lies as a whole is its pose's
//! business.

use super::keyframes::Keyframe;
use super::volume::TsdfVolume;
use crate::geometry::{CellGrid, DepthPatch, MotionEquations, RayGrid, point_to_plane_row};
use nalgebra::{Point3, Vector3, Vector6};
use rayon::prelude::*;

/// A patch of a frame against the model.
pub struct Patch {
    /// The cell of the image that it fills.
    pub cell: usize,
    /// How much too long its depth is, over z², per metre: a Kinect I's depth comes of a disparity, whose errors are alike at all
    /// depths.
    pub excess: f64,
    /// Derivative of that by a motion of the measured points in the camera's frame: turn (rad), shift (m).
    pub by_motion: Vector6<f64>,
    /// What it counts for.
    pub weight: f64,
}

/// Columns of patches in an image.
const COLUMNS: usize = 32;
/// Pixels between those that are looked at.
const STEP_PX: usize = 4;
/// Fewer pixels with a distance to the model make no patch.
const MIN_PIXELS: i32 = 8;
/// Most frames that are looked at.
const MAX_FRAMES: usize = 120;
/// Fewer frames cannot be told from their noise.
const MIN_FRAMES: usize = 12;
/// More slanting patches are not looked at: a small turn of the normal is a large range there.
const MIN_COSINE: f64 = 0.5;
/// Fewer patches and a frame's pose takes up all that there is.
const MIN_PATCHES: usize = 60;
/// Motions that a frame's patches do not hold, as along a wall, are damped by this share of all that they hold; the noise of their
/// normals alone makes 0.0003.
const DAMPING: f64 = 1e-6;

/// The cells of an image that patches fill.
pub fn cells(rays: &RayGrid) -> CellGrid {
    let i = rays.camera().intrinsics();
    CellGrid::new(i.width, i.height, COLUMNS)
}

/// The patches of frames spread evenly over a scan, each with its frame's index, that lie within `max_distance_m` of the model;
/// `None` if too few frames have enough of them.
pub fn of_frames(
    frames: &[Keyframe],
    volume: &TsdfVolume,
    rays: &RayGrid,
    cells: &CellGrid,
    max_distance_m: f64,
) -> Option<Vec<(usize, Vec<Patch>)>> {
    let every = frames.len().div_ceil(MAX_FRAMES).max(1);
    let looked_at: Vec<usize> = (0..frames.len()).step_by(every).collect();
    let patches: Vec<(usize, Vec<Patch>)> = looked_at
        .into_par_iter()
        .map(|index| {
            (
                index,
                of_frame(&frames[index], volume, rays, cells, max_distance_m),
            )
        })
        .filter(|(_, patches)| patches.len() >= MIN_PATCHES)
        .collect();
    (patches.len() >= MIN_FRAMES).then_some(patches)
}

/// The patches of one frame that lie within `max_distance_m` of the model.
pub fn of_frame(
    frame: &Keyframe,
    volume: &TsdfVolume,
    rays: &RayGrid,
    cells: &CellGrid,
    max_distance_m: f64,
) -> Vec<Patch> {
    let depth_m = frame.depth_m();
    let pose = &frame.world_from_camera;
    let patch = |cell: usize| {
        let square = cells.square(cell, STEP_PX);
        // An edge is no place to measure.
        let centre = DepthPatch::fit(&depth_m, rays, square)?.centre;
        let (mut sum, mut gradient, mut n) = (0.0, Vector3::zeros(), 0);
        for (u, v) in square.pixels() {
            let z = *depth_m.at(u, v);
            let point = pose * Point3::from((rays.direction(u, v) * z).cast::<f64>());
            let sample = volume.sample_with_gradient(&point.coords.cast());
            if let Some((distance, slope)) = sample.filter(|_| z > 0.0) {
                sum += f64::from(distance);
                gradient += slope.cast::<f64>();
                n += 1;
            }
        }
        let distance = sum / f64::from(n);
        if n < MIN_PIXELS || distance.abs() > max_distance_m {
            return None;
        }
        let normal = pose.rotation.inverse() * gradient.try_normalize(0.0)?;
        let towards = -centre.coords.try_normalize(0.0)?;
        let cosine = normal.dot(&towards);
        if cosine < MIN_COSINE {
            return None;
        }
        // Depth that is too long lies behind the surface, and shortens the signed distance by its cosine.
        let depth_by_distance = -1.0 / (centre.coords.norm() * cosine * centre.z);
        Some(Patch {
            cell,
            excess: distance * depth_by_distance,
            by_motion: point_to_plane_row(&centre.coords, &normal) * depth_by_distance,
            weight: cosine * cosine,
        })
    };
    (0..cells.n_cells()).filter_map(patch).collect()
}

/// What is known of frames, by turns in two halves.
pub fn halves<T: Copy>(frames: &[T]) -> (Vec<T>, Vec<T>) {
    let every_second = |first: usize| frames.iter().skip(first).step_by(2).copied().collect();
    (every_second(0), every_second(1))
}

/// The motion of a frame that explains its patches best, whatever they are to show.
pub struct MotionFit<'a> {
    patches: &'a [Patch],
    /// `None` where the patches hold no motion.
    equations: Option<MotionEquations>,
}

impl<'a> MotionFit<'a> {
    /// Of a frame with these patches.
    pub fn new(patches: &'a [Patch]) -> Self {
        let rows = patches.iter().map(|patch| (patch.by_motion, patch.weight));
        MotionFit {
            patches,
            equations: MotionEquations::new(rows.collect(), DAMPING),
        }
    }

    /// The motion that explains a value of each patch best; none where the patches do not hold it.
    pub fn explaining(&self, value: impl Fn(&Patch) -> f64) -> Vector6<f64> {
        match &self.equations {
            Some(equations) => equations.explaining(self.patches.iter().map(value)),
            None => Vector6::zeros(),
        }
    }
}
