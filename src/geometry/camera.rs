//! The Brown–Conrady camera: projection with its derivative, exact unprojection, and rays for whole images.

use depth_camera::{Image, Intrinsics};
use nalgebra::{Matrix2, Matrix2x3, Point3, Vector2, Vector3};

/// A camera that projects with exact lens distortion.
///
/// The polynomial stops being a lens where its radial derivative falls to zero; points beyond that radius do not project.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct CameraModel {
    intrinsics: Intrinsics,
    max_radius_squared: f64,
}

impl CameraModel {
    /// The camera of these intrinsics.
    pub fn new(intrinsics: Intrinsics) -> Self {
        CameraModel {
            intrinsics,
            max_radius_squared: monotonic_radius_squared(&intrinsics),
        }
    }

    /// A camera without a lens, on which all that lies before it projects; sizes are those of columns, then rows, pixels.
    pub fn pinhole(size: [usize; 2], focal_px: [f64; 2], centre_px: [f64; 2]) -> Self {
        let ([width, height], [fx, fy], [cx, cy]) = (size, focal_px, centre_px);
        CameraModel {
            intrinsics: Intrinsics {
                width,
                height,
                fx,
                fy,
                cx,
                cy,
                k1: 0.0,
                k2: 0.0,
                p1: 0.0,
                p2: 0.0,
                k3: 0.0,
            },
            max_radius_squared: f64::INFINITY,
        }
    }

    /// The intrinsics.
    pub fn intrinsics(&self) -> &Intrinsics {
        &self.intrinsics
    }

    /// Squared normalised radius x² + y² beyond which nothing projects.
    pub fn max_radius_squared(&self) -> f64 {
        self.max_radius_squared
    }

    /// The same lens seen by an image smaller by an integer `factor`, whose pixels are the means of `factor`² pixels.
    pub fn reduced(&self, factor: usize) -> CameraModel {
        let scale = 1.0 / factor as f64;
        let centre = |c: f64| (c + 0.5) * scale - 0.5;
        let i = &self.intrinsics;
        CameraModel::new(Intrinsics {
            width: i.width / factor,
            height: i.height / factor,
            fx: i.fx * scale,
            fy: i.fy * scale,
            cx: centre(i.cx),
            cy: centre(i.cy),
            ..*i
        })
    }

    /// The same lens seen by an image larger by an integer `factor`, whose pixels are samples of this one's.
    pub fn finer(&self, factor: usize) -> CameraModel {
        let scale = factor as f64;
        let centre = |c: f64| (c + 0.5) * scale - 0.5;
        let i = &self.intrinsics;
        CameraModel::new(Intrinsics {
            width: i.width * factor,
            height: i.height * factor,
            fx: i.fx * scale,
            fy: i.fy * scale,
            cx: centre(i.cx),
            cy: centre(i.cy),
            ..*i
        })
    }

    /// The same with focal lengths that are longer by shares of themselves, across and down; its distortion moves the same pixels by as much
    /// as before, or nearly, where the two differ.
    pub fn with_longer_focus(&self, by: [f64; 2]) -> CameraModel {
        let i = &self.intrinsics;
        let [x, y] = by.map(|by| 1.0 + by);
        let longer = (x * y).sqrt();
        CameraModel::new(Intrinsics {
            fx: i.fx * x,
            fy: i.fy * y,
            k1: i.k1 * longer.powi(2),
            k2: i.k2 * longer.powi(4),
            k3: i.k3 * longer.powi(6),
            p1: i.p1 * longer,
            p2: i.p2 * longer,
            ..*i
        })
    }

    /// Pixel of a point in the camera frame (m); `None` behind the camera or beyond the lens.
    pub fn project(&self, point_camera: &Point3<f64>) -> Option<Vector2<f64>> {
        if point_camera.z <= 1e-6 {
            return None;
        }
        let (x, y) = (
            point_camera.x / point_camera.z,
            point_camera.y / point_camera.z,
        );
        if x * x + y * y > self.max_radius_squared {
            return None;
        }
        Some(self.distort(x, y))
    }

    /// Pixel of a point in the camera frame and its derivative by the point, pixels per metre.
    pub fn project_with_jacobian(
        &self,
        point_camera: &Point3<f64>,
    ) -> Option<(Vector2<f64>, Matrix2x3<f64>)> {
        let pixel = self.project(point_camera)?;
        let inv_z = 1.0 / point_camera.z;
        let (x, y) = (point_camera.x * inv_z, point_camera.y * inv_z);
        let by_normalised = self.distortion_jacobian(x, y);
        let normalised_by_point = Matrix2x3::new(inv_z, 0.0, -x * inv_z, 0.0, inv_z, -y * inv_z);
        Some((pixel, by_normalised * normalised_by_point))
    }

    /// Pixel of the normalised coordinates (X/Z, Y/Z).
    fn distort(&self, x: f64, y: f64) -> Vector2<f64> {
        let i = &self.intrinsics;
        let r2 = x * x + y * y;
        let radial = 1.0 + r2 * (i.k1 + r2 * (i.k2 + r2 * i.k3));
        let xd = x * radial + 2.0 * i.p1 * x * y + i.p2 * (r2 + 2.0 * x * x);
        let yd = y * radial + i.p1 * (r2 + 2.0 * y * y) + 2.0 * i.p2 * x * y;
        Vector2::new(i.fx * xd + i.cx, i.fy * yd + i.cy)
    }

    /// Derivative of [`Self::distort`].
    fn distortion_jacobian(&self, x: f64, y: f64) -> Matrix2<f64> {
        let i = &self.intrinsics;
        let r2 = x * x + y * y;
        let radial = 1.0 + r2 * (i.k1 + r2 * (i.k2 + r2 * i.k3));
        let slope = 2.0 * (i.k1 + r2 * (2.0 * i.k2 + r2 * 3.0 * i.k3));
        let xx = radial + x * x * slope + 2.0 * i.p1 * y + 6.0 * i.p2 * x;
        let cross = x * y * slope + 2.0 * i.p1 * x + 2.0 * i.p2 * y;
        let yy = radial + y * y * slope + 6.0 * i.p1 * y + 2.0 * i.p2 * x;
        Matrix2::new(i.fx * xx, i.fx * cross, i.fy * cross, i.fy * yy)
    }

    /// Normalised coordinates (X/Z, Y/Z) of a pixel, by Newton's method; `None` where the lens has no such ray.
    pub fn unproject(&self, u: f64, v: f64) -> Option<Vector2<f64>> {
        let i = &self.intrinsics;
        let off = |ray: &Vector2<f64>| self.distort(ray.x, ray.y) - Vector2::new(u, v);
        let mut ray = Vector2::new((u - i.cx) / i.fx, (v - i.cy) / i.fy);
        let mut error = off(&ray);
        for _ in 0..20 {
            if error.norm() < 1e-9 {
                break;
            }
            ray -= self.distortion_jacobian(ray.x, ray.y).try_inverse()? * error;
            error = off(&ray);
        }
        (error.norm() < 1e-6 && ray.norm_squared() <= self.max_radius_squared).then_some(ray)
    }

    /// Whether a pixel lies inside the image with `margin_px` to spare on all sides.
    pub fn contains(&self, pixel: &Vector2<f64>, margin_px: f64) -> bool {
        pixel.x >= margin_px
            && pixel.y >= margin_px
            && pixel.x <= self.intrinsics.width as f64 - 1.0 - margin_px
            && pixel.y <= self.intrinsics.height as f64 - 1.0 - margin_px
    }
}

/// The squared normalised radius up to which distorted radius grows with radius, at most 4 (63°).
fn monotonic_radius_squared(i: &Intrinsics) -> f64 {
    const LIMIT: f64 = 4.0;
    const STEPS: usize = 4000;
    let derivative = |r2: f64| 1.0 + r2 * (3.0 * i.k1 + r2 * (5.0 * i.k2 + r2 * 7.0 * i.k3));
    (1..=STEPS)
        .map(|step| LIMIT * step as f64 / STEPS as f64)
        .find(|&r2| derivative(r2) <= 0.05)
        .unwrap_or(LIMIT)
}

/// The ray (X/Z, Y/Z, 1) of every pixel of an image; NaN where the lens has none.
#[derive(Clone, Debug)]
pub struct RayGrid {
    camera: CameraModel,
    rays: Image<[f32; 2]>,
}

impl RayGrid {
    /// Computes the rays of all pixels.
    pub fn new(camera: CameraModel) -> Self {
        let (width, height) = (camera.intrinsics.width, camera.intrinsics.height);
        let rays = (0..width * height)
            .map(|pixel| {
                camera
                    .unproject((pixel % width) as f64, (pixel / width) as f64)
                    .map_or([f32::NAN; 2], |ray| [ray.x as f32, ray.y as f32])
            })
            .collect();
        RayGrid {
            camera,
            rays: Image::from_vec(width, height, rays),
        }
    }

    /// The camera whose pixels these are.
    pub fn camera(&self) -> &CameraModel {
        &self.camera
    }

    /// Normalised coordinates (X/Z, Y/Z) of all pixels.
    pub fn rays(&self) -> &Image<[f32; 2]> {
        &self.rays
    }

    /// The ray of a pixel with unit depth.
    pub fn direction(&self, u: usize, v: usize) -> Vector3<f32> {
        let [x, y] = *self.rays.at(u, v);
        Vector3::new(x, y, 1.0)
    }
}

#[cfg(test)]
pub(crate) mod tests {
    use super::*;

    /// The lens of the simulated Kinect II sessions, with tangential terms added.
    pub(crate) fn distorted_camera() -> CameraModel {
        CameraModel::new(Intrinsics {
            width: 512,
            height: 424,
            fx: 365.6,
            fy: 364.1,
            cx: 256.8,
            cy: 205.3,
            k1: 0.0905,
            k2: -0.2675,
            p1: -0.0042,
            p2: 0.0043,
            k3: 0.0949,
        })
    }

    #[test]
    fn unprojection_inverts_projection_at_every_corner() {
        let camera = distorted_camera();
        for (u, v) in [
            (0.0, 0.0),
            (511.0, 0.0),
            (0.0, 423.0),
            (511.0, 423.0),
            (256.3, 17.8),
        ] {
            let ray = camera.unproject(u, v).expect("inside the lens");
            let pixel = camera
                .project(&Point3::new(ray.x * 1.7, ray.y * 1.7, 1.7))
                .expect("in front");
            assert!((pixel - Vector2::new(u, v)).norm() < 1e-6);
        }
    }

    #[test]
    fn projection_jacobian_matches_central_differences() {
        let camera = distorted_camera();
        let point = Point3::new(0.21, -0.17, 0.8);
        let (_, jacobian) = camera.project_with_jacobian(&point).expect("in front");
        for axis in 0..3 {
            let mut step = Vector3::zeros();
            step[axis] = 1e-6;
            let numeric = (camera.project(&(point + step)).expect("in front")
                - camera.project(&(point - step)).expect("in front"))
                / 2e-6;
            assert!((numeric - jacobian.column(axis)).norm() < 1e-4 * jacobian.norm());
        }
    }

    #[test]
    fn a_reduced_pixel_is_the_mean_of_its_pixels() {
        let camera = distorted_camera();
        let point = Point3::new(0.1, 0.05, 0.9);
        let full = camera.project(&point).expect("in front");
        let half = camera.reduced(2).project(&point).expect("in front");
        assert!((half - (full.add_scalar(0.5) / 2.0).add_scalar(-0.5)).norm() < 1e-9);
    }
}
