//! The lamp as a camera, whose depth buffer tells what lies in shadow.
//!
//! A pinhole with the camera's orientation, and of its image plane the window where the object is. A lamp near the camera looks over
//! 100°, more than the camera sees; one farther aside looks at what the camera sees from where the lamp stands.
//!
//! Not handled: what lies behind the lamp, or beyond [`MAX_TANGENT`] off its axis, counts as hidden.

use crate::geometry::{CameraModel, RayGrid};
use nalgebra::Point3;

/// Pixels along a side at most; so many cover 100°.
const SIDE: f64 = 800.0;
/// Pixels along a side at least.
const LEAST: f64 = 16.0;
/// Reach round the object in radii: what is displaced, and pixels beside what is looked at.
const ROUND_IT: f64 = 1.2;
/// Pixels beside what the camera sees; no window is then narrower than [`LEAST`].
const BESIDE: f64 = 0.5 * LEAST;
/// No camera measures nearer, metres.
const NEAREST_SEEN_M: f64 = 0.3;
/// Nothing is looked at nearer to the lamp's plane, metres; arbitrary, since [`MAX_TANGENT`] bounds it before.
const NEAREST_LIT_M: f64 = 0.001;
/// Largest tangent off the axis, 79°: little more is not grazing for whatever faces the camera.
const MAX_TANGENT: f64 = 5.0;

/// The lamp's "camera": `centre` is the object's in the light's frame, `radius_m` its reach, `lamp` the light's place in the frame of
/// the camera, whose rays tell what it sees.
pub fn light_camera(
    centre: &Point3<f64>,
    radius_m: f64,
    lamp: &Point3<f64>,
    rays: &RayGrid,
) -> CameraModel {
    let reach = ROUND_IT * radius_m;
    let depths_m = [centre.z - reach, centre.z + reach];
    let sight = sight(rays);
    let [x, y] = [0, 1].map(|axis| {
        let field = field(sight[axis], [lamp[axis], lamp.z], depths_m);
        let sides_m = [centre[axis] - reach, centre[axis] + reach];
        Window::new(sides_m, depths_m, field)
    });
    CameraModel::pinhole(
        [x.n_pixels, y.n_pixels],
        [x.focal_px, y.focal_px],
        [x.centre_px, y.centre_px],
    )
}

/// One axis of the lamp's camera.
struct Window {
    n_pixels: usize,
    focal_px: f64,
    /// Where the lamp's axis meets the image, which may be outside it.
    centre_px: f64,
}

impl Window {
    /// The part of a field (pixels of the whole plane) where the object is, whose sides lie between two depths. What would have too
    /// many pixels gets larger ones.
    fn new(sides_m: [f64; 2], depths_m: [f64; 2], field: [f64; 2]) -> Window {
        let [low, high] = match depths_m[0] > 0.0 {
            true => {
                let tangents = sides_m
                    .into_iter()
                    .flat_map(|side| depths_m.map(|z| side / z));
                let around = [f64::MAX, f64::MIN];
                tangents.map(pixel).fold(around, |[low, high], pixel| {
                    [low.min(pixel), high.max(pixel)]
                })
            }
            false => field,
        };
        let first = low.floor().clamp(field[0], field[1] - LEAST);
        let width = (high.ceil().min(field[1]) - first).max(LEAST);
        let shrink = (SIDE / width).min(1.0);
        Window {
            n_pixels: width.min(SIDE) as usize,
            focal_px: shrink * focal_px(),
            centre_px: shrink * (principal_px() - first),
        }
    }
}

/// Pixels of the whole plane, along one axis, between which the lamp looks. `sight` are the tangents between which the camera sees,
/// `lamp` its place along the axis and along the camera's; the object lies between two depths before the lamp.
fn field(sight: [f64; 2], lamp: [f64; 2], depths_m: [f64; 2]) -> [f64; 2] {
    let [aside, ahead] = lamp;
    let nearest = depths_m[0].max(NEAREST_SEEN_M - ahead).max(NEAREST_LIT_M);
    let depths_m = [nearest, depths_m[1].max(nearest)];
    // Monotonic in the depth.
    let tangents = |ray: f64| depths_m.map(|z| (ray * (z + ahead) - aside) / z);
    let [[a, b], [c, d]] = sight.map(tangents);
    let [low, high] = [a.min(b), c.max(d)].map(|end| pixel(end.clamp(-MAX_TANGENT, MAX_TANGENT)));
    let seen = [(low - BESIDE).floor(), (high + BESIDE).ceil()];
    match seen[0] >= 0.0 && seen[1] <= SIDE {
        true => [0.0, SIDE],
        false => seen,
    }
}

/// Least and largest X/Z, and Y/Z, that a camera sees: at the corners of its image or the middles of its sides.
fn sight(rays: &RayGrid) -> [[f64; 2]; 2] {
    let rays = rays.rays();
    let places = |n: usize| [0, n / 2, n - 1];
    let mut sight = [[0.0f64; 2]; 2];
    for v in places(rays.height()) {
        for u in places(rays.width()) {
            for (ends, &along) in sight.iter_mut().zip(rays.at(u, v)) {
                // A pixel without a ray is passed over.
                let along = f64::from(along);
                *ends = [ends[0].min(along), ends[1].max(along)];
            }
        }
    }
    sight
}

/// Focal length for a field of 100°, pixels.
fn focal_px() -> f64 {
    SIDE / 2.0 / 50.0f64.to_radians().tan()
}

/// Where the axis meets that field.
fn principal_px() -> f64 {
    (SIDE - 1.0) / 2.0
}

/// Pixel of a tangent on the whole plane.
fn pixel(tangent: f64) -> f64 {
    principal_px() + focal_px() * tangent
}

#[cfg(test)]
mod tests {
    use super::super::optics::Optics;
    use super::super::scenes::{RippledPlane, calibration, optics, poses, rays, views};
    use super::super::sites::{SiteKind, Sites, ViewSet};
    use super::*;
    use crate::shading::NearLight;
    use depth_camera::Intrinsics;
    use nalgebra::Vector3;

    /// Pixels beside the outermost that a point is looked for in.
    const MARGIN_PX: f64 = 2.0;
    /// A Kinect's.
    const NEAR: Point3<f64> = Point3::new(0.05, 0.0, 0.004);

    fn assert_looks_at_all(light: &CameraModel, centre: &Point3<f64>, radius_m: f64) {
        let corners = (-2..=2).flat_map(|i| (-2..=2).map(move |j| (i, j)));
        for (i, j) in corners {
            for k in -2..=2 {
                let direction = Vector3::new(f64::from(i), f64::from(j), f64::from(k));
                let Some(direction) = direction.try_normalize(0.0) else {
                    continue;
                };
                let point = centre + direction * radius_m;
                let pixel = light.project(&point).expect("before the light");
                assert!(light.contains(&pixel, MARGIN_PX), "{point}: {pixel}");
            }
        }
    }

    #[test]
    fn the_light_looks_at_all_of_the_object_and_at_little_else() {
        let radius_m = 0.12;
        for centre in [(0.0, 0.0, 0.6), (0.2, -0.1, 0.5), (-0.3, 0.2, 1.2)] {
            let centre = Point3::new(centre.0, centre.1, centre.2);
            let light = light_camera(&centre, radius_m, &NEAR, &rays());
            assert_looks_at_all(&light, &centre, radius_m);
            let Intrinsics { width, height, .. } = *light.intrinsics();
            assert!(width * height < 800 * 800 / 4, "{width} by {height}");
        }
    }

    #[test]
    fn a_lamp_near_the_camera_has_a_window_of_the_field_of_100_degrees() {
        let of = |centre: Point3<f64>| {
            let light = light_camera(&centre, 0.12, &NEAR, &rays());
            let Intrinsics { width, fx, cx, .. } = *light.intrinsics();
            assert_eq!(fx, focal_px());
            (width, cx)
        };
        // 0.144 m to either side at 0.456 m are 106 pixels.
        assert_eq!(of(Point3::new(0.0, 0.0, 0.6)), (213, 106.5));
        // What stands round the lamp is looked for everywhere, what reaches over the field up to its end.
        assert_eq!(of(Point3::new(0.0, 0.0, 0.1)), (800, 399.5));
        assert_eq!(of(Point3::new(-0.5, 0.0, 0.5)).1, 399.5);
    }

    #[test]
    fn a_lamp_far_aside_looks_at_the_object_too() {
        let (radius_m, in_camera) = (0.05, Point3::new(0.0, 0.0, 0.6));
        let aside = [
            (0.7, 0.0, 0.0),
            (1.2, 0.0, 0.0),
            (-0.3, 1.2, 0.1),
            (2.0, 0.0, 0.0),
        ];
        for lamp in aside {
            let lamp = Point3::new(lamp.0, lamp.1, lamp.2);
            let centre = Point3::from(in_camera - lamp);
            let light = light_camera(&centre, radius_m, &lamp, &rays());
            assert_looks_at_all(&light, &centre, radius_m);
            let Intrinsics { width, fx, .. } = *light.intrinsics();
            assert!(width <= 800 && fx == focal_px(), "{width}, {fx}");
        }
    }

    #[test]
    fn what_stands_round_the_light_or_beside_its_field_leaves_an_image() {
        for centre in [(0.0, 0.0, 0.1), (3.0, 0.0, 0.5), (-3.0, -3.0, 0.5)] {
            let centre = Point3::new(centre.0, centre.1, centre.2);
            let light = light_camera(&centre, 0.12, &NEAR, &rays());
            let Intrinsics { width, height, .. } = *light.intrinsics();
            assert!((16..=800).contains(&width) && (16..=800).contains(&height));
        }
        // The lamp's plane cuts the object: what lies before it is looked at, by larger pixels.
        let lamp = Point3::new(1.0, 0.0, 0.5);
        let centre = Point3::new(-1.0, 0.0, 0.1);
        let light = light_camera(&centre, 0.3, &lamp, &rays());
        let Intrinsics { width, fx, .. } = *light.intrinsics();
        assert!(width == 800 && fx < focal_px(), "{width}, {fx}");
        let before = Point3::new(-1.0, 0.0, 0.3);
        let pixel = light.project(&before).expect("before the light");
        assert!(light.contains(&pixel, MARGIN_PX), "{pixel}");
        assert_eq!(light.project(&Point3::new(-1.0, 0.0, -0.1)), None);
    }

    #[test]
    fn a_plane_that_a_lamp_far_aside_lights_is_not_in_shade() {
        let n_seen = |position: Point3<f64>| {
            let (rays, calibration) = (rays(), calibration());
            let near = optics(&rays, &calibration);
            let lit = Optics {
                light: NearLight {
                    position,
                    ..near.light
                },
                ..near
            };
            let plane = RippledPlane { amplitude_m: 0.0 };
            let mesh = plane.mesh(0.004);
            let views = views(&plane, &mesh, &lit, &poses(0.0)[..1]);
            let sites = Sites::new(SiteKind::Face, &mesh, &views, ViewSet::MAX);
            sites.visible.iter().filter(|views| **views != 0).count()
        };
        let of_near = n_seen(NEAR);
        assert!(of_near > 300, "{of_near}");
        for x in [0.7, 1.2] {
            let n = n_seen(Point3::new(x, 0.0, 0.0));
            assert!(n >= of_near * 9 / 10, "{n} of {of_near}");
        }
    }
}
