//! A frame as the volume takes it: for each pixel its depth, what it weighs, and how its surface slants.

use super::lens::round_bits;
use super::noise::DepthNoise;
use super::preprocess::SAME_SURFACE_SIGMAS;
use super::pyramid::{FramePyramid, Level};
use super::volume::WEIGHT_ONE;
use pulp::{Arch, Simd, WithSimd};
use rayon::prelude::*;

/// One pixel: depth (m, `f32`) in the low half, then its weight in units of 1/256 and its slope in units of 1/32768, 16 bits
/// each. The slope is `n·(x, y, 1)` with the ray of the pixel: it turns a difference along the optical axis into a distance
/// to the surface. A depth of 0 is no measurement.
pub type Observation = u64;

/// Slopes are kept in steps of one 32768th: rays of 60° give 2 at most.
pub const SLOPE_ONE: f32 = 32_768.0;
/// Largest value of 16 bits.
const MAX_16_BITS: f32 = 65_535.0;
/// Depth at which a frontal measurement has weight 1: object scale.
const REFERENCE_DEPTH_M: f32 = 0.6;
/// Weight of a pixel without a normal, on a rim, where depth is least reliable; arbitrary.
const RIM_WEIGHT: f32 = 0.1;
/// A difference along the axis never counts for less than this share of itself (surfaces steeper than 75°).
const MIN_SLOPE: f32 = 0.25;

/// The observations of one frame, kept from frame to frame.
#[derive(Clone, Debug)]
pub struct Observations {
    /// All pixels row by row, and behind them one that is no measurement.
    pixels: Vec<Observation>,
    /// Weight and slope of the pixels of the image reduced by 2; 0 without a normal.
    half: Vec<u32>,
}

impl Observations {
    /// Of an empty frame.
    pub fn new(frame: &FramePyramid) -> Self {
        Observations {
            pixels: vec![0; frame.depth.len() + 1],
            half: vec![0; frame.reduced[0].depth.len()],
        }
    }

    /// All pixels row by row, and behind them one that is no measurement.
    #[inline(always)]
    pub fn pixels(&self) -> &[Observation] {
        &self.pixels
    }

    /// Weighs every pixel of a frame by noise, (σ(0.6 m)/σ(z))², and by incidence on the surface of the half image.
    pub fn fill(&mut self, arch: Arch, frame: &FramePyramid, noise: &DepthNoise) {
        let level = &frame.reduced[0];
        let (width, half_width) = (frame.rays.width, level.rays.width);
        self.half
            .par_chunks_mut(half_width)
            .zip(self.pixels.par_chunks_mut(2 * width))
            .zip(frame.depth.par_chunks_exact(2 * width))
            .enumerate()
            .for_each(|(v, ((half, pixels), depth))| {
                let row = v * half_width..(v + 1) * half_width;
                arch.dispatch(HalfRow {
                    out: half,
                    level,
                    first: row.start,
                    noise,
                });
                for (pixels, depth) in pixels
                    .chunks_exact_mut(width)
                    .zip(depth.chunks_exact(width))
                {
                    arch.dispatch(FullRow {
                        out: pixels,
                        depth,
                        half,
                        half_depth: &level.depth[row.clone()],
                        pitch: level.pitch,
                        noise,
                    });
                }
            });
    }
}

/// One pixel: depth (m), weight and slope.
#[inline(always)]
fn join(depth_m: f32, packed: u32) -> Observation {
    (u64::from(packed) << 32) | u64::from(depth_m.to_bits())
}

/// A pixel of a test.
#[cfg(test)]
pub fn observation(depth_m: f32, weight: f32, slope: f32) -> Observation {
    join(depth_m, pack(weight, slope))
}

/// Weight and slope as 16 bits each.
#[inline(always)]
fn pack(weight: f32, slope: f32) -> u32 {
    let weight = if weight * WEIGHT_ONE < MAX_16_BITS {
        weight * WEIGHT_ONE
    } else {
        MAX_16_BITS
    };
    let weight = if weight > 1.0 { weight } else { 1.0 };
    let slope = if slope * SLOPE_ONE < MAX_16_BITS {
        slope * SLOPE_ONE
    } else {
        MAX_16_BITS
    };
    (round_bits(slope) << 16) | round_bits(weight)
}

struct HalfRow<'a> {
    out: &'a mut [u32],
    level: &'a Level,
    first: usize,
    noise: &'a DepthNoise,
}

impl WithSimd for HalfRow<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, _: S) {
        let Level {
            rays,
            depth,
            normals,
            ..
        } = self.level;
        let cells = self.first..self.first + self.out.len();
        let (x, y, z) = (
            &rays.x[cells.clone()],
            &rays.y[cells.clone()],
            &depth[cells.clone()],
        );
        let [nx, ny, nz] = [0, 1, 2].map(|axis| &normals[axis][cells.clone()]);
        let reference = self.noise.sigma_m(REFERENCE_DEPTH_M);
        for (u, out) in self.out.iter_mut().enumerate() {
            let slope = -(nx[u] * x[u] + ny[u] * y[u] + nz[u]);
            let length = (x[u] * x[u] + y[u] * y[u] + 1.0).sqrt();
            let ratio = reference / self.noise.sigma_m(z[u]);
            let steep = if slope > MIN_SLOPE { slope } else { MIN_SLOPE };
            let packed = pack(slope / length * ratio * ratio, steep);
            *out = if slope > 0.0 { packed } else { 0 };
        }
    }
}

struct FullRow<'a> {
    out: &'a mut [Observation],
    depth: &'a [f32],
    half: &'a [u32],
    half_depth: &'a [f32],
    /// Of the half image.
    pitch: f32,
    noise: &'a DepthNoise,
}

impl WithSimd for FullRow<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, _: S) {
        let reference = self.noise.sigma_m(REFERENCE_DEPTH_M);
        let pairs = self.out.as_chunks_mut::<2>().0.iter_mut();
        let inputs = self
            .depth
            .as_chunks::<2>()
            .0
            .iter()
            .zip(self.half)
            .zip(self.half_depth);
        for (out, ((depth, &half), &half_depth)) in pairs.zip(inputs) {
            for (out, &z) in out.iter_mut().zip(depth) {
                let sigma_m = self.noise.sigma_m(z);
                let reach = SAME_SURFACE_SIGMAS * sigma_m + 2.5 * self.pitch * z;
                let ratio = reference / sigma_m;
                let rim = pack(RIM_WEIGHT * ratio * ratio, 1.0);
                let on_surface = (half != 0) & ((z - half_depth).abs() < reach);
                let packed = if on_surface { half } else { rim };
                *out = join(z, packed);
            }
        }
    }
}
