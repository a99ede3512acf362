//! The ball before a plane that fills the image, frame by frame.
//!
//! Where a plane fills the image, a camera that moves is held by nothing but the ball on it, and a model of several frames smears
//! that. One frame tells a ball alone: what stands out of the plane in one piece is one if a single sphere explains it, and if
//! nearly all that the camera would see of that sphere is seen.
//!
//! Not handled: a ball that touches, in the image, something else that stands out of the plane.

use super::model::meet_sphere;
use super::plane::{ON_PLANE_SIGMAS, point_of};
use super::sphere::{BallRadius, FoundSphere, ON_PLANE_M, refit, tolerance_m};
use crate::fusion::DepthNoise;
use crate::geometry::{Plane, RayGrid};
use crate::robust::{Tukey, median};
use depth_camera::Image;
use nalgebra::{Matrix4, Point3, Vector3, Vector4};
use std::ops::RangeInclusive;

/// A ball in one depth image.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Ball {
    /// Its centre, camera frame, metres.
    pub centre: Point3<f64>,
    /// Its radius, metres.
    pub radius_m: f64,
    /// Share of its front within the image that has depth on it.
    pub seen_share: f64,
}

/// Balls that are told, metres: one of 5 cm across still is at 1.2 m.
pub const BALL_RADII_M: RangeInclusive<f64> = 0.02..=0.4;
/// Smaller pieces are no targets.
const MIN_PIXELS: usize = 100;
const N_STEPS: usize = 10;
/// Depth lies on a sphere within so many sigmas of its noise, and within what multipath bends.
const ON_SPHERE_SIGMAS: f64 = 2.0;
/// Of a piece that a sphere explains so much lies on it: 0.83 and more of balls of 5 to 24 cm, simulated up to 1.2 m away and recorded;
/// 0.63 at most of simulated boxes, cups, cans and heads.
const MIN_ON_SPHERE: f64 = 0.7;
/// And of the sphere's front so much is seen: 0.70 and more of these balls, 0.51 at most of the others.
const MIN_SEEN: f64 = 0.6;
/// The centre of a ball lies at least this share of its radius before the plane. That of a dome does not, and that of the sphere which
/// the flat top of a box lies on is behind the plane.
const MIN_HEIGHT: f64 = 0.5;
/// Balls are alike whose radii differ by less than this share: at 1.2 m noise makes one of 5 cm 13 % smaller.
const ALIKE: f64 = 0.2;
/// A session shows a ball if this share of its frames does; arbitrary.
const MIN_FRAMES: f64 = 1.0 / 3.0;

/// The ball before a plane in a depth image (metres, 0 is none), if there is one.
pub fn ball_before(
    plane: &Plane,
    depth_m: &Image<f32>,
    rays: &RayGrid,
    noise: &DepthNoise,
) -> Option<Ball> {
    let view = View {
        plane,
        depth_m,
        rays,
        noise,
    };
    let balls = view.pieces().into_iter().filter_map(|piece| {
        let (centre, radius_m) = view.sphere_of(&piece)?;
        let seen_share = view.seen_share(&centre, radius_m);
        (seen_share >= MIN_SEEN).then_some(Ball {
            centre,
            radius_m,
            seen_share,
        })
    });
    balls.max_by(|a, b| a.seen_share.total_cmp(&b.seen_share))
}

/// Whether two radii may be those of one ball.
pub fn are_alike(radius_m: f64, other_m: f64) -> bool {
    (radius_m / other_m - 1.0).abs() < ALIKE
}

/// What the frames of a session show of balls.
#[derive(Debug, Default)]
pub struct Sightings {
    balls: Vec<Ball>,
    n_frames: usize,
}

impl Sightings {
    /// Takes in what a frame shows.
    pub fn add(&mut self, ball: Option<Ball>) {
        self.balls.extend(ball);
        self.n_frames += 1;
    }

    /// The ball that the frames agree on, at the origin of its own frame; `None` where too few show one.
    pub fn agreed(&self, radius: BallRadius) -> Option<FoundSphere> {
        let radius_m = match radius {
            BallRadius::Given(radius_m) => radius_m,
            BallRadius::Unknown => {
                let mut radii: Vec<f64> = self.balls.iter().map(|ball| ball.radius_m).collect();
                median(&mut radii)?
            }
        };
        let alike = self.balls.iter();
        let alike = alike.filter(|ball| are_alike(ball.radius_m, radius_m));
        let mut seen_shares: Vec<f64> = alike.map(|ball| ball.seen_share).collect();
        let is_shown = seen_shares.len() as f64 >= MIN_FRAMES * self.n_frames as f64;
        let coverage = median(&mut seen_shares)?;
        is_shown.then_some(FoundSphere {
            centre_world: Point3::origin(),
            radius_m,
            radius_sigma_m: radius.sigma_m(radius_m),
            coverage,
        })
    }
}

/// One depth image and the plane that fills it.
struct View<'a> {
    plane: &'a Plane,
    depth_m: &'a Image<f32>,
    rays: &'a RayGrid,
    noise: &'a DepthNoise,
}

impl View<'_> {
    /// What stands out of the plane, piece by piece: pixels that touch by their sides.
    fn pieces(&self) -> Vec<Vec<Point3<f64>>> {
        let (width, height) = (self.depth_m.width(), self.depth_m.height());
        // Without those that belong to a piece already.
        let mut standing_out = self.standing_out();
        let mut pieces = Vec::new();
        for start in 0..standing_out.len() {
            if standing_out[start].is_none() {
                continue;
            }
            let (mut piece, mut rim) = (Vec::new(), vec![start]);
            while let Some(pixel) = rim.pop() {
                let Some(point) = standing_out[pixel].take() else {
                    continue;
                };
                piece.push(point);
                let (u, v) = (pixel % width, pixel / width);
                rim.extend((u > 0).then(|| pixel - 1));
                rim.extend((u + 1 < width).then(|| pixel + 1));
                rim.extend((v > 0).then(|| pixel - width));
                rim.extend((v + 1 < height).then(|| pixel + width));
            }
            if piece.len() >= MIN_PIXELS {
                pieces.push(piece);
            }
        }
        pieces
    }

    /// Of each pixel the point that it sees, if that stands out of the plane.
    fn standing_out(&self) -> Vec<Option<Point3<f64>>> {
        let pixels = self.rays.rays().data().iter().zip(self.depth_m.data());
        let points = pixels.map(|(ray, &z)| {
            let point = point_of(&(ray.map(f64::from), z));
            let noise_m = ON_PLANE_SIGMAS * f64::from(self.noise.sigma_m(z));
            let stands_out = self.plane.height_m(&point) > ON_PLANE_M.max(noise_m);
            (z > 0.0 && stands_out).then_some(point)
        });
        points.collect()
    }

    /// Centre and radius of the ball that explains a piece, if one does.
    fn sphere_of(&self, piece: &[Point3<f64>]) -> Option<(Point3<f64>, f64)> {
        let (mut centre, mut r) = sphere_through(piece)?;
        for _ in 0..N_STEPS {
            let weighted = piece.iter().map(|point| {
                let loss = Tukey {
                    scale: self.tolerance_m(point, r),
                    cutoff: 3.0,
                };
                (*point, loss.weight((point - centre).norm() - r))
            });
            (centre, r) = refit(weighted, &centre, r, BallRadius::Unknown)?;
        }
        let on_sphere = piece
            .iter()
            .filter(|point| self.is_on_sphere(point, &centre, r));
        let is_explained = on_sphere.count() as f64 >= MIN_ON_SPHERE * piece.len() as f64;
        let is_ball = self.plane.height_m(&centre) > MIN_HEIGHT * r && centre.z > r;
        (is_explained && is_ball && BALL_RADII_M.contains(&r)).then_some((centre, r))
    }

    /// Of what a sphere would show before the plane the share that has depth on it.
    fn seen_share(&self, centre: &Point3<f64>, r: f64) -> f64 {
        let (mut n_expected, mut n_seen) = (0usize, 0usize);
        for (ray, &z) in self.rays.rays().data().iter().zip(self.depth_m.data()) {
            let ray = ray.map(f64::from);
            let Some(at) = meet_sphere(ray, &centre.coords, r) else {
                continue;
            };
            // Nothing is expected along rays that the lens does not have.
            if self.plane.height_m(&at.point) > 0.0 {
                n_expected += 1;
                let is_seen = z > 0.0 && self.is_on_sphere(&point_of(&(ray, z)), centre, r);
                n_seen += usize::from(is_seen);
            }
        }
        n_seen as f64 / n_expected.max(1) as f64
    }

    fn is_on_sphere(&self, point: &Point3<f64>, centre: &Point3<f64>, r: f64) -> bool {
        ((point - centre).norm() - r).abs() < self.tolerance_m(point, r)
    }

    fn tolerance_m(&self, point: &Point3<f64>, r: f64) -> f64 {
        let sigma_m = f64::from(self.noise.sigma_m(point.z as f32));
        tolerance_m(r).max(ON_SPHERE_SIGMAS * sigma_m)
    }
}

/// The sphere `|p|² = 2 c·p + (r² − |c|²)` through points by linear least squares, about their mean; `None` where there is none.
fn sphere_through(points: &[Point3<f64>]) -> Option<(Point3<f64>, f64)> {
    let sum: Vector3<f64> = points.iter().map(|point| point.coords).sum();
    let mean = sum / points.len() as f64;
    let (mut jtj, mut jtr) = (Matrix4::zeros(), Vector4::zeros());
    for point in points {
        let arm = point.coords - mean;
        let row = Vector4::new(2.0 * arm.x, 2.0 * arm.y, 2.0 * arm.z, 1.0);
        jtj += row * row.transpose();
        jtr += row * arm.norm_squared();
    }
    let solution = jtj.cholesky()?.solve(&jtr);
    let squared = solution.w + solution.xyz().norm_squared();
    let centre = Point3::from(mean + solution.xyz());
    (squared > 0.0).then(|| (centre, squared.sqrt()))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::CameraModel;
    use depth_camera::{Intrinsics, Sensor};

    fn rays() -> RayGrid {
        RayGrid::new(CameraModel::new(Intrinsics {
            width: 320,
            height: 240,
            fx: 240.0,
            fy: 240.0,
            cx: 159.5,
            cy: 119.5,
            k1: 0.0,
            k2: 0.0,
            p1: 0.0,
            p2: 0.0,
            k3: 0.0,
        }))
    }

    /// What is found in a depth image of a table 0.8 m away on which rays meet things at other depths, with noise of ±1.5 mm.
    fn found(thing: impl Fn(&Plane, [f64; 2]) -> Option<f64>) -> Option<Ball> {
        let rays = rays();
        let table = table();
        let mut random = fastrand::Rng::with_seed(2);
        let depths = rays.rays().data().iter().map(|ray| {
            let ray = ray.map(f64::from);
            let z = thing(&table, ray).unwrap_or_else(|| table.met_by(ray).expect("before it").z);
            (z + 0.003 * (random.f64() - 0.5)) as f32
        });
        let depth = Image::from_vec(320, 240, depths.collect());
        let noise = DepthNoise::of_sensor(Sensor::Kinect2);
        ball_before(&table, &depth, &rays, &noise)
    }

    fn table() -> Plane {
        Plane {
            normal: Vector3::new(0.0, -0.6, -0.8),
            offset_m: -0.64,
        }
    }

    /// A point above the middle of the table.
    fn above(height_m: f64) -> Point3<f64> {
        let foot = table().met_by([0.05, 0.02]).expect("before the camera");
        foot + table().normal * height_m
    }

    #[test]
    fn a_ball_of_six_centimetres_is_found_in_one_image() {
        let centre = above(0.03);
        let ball = found(|_, ray| Some(meet_sphere(ray, &centre.coords, 0.03)?.point.z));
        let ball = ball.expect("a ball");
        assert!((ball.radius_m - 0.03).abs() < 0.001, "{ball:?}");
        assert!((ball.centre - centre).norm() < 0.002, "{ball:?}");
        assert!(ball.seen_share > 0.9, "{ball:?}");
    }

    #[test]
    fn half_a_ball_a_block_and_a_bare_table_are_none() {
        let middle = above(0.0);
        let half = found(|table, ray| {
            let on_sphere = meet_sphere(ray, &middle.coords, 0.03)?.point;
            (table.height_m(&on_sphere) > 0.0).then_some(on_sphere.z)
        });
        assert_eq!(half, None);
        // The top of a block of 10 cm by 10 cm, 6 cm high.
        let block = found(|table, ray| {
            let top = Plane::through(&above(0.06), table.normal).met_by(ray)?;
            let aside = top - above(0.06);
            let along = aside.dot(&table.normal.cross(&Vector3::x()));
            (aside.x.abs() < 0.05 && along.abs() < 0.05).then_some(top.z)
        });
        assert_eq!(block, None);
        assert_eq!(found(|_, _| None), None);
    }

    #[test]
    fn frames_agree_on_a_ball_that_a_third_of_them_show() {
        let ball = |radius_m: f64| Ball {
            centre: Point3::new(0.0, 0.0, 0.7),
            radius_m,
            seen_share: 0.9,
        };
        let mut sightings = Sightings::default();
        assert_eq!(sightings.agreed(BallRadius::Unknown), None);
        for radius_m in [Some(0.05), None, Some(0.052), None, Some(0.12), None] {
            sightings.add(radius_m.map(ball));
        }
        let sphere = sightings.agreed(BallRadius::Unknown).expect("two of six");
        assert_eq!((sphere.radius_m, sphere.coverage), (0.052, 0.9));
        assert_eq!(sightings.agreed(BallRadius::Given(0.12)), None);
        sightings.add(None);
        assert_eq!(sightings.agreed(BallRadius::Unknown), None);
    }
}
