//! Projection for kernels that work on many points at once.

use super::lanes::{MAX_ROUNDED, round, round_bits};
use crate::geometry::CameraModel;

/// [`CameraModel::project`] in single precision; off by 10⁻⁴ pixels at most.
#[derive(Clone, Copy, Debug)]
pub struct Lens {
    focal: [f32; 2],
    centre: [f32; 2],
    radial: [f32; 3],
    tangential: [f32; 2],
    max_radius_squared: f32,
    /// Centres of the last column and row.
    last: [f32; 2],
    stride: f32,
    n_pixels: u32,
}

impl Lens {
    /// The lens of a camera.
    ///
    /// # Panics
    /// For images of 8 million pixels and more.
    pub fn new(camera: &CameraModel) -> Self {
        let i = camera.intrinsics();
        let n_pixels = i.width * i.height;
        assert!(n_pixels < MAX_ROUNDED, "{n_pixels} pixels are too many");
        Lens {
            focal: [i.fx as f32, i.fy as f32],
            centre: [i.cx as f32, i.cy as f32],
            radial: [i.k1 as f32, i.k2 as f32, i.k3 as f32],
            tangential: [i.p1 as f32, i.p2 as f32],
            max_radius_squared: camera.max_radius_squared() as f32,
            last: [i.width as f32 - 1.0, i.height as f32 - 1.0],
            stride: i.width as f32,
            n_pixels: n_pixels as u32,
        }
    }

    /// Row-major index of the pixel nearest to a point in the camera frame (m); the number of pixels where there is none.
    #[inline(always)]
    pub fn pixel_index(&self, point: [f32; 3]) -> u32 {
        let Projected { u, v, is_there } = self.project(point);
        let index = self.nearest_index(u, v);
        if is_there { index } else { self.n_pixels }
    }

    /// Where a point in the camera frame (m) falls.
    #[inline(always)]
    pub fn project(&self, [x, y, z]: [f32; 3]) -> Projected {
        let inv_z = 1.0 / z;
        let (x, y) = (x * inv_z, y * inv_z);
        let Distorted {
            x: xd, y: yd, r2, ..
        } = self.distort(x, y);
        Projected {
            u: self.focal[0] * xd + self.centre[0],
            v: self.focal[1] * yd + self.centre[1],
            is_there: (z > 1e-6) & (r2 <= self.max_radius_squared),
        }
    }

    /// The Brown–Conrady polynomial.
    #[inline(always)]
    fn distort(&self, x: f32, y: f32) -> Distorted {
        let ([k1, k2, k3], [p1, p2]) = (self.radial, self.tangential);
        let r2 = x * x + y * y;
        let radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3));
        let xy2 = 2.0 * x * y;
        Distorted {
            x: x * radial + (p1 * xy2 + p2 * (r2 + 2.0 * x * x)),
            y: y * radial + (p1 * (r2 + 2.0 * y * y) + p2 * xy2),
            r2,
            radial,
        }
    }

    /// Row-major index of the pixel nearest to a place in the image; the number of pixels where there is none.
    #[inline(always)]
    pub fn nearest_index(&self, u: f32, v: f32) -> u32 {
        let inside = (u >= 0.0) & (v >= 0.0) & (u <= self.last[0]) & (v <= self.last[1]);
        let index = round_bits(round(v) * self.stride + round(u));
        if inside { index } else { self.n_pixels }
    }

    /// Centres of the last column and row.
    #[inline(always)]
    pub fn last(&self) -> [f32; 2] {
        self.last
    }

    /// The lens as a point in the camera frame (m) and its neighbourhood see it: the projection of a pinhole with a skewed image.
    /// Off by the second derivative of the distortion: 0.1 pixels at most two hundredths of the depth away from the point.
    #[inline(always)]
    pub fn near(&self, [x, y, z]: [f32; 3]) -> LocalLens {
        let inv_z = 1.0 / z;
        let (x, y) = (x * inv_z, y * inv_z);
        let Distorted {
            x: xd,
            y: yd,
            r2,
            radial,
        } = self.distort(x, y);
        let ([k1, k2, k3], [p1, p2]) = (self.radial, self.tangential);
        let slope = k1 + r2 * (2.0 * k2 + r2 * (3.0 * k3));
        let xx = radial + (2.0 * x * x * slope + (2.0 * p1 * y + 6.0 * p2 * x));
        let xy = 2.0 * x * y * slope + 2.0 * (p1 * x + p2 * y);
        let yy = radial + (2.0 * y * y * slope + (6.0 * p1 * y + 2.0 * p2 * x));
        let [fx, fy] = self.focal;
        LocalLens {
            column: [
                fx * xx,
                fx * xy,
                fx * (xd - xx * x - xy * y) + self.centre[0],
            ],
            row: [
                fy * xy,
                fy * yy,
                fy * (yd - xy * x - yy * y) + self.centre[1],
            ],
            projects: (z > 1e-6) & (r2 <= self.max_radius_squared),
        }
    }
}

/// Where a point falls, pixels.
#[derive(Clone, Copy, Debug)]
pub struct Projected {
    /// Column.
    pub u: f32,
    /// Row.
    pub v: f32,
    /// Whether the point lies in front of the camera and within the lens; the place means nothing otherwise.
    pub is_there: bool,
}

/// A ray X/Z, Y/Z after the lens.
struct Distorted {
    x: f32,
    y: f32,
    /// Squared radius before it.
    r2: f32,
    /// Its radial factor.
    radial: f32,
}

/// A lens linearised about a point: the pixel of a point p near it is `(column·p / z, row·p / z)`.
#[derive(Clone, Copy, Debug)]
pub struct LocalLens {
    /// Column times depth, by the point's coordinates.
    pub column: [f32; 3],
    /// Row times depth, by the point's coordinates.
    pub row: [f32; 3],
    /// Whether the point lies in front of the camera and within the lens.
    pub projects: bool,
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::camera::tests::distorted_camera;
    use nalgebra::Point3;

    #[test]
    fn the_index_is_that_of_the_exact_projection() {
        let camera = distorted_camera();
        let lens = Lens::new(&camera);
        let (width, height) = (512.0, 424.0);
        let mut n_seen = 0;
        for step in 0..20_000 {
            let angle = f64::from(step) * 0.1;
            let radius = f64::from(step) * 6e-5;
            let point = Point3::new(0.7 * radius * angle.cos(), 0.7 * radius * angle.sin(), 0.7);
            let pixel = camera.project(&point).filter(|p| camera.contains(p, 0.0));
            let index = lens.pixel_index([point.x, point.y, point.z].map(|x| x as f32));
            let Some(pixel) = pixel else {
                // Within rounding of the border either answer is right.
                let near = index < 512 * 424 && camera.project(&point).is_some();
                assert!(index == 512 * 424 || near);
                continue;
            };
            let off = [pixel.x, pixel.y].map(|x| (x - x.floor() - 0.5).abs());
            let border = pixel.x < 1e-3
                || pixel.y < 1e-3
                || pixel.x > width - 1.001
                || pixel.y > height - 1.001;
            if border || off.iter().any(|&off| off < 1e-3) {
                continue;
            }
            n_seen += 1;
            let expected = pixel.y.round() * width + pixel.x.round();
            assert_eq!(f64::from(index), expected);
        }
        assert!(n_seen > 5000);
    }

    #[test]
    fn near_a_point_the_lens_is_a_skewed_pinhole() {
        let camera = distorted_camera();
        let lens = Lens::new(&camera);
        let mut n_near = 0;
        for step in 0..2000 {
            let (angle, radius) = (f64::from(step) * 0.1, f64::from(step) * 2.5e-4);
            let point = [0.8 * radius * angle.cos(), 0.8 * radius * angle.sin(), 0.8];
            let local = lens.near(point.map(|x| x as f32));
            // The corner of a brick of 5 mm voxels.
            let near = point.map(|x| x + 0.0075);
            let Some(pixel) = camera
                .project(&Point3::from(near))
                .filter(|p| camera.contains(p, 0.0))
            else {
                continue;
            };
            assert!(local.projects);
            n_near += 1;
            let dot = |row: [f32; 3]| (0..3).map(|i| f64::from(row[i]) * near[i]).sum::<f64>();
            let off = [
                dot(local.column) / near[2] - pixel.x,
                dot(local.row) / near[2] - pixel.y,
            ];
            assert!(off.iter().all(|off| off.abs() < 0.03), "{point:?} {off:?}");
        }
        assert!(n_near > 1000);
    }

    #[test]
    fn what_is_behind_the_camera_has_no_pixel() {
        let lens = Lens::new(&distorted_camera());
        for z in [0.0, -1.0, f32::NAN] {
            assert_eq!(lens.pixel_index([0.01, 0.0, z]), 512 * 424);
        }
    }
}
