//! Where a Kinect I was when its lamp lit an image, if it did not rest over the pause for it: somewhere on the way from the frame before to the
//! frame after, which nobody tracked.
//!
//! The light tells. By the near light model the logarithm of the intensity is that of `(n·l)/d²` and the albedo's together. Where the model is
//! seen from the image's own pose, their difference changes as the albedo does; from any other every edge and fold of the surface shows in it
//! twice, where the image has it and where it is predicted. So the image is put where that difference changes least from one pixel to the next.

use super::ShadingSnapshot;
use crate::fusion::{InfraredOptics, ModelMap};
use crate::geometry::{Motion, Pose, RayGrid, between};
use crate::shading::{NearLight, SATURATION, linearise};
use depth_camera::Image;
use nalgebra::Point3;
use rayon::prelude::*;

/// No hand that was to hold still goes farther in a pause; what does was not tracked.
pub(super) const MAX_WAY: Motion = Motion {
    rotation_rad: 0.15,
    translation_m: 0.06,
};
/// Shares of the way that are looked at.
const SHARES: [f64; 5] = [0.0, 0.25, 0.5, 0.75, 1.0];
/// Surface lit at a smaller cosine is not looked at: there a small error of the normal is a large one of the light.
const MIN_COSINE: f64 = 0.25;
/// Darker pixels, as shares of full scale on the optical axis, show noise.
const DARKEST: f32 = 0.01;
/// A larger change of the logarithm counts as this: one shadow is not to outweigh the surface.
const LARGEST_CHANGE: f32 = 1.0;
/// Changes that differ by less, as a share of the least, do not tell: on the ways of a pot they do by 1 to 9 %.
const MIN_CONTRAST: f64 = 0.01;
/// Fewer pairs of pixels do not tell.
const MIN_PAIRS: usize = 500;

/// What all images of a scan say counts as so many times what each says by itself: who rests before the projector is covered, or only once it
/// is, does so each time. On a pot one alone is right to 0.12 to 0.29 of its way, with all to 0.03 to 0.12.
const HABIT: f64 = 2.0;

/// How much the difference changes at each of [`SHARES`], against its mean over them.
type Changes = [f64; SHARES.len()];

/// Puts images whose camera moved over the pause to the poses on their ways at which the light agrees best with the surface that `seen_from`
/// shows from poses of the camera, world frame, at a whole fraction of the images' resolution; their depth becomes what was seen from there.
/// Returns the share of the way of each; `None`, and it stays at the frame before, where the camera rested or the surface does not tell.
pub fn place_on_their_ways(
    snapshots: &mut [ShadingSnapshot],
    rays: &RayGrid,
    optics: &InfraredOptics,
    seen_from: impl Fn(&Pose) -> ModelMap + Sync,
) -> Vec<Option<f64>> {
    let flat = optics.calibration.flat_field.image(rays);
    let told = snapshots.iter().map(|snapshot| {
        let way = snapshot.way()?;
        changes(
            &snapshot.linear(optics, &flat),
            &way,
            &optics.light,
            &seen_from,
        )
    });
    let told: Vec<Option<Changes>> = told.collect();
    let mut of_all = Changes::default();
    for changes in told.iter().flatten() {
        for (of_all, change) in of_all.iter_mut().zip(changes) {
            *of_all += change;
        }
    }
    let n_told = told.iter().flatten().count().max(1) as f64;
    let shares = snapshots.iter_mut().zip(told).map(|(snapshot, own)| {
        let (way, mut together) = snapshot.way().zip(own)?;
        for (change, of_all) in together.iter_mut().zip(of_all) {
            *change += HABIT * of_all / n_told;
        }
        let share = share_of_least(&together)?;
        snapshot.place(&way, share, rays);
        Some(share)
    });
    shares.collect()
}

impl ShadingSnapshot {
    /// The poses between which it was taken; `None` where the camera rested.
    fn way(&self) -> Option<(Pose, Pose)> {
        let before = self.world_from_camera;
        Some((before, before * self.moved?))
    }

    /// Linear intensity, as its pixels integrated it.
    fn linear(&self, optics: &InfraredOptics, flat: &Image<f64>) -> Image<f32> {
        let (full_scale, calibration) = (optics.full_scale, &optics.calibration);
        let counts = self.lit_counts(full_scale, calibration.gamma);
        linearise(&counts, full_scale, SATURATION, calibration, flat).integrated
    }

    /// Puts it at a share of its way.
    fn place(&mut self, (before, after): &(Pose, Pose), share: f64, rays: &RayGrid) {
        let here = between(before, after, share);
        let here_from_before = here.inverse() * before;
        self.depth_m = seen_from_elsewhere(&self.depth_m, rays, &here_from_before);
        self.moved = self.moved.map(|moved| {
            let shift = here_from_before.rotation * moved.translation.vector;
            Pose::from_parts(shift.into(), moved.rotation)
        });
        self.world_from_camera = here;
    }
}

/// How light and surface agree on the way from a pose to another; `None` where too little shows both.
fn changes(
    linear: &Image<f32>,
    (before, after): &(Pose, Pose),
    light: &NearLight,
    seen_from: &(impl Fn(&Pose) -> ModelMap + Sync),
) -> Option<Changes> {
    let mut told = [None; SHARES.len()];
    let at = told.par_iter_mut().zip(SHARES).with_max_len(1);
    at.for_each(|(changed, share)| {
        let pose = between(before, after, share);
        *changed = change(linear, &seen_from(&pose), &pose, light);
    });
    let mut changes = Changes::default();
    for (change, told) in changes.iter_mut().zip(told) {
        *change = told?;
    }
    let mean = changes.iter().sum::<f64>() / SHARES.len() as f64;
    Some(changes.map(|change| change / mean))
}

/// Depth (m) as the camera that measured it would see it from elsewhere; 0 where nothing is known of it.
fn seen_from_elsewhere(depth_m: &Image<f32>, rays: &RayGrid, there_from_here: &Pose) -> Image<f32> {
    let (width, height) = (depth_m.width(), depth_m.height());
    let mut there_m = Image::filled(width, height, 0.0f32);
    for (&z, &[x, y]) in depth_m.data().iter().zip(rays.rays().data()) {
        let point = there_from_here * Point3::new(x * z, y * z, z).cast::<f64>();
        let pixel = rays.camera().project(&point).filter(|_| z > 0.0);
        let Some(pixel) = pixel.filter(|pixel| rays.camera().contains(pixel, 0.0)) else {
            continue;
        };
        let at = pixel.y.round() as usize * width + pixel.x.round() as usize;
        let seen = &mut there_m.data_mut()[at];
        // What is nearer hides what is farther.
        if *seen == 0.0 || point.z < f64::from(*seen) {
            *seen = point.z as f32;
        }
    }
    there_m
}

/// How much the logarithm of the intensity over that of the predicted light changes between neighbouring pixels of a model that was seen from a
/// pose, mean; `None` where too few show both.
fn change(
    linear: &Image<f32>,
    model: &ModelMap,
    world_from_camera: &Pose,
    light: &NearLight,
) -> Option<f64> {
    let camera_from_world = world_from_camera.inverse();
    let surface = model.points.data().iter().zip(model.normals.data());
    // NaN where no surface is seen, or it is lit too slantingly.
    let predicted = surface.map(|(point, normal)| {
        let point = camera_from_world * Point3::from(point.cast::<f64>());
        let normal = camera_from_world * normal.cast::<f64>();
        let irradiance = light.irradiance_above(MIN_COSINE, &point, &normal);
        irradiance.map_or(f32::NAN, |irradiance| irradiance as f32)
    });
    let (width, height) = (model.points.width(), model.points.height());
    let predicted = Image::from_vec(width, height, predicted.collect());
    let rest = |u: usize, v: usize| {
        let intensity = mean_of_cell(linear, width, u, v).filter(|mean| *mean >= DARKEST)?;
        Some((intensity / smoothed(&predicted, u, v)?).ln())
    };
    let rests: Vec<Option<f32>> = (0..width * height)
        .map(|pixel| rest(pixel % width, pixel / width))
        .collect();
    let (mut sum, mut n) = (0.0, 0);
    for (pixel, &rest) in rests.iter().enumerate() {
        let right = (pixel + 1) % width != 0;
        let beside = [right.then_some(pixel + 1), Some(pixel + width)];
        for other in beside.into_iter().flatten() {
            let other = rests.get(other).copied().flatten();
            if let Some((here, there)) = rest.zip(other) {
                sum += f64::from((here - there).abs().min(LARGEST_CHANGE));
                n += 1;
            }
        }
    }
    (n >= MIN_PAIRS).then(|| sum / n as f64)
}

/// The mean of an image over the cell that one of its reduced image's pixels is; `None` where a pixel has no value.
fn mean_of_cell(image: &Image<f32>, reduced_width: usize, u: usize, v: usize) -> Option<f32> {
    let side = image.width() / reduced_width;
    let rows = v * side..(v + 1) * side;
    let sum: f32 = rows
        .map(|row| image.row(row)[u * side..(u + 1) * side].iter().sum::<f32>())
        .sum();
    let mean = sum / (side * side) as f32;
    (!mean.is_nan()).then_some(mean)
}

/// Mean of the pixels that have a value, from one row and column before to one after, in the proportions 1, 2, 1: the model's normals are noisy;
/// `None` where the middle one has none.
fn smoothed(image: &Image<f32>, u: usize, v: usize) -> Option<f32> {
    if image.at(u, v).is_nan() {
        return None;
    }
    let (mut sum, mut weights) = (0.0, 0.0);
    for row in v.saturating_sub(1)..(v + 2).min(image.height()) {
        for column in u.saturating_sub(1)..(u + 2).min(image.width()) {
            let value = *image.at(column, row);
            let nearness = |at: usize, middle: usize| if at == middle { 2.0 } else { 1.0 };
            let weight = nearness(row, v) * nearness(column, u);
            if !value.is_nan() {
                sum += weight * value;
                weights += weight;
            }
        }
    }
    Some(sum / weights)
}

/// The share of the way, 0 to 1, at which a parabola through the changes at [`SHARES`] is least; `None` where they hardly differ.
fn share_of_least(changes: &Changes) -> Option<f64> {
    let [least, most] = [f64::min, f64::max].map(|of| changes.iter().copied().reduce(of));
    let (least, most) = least.zip(most)?;
    if most - least < MIN_CONTRAST * least {
        return None;
    }
    // Sums over shares less their middle: of squares, and of squares' deviations from their mean.
    let middle = 0.5;
    let (mut slope, mut bend) = (0.0, 0.0);
    let (mut squares, mut fourths) = (0.0, 0.0);
    let mean_square =
        SHARES.iter().map(|s| (s - middle).powi(2)).sum::<f64>() / SHARES.len() as f64;
    for (share, change) in SHARES.iter().zip(changes) {
        let x = share - middle;
        let beyond = x * x - mean_square;
        slope += x * change;
        squares += x * x;
        bend += beyond * change;
        fourths += beyond * beyond;
    }
    let (slope, bend) = (slope / squares, bend / fourths);
    Some(match bend > 0.0 {
        true => (middle - slope / (2.0 * bend)).clamp(0.0, 1.0),
        false if slope < 0.0 => 1.0,
        false => 0.0,
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::{CameraModel, increment};
    use crate::shading::Calibration;
    use crate::snapshot::scenes;
    use depth_camera::Sensor;
    use nalgebra::{Vector3, Vector6};

    /// A roof, its ridge towards the camera, and where the ray of a pixel from a pose meets it.
    fn meet(world_from_camera: &Pose, [x, y]: [f32; 2]) -> (Point3<f64>, Vector3<f64>) {
        const STEEPNESS: f64 = 0.5;
        let eye = world_from_camera.translation.vector;
        let ray = world_from_camera * Vector3::new(f64::from(x), f64::from(y), 1.0);
        let sides = [-1.0, 1.0].map(|side| {
            let normal = Vector3::new(side * STEEPNESS, 0.0, -1.0) / STEEPNESS.hypot(1.0);
            let way = (Vector3::new(0.0, 0.0, 0.6) - eye).dot(&normal) / ray.dot(&normal);
            (Point3::from(eye + way * ray), normal)
        });
        // Of a roof that is convex the farther plane hides the nearer one.
        let [left, right] = sides;
        match left.0.z >= right.0.z {
            true => left,
            false => right,
        }
    }

    #[test]
    fn an_image_is_put_where_on_its_way_it_was_taken() {
        let info = scenes::camera_info(Sensor::Kinect1);
        let camera = CameraModel::new(info.intrinsics);
        let rays = RayGrid::new(camera);
        let reduced = RayGrid::new(camera.reduced(2));
        let calibration = Calibration::shipped_for(&info).unwrap();
        let light = calibration.light.near_light(info.light.unwrap().position_m);
        let full_scale = info.ir_full_scale.unwrap();
        let optics = InfraredOptics {
            light,
            calibration: calibration.clone(),
            full_scale,
        };
        let flat = calibration.flat_field.image(&rays);
        let before = increment(&Vector6::new(0.0, 0.02, 0.0, -0.015, 0.0, 0.0));
        let moved = increment(&Vector6::new(0.0, -0.03, 0.01, 0.04, 0.005, 0.0));
        let seen_from = |pose: &Pose| {
            let hits = reduced.rays().map(|&ray| meet(pose, ray));
            ModelMap {
                points: hits.map(|(point, _)| point.coords.cast()),
                normals: hits.map(|(_, normal)| normal.cast()),
            }
        };
        let taken_at = |share: f64| {
            let pose = between(&before, &(before * moved), share);
            let camera_from_world = pose.inverse();
            let pixels = rays.rays().data().iter().zip(flat.data());
            let counts = pixels.map(|(&ray, flat)| {
                let (point, normal) = meet(&pose, ray);
                // A darker stripe across the roof, which no model knows.
                let albedo = if point.y.abs() < 0.03 { 0.06 } else { 0.12 };
                let (point, normal) = (camera_from_world * point, camera_from_world * normal);
                let linear = albedo * flat * light.irradiance(&point, &normal).max(0.0);
                (full_scale * linear.powf(calibration.gamma)) as f32
            });
            let (width, height) = (info.intrinsics.width, info.intrinsics.height);
            ShadingSnapshot {
                frame_id: 0,
                device_time_secs: 0.0,
                n_exposures: 4,
                ir_counts: Image::from_vec(width, height, counts.collect()),
                unlit_counts: None,
                depth_m: Image::filled(width, height, 0.6),
                world_from_camera: before,
                moved: Some(moved),
            }
        };
        for share in [0.0, 0.4, 1.0] {
            let mut snapshots = [taken_at(share), taken_at(share)];
            // One of them rested.
            snapshots[1].moved = None;
            let found = place_on_their_ways(&mut snapshots, &rays, &optics, seen_from);
            assert_eq!(found[1], None);
            assert_eq!(snapshots[1].world_from_camera, before);
            let found = found[0].unwrap();
            assert!((found - share).abs() < 0.12, "{found} for {share}");
            let expected = between(&before, &(before * moved), found);
            assert_eq!(snapshots[0].world_from_camera, expected);
            assert_eq!(snapshots[0].depth_m.row(50)[60] == 0.6, found == 0.0);
        }
        // A hand does as it does mostly.
        let share_of_last = |shares: &[f64]| {
            let mut snapshots: Vec<_> = shares.iter().copied().map(taken_at).collect();
            let found = place_on_their_ways(&mut snapshots, &rays, &optics, seen_from);
            found.last().copied().flatten().unwrap()
        };
        let (alone, among_others) = (share_of_last(&[0.5]), share_of_last(&[1.0, 1.0, 1.0, 0.5]));
        assert!(among_others > alone + 0.1, "{among_others} {alone}");
    }

    #[test]
    fn what_bends_the_other_way_is_least_at_an_end() {
        assert_eq!(share_of_least(&[5.0, 4.0, 3.0, 4.0, 5.0]), Some(0.5));
        assert_eq!(share_of_least(&[1.0, 1.8, 2.5, 3.1, 3.6]), Some(0.0));
        assert_eq!(share_of_least(&[3.6, 3.1, 2.5, 1.8, 1.0]), Some(1.0));
        assert_eq!(share_of_least(&[1.0, 2.0, 4.0, 7.0, 11.0]), Some(0.0));
        assert_eq!(share_of_least(&[1.0, 1.001, 0.999, 1.002, 1.0]), None);
    }
}
