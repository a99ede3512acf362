//! What a view tells about the tilt of the surface.
//!
//! With the unit normal n and the unit vector l to the light, tilting the surface by a small tangential vector e changes
//! the brightness `n·l` by `e·t` with `t = l − (n·l) n`: nothing where the surface is seen head-on, for light and camera
//! are almost together. A view's information about a *patch* of the surface (20 mm wide) is the sum of `t tᵀ` over the
//! pixels that show it, kept apart by the side that the light comes from. Three numbers would do in the patch's tangent plane; in the world frame the sums of different
//! views need no common basis, at the price of six.

use super::ShadingSnapshot;
use crate::fusion::ModelMap;
use crate::geometry::tangents;
use crate::shading::SATURATION;
use depth_camera::CameraInfo;
use nalgebra::{Matrix2, Matrix3, Point3, Vector3};

/// Pixels darker than this share of full scale carry more noise than shading.
const DARKEST: f64 = 0.005;
/// Side of a patch, metres: a dozen edges of a refined mesh, and small against an object.
const PATCH_M: f64 = 0.02;
/// Side of a cell of light directions, as unit vectors: 14°. Views of one cell err alike (pose, depth bias, model), so they
/// repeat each other however often they are taken. Without cells the ends of a swing were chosen again and again, and 36
/// such views of a relief refined it to 7.7° of mean normal error, 36 evenly spaced ones to 6.9° and 36 chosen by cells to
/// 6.9°; 12 views gave 8.5°, 7.3° and 7.2°. Cells of 0.15 gave 6.7° with 36 views, but 7.8° with 12.
const LIGHT_CELL: f64 = 0.25;
/// The surface is looked at about every so many pixels of the full image, along rows and columns.
pub(super) const SAMPLE_PX: usize = 4;
/// Refinement is of the object that the operator points at: surface counts by a Gaussian of its angle to the optical axis
/// with this deviation, 8°: 84 mm at 0.6 m. Arbitrary.
const ATTENTION_RAD: f64 = 0.14;
/// Pixels farther from the optical axis, 2.8 deviations, are not looked at; they would weigh less than 0.02.
pub(super) const ATTENTION_REACH_RAD: f64 = 2.8 * ATTENTION_RAD;
/// Surface seen or lit at a smaller cosine is not looked at (70°): its footprint is three pixels long.
const MIN_COSINE: f64 = 0.342;
/// The distance at which a pixel's noise and the error of the model are about as large, metres. Beyond it the change of
/// brightness fades with the square of the distance against the noise; nearer, the relative change is what counts.
const REFERENCE_M: f64 = 0.6;
/// A patch is worth half of what it can be worth to first order when its sum of `t tᵀ` reaches this: one view at 13°
/// from 0.6 m. Small, so that what is not seen yet counts more than what is seen well; 0.25 did worse, see [`LIGHT_CELL`].
const HALF_INFORMATION: f64 = 0.05;

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

/// Names a patch under light from one side: a cell of the world grid, the axis that the surface faces, and a cell of light
/// directions. The axis keeps the sides of a thin wall apart; unlike an octant it does not change with the noise of a
/// normal along an axis.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub(super) struct PatchKey(u64);

/// A patch whatever side it is lit from.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub(super) struct SurfaceKey(u64);

impl SurfaceKey {
    /// The patch at a place that faces along an axis.
    pub(super) fn of(point_world: &Vector3<f64>, normal_world: &Vector3<f64>, axis: usize) -> Self {
        SurfaceKey(place(point_world) << 3 | face(normal_world, axis))
    }
}

impl PatchKey {
    fn of(point_world: &Vector3<f64>, normal_world: &Vector3<f64>, l_world: &Vector3<f64>) -> Self {
        // A unit vector needs 4 bits of cells.
        let side = cells(l_world, LIGHT_CELL, 4);
        let face = face(normal_world, normal_world.iamax());
        PatchKey(place(point_world) << 15 | side << 3 | face)
    }

    /// The patch without the side.
    pub(super) fn surface(self) -> SurfaceKey {
        SurfaceKey(self.0 >> 15 << 3 | self.0 & 7)
    }
}

/// 16 bits a coordinate: with 20 mm they reach 650 m to either side.
fn place(point_world: &Vector3<f64>) -> u64 {
    cells(point_world, PATCH_M, 16)
}

fn face(normal_world: &Vector3<f64>, axis: usize) -> u64 {
    2 * axis as u64 + u64::from(normal_world[axis] > 0.0)
}

/// The cell of a grid round the origin that a vector lies in, `n_bits` a coordinate.
fn cells(vector: &Vector3<f64>, side: f64, n_bits: u32) -> u64 {
    let (offset, mask) = (1_i64 << (n_bits - 1), (1_u64 << n_bits) - 1);
    vector.iter().fold(0, |cells, x| {
        let cell = (x / side).floor() as i64 + offset;
        cells << n_bits | (cell as u64 & mask)
    })
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

    fn matrix(&self) -> Matrix3<f64> {
        let [xx, xy, xz, yy, yz, zz] = self.0;
        Matrix3::new(xx, xy, xz, xy, yy, yz, xz, yz, zz)
    }

    /// The tilt that is known least, as a unit vector in a patch's plane, and how well it is known; `None` where the plane
    /// is none. Where nothing is known all tilts are alike, and it is any.
    pub(super) fn least_tilt(&self, normal: &Vector3<f64>) -> Option<(Vector3<f64>, f64)> {
        let [first, second] = tangents(normal)?;
        let matrix = self.matrix();
        let between = |a: &Vector3<f64>, b: &Vector3<f64>| a.dot(&(matrix * b));
        let in_plane = Matrix2::new(
            between(&first, &first),
            between(&first, &second),
            between(&second, &first),
            between(&second, &second),
        );
        let eigen = in_plane.symmetric_eigen();
        let least = eigen.eigenvalues.imin();
        let vector = eigen.eigenvectors.column(least);
        let tilt = first * vector.x + second * vector.y;
        Some((tilt, eigen.eigenvalues[least].max(0.0)))
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

impl ViewInformation {
    /// The same view if all that it tells counted by a factor.
    pub(super) fn scaled(mut self, factor: f64) -> Self {
        for (_, information) in &mut self.patches {
            *information = Information(information.0.map(|sum| factor * sum));
        }
        self
    }
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
    let min_cos_axis = ATTENTION_REACH_RAD.cos();

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
            let attention = attention_at(cos_axis);
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
                PatchKey::of(&point, &normal, &l),
                Information::of_tangent(&t, weight),
            ));
        }
    }
    ViewInformation {
        patches: by_patch(samples),
        target_world: (weights > 0.0).then(|| Point3::from(target / weights)),
    }
}

/// How much what lies so far from the optical axis, radians, counts: 1 on it.
pub fn attention(from_axis_rad: f64) -> f64 {
    (-0.5 * (from_axis_rad / ATTENTION_RAD).powi(2)).exp()
}

/// [`attention`] to what lies at this cosine to the optical axis.
pub(super) fn attention_at(cos_axis: f64) -> f64 {
    attention(cos_axis.min(1.0).acos())
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
mod tests;
