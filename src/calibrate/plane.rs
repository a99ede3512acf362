//! The plane of a wall in one depth image.

use crate::fusion::DepthNoise;
use crate::geometry::{Plane, Pose, RayGrid};
use crate::robust::Tukey;
use depth_camera::Image;
use nalgebra::{Isometry3, Matrix3, Point3, Translation3, UnitQuaternion, Vector3};

/// The plane that most of a depth image lies on.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct DominantPlane {
    /// In the camera frame; its normal faces the camera.
    pub plane: Plane,
    /// Share of the image's depth that lies on it.
    pub share: f64,
}

impl DominantPlane {
    /// Share of a depth image (metres, 0 is none) that lies farther before the plane than this, metres.
    pub fn share_before(&self, depth_m: &Image<f32>, rays: &RayGrid, beyond_m: f64) -> f64 {
        let pixels = pixels_with_depth(depth_m, rays);
        let heights_m = pixels.iter().map(|p| self.plane.height_m(&point_of(p)));
        let before = heights_m.filter(|height_m| *height_m > beyond_m);
        before.count() as f64 / pixels.len().max(1) as f64
    }

    /// Where a camera is against the plane, as far as that tells: its distance, and the least turn that makes it look straight on.
    pub fn plane_from_camera(&self) -> Pose {
        let distance_m = self.plane.height_m(&Point3::origin());
        Isometry3::from_parts(Translation3::new(0.0, 0.0, -distance_m), self.turn())
    }

    /// Where a camera is against something on the plane that it sees at a point of its frame, turned as against the plane.
    pub fn thing_from_camera(&self, place: &Point3<f64>) -> Pose {
        let turn = self.turn();
        Isometry3::from_parts(Translation3::from(-(turn * place.coords)), turn)
    }

    /// The least turn that makes a camera look straight on.
    fn turn(&self) -> UnitQuaternion<f64> {
        let straight_on: Vector3<f64> = -Vector3::z();
        let turn = UnitQuaternion::rotation_between(&self.plane.normal, &straight_on);
        turn.unwrap_or_else(UnitQuaternion::identity)
    }
}

/// How far a depth pixel lies from a plane along the optical axis, in sigmas of its noise.
pub fn residual_sigmas(plane: &Plane, ray: [f64; 2], depth_m: f32, noise: &DepthNoise) -> f64 {
    match plane.met_by(ray) {
        Some(point) => (f64::from(depth_m) - point.z) / f64::from(noise.sigma_m(depth_m)),
        None => f64::INFINITY,
    }
}

/// Depth within this many sigmas of a plane lies on it: quantised and correlated depth of a Kinect I stays within 4.
pub const ON_PLANE_SIGMAS: f64 = 5.0;
const N_DRAWS: usize = 300;
const N_SCORED: usize = 2_000;
/// Every so many pixels of the image are looked at.
const STRIDE: usize = 3;

/// The plane that most of a depth image lies on: RANSAC, then reweighted least squares on depth over its noise.
/// `None` without enough depth.
pub fn dominant_plane(
    depth_m: &Image<f32>,
    rays: &RayGrid,
    noise: &DepthNoise,
) -> Option<DominantPlane> {
    let pixels = pixels_with_depth(depth_m, rays);
    if pixels.len() < 100 {
        return None;
    }
    let mut random = fastrand::Rng::with_seed(1);
    let mut best: Option<DominantPlane> = None;
    let scored: Vec<_> = (0..N_SCORED.min(pixels.len()))
        .map(|_| pixels[random.usize(..pixels.len())])
        .collect();
    for _ in 0..N_DRAWS {
        let [a, b, c] = std::array::from_fn(|_| point_of(&pixels[random.usize(..pixels.len())]));
        if let Some(plane) = plane_through(&a, &b, &c) {
            let drawn = with_share(plane, &scored, noise);
            if best.is_none_or(|best| drawn.share > best.share) {
                best = Some(drawn);
            }
        }
    }
    let mut plane = best?.plane;
    for _ in 0..10 {
        plane = refit(&plane, &pixels, noise)?;
    }
    Some(with_share(plane, &pixels, noise))
}

/// Ray and depth of a pixel.
type RangePixel = ([f64; 2], f32);

fn pixels_with_depth(depth_m: &Image<f32>, rays: &RayGrid) -> Vec<RangePixel> {
    let all = (0..depth_m.height())
        .step_by(STRIDE)
        .flat_map(|v| (0..depth_m.width()).step_by(STRIDE).map(move |u| (u, v)));
    all.filter_map(|(u, v)| {
        let [x, y] = *rays.rays().at(u, v);
        let z = *depth_m.at(u, v);
        (z > 0.0 && x.is_finite()).then_some(([x as f64, y as f64], z))
    })
    .collect()
}

/// What a pixel sees, camera frame, metres.
pub fn point_of(([x, y], z): &RangePixel) -> Point3<f64> {
    Point3::new(*x, *y, 1.0) * f64::from(*z)
}

/// The plane through three points; `None` if they are in line, or in a plane with the camera.
pub fn plane_through(a: &Point3<f64>, b: &Point3<f64>, c: &Point3<f64>) -> Option<Plane> {
    let normal = (b - a).cross(&(c - a)).try_normalize(1e-6)?;
    facing_camera(normal, normal.dot(&a.coords))
}

/// The plane `normal · p = offset`, turned towards the camera; `None` through the camera.
fn facing_camera(normal: Vector3<f64>, offset: f64) -> Option<Plane> {
    (offset.abs() > 1e-6).then(|| Plane {
        normal: normal * -offset.signum(),
        offset_m: -offset.abs(),
    })
}

fn with_share(plane: Plane, pixels: &[RangePixel], noise: &DepthNoise) -> DominantPlane {
    let on_plane =
        |(ray, z): &&RangePixel| residual_sigmas(&plane, *ray, *z, noise).abs() < ON_PLANE_SIGMAS;
    DominantPlane {
        plane,
        share: pixels.iter().filter(on_plane).count() as f64 / pixels.len() as f64,
    }
}

/// One step of least squares on inverse depth, `1/z = a x + b y + c`, which is linear and keeps its noise simple.
fn refit(plane: &Plane, pixels: &[RangePixel], noise: &DepthNoise) -> Option<Plane> {
    let loss = Tukey {
        scale: 1.0,
        cutoff: ON_PLANE_SIGMAS,
    };
    let (mut jtj, mut jtr) = (Matrix3::zeros(), Vector3::zeros());
    for ([x, y], z) in pixels {
        let share = loss.weight(residual_sigmas(plane, [*x, *y], *z, noise));
        if share == 0.0 {
            continue;
        }
        let z_m = f64::from(*z);
        let sigma = f64::from(noise.sigma_m(*z)) / (z_m * z_m);
        let weight = share / (sigma * sigma);
        let row = Vector3::new(*x, *y, 1.0);
        jtj += row * row.transpose() * weight;
        jtr += row * (weight / z_m);
    }
    let coefficients = jtj.cholesky()?.solve(&jtr);
    let norm = coefficients.norm();
    facing_camera(coefficients / norm, 1.0 / norm)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::CameraModel;
    use depth_camera::{Intrinsics, Sensor};

    #[test]
    fn a_tilted_wall_behind_an_object_is_found_to_a_tenth_of_a_millimetre() {
        let rays = RayGrid::new(CameraModel::new(Intrinsics {
            width: 160,
            height: 120,
            fx: 120.0,
            fy: 120.0,
            cx: 79.5,
            cy: 59.5,
            k1: 0.0,
            k2: 0.0,
            p1: 0.0,
            p2: 0.0,
            k3: 0.0,
        }));
        let truth = Plane {
            normal: Vector3::new(0.1, -0.05, -1.0)
                .try_normalize(0.0)
                .expect("not zero"),
            offset_m: -0.9,
        };
        let mut random = fastrand::Rng::with_seed(3);
        let depths = (0..160 * 120)
            .map(|pixel| {
                let ray = rays.rays().at(pixel % 160, pixel / 160).map(f64::from);
                let z = truth.met_by(ray).expect("in front").z as f32;
                let object = pixel % 160 < 30;
                if object {
                    0.6
                } else {
                    z + 0.002 * (random.f32() - 0.5)
                }
            })
            .collect();
        let depth = Image::from_vec(160, 120, depths);
        let noise = DepthNoise::of_sensor(Sensor::Kinect2);
        let found = dominant_plane(&depth, &rays, &noise).expect("a wall");
        assert!((found.plane.offset_m + 0.9).abs() < 1e-4);
        assert!(found.plane.normal.angle(&truth.normal) < 3e-4);
        assert!((found.share - 130.0 / 160.0).abs() < 0.02);
        // The plane lies at z = 0 of its frame, something on it at the origin of the other.
        let thing = Point3::new(0.1, 0.0, 0.7);
        let height_m = found.plane.height_m(&thing);
        assert!(((found.plane_from_camera() * thing).z + height_m).abs() < 1e-12);
        let seen = found.thing_from_camera(&thing) * thing;
        assert!(seen.coords.norm() < 1e-12);
    }
}
