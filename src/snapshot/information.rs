//! What a view tells about the tilt of the surface.
//!
//! With the unit normal n and the unit vector l to the light, tilting the surface by a small tangential vector e changes
//! the brightness `n·l` by `e·t` with `t = l − (n·l) n`: nothing where the surface is seen head-on, for light and camera
//! are almost together. A view's information about a *patch* of the surface (20 mm wide) is the sum of `t tᵀ` over the
//! pixels that show it. Three numbers would do in the patch's tangent plane; in the world frame the sums of different
//! views need no common basis, at the price of six.

use super::ShadingSnapshot;
use super::exposures::SATURATION;
use crate::fusion::ModelMap;
use depth_camera::CameraInfo;
use nalgebra::{Point3, Vector3};

/// Pixels darker than this share of full scale carry more noise than shading.
const DARKEST: f64 = 0.005;
/// Side of a patch, metres: a dozen edges of a refined mesh, and small against an object.
const PATCH_M: f64 = 0.02;
/// The surface is looked at about every so many pixels of the full image, along rows and columns.
const SAMPLE_PX: usize = 4;
/// Refinement is of the object that the operator points at: a pixel counts by a Gaussian of its angle to the optical axis
/// with this deviation, 8°: 84 mm at 0.6 m. Arbitrary.
const ATTENTION_RAD: f64 = 0.14;
/// Pixels beyond this many deviations are not looked at; they would weigh less than 0.02.
const ATTENTION_REACH: f64 = 2.8;
/// Surface seen or lit at a smaller cosine is not looked at (70°): its footprint is three pixels long.
const MIN_COSINE: f64 = 0.342;
/// The distance at which a pixel's noise and the error of the model are about as large, metres. Beyond it the change of
/// brightness fades with the square of the distance against the noise; nearer, the relative change is what counts.
const REFERENCE_M: f64 = 0.6;
/// A patch is worth half of what it can be worth to first order when its sum of `t tᵀ` reaches this: one view at 30°
/// from 0.6 m. Arbitrary.
const HALF_INFORMATION: f64 = 0.25;

/// What information depends on beside the view.
#[derive(Clone, Copy, Debug)]
pub(super) struct Optics {
    /// Position of the light in the camera frame, metres.
    pub(super) light_camera: Point3<f64>,
    /// IR counts at full scale.
    pub(super) full_scale: f64,
    /// Focal lengths of the full image, pixels.
    pub(super) focal_px: [f64; 2],
}

impl Optics {
    /// The optics of a camera, `None` if it has no IR or no light.
    pub(super) fn new(info: &CameraInfo) -> Option<Self> {
        Some(Optics {
            light_camera: Point3::from(info.light?.position_m),
            full_scale: info.ir_full_scale?,
            focal_px: [info.intrinsics.fx, info.intrinsics.fy],
        })
    }
}

/// Names a patch: a cell of the world grid and the axis that its surface faces. The axis keeps the sides of a thin wall
/// apart; unlike an octant it does not change with the noise of a normal along an axis.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub(super) struct PatchKey(u64);

impl PatchKey {
    fn of(point_world: &Vector3<f64>, normal_world: &Vector3<f64>) -> Self {
        // 20 bits a coordinate reach 10 km to either side.
        let cell =
            point_world.map(|x| ((x / PATCH_M).floor() as i64 + (1 << 19)) as u64 & 0xf_ffff);
        let axis = normal_world.iamax();
        let face = 2 * axis as u64 + u64::from(normal_world[axis] > 0.0);
        PatchKey(cell.x << 43 | cell.y << 23 | cell.z << 3 | face)
    }
}

/// Sum of `t tᵀ` over [`HALF_INFORMATION`]: the upper triangle, row by row.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(super) struct Information([f64; 6]);

impl Information {
    fn of_tangent(t: &Vector3<f64>, weight: f64) -> Self {
        let w = weight / HALF_INFORMATION;
        Information([
            w * t.x * t.x,
            w * t.x * t.y,
            w * t.x * t.z,
            w * t.y * t.y,
            w * t.y * t.z,
            w * t.z * t.z,
        ])
    }

    pub(super) fn plus(&self, other: &Information) -> Information {
        Information(std::array::from_fn(|i| self.0[i] + other.0[i]))
    }

    pub(super) fn minus(&self, other: &Information) -> Information {
        Information(std::array::from_fn(|i| self.0[i] - other.0[i]))
    }

    /// Determinant of the identity plus this; at least 1 but for rounding.
    pub(super) fn determinant(&self) -> f64 {
        let [xx, xy, xz, yy, yz, zz] = self.0;
        let (a, b, c) = (1.0 + xx, 1.0 + yy, 1.0 + zz);
        a * (b * c - yz * yz) - xy * (xy * c - yz * xz) + xz * (xy * yz - b * xz)
    }
}

/// What one view tells.
#[derive(Clone, Debug, Default)]
pub(super) struct ViewInformation {
    /// By patch, keys in increasing order.
    pub(super) patches: Vec<(PatchKey, Information)>,
    /// The middle of the surface that the camera looks at, world frame; `None` if there is none near the axis.
    pub(super) target_world: Option<Point3<f64>>,
}

/// Measures what a shading image tells about the surface of `model`, which was seen from (almost) the same pose.
pub(super) fn view_information(
    snapshot: &ShadingSnapshot,
    model: &ModelMap,
    optics: &Optics,
) -> ViewInformation {
    let eye = snapshot.world_from_camera.translation.vector;
    let axis = snapshot.world_from_camera.rotation * Vector3::z();
    let light = (snapshot.world_from_camera * optics.light_camera).coords;
    let usable = DARKEST * optics.full_scale..SATURATION * optics.full_scale;

    let (width, height) = (model.points.width(), model.points.height());
    let factor = snapshot.ir_counts.width() / width;
    let step = (SAMPLE_PX / factor.max(1)).max(1);
    let pixel_solid_angle = (step * factor).pow(2) as f64 / optics.focal_px.iter().product::<f64>();
    // Pixels are counted in those of a patch seen head-on at the reference distance: near views have more of them.
    let unit = pixel_solid_angle * (REFERENCE_M / PATCH_M).powi(2);
    let min_cos_axis = (ATTENTION_RAD * ATTENTION_REACH).cos();

    let mut samples = Vec::new();
    let (mut target, mut weights) = (Vector3::zeros(), 0.0);
    for v in (0..height).step_by(step) {
        for u in (0..width).step_by(step) {
            let normal = model.normals.at(u, v).cast::<f64>();
            let point = model.points.at(u, v).cast::<f64>();
            let (to_eye, to_light) = (eye - point, light - point);
            let distance = to_eye.norm();
            let cos_axis = -to_eye.dot(&axis) / distance;
            if normal == Vector3::zeros() || cos_axis < min_cos_axis {
                continue;
            }
            let attention = (-0.5 * (cos_axis.acos() / ATTENTION_RAD).powi(2)).exp();
            target += point * attention;
            weights += attention;

            let l = to_light / to_light.norm();
            let (cos_view, cos_light) = (normal.dot(&to_eye) / distance, normal.dot(&l));
            let counts = *snapshot
                .ir_counts
                .at(u * factor + factor / 2, v * factor + factor / 2);
            if cos_view.min(cos_light) < MIN_COSINE || !usable.contains(&f64::from(counts)) {
                continue;
            }
            let signal = (REFERENCE_M / to_light.norm()).powi(2).min(1.0);
            let t = (l - normal * cos_light) * signal;
            // A slanted footprint blurs: detail across it is lost in proportion.
            let weight = unit * attention * cos_axis.powi(3) * cos_view;
            samples.push((
                PatchKey::of(&point, &normal),
                Information::of_tangent(&t, weight),
            ));
        }
    }
    ViewInformation {
        patches: by_patch(samples),
        target_world: (weights > 0.0).then(|| Point3::from(target / weights)),
    }
}

/// Adds up the samples of each patch.
fn by_patch(mut samples: Vec<(PatchKey, Information)>) -> Vec<(PatchKey, Information)> {
    samples.sort_by_key(|(key, _)| *key);
    samples
        .chunk_by(|a, b| a.0 == b.0)
        .map(|patch| {
            let sum = Information::default();
            let sum = patch.iter().fold(sum, |sum, (_, sample)| sum.plus(sample));
            (patch[0].0, sum)
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::snapshot::scenes::{self, Plane};
    use depth_camera::Sensor;
    use nalgebra::Matrix3;

    fn trace(view: &ViewInformation) -> f64 {
        let sums = view.patches.iter().map(|(_, i)| i.0[0] + i.0[3] + i.0[5]);
        sums.sum()
    }

    /// The view of a plane whose normal leans by `tilt_rad` from a camera 0.4 m before it, with the light in the camera.
    fn view_of(tilt_rad: f64) -> ViewInformation {
        let plane = Plane::tilted(tilt_rad, 0.0);
        let optics = Optics {
            light_camera: Point3::origin(),
            ..Optics::new(&scenes::camera_info(Sensor::Kinect2)).unwrap()
        };
        let pose = nalgebra::Isometry3::translation(0.0, 0.0, 0.2);
        let (snapshot, model) = scenes::view_of_plane(&plane, &pose);
        view_information(&snapshot, &model, &optics)
    }

    #[test]
    fn determinant_is_that_of_the_matrix() {
        let t = Vector3::new(0.3, -0.2, 0.5);
        let s = Vector3::new(-0.1, 0.7, 0.2);
        let sum = Information::of_tangent(&t, 2.0).plus(&Information::of_tangent(&s, 1.0));
        let matrix =
            Matrix3::identity() + (t * t.transpose() * 2.0 + s * s.transpose()) / HALF_INFORMATION;
        assert!((sum.determinant() - matrix.determinant()).abs() < 1e-12 * matrix.determinant());
        let rest = sum.minus(&Information::of_tangent(&s, 1.0));
        let alone = 1.0 + 2.0 * t.norm_squared() / HALF_INFORMATION;
        assert!((rest.determinant() - alone).abs() < 1e-12 * alone);
    }

    #[test]
    fn a_surface_seen_head_on_tells_least() {
        let tilts = [0.0, 20.0, 40.0, 60.0, 75.0];
        let [head_on, t20, t40, t60, t75] =
            tilts.map(|tilt: f64| trace(&view_of(tilt.to_radians())));
        // Perspective tilts the surface beside the axis: by 8° in each direction, 2 · 0.14² against sin² 20°.
        assert!(head_on < 0.4 * t20);
        assert!(t20 < t40);
        // Beyond 60° fewer pixels show the surface, and at 75° all but the nearest are too slanted.
        assert!(t60 < 1.5 * t40 && t75 < 0.5 * t60, "{t40} {t60} {t75}");
    }

    #[test]
    fn information_of_a_tilted_plane_is_the_closed_form() {
        // The Gaussian's solid angle over that of a patch at the reference distance, times cosine and sine squared; the
        // whole view is nearer than that distance.
        let tilt = 30.0_f64.to_radians();
        let expected = 2.0
            * std::f64::consts::PI
            * (ATTENTION_RAD * REFERENCE_M / PATCH_M).powi(2)
            * tilt.cos()
            * tilt.sin().powi(2)
            / HALF_INFORMATION;
        let measured = trace(&view_of(tilt));
        // The tilt that perspective adds is of both signs; its square and the cut at 2.8 sigmas leave some.
        assert!(
            (measured / expected - 1.0).abs() < 0.15,
            "{measured} {expected}"
        );
    }

    #[test]
    fn saturated_and_black_pixels_tell_nothing() {
        let plane = Plane::tilted(0.5, 0.0);
        let optics = Optics::new(&scenes::camera_info(Sensor::Kinect2)).unwrap();
        let (mut snapshot, model) = scenes::view_of_plane(&plane, &nalgebra::Isometry3::identity());
        for counts in [65535.0, 0.0] {
            snapshot.ir_counts = snapshot.ir_counts.map(|_| counts);
            let view = view_information(&snapshot, &model, &optics);
            assert!(view.patches.is_empty() && view.target_world.is_some());
        }
    }
}
