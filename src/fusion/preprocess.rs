//! From a depth image to smoothed levels with normals.

use super::noise::DepthNoise;
use super::normals::find_normals;
use super::pyramid::FramePyramid;
use depth_camera::Image;
use pulp::{Arch, Simd, WithSimd};
use rayon::prelude::*;

/// Nearest and farthest depth that counts, metres.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct DepthRange {
    /// Nearer depth is ignored.
    pub near_m: f32,
    /// Farther depth is ignored.
    pub far_m: f32,
}

/// Rows that one task works on.
const TASK_ROWS: usize = 16;

/// Sets depths outside the range to 0, the mark of no measurement; NaN and infinities too.
pub fn clip_depth(arch: Arch, image: &Image<f32>, range: DepthRange, frame: &mut FramePyramid) {
    let size = TASK_ROWS * image.width();
    frame
        .depth
        .par_chunks_mut(size)
        .zip(image.data().par_chunks(size))
        .zip(frame.rays.x.par_chunks(size))
        .for_each(|((out, depth), rays)| {
            arch.dispatch(Clip {
                out,
                depth,
                rays,
                range,
            });
        });
}

/// Fills the reduced levels from the clipped depth.
pub fn build_levels(arch: Arch, noise: &DepthNoise, frame: &mut FramePyramid) {
    let width = frame.rays.width;
    let [half, quarter, eighth] = &mut frame.reduced;
    let half_width = half.rays.width;
    halve(
        arch,
        noise,
        &frame.depth,
        width,
        half.pitch,
        half_width,
        &mut frame.rough_half,
    );
    smooth(arch, noise, &frame.rough_half, half_width, &mut half.depth);
    let quarter_width = quarter.rays.width;
    halve(
        arch,
        noise,
        &half.depth,
        half_width,
        quarter.pitch,
        quarter_width,
        &mut quarter.depth,
    );
    halve(
        arch,
        noise,
        &quarter.depth,
        quarter_width,
        eighth.pitch,
        eighth.rays.width,
        &mut eighth.depth,
    );
    for level in &mut frame.reduced {
        find_normals(arch, noise, level);
    }
    frame.measure_depth();
}

/// Range differences beyond so many sigmas belong to another surface.
pub const SAME_SURFACE_SIGMAS: f32 = 4.0;

struct Clip<'a> {
    out: &'a mut [f32],
    depth: &'a [f32],
    rays: &'a [f32],
    range: DepthRange,
}

impl WithSimd for Clip<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, _: S) {
        let DepthRange { near_m, far_m } = self.range;
        for ((out, &z), &x) in self.out.iter_mut().zip(self.depth).zip(self.rays) {
            let valid = (z >= near_m) & (z <= far_m) & !x.is_nan();
            *out = if valid { z } else { 0.0 };
        }
    }
}

/// Halves an image: each pixel is the mean of those of its four that lie on the surface of the nearest one, if they are
/// three at least. `pitch` is the distance between the rays of the halved image at unit depth.
fn halve(
    arch: Arch,
    noise: &DepthNoise,
    depth: &[f32],
    width: usize,
    pitch: f32,
    half_width: usize,
    out: &mut [f32],
) {
    let task = 2 * TASK_ROWS * width;
    out.par_chunks_mut(TASK_ROWS * half_width)
        .zip(depth.par_chunks(task))
        .for_each(|(out, depth)| {
            for (out, rows) in out
                .chunks_exact_mut(half_width)
                .zip(depth.chunks_exact(2 * width))
            {
                let (top, bottom) = rows.split_at(width);
                arch.dispatch(HalveRow {
                    out,
                    top,
                    bottom,
                    pitch,
                    noise,
                });
            }
        });
}

struct HalveRow<'a> {
    out: &'a mut [f32],
    top: &'a [f32],
    bottom: &'a [f32],
    pitch: f32,
    noise: &'a DepthNoise,
}

impl WithSimd for HalveRow<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, _: S) {
        let pairs = self
            .top
            .as_chunks::<2>()
            .0
            .iter()
            .zip(self.bottom.as_chunks::<2>().0);
        for (out, (top, bottom)) in self.out.iter_mut().zip(pairs) {
            let four = [top[0], top[1], bottom[0], bottom[1]];
            let mut nearest = f32::MAX;
            for z in four {
                nearest = if (z > 0.0) & (z < nearest) {
                    z
                } else {
                    nearest
                };
            }
            // A surface met at 60° changes by 1.7 pitches from pixel to pixel.
            let reach =
                SAME_SURFACE_SIGMAS * self.noise.sigma_m(nearest) + 1.7 * self.pitch * nearest;
            let (mut sum, mut n) = (0.0f32, 0.0f32);
            for z in four {
                let same = (z > 0.0) & (z - nearest <= reach);
                sum += if same { z } else { 0.0 };
                n += if same { 1.0 } else { 0.0 };
            }
            // A lone pixel of four stands on a depth edge, where the mean would be off by half a pixel.
            *out = if n >= 3.0 { sum / n } else { 0.0 };
        }
    }
}

/// Edge-preserving smoothing over 3×3 pixels (Tomasi and Manduchi 1998) with the range weight `(1 − (Δz/4σ)²)²`, which is
/// zero beyond four sigmas of the depth noise. The image's border is left as it is.
fn smooth(arch: Arch, noise: &DepthNoise, depth: &[f32], width: usize, out: &mut [f32]) {
    let height = depth.len() / width;
    out.par_chunks_mut(width).enumerate().for_each(|(v, out)| {
        out.copy_from_slice(&depth[v * width..(v + 1) * width]);
        if v > 0 && v + 1 < height {
            let rows = rows_round(depth, width, v);
            arch.dispatch(SmoothRow { out, rows, noise });
        }
    });
}

struct SmoothRow<'a> {
    out: &'a mut [f32],
    rows: [&'a [f32]; 3],
    noise: &'a DepthNoise,
}

/// Gauss weights of the centre, its neighbours and the corners for a standard deviation of 0.75 pixels.
const SPATIAL: [[f32; 3]; 3] = [
    [0.169, 0.411, 0.169],
    [0.411, 1.0, 0.411],
    [0.169, 0.411, 0.169],
];

impl WithSimd for SmoothRow<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, _: S) {
        let Some(n) = self.out.len().checked_sub(2) else {
            return;
        };
        let out = &mut self.out[1..n + 1];
        let taps = self
            .rows
            .map(|row| [&row[..n], &row[1..n + 1], &row[2..n + 2]]);
        for u in 0..n {
            let centre = taps[1][1][u];
            let inv_reach = 1.0 / (SAME_SURFACE_SIGMAS * self.noise.sigma_m(centre));
            let (mut sum, mut weights) = (0.0f32, 0.0f32);
            for (taps, spatial) in taps.iter().zip(&SPATIAL) {
                for (tap, spatial) in taps.iter().zip(spatial) {
                    let t = (tap[u] - centre) * inv_reach;
                    let range = 1.0 - t * t;
                    let range = if range > 0.0 { range } else { 0.0 };
                    let weight = spatial * range * range;
                    sum += weight * (tap[u] - centre);
                    weights += weight;
                }
            }
            out[u] = if centre > 0.0 {
                centre + sum / weights
            } else {
                0.0
            };
        }
    }
}

/// Row `v` of a plane between its neighbours.
pub fn rows_round(plane: &[f32], width: usize, v: usize) -> [&[f32]; 3] {
    [v - 1, v, v + 1].map(|v| &plane[v * width..(v + 1) * width])
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::CameraModel;
    use crate::geometry::camera::tests::distorted_camera;
    use crate::geometry::lanes::arch_levels;
    use depth_camera::{Intrinsics, Sensor};

    const ALL: DepthRange = DepthRange {
        near_m: 0.3,
        far_m: 2.0,
    };

    fn pinhole() -> CameraModel {
        CameraModel::new(Intrinsics {
            width: 160,
            height: 120,
            fx: 150.0,
            fy: 150.0,
            cx: 79.5,
            cy: 59.5,
            k1: 0.0,
            k2: 0.0,
            p1: 0.0,
            p2: 0.0,
            k3: 0.0,
        })
    }

    fn pyramid_of(
        arch: Arch,
        camera: &CameraModel,
        depth: impl Fn(f32, f32) -> f32,
    ) -> FramePyramid {
        let mut frame = FramePyramid::new(camera);
        let rays = frame.rays.clone();
        let data = rays
            .x
            .iter()
            .zip(&rays.y)
            .map(|(&x, &y)| depth(x, y))
            .collect();
        let image = Image::from_vec(rays.width, rays.height, data);
        clip_depth(arch, &image, ALL, &mut frame);
        build_levels(arch, &DepthNoise::of_sensor(Sensor::Kinect2), &mut frame);
        frame
    }

    #[test]
    fn normals_of_a_slanted_plane_are_exact_on_every_level() {
        let length = (0.3f32 * 0.3 + 0.2 * 0.2 + 1.0).sqrt();
        let expected = [-0.3 / length, 0.2 / length, -1.0 / length];
        let plane = |x: f32, y: f32| 0.8 / (1.0 + 0.3 * x - 0.2 * y);
        for level in pyramid_of(Arch::new(), &pinhole(), plane).reduced {
            let pixel = level.rays.height / 2 * level.rays.width + level.rays.width / 2;
            let normal = [0, 1, 2].map(|axis| level.normals[axis][pixel]);
            let cosine: f32 = (0..3).map(|axis| normal[axis] * expected[axis]).sum();
            // Means of four pixels of a slanted plane lie off it by second-order terms only.
            assert!(cosine > 0.9999);
        }
    }

    #[test]
    fn depth_edges_are_not_smoothed_over() {
        let step = |x: f32, _: f32| if x < 0.0 { 0.6 } else { 0.7 };
        for level in pyramid_of(Arch::new(), &pinhole(), step).reduced {
            let off = |z: &f32| (z - 0.6).abs().min((z - 0.7).abs());
            assert!(level.depth.iter().all(|z| *z == 0.0 || off(z) < 1e-6));
        }
    }

    #[test]
    fn clipping_drops_what_is_not_a_number() {
        let mut frame = FramePyramid::new(&pinhole());
        let mut depth = Image::filled(160, 120, 0.0f32);
        depth.data_mut()[..5].copy_from_slice(&[f32::NAN, 0.2, 1.0, f32::INFINITY, 2.1]);
        clip_depth(Arch::new(), &depth, ALL, &mut frame);
        assert_eq!(frame.depth[..5], [0.0, 0.0, 1.0, 0.0, 0.0]);
        assert!(frame.depth[5..].iter().all(|&z| z == 0.0));
    }

    #[test]
    fn every_instruction_set_gives_the_same_bits() {
        let bumpy = |x: f32, y: f32| 0.8 + 0.05 * (40.0 * x).sin() * (31.0 * y).cos();
        let bits = |arch: Arch| -> Vec<u32> {
            let frame = pyramid_of(arch, &distorted_camera(), bumpy);
            let planes = frame
                .reduced
                .iter()
                .flat_map(|level| level.normals.iter().chain([&level.depth]));
            planes.flatten().map(|x| x.to_bits()).collect()
        };
        let [first, others @ ..] = &arch_levels()[..] else {
            panic!("there is always one");
        };
        let expected = bits(*first);
        assert!(others.iter().all(|&arch| bits(arch) == expected));
    }
}
