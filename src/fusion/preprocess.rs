//! From a depth image to filtered vertex and normal maps on a pyramid.

use super::noise::DepthNoise;
use crate::geometry::{CameraModel, RayGrid};
use depth_camera::Image;
use nalgebra::Vector3;
use rayon::prelude::*;

/// Points and unit normals of one pyramid level in the camera frame; a point with z = 0 is invalid, a zero normal too.
#[derive(Clone, Debug)]
pub struct VertexMap {
    /// Points, metres.
    pub points: Image<Vector3<f32>>,
    /// Normals towards the camera.
    pub normals: Image<Vector3<f32>>,
}

/// The levels of one frame, finest first.
#[derive(Clone, Debug)]
pub struct FramePyramid {
    /// Filtered vertex and normal map of the whole image.
    pub full: VertexMap,
    /// Maps of the image reduced by 2, 4 and 8.
    pub reduced: [VertexMap; N_REDUCED],
}

/// How many reduced levels there are.
pub const N_REDUCED: usize = 3;

/// The rays of the whole image and of its reduced levels.
#[derive(Clone, Debug)]
pub struct PyramidRays {
    full: RayGrid,
    reduced: [RayGrid; N_REDUCED],
}

impl PyramidRays {
    /// Unprojects all pixels of all levels once.
    pub fn new(camera: CameraModel) -> Self {
        PyramidRays {
            full: RayGrid::new(camera),
            reduced: std::array::from_fn(|level| RayGrid::new(camera.reduced(2 << level))),
        }
    }

    /// Rays of the whole image.
    pub fn full(&self) -> &RayGrid {
        &self.full
    }

    /// Rays of the image reduced by `2 << level`.
    pub fn reduced(&self, level: usize) -> &RayGrid {
        &self.reduced[level]
    }
}

/// Sets depths outside the working range to 0, the mark of no measurement; NaN and infinities too.
pub fn clip_depth(depth: &Image<f32>, min_m: f32, max_m: f32) -> Image<f32> {
    depth.map(|&z| if z >= min_m && z <= max_m { z } else { 0.0 })
}

/// Builds the filtered pyramid of a clipped depth image.
pub fn build_pyramid(depth: &Image<f32>, rays: &PyramidRays, noise: &DepthNoise) -> FramePyramid {
    let smooth = bilateral_filter(depth, noise);
    let pitch = |level: usize| 1.0 / rays.reduced[level].camera().intrinsics().fx as f32;
    let half = halve(&smooth, noise, pitch(0));
    let quarter = halve(&half, noise, pitch(1));
    let eighth = halve(&quarter, noise, pitch(2));
    let map = |depth: &Image<f32>, rays: &RayGrid| vertex_map(depth, rays, noise);
    FramePyramid {
        full: map(&smooth, &rays.full),
        reduced: [
            map(&half, &rays.reduced[0]),
            map(&quarter, &rays.reduced[1]),
            map(&eighth, &rays.reduced[2]),
        ],
    }
}

/// Range differences beyond so many sigmas belong to another surface.
const SAME_SURFACE_SIGMAS: f32 = 4.0;

/// Edge-preserving smoothing over 5×5 pixels (Tomasi and Manduchi 1998) with the range weight `(1 − (Δz/4σ)²)²`, which is
/// zero beyond four sigmas of the depth noise.
fn bilateral_filter(depth: &Image<f32>, noise: &DepthNoise) -> Image<f32> {
    const RADIUS: isize = 2;
    /// Gauss weights of pixel distances 0, 1, 2 for a standard deviation of 1.5 pixels.
    const SPATIAL: [f32; 3] = [1.0, 0.800_74, 0.411_11];
    let (width, height) = (depth.width() as isize, depth.height() as isize);
    let mut out = Image::filled(depth.width(), depth.height(), 0.0f32);
    out.data_mut()
        .par_chunks_mut(depth.width())
        .enumerate()
        .for_each(|(v, row)| {
            for (u, out) in row.iter_mut().enumerate() {
                let centre = *depth.at(u, v);
                if centre <= 0.0 {
                    continue;
                }
                let inv_reach = 1.0 / (SAME_SURFACE_SIGMAS * noise.sigma_m(centre));
                let (mut sum, mut weights) = (0.0, 0.0);
                for dv in -RADIUS..=RADIUS {
                    let y = v as isize + dv;
                    if y < 0 || y >= height {
                        continue;
                    }
                    let line = depth.row(y as usize);
                    for du in -RADIUS..=RADIUS {
                        let x = u as isize + du;
                        if x < 0 || x >= width {
                            continue;
                        }
                        let z = line[x as usize];
                        let t = (z - centre) * inv_reach;
                        let range = (1.0 - t * t).max(0.0);
                        let w =
                            SPATIAL[du.unsigned_abs()] * SPATIAL[dv.unsigned_abs()] * range * range;
                        sum += w * z;
                        weights += w;
                    }
                }
                *out = sum / weights;
            }
        });
    out
}

/// Halves an image: each pixel is the mean of those of its four that lie on the surface of the nearest one. `pitch` is the
/// distance between the rays of the halved image's pixels at unit depth.
fn halve(depth: &Image<f32>, noise: &DepthNoise, pitch: f32) -> Image<f32> {
    let (width, height) = (depth.width() / 2, depth.height() / 2);
    let mut out = Image::filled(width, height, 0.0f32);
    for v in 0..height {
        for u in 0..width {
            let four =
                [(0, 0), (1, 0), (0, 1), (1, 1)].map(|(du, dv)| *depth.at(2 * u + du, 2 * v + dv));
            let nearest = four
                .into_iter()
                .filter(|&z| z > 0.0)
                .fold(f32::INFINITY, f32::min);
            if nearest.is_infinite() {
                continue;
            }
            // A surface met at 60° changes by 1.7 pitches from pixel to pixel.
            let reach = SAME_SURFACE_SIGMAS * noise.sigma_m(nearest) + 1.7 * pitch * nearest;
            let (sum, n) = four
                .into_iter()
                .filter(|&z| z > 0.0 && z - nearest <= reach)
                .fold((0.0, 0), |(sum, n), z| (sum + z, n + 1));
            // A lone pixel of four stands on a depth edge, where the mean would be off by half a pixel.
            if n >= 3 {
                out.data_mut()[v * width + u] = sum / n as f32;
            }
        }
    }
    out
}

/// Unprojects a depth image and takes normals from central differences of the points.
fn vertex_map(depth: &Image<f32>, rays: &RayGrid, noise: &DepthNoise) -> VertexMap {
    let (width, height) = (depth.width(), depth.height());
    let points: Vec<Vector3<f32>> = depth
        .data()
        .par_iter()
        .zip(rays.rays().data())
        .map(|(&z, &[x, y])| {
            if z > 0.0 && !x.is_nan() {
                Vector3::new(x * z, y * z, z)
            } else {
                Vector3::zeros()
            }
        })
        .collect();
    let points = Image::from_vec(width, height, points);
    let mut normals = Image::filled(width, height, Vector3::zeros());
    normals
        .data_mut()
        .par_chunks_mut(width)
        .enumerate()
        .filter(|(v, _)| *v > 0 && v + 1 < height)
        .for_each(|(v, row)| {
            for (u, normal) in row.iter_mut().enumerate().take(width - 1).skip(1) {
                *normal = normal_at(&points, u, v, noise).unwrap_or_default();
            }
        });
    VertexMap { points, normals }
}

/// Normal of a pixel towards the camera, `None` where a neighbour is missing or lies on another surface.
fn normal_at(
    points: &Image<Vector3<f32>>,
    u: usize,
    v: usize,
    noise: &DepthNoise,
) -> Option<Vector3<f32>> {
    let centre = points.at(u, v);
    if centre.z <= 0.0 {
        return None;
    }
    let (left, right) = (points.at(u - 1, v), points.at(u + 1, v));
    let (up, down) = (points.at(u, v - 1), points.at(u, v + 1));
    // On a steep surface neighbours differ by more than noise: a slope of 5 (79°) over the pixel pitch is still one surface.
    let pitch = (right.x - left.x).abs().max((down.y - up.y).abs());
    let reach = SAME_SURFACE_SIGMAS * noise.sigma_m(centre.z) + 2.5 * pitch;
    let same = |p: &Vector3<f32>| p.z > 0.0 && (p.z - centre.z).abs() < reach;
    if !(same(left) && same(right) && same(up) && same(down)) {
        return None;
    }
    (down - up)
        .cross(&(right - left))
        .try_normalize(1e-12)
        .map(|n| if n.dot(centre) > 0.0 { -n } else { n })
}

#[cfg(test)]
mod tests {
    use super::*;
    use depth_camera::{Intrinsics, Sensor};

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

    #[test]
    fn normals_of_a_slanted_plane_are_exact_on_every_level() {
        let rays = PyramidRays::new(pinhole());
        let expected = Vector3::new(-0.3f32, 0.2, -1.0).normalize_or_panic();
        let plane = |ray: [f32; 2]| 0.8 / (1.0 + 0.3 * ray[0] - 0.2 * ray[1]);
        let depth = rays.full().rays().map(|&ray| plane(ray));
        let pyramid = build_pyramid(&depth, &rays, &DepthNoise::of_sensor(Sensor::Kinect2));
        for map in pyramid.reduced.iter().chain([&pyramid.full]) {
            let (u, v) = (map.normals.width() / 2, map.normals.height() / 2);
            // Means of four pixels of a slanted plane lie off it by second-order terms only.
            assert!(map.normals.at(u, v).dot(&expected) > 0.9999);
        }
    }

    trait NormalizeOrPanic {
        fn normalize_or_panic(self) -> Self;
    }

    impl NormalizeOrPanic for Vector3<f32> {
        fn normalize_or_panic(self) -> Self {
            self.try_normalize(0.0).expect("not zero")
        }
    }

    #[test]
    fn depth_edges_are_not_smoothed_over() {
        let noise = DepthNoise::of_sensor(Sensor::Kinect1);
        let mut depth = Image::filled(20, 20, 0.6f32);
        for v in 0..20 {
            for u in 10..20 {
                depth.data_mut()[v * 20 + u] = 0.7;
            }
        }
        let smooth = bilateral_filter(&depth, &noise);
        assert!(
            smooth
                .data()
                .iter()
                .zip(depth.data())
                .all(|(a, b)| (a - b).abs() < 1e-6)
        );
    }

    #[test]
    fn clipping_drops_what_is_not_a_number() {
        let depth = Image::from_vec(4, 1, vec![f32::NAN, 0.2, 1.0, f32::INFINITY]);
        assert_eq!(clip_depth(&depth, 0.3, 2.0).data(), &[0.0, 0.0, 1.0, 0.0]);
    }
}
