//! What the infrared image adds where the geometry lets the camera slide.
//!
//! The sensor lights the scene itself, so that brightness moves with the camera: two images cannot be compared as they are.
//! A key view is kept with the model's surface and normals. By Eq. (1) its intensity gives that in any other view, with that view's
//! own distance and incidence; the difference to what the view shows is the residual, and its derivative is the slope of the albedo,
//! which counts where it stands out of its noise. It acts in the free directions of [`Degeneracy`] alone: where there are none, no
//! pose changes by a bit.
//!
//! Not handled: motion by more than half a wavelength of the texture between frames, highlights, Kinect I, whose images
//! with depth show the projector's speckle.

use super::MODEL_LEVEL;
use super::align::{AlignedPose, SIZE_M};
use super::degeneracy::Degeneracy;
use super::eye::Eye;
use super::icp::is_small;
use super::normal_equations::{NormalEquations, Rows, TileSums, huber_weight};
use super::pose_correction::PoseCorrection;
use super::pyramid::Level;
use super::raycast::ModelMap;
use super::sdf_alignment::{self, Slopes};
use super::track::Track;
use super::volume::TsdfVolume;
use crate::geometry::lanes::LANES;
use crate::geometry::{CameraModel, Motion, Pose, RayGrid, motion_between};
use crate::shading::{Calibration, LinearImage, NearLight, SATURATION, linearise};
use depth_camera::Image;
use nalgebra::{Matrix2x3, Point3, Vector2, Vector3};

/// What has to be known of infrared images of a scene that the sensor lights itself.
#[derive(Clone, Debug)]
pub struct InfraredOptics {
    /// Response, flat field and noise.
    pub calibration: Calibration,
    /// The sensor's light.
    pub light: NearLight,
    /// Counts of full scale.
    pub full_scale: f64,
}

/// Pixels of the whole image along a side of one of the model's.
const REDUCTION: usize = 2 << MODEL_LEVEL;
/// What Eq. (1) leaves unexplained, as a share of the intensity: interreflection, and normals that are off by a degree or two.
const MODEL_ERROR: f64 = 0.02;
/// Intensities that differ by more than this factor are no motion over a texture: one view is in shadow, or saturated.
const MAX_RATIO: f64 = 1.5;
/// Where the albedo is flatter than this share of itself a pixel it tells nothing of motion, and what the light model leaves
/// unexplained would; where it is steeper, it is the edge of a shadow, which moves with the light.
const MIN_SLOPE: f64 = 0.03;
const MAX_SLOPE: f64 = 0.25;
/// Normals are averaged over so many pixels to either side for the albedo's slope: a frame's are some degrees off.
const NORMAL_REACH: usize = 2;
/// A point of the key view farther than this in front of or behind a point of the frame is not the same, metres.
const SAME_DEPTH_M: f64 = 0.02;
/// The slope has to be so many sigmas of its own noise: what noise prints on a bare table would hold the camera where it is thought
/// to be.
const MIN_SLOPE_SIGMAS: f64 = 4.0;
/// Below so many pixels in common the images hold nothing: a ball of 16 cm shows 300 at 0.7 m.
const MIN_PIXELS: usize = 50;
/// Below this share of the frame's points in the key view another one is kept.
const MIN_OVERLAP: f64 = 0.7;
/// Farther from where the geometry ends the images see another place of the print.
const MAX_HELD: Motion = Motion {
    rotation_rad: 0.2,
    translation_m: 0.1,
};
/// Steps at most; three do from where alignment to the geometry ends.
const MAX_STEPS: usize = 8;

/// The infrared image in hand, and the view that it is compared to.
#[derive(Clone)]
pub struct Infrared {
    optics: InfraredOptics,
    /// The flat field of each pixel.
    flat: Image<f64>,
    /// The camera of the model's pixels.
    camera: CameraModel,
    counts: Image<u16>,
    /// Whether the counts are of the frame in hand.
    is_in_hand: bool,
    key: Option<KeyView>,
}

/// A view to compare others to.
#[derive(Clone)]
struct KeyView {
    /// When it was taken, on the device's clock, seconds.
    time_secs: f64,
    world_from_camera: Pose,
    image: LinearImage,
    /// Albedo times the light's strength, m², smoothed: its slopes are those of the texture, without those of the light. Its sigma
    /// is that of its slopes as a share of itself.
    albedo: LinearImage,
    surface: ModelMap,
}

impl Infrared {
    /// No image yet.
    pub fn new(camera: CameraModel, optics: InfraredOptics) -> Self {
        Infrared {
            flat: optics.calibration.flat_field.image(&RayGrid::new(camera)),
            optics,
            camera: camera.reduced(REDUCTION),
            counts: Image::filled(camera.intrinsics().width, camera.intrinsics().height, 0),
            is_in_hand: false,
            key: None,
        }
    }

    /// Takes the image of the frame to come in hand; one of another size is none.
    pub fn take(&mut self, counts: &Image<u16>) {
        self.is_in_hand = counts.data().len() == self.counts.data().len();
        if self.is_in_hand {
            self.counts.data_mut().copy_from_slice(counts.data());
        }
    }

    /// Puts the image in hand away: the next frame is another.
    pub fn forget(&mut self) {
        self.is_in_hand = false;
    }

    /// Moves the view that others are compared to as the model was moved at its time.
    pub fn correct(&mut self, correction: &PoseCorrection) {
        if let Some(key) = &mut self.key {
            let motion = correction.at(key.time_secs);
            key.world_from_camera = motion * key.world_from_camera;
            key.surface.move_by(&motion);
        }
    }

    /// Forgets the view that others are compared to if it was taken later than `after_secs`.
    pub fn forget_after(&mut self, after_secs: f64) {
        let is_later = |key: &KeyView| key.time_secs > after_secs;
        if self.key.as_ref().is_some_and(is_later) {
            self.key = None;
        }
    }

    /// Moves an aligned frame in the directions that its geometry leaves free to where its image agrees with the key view;
    /// `None` if there are no such directions, or nothing to compare.
    pub fn hold(
        &self,
        eye: &Eye,
        volume: &TsdfVolume,
        degeneracy: &Degeneracy,
        aligned: &AlignedPose,
    ) -> Option<AlignedPose> {
        if degeneracy.n_free == 0 {
            return None;
        }
        let (key, linear) = (self.key.as_ref()?, self.linear()?);
        let level = eye.level(MODEL_LEVEL);
        let geometry_at = |pose: &Pose, slopes| {
            sdf_alignment::equations(eye.arch, level, volume, pose, &eye.noise, slopes)
        };
        let mut pose = aligned.pose;
        for _ in 0..MAX_STEPS {
            let images = self.equations(key, &linear, level, &pose);
            if images.n_inliers < MIN_PIXELS {
                return None;
            }
            let geometry = geometry_at(&pose, Slopes::Frame);
            let step = degeneracy.solve(&geometry, &images, &pose.translation.vector)?;
            pose = step * pose;
            if is_small(&step) {
                break;
            }
        }
        let images = self.equations(key, &linear, level, &pose);
        let held = motion_between(&aligned.pose, &pose);
        if images.n_inliers < MIN_PIXELS || !held.is_within(&MAX_HELD) {
            return None;
        }
        let geometry = geometry_at(&pose, Slopes::Model);
        Some(AlignedPose {
            pose,
            conditioning: geometry.and(&images).conditioning(SIZE_M),
            equations: geometry,
        })
    }

    /// Keeps the frame in hand, which was fused where the track now ends, as the key view if the one that is kept shows too little of
    /// it.
    pub fn remember(&mut self, level: &Level, model: &ModelMap, track: &Track) {
        let world_from_camera = &track.world_from_camera;
        let sees_enough = |key: &KeyView| self.overlap(key, level, world_from_camera) > MIN_OVERLAP;
        if self.key.as_ref().is_some_and(sees_enough) {
            return;
        }
        if let Some(image) = self.linear() {
            self.key = Some(KeyView {
                time_secs: track.time_secs,
                world_from_camera: *world_from_camera,
                albedo: self.albedo(&image, level),
                image,
                surface: model.clone(),
            });
        }
    }

    /// The image in hand, linear, with the model's pixels.
    fn linear(&self) -> Option<LinearImage> {
        let Infrared { optics, flat, .. } = self;
        if !self.is_in_hand {
            return None;
        }
        let counts = self.counts.map(|&counts| f32::from(counts));
        let (scale, calibration) = (optics.full_scale, &optics.calibration);
        let linear = linearise(&counts, scale, SATURATION, calibration, flat);
        Some(reduced(&linear, &self.camera))
    }

    /// Eq. (1) solved for the albedo, with the frame's smoothed normals, and averaged with the pixels around; NaN where one of them
    /// shows no surface or another one, or is hardly lit.
    fn albedo(&self, image: &LinearImage, level: &Level) -> LinearImage {
        /// Means of two squares of 3 pixels a side that lie a pixel apart: 3 pixels each are not in the other.
        const SLOPE_NOISE: f32 = 0.272;
        let (width, height) = (image.value.width(), image.value.height());
        let normals = smoothed(level);
        let values = image.value.data().iter().zip(&normals);
        let albedo = values.enumerate().map(|(pixel, (value, normal))| {
            let point = Vector3::from(level.point(pixel)).cast().into();
            let irradiance = self.irradiance(&point, &normal.cast());
            irradiance.map_or(f32::NAN, |irradiance| value / irradiance as f32)
        });
        let albedo: Vec<f32> = albedo.collect();
        let mut mean = Image::filled(width, height, f32::NAN);
        for v in 1..height - 1 {
            for u in 1..width - 1 {
                let z = level.depth[v * width + u];
                let first = (v - 1..=v + 1).map(|row| row * width + u - 1);
                let around = first.flat_map(|first| first..first + 3);
                let around = around.map(|pixel| {
                    let is_same = f64::from((level.depth[pixel] - z).abs()) < SAME_DEPTH_M;
                    if is_same { albedo[pixel] } else { f32::NAN }
                });
                mean.data_mut()[v * width + u] = around.sum::<f32>() / 9.0;
            }
        }
        let noise = image.sigma.data().iter().zip(image.value.data());
        let noise = noise.map(|(sigma, value)| SLOPE_NOISE * sigma / value);
        LinearImage {
            integrated: mean.clone(),
            value: mean,
            sigma: Image::from_vec(width, height, noise.collect()),
        }
    }

    /// Light on a point with a normal, camera frame, per m²; `None` at grazing incidence, and where the normal is none.
    fn irradiance(&self, point: &Point3<f64>, normal: &Vector3<f64>) -> Option<f64> {
        /// Beyond 75° the cosine, and with it the albedo, hangs on the normal's last degree.
        const MIN_COSINE: f64 = 0.26;
        let light = &self.optics.light;
        light.irradiance_above(MIN_COSINE, point, normal)
    }

    /// Residuals of the frame's image against the one predicted from the key view, by left increments of the pose.
    fn equations(
        &self,
        key: &KeyView,
        linear: &LinearImage,
        level: &Level,
        world_from_camera: &Pose,
    ) -> NormalEquations {
        NormalEquations::of_tiles(level.n_tiles(), |tile| {
            let mut sums = TileSums::ZERO;
            let mut rows = Rows::EMPTY;
            let mut lane = 0;
            for pixel in level.tile(tile) {
                if level.depth[pixel] <= 0.0 {
                    continue;
                }
                sums.n_points += 1;
                let Some(row) = self.residual(key, linear, level, world_from_camera, pixel) else {
                    continue;
                };
                rows.set(lane, &row.lever, &row.gradient, row.residual, row.weight);
                lane += 1;
                if lane == LANES {
                    sums.add(&rows);
                    (rows, lane) = (Rows::EMPTY, 0);
                }
            }
            sums.add(&rows);
            sums
        })
    }

    fn residual(
        &self,
        key: &KeyView,
        linear: &LinearImage,
        level: &Level,
        world_from_camera: &Pose,
        pixel: usize,
    ) -> Option<Row> {
        let point = Vector3::from(level.point(pixel)).cast::<f64>();
        let seen = key.place(&self.camera, &(world_from_camera * Point3::from(point)))?;
        let (key_value, _, key_noise) = key.image.sample(seen.place.x, seen.place.y)?;
        let from_world = world_from_camera.rotation.inverse();
        let irradiance = self.irradiance(&point.into(), &(from_world * seen.normal_world))?;
        let key_normal = key.world_from_camera.rotation.inverse() * seen.normal_world;
        let key_irradiance = self.irradiance(&seen.point, &key_normal)?;
        // Eq. (1) for both views: the albedo is the same, and a normal that is off hardly matters to the ratio.
        let ratio = irradiance / key_irradiance;
        let predicted = key_value * ratio;
        let shown = f64::from(linear.value.data()[pixel]);
        let is_lit = shown < MAX_RATIO * predicted && predicted < MAX_RATIO * shown;
        if !is_lit {
            return None;
        }
        let residual = shown - predicted;
        let noise = f64::from(linear.sigma.data()[pixel]).hypot(ratio * key_noise);
        let sigma = noise.hypot(MODEL_ERROR * predicted);
        // The albedo that is predicted with is that of another point when the pose moves.
        let (albedo, slope, albedo_noise) = key.albedo.sample(seen.place.x, seen.place.y)?;
        let relative_slope = Vector2::from(slope) / albedo;
        let least = MIN_SLOPE.max(MIN_SLOPE_SIGMAS * albedo_noise);
        if !(least..MAX_SLOPE).contains(&relative_slope.norm()) {
            return None;
        }
        let by_point = seen.by_point.transpose() * relative_slope;
        let gradient = key.world_from_camera.rotation * (by_point * -predicted);
        let lever = world_from_camera.rotation * point;
        Some(Row {
            lever: lever.cast(),
            gradient: gradient.cast(),
            residual: residual as f32,
            weight: huber_weight(residual as f32, sigma as f32),
        })
    }

    /// Share of a frame's points that the key view shows.
    fn overlap(&self, key: &KeyView, level: &Level, world_from_camera: &Pose) -> f64 {
        let (mut n_points, mut n_seen) = (0, 0);
        for pixel in (0..level.depth.len()).filter(|&pixel| level.depth[pixel] > 0.0) {
            let point = Point3::from(Vector3::from(level.point(pixel)).cast::<f64>());
            n_points += 1;
            n_seen += usize::from(
                key.place(&self.camera, &(world_from_camera * point))
                    .is_some(),
            );
        }
        n_seen as f64 / f64::from(n_points.max(1))
    }
}

/// One residual of the images: see [`Rows`].
struct Row {
    lever: Vector3<f32>,
    gradient: Vector3<f32>,
    residual: f32,
    weight: f32,
}

/// A point of the scene as the key view shows it.
struct Seen {
    /// In the key view's camera frame, metres.
    point: Point3<f64>,
    /// On its image, pixels.
    place: Vector2<f64>,
    /// Derivative of that by the point, pixels per metre.
    by_point: Matrix2x3<f64>,
    normal_world: Vector3<f64>,
}

impl KeyView {
    /// How the key view shows a point; `None` where it shows another surface, or none.
    fn place(&self, camera: &CameraModel, point_world: &Point3<f64>) -> Option<Seen> {
        let point = self.world_from_camera.inverse_transform_point(point_world);
        let (place, by_point) = camera.project_with_jacobian(&point)?;
        if !camera.contains(&place, 0.5) {
            return None;
        }
        let width = self.surface.normals.width();
        let pixel = (place.y + 0.5) as usize * width + (place.x + 0.5) as usize;
        let normal = self.surface.normals.data()[pixel];
        let shown = self.surface.points.data()[pixel].cast::<f64>();
        let shown = self
            .world_from_camera
            .inverse_transform_point(&shown.into());
        let is_same = normal != Vector3::zeros() && (shown.z - point.z).abs() < SAME_DEPTH_M;
        is_same.then(|| Seen {
            point,
            place,
            by_point,
            normal_world: normal.cast(),
        })
    }
}

/// Normals of a level averaged with those around them, row by row; zero where there is none.
fn smoothed(level: &Level) -> Vec<Vector3<f32>> {
    let (width, height) = (level.rays.width, level.rays.height);
    let around =
        |at: usize, end: usize| at.saturating_sub(NORMAL_REACH)..(at + NORMAL_REACH + 1).min(end);
    let normal = |pixel: usize| Vector3::from([0, 1, 2].map(|axis| level.normals[axis][pixel]));
    let mut smooth = vec![Vector3::zeros(); width * height];
    for (pixel, mean) in smooth.iter_mut().enumerate() {
        let (u, v) = (pixel % width, pixel / width);
        if normal(pixel) == Vector3::zeros() {
            continue;
        }
        let rows = around(v, height);
        let columns = around(u, width);
        let pixels = rows.flat_map(|row| columns.clone().map(move |column| row * width + column));
        let sum: Vector3<f32> = pixels.map(normal).sum();
        *mean = sum.try_normalize(0.0).unwrap_or_default();
    }
    smooth
}

/// An image with the pixels of a reduced camera; NaN where fewer than half of its pixels have a value.
fn reduced(linear: &LinearImage, camera: &CameraModel) -> LinearImage {
    let (width, height) = (camera.intrinsics().width, camera.intrinsics().height);
    let (mut value, mut sigma) = (Vec::new(), Vec::new());
    for v in 0..height {
        for u in 0..width {
            let (mut sum, mut variance, mut n) = (0.0, 0.0, 0);
            for row in 0..REDUCTION {
                let first = (v * REDUCTION + row) * linear.value.width() + u * REDUCTION;
                let cells = first..first + REDUCTION;
                let values = linear.integrated.data()[cells.clone()].iter();
                for (&value, &sigma) in values.zip(&linear.sigma.data()[cells]) {
                    if !value.is_nan() {
                        sum += value;
                        variance += sigma * sigma;
                        n += 1;
                    }
                }
            }
            let is_whole = 2 * n >= REDUCTION * REDUCTION;
            value.push(if is_whole { sum / n as f32 } else { f32::NAN });
            sigma.push(if is_whole {
                variance.sqrt() / n as f32
            } else {
                f32::NAN
            });
        }
    }
    let value = Image::from_vec(width, height, value);
    LinearImage {
        // A full pixel's blur is nothing beside a reduced one.
        integrated: value.clone(),
        value,
        sigma: Image::from_vec(width, height, sigma),
    }
}

#[cfg(test)]
mod tests;
