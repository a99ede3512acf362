//! A frame as the volume takes it: for each pixel its depth, what it weighs, and how its surface slants.

use super::band_ends::{self, BandEnds, TILE};
use super::block::WEIGHT_ONE;
use super::noise::DepthNoise;
use super::preprocess::SAME_SURFACE_SIGMAS;
use super::pyramid::{FramePyramid, Level, lane};
use crate::geometry::lanes::{LANES, Lane, round_bits};
use pulp::{Arch, Simd, WithSimd};
use rayon::prelude::*;

/// One pixel: its depth in steps of [`DepthStep`] in the low 16 bits, then its weight in units of 1/256 and its slope in
/// units of 1/128, 8 bits each. The slope is `n·(x, y, 1)` with the ray of the pixel: it turns a difference along the optical
/// axis into a distance to the surface. A depth of 0 is no measurement.
pub type Observation = u32;

/// Slopes are kept in steps of one 128th: rays of 60° give 2 at most.
const SLOPE_ONE: f32 = 128.0;
/// Largest values of 8 and 16 bits.
const MAX_8_BITS: f32 = 255.0;
const MAX_16_BITS: f32 = 65_535.0;

/// Depth is kept in steps of the largest depth / 65535, which is 0.03 mm within 2 m: far below the noise.
#[derive(Clone, Copy, Debug)]
pub struct DepthStep {
    step_m: f32,
    steps_per_m: f32,
}

impl DepthStep {
    /// The step for depths up to `far_m`.
    pub fn up_to(far_m: f32) -> Self {
        DepthStep {
            step_m: far_m / MAX_16_BITS,
            steps_per_m: MAX_16_BITS / far_m,
        }
    }

    /// Depth of an observation, metres.
    #[inline(always)]
    pub fn depth_of(self, pixel: Observation) -> f32 {
        (pixel & 0xFFFF) as i32 as f32 * self.step_m
    }

    /// One pixel: depth (m), weight and slope.
    #[inline(always)]
    fn join(self, depth_m: f32, packed: u32) -> Observation {
        packed << 16 | round_bits(depth_m * self.steps_per_m)
    }
}

/// A difference along the axis never counts for less than this share of itself (surfaces steeper than 75°).
const MIN_SLOPE: f32 = 0.25;

/// The observations of one frame, kept from frame to frame.
#[derive(Clone, Debug)]
pub struct Observations {
    /// All pixels row by row, and behind them one that is no measurement.
    pixels: Vec<Observation>,
    /// Weight and slope of the pixels of the image reduced by 2; 0 without a normal.
    half: Vec<u32>,
    depth_step: DepthStep,
    band_ends: BandEnds,
}

impl Observations {
    /// Of an empty frame of depths up to `far_m`.
    pub fn new(frame: &FramePyramid, far_m: f32) -> Self {
        Observations {
            pixels: vec![0; frame.depth.len() + 1],
            half: vec![0; frame.reduced[0].depth.len()],
            depth_step: DepthStep::up_to(far_m),
            band_ends: BandEnds::new(frame.rays.width, frame.rays.height),
        }
    }

    /// All pixels row by row, and behind them one that is no measurement.
    #[inline(always)]
    pub fn pixels(&self) -> &[Observation] {
        &self.pixels
    }

    /// In which steps depth is kept.
    #[inline(always)]
    pub fn depth_step(&self) -> DepthStep {
        self.depth_step
    }

    /// Where the truncation band begins and ends.
    #[inline(always)]
    pub fn band_ends(&self) -> &BandEnds {
        &self.band_ends
    }

    /// Weighs every pixel of a frame by noise, (σ(0.6 m)/σ(z))², and by incidence on the surface of the half image.
    pub fn fill(
        &mut self,
        arch: Arch,
        frame: &FramePyramid,
        noise: &DepthNoise,
        truncation_m: f32,
    ) {
        let level = &frame.reduced[0];
        let (width, half_width) = (frame.rays.width, level.rays.width);
        let step = self.depth_step;
        self.half
            .par_chunks_mut(TILE / 2 * half_width)
            .zip(self.pixels.par_chunks_mut(TILE * width))
            .zip(frame.depth.par_chunks(TILE * width))
            .zip(self.band_ends.rows_mut())
            .enumerate()
            .for_each(|(tile_row, (((half, pixels), depth), ends))| {
                let rows = half
                    .chunks_exact_mut(half_width)
                    .zip(pixels.chunks_exact_mut(2 * width))
                    .zip(depth.chunks_exact(2 * width));
                for (v, ((half, pixels), depth)) in rows.enumerate() {
                    let first = (tile_row * TILE / 2 + v) * half_width;
                    arch.dispatch(HalfRow {
                        out: half,
                        level,
                        first,
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
                            half_depth: &level.depth[first..first + half_width],
                            pitch: level.pitch,
                            noise,
                            step,
                        });
                    }
                }
                band_ends::find(arch, ends, pixels, width, step, truncation_m);
            });
    }

    /// Of the pixels of a test.
    #[cfg(test)]
    pub fn of_pixels(
        arch: Arch,
        pixels: &[Observation],
        width: usize,
        depth_step: DepthStep,
        truncation_m: f32,
    ) -> Self {
        let mut observations = Observations {
            pixels: pixels.iter().copied().chain([0]).collect(),
            half: Vec::new(),
            depth_step,
            band_ends: BandEnds::new(width, pixels.len() / width),
        };
        let rows = observations.band_ends.rows_mut();
        rows.zip(pixels.par_chunks(TILE * width))
            .for_each(|(ends, pixels)| {
                band_ends::find(arch, ends, pixels, width, depth_step, truncation_m)
            });
        observations
    }
}

/// Slope of an observation.
#[inline(always)]
pub fn slope_of(pixel: Observation) -> f32 {
    (pixel >> 24) as i32 as f32 * (1.0 / SLOPE_ONE)
}

/// Weight of an observation in units of 1/256.
#[inline(always)]
pub fn weight_of(pixel: Observation) -> f32 {
    (pixel >> 16 & 0xFF) as i32 as f32
}

/// A pixel of a test.
#[cfg(test)]
pub fn observation(step: DepthStep, depth_m: f32, weight: f32, slope: f32) -> Observation {
    step.join(depth_m, pack(weight, slope))
}

/// Weight, from 1/256 to 255/256, and slope as 8 bits each.
#[inline(always)]
fn pack(weight: f32, slope: f32) -> u32 {
    let at_most = |x: f32| if x < MAX_8_BITS { x } else { MAX_8_BITS };
    let weight = at_most(weight * WEIGHT_ONE);
    let weight = if weight > 1.0 { weight } else { 1.0 };
    (round_bits(at_most(slope * SLOPE_ONE)) << 8) | round_bits(weight)
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
        for (u, out) in self.out.iter_mut().enumerate() {
            let slope = -(nx[u] * x[u] + ny[u] * y[u] + nz[u]);
            let length = (x[u] * x[u] + y[u] * y[u] + 1.0).sqrt();
            let precision = self.noise.precision(self.noise.sigma_m(z[u]));
            let steep = if slope > MIN_SLOPE { slope } else { MIN_SLOPE };
            let packed = pack(slope / length * precision * precision, steep);
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
    step: DepthStep,
}

impl WithSimd for FullRow<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(mut self, _: S) {
        let out = std::mem::take(&mut self.out);
        let parts = out.chunks_mut(2 * LANES).zip(self.depth.chunks(2 * LANES));
        for (part, (out, depth)) in parts.enumerate() {
            let half = self.half[part * LANES..].first_chunk::<LANES>();
            let half_depth = self.half_depth[part * LANES..].first_chunk::<LANES>();
            match (out.first_chunk_mut(), depth.first_chunk(), half, half_depth) {
                (Some(out), Some(depth), Some(half), Some(half_depth)) => {
                    *out = self.pixels(depth, half, half_depth);
                }
                _ => {
                    let first = part * LANES;
                    let cells = first..first + out.len() / 2;
                    let mut padded = [0.0; 2 * LANES];
                    padded[..depth.len()].copy_from_slice(depth);
                    let mut half = [0; LANES];
                    half[..cells.len()].copy_from_slice(&self.half[cells]);
                    let pixels = self.pixels(&padded, &half, &lane(self.half_depth, first));
                    out.copy_from_slice(&pixels[..out.len()]);
                }
            }
        }
    }
}

impl FullRow<'_> {
    /// The observations of two lanes of pixels, over one of the half image.
    #[allow(
        clippy::needless_range_loop,
        reason = "one index runs through all the lanes, which is what becomes vector code"
    )]
    #[inline(always)]
    fn pixels(
        &self,
        depth: &[f32; 2 * LANES],
        half: &[u32; LANES],
        half_depth: &Lane,
    ) -> [Observation; 2 * LANES] {
        let mut pixels = [0; 2 * LANES];
        for i in 0..2 * LANES {
            let (z, half, half_depth) = (depth[i], half[i / 2], half_depth[i / 2]);
            let sigma_m = self.noise.sigma_m(z);
            let reach = SAME_SURFACE_SIGMAS * sigma_m + 2.5 * self.pitch * z;
            let precision = self.noise.precision(sigma_m);
            let rim = pack(self.noise.rim_weight() * precision * precision, 1.0);
            let on_surface = (half != 0) & ((z - half_depth).abs() < reach);
            let packed = if on_surface { half } else { rim };
            pixels[i] = self.step.join(z, packed);
        }
        pixels
    }
}
