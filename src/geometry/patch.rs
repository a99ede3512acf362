//! Squares of a depth image as flat pieces of surface.

use super::RayGrid;
use depth_camera::Image;
use nalgebra::{Matrix3, Point3, Vector3};

/// The plane through the depth of a square of pixels, camera frame.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct DepthPatch {
    /// Mean of the measured points, metres.
    pub centre: Point3<f64>,
    /// Unit normal towards the camera.
    pub normal: Vector3<f64>,
    /// Area of the surface that the measured pixels cover, square metres.
    pub area_m2: f64,
}

/// A square of pixels of which every `step`-th is looked at in both directions.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct PixelSquare {
    /// Leftmost column.
    pub u: usize,
    /// Top row.
    pub v: usize,
    /// Pixels along a side.
    pub side: usize,
    /// Pixels from one that is looked at to the next.
    pub step: usize,
}

impl PixelSquare {
    /// The pixels that are looked at, row by row.
    pub fn pixels(self) -> impl Iterator<Item = (usize, usize)> {
        let PixelSquare { u, v, side, step } = self;
        let along = move |first: usize| (first..first + side).step_by(step);
        along(v).flat_map(move |v| along(u).map(move |u| (u, v)))
    }

    fn n_pixels(self) -> usize {
        self.side.div_ceil(self.step).pow(2)
    }
}

/// Depth that differs by more than this share within a square shows an edge.
const MAX_DEPTH_STEP: f64 = 0.12;
/// Grazing patches are taken at this cosine: their area is uncertain.
const MIN_COSINE: f64 = 0.08;

impl DepthPatch {
    /// Fits the plane to a square's depth (metres, 0 is none); `None` where less than half of it is measured or where it
    /// holds an edge.
    ///
    /// The reciprocal depth of a plane is linear in the ray (X/Z, Y/Z), so that three unknowns and no eigenvectors do.
    pub fn fit(depth_m: &Image<f32>, rays: &RayGrid, square: PixelSquare) -> Option<Self> {
        let (mut moments, mut right) = (Matrix3::zeros(), Vector3::zeros());
        let (mut sum, mut n) = (Vector3::zeros(), 0usize);
        let (mut nearest, mut farthest) = (f64::MAX, 0.0f64);
        for (u, v) in square.pixels() {
            let z = f64::from(*depth_m.at(u, v));
            let [x, y] = rays.rays().at(u, v).map(f64::from);
            if z <= 0.0 || !x.is_finite() {
                continue;
            }
            let ray = Vector3::new(x, y, 1.0);
            moments += ray * ray.transpose();
            right += ray / z;
            sum += ray * z;
            n += 1;
            nearest = nearest.min(z);
            farthest = farthest.max(z);
        }
        if 2 * n < square.n_pixels() || farthest - nearest > MAX_DEPTH_STEP * nearest {
            return None;
        }
        let middle = sum / n as f64;
        let towards_plane = moments.cholesky()?.solve(&right);
        let normal = -towards_plane.try_normalize(0.0)?;
        let cosine = (-normal.dot(&middle) / middle.norm()).max(MIN_COSINE);
        let i = rays.camera().intrinsics();
        // Area of the pixels at this depth, seen from the camera, over the slant: d² dω / cosθ with dω = cos³/(fx fy).
        let axis_cosine = middle.z / middle.norm();
        let n_covered = (n * square.step * square.step) as f64;
        let solid_angle = n_covered * axis_cosine.powi(3) / (i.fx * i.fy);
        Some(DepthPatch {
            centre: Point3::from(middle),
            normal,
            area_m2: middle.norm_squared() * solid_angle / cosine,
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::camera::tests::distorted_camera;

    fn plane_depth(rays: &RayGrid, normal: Vector3<f64>, distance_m: f64) -> Image<f32> {
        let data = rays.rays().data().iter().map(|&[x, y]| {
            let ray = Vector3::new(f64::from(x), f64::from(y), 1.0);
            (-distance_m / normal.dot(&ray)) as f32
        });
        let i = rays.camera().intrinsics();
        Image::from_vec(i.width, i.height, data.collect())
    }

    const SQUARE: PixelSquare = PixelSquare {
        u: 300,
        v: 96,
        side: 16,
        step: 2,
    };

    #[test]
    fn a_slanted_plane_gives_its_normal_and_the_area_between_its_corners() {
        let rays = RayGrid::new(distorted_camera());
        let normal = Vector3::new(0.4, -0.2, -1.0)
            .try_normalize(0.0)
            .expect("not zero");
        let depth = plane_depth(&rays, normal, 0.8);
        let patch = DepthPatch::fit(&depth, &rays, SQUARE).expect("a plane");
        assert!((patch.normal - normal).norm() < 1e-4);
        assert!((normal.dot(&patch.centre.coords) + 0.8).abs() < 1e-5);
        let corner = |u, v| rays.direction(u, v) * *depth.at(u, v);
        let (a, b, c) = (corner(300, 96), corner(316, 96), corner(300, 112));
        let area = f64::from((b - a).cross(&(c - a)).norm());
        assert!(
            (patch.area_m2 / area - 1.0).abs() < 0.05,
            "{}",
            patch.area_m2 / area
        );
    }

    #[test]
    fn edges_and_holes_are_no_patches() {
        let rays = RayGrid::new(distorted_camera());
        let plane = plane_depth(&rays, Vector3::new(0.0, 0.0, -1.0), 1.0);
        let mut edge = plane.clone();
        let mut holes = plane;
        for (u, v) in SQUARE.pixels() {
            if u > 304 {
                edge.data_mut()[v * 512 + u] = 1.3;
                holes.data_mut()[v * 512 + u] = 0.0;
            }
        }
        assert_eq!(DepthPatch::fit(&edge, &rays, SQUARE), None);
        assert_eq!(DepthPatch::fit(&holes, &rays, SQUARE), None);
    }
}
