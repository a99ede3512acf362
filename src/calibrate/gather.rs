//! From a stream of frames to the images that a calibration needs: of a wall, or of a sphere.

use super::plane::{Plane, dominant_plane};
use super::refusal::Refusal;
use super::samples::SATURATION;
use super::sphere::{BallRadius, FoundSphere, find_sphere};
use crate::fusion::{DepthNoise, Fusion, FusionParams, TrackingOutcome};
use crate::geometry::{CameraModel, Pose, RayGrid};
use crate::shading::without_ambient;
use crate::snapshot::{HeldPose, ShadingSnapshot, SnapshotParams, SnapshotSelector, TrackedFrame};
use depth_camera::{CameraInfo, Frame, Image, Sensor};
use nalgebra::Point3;

/// What one session shows.
#[derive(Clone, Debug)]
pub struct Scan {
    /// The session's name.
    pub name: String,
    /// What is in view.
    pub target: Target,
    /// The images, in order of time.
    pub images: Vec<TargetImage>,
    /// IR images that could not be used: without depth, without a pose, under speckle.
    pub n_unused: usize,
}

/// What a calibration looks at.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Target {
    /// A plain wall.
    Wall,
    /// A white sphere.
    Sphere(FoundSphere),
}

/// One IR image under the sensor's light, with its geometry.
#[derive(Clone, Debug)]
pub struct TargetImage {
    /// The (first) frame that it comes from.
    pub frame_id: u64,
    /// How many exposures were averaged.
    pub n_exposures: usize,
    /// IR counts of the sensor's light alone, response not removed.
    pub ir_counts: Image<f32>,
    /// What they come from, where the room's light is in it.
    pub ambient: Option<Ambient>,
    /// Depth from the same pose, metres, 0 is none.
    pub depth_m: Image<f32>,
    /// Where the target is, as far as depth tells.
    pub place: Place,
}

/// IR counts of one pose, response not removed.
#[derive(Clone, Debug)]
pub struct Ambient {
    /// Under the sensor's light and the room's.
    pub both: Image<f32>,
    /// Under the room's alone.
    pub unlit: Image<f32>,
}

impl TargetImage {
    /// Takes the room's light off, which adds up with the sensor's before a response of that gamma.
    pub fn take_ambient_off(&mut self, full_scale: f64, gamma: f64) {
        if let Some(Ambient { both, unlit }) = &self.ambient {
            self.ir_counts = without_ambient(both, unlit, SATURATION * full_scale, gamma);
        }
    }
}

/// Where a target lies in the camera frame.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Place {
    /// The plane of the wall.
    Wall(Plane),
    /// Centre of the sphere, metres.
    Sphere(Point3<f64>),
}

/// Images of one scan at most; a scan with more keeps every second, every fourth, …
const MAX_IMAGES: usize = 32;
/// A wall is a plane that holds this share of the depth.
const WALL_SHARE: f64 = 0.8;
/// A sphere is found in a mesh of a few frames, too: half a frontal view makes a surface.
const MIN_SURFACE_WEIGHT: f64 = 0.5;
/// Depth images with less valid pixels tell nothing; those of a covered Kinect I stay below 4 %.
const MIN_VALID_SHARE: f64 = 0.05;

/// Takes the frames of one session in.
pub struct Gatherer {
    rays: RayGrid,
    noise: DepthNoise,
    fusion: Fusion,
    /// Kinect I: recognises the images under the lamp.
    selector: Option<SnapshotSelector>,
    is_wall: Option<bool>,
    kept: Vec<ShadingSnapshot>,
    /// Every so many images are kept.
    stride: usize,
    n_seen: usize,
    n_unused: usize,
}

impl Gatherer {
    /// A gatherer for one camera; `fusion` must have been validated. `None` if the camera gives no IR or has no light.
    pub fn new(info: &CameraInfo, fusion: FusionParams) -> Option<Self> {
        let params = SnapshotParams {
            max_snapshots: 2 * MAX_IMAGES,
            held_pose: HeldPose::BetweenOrBefore,
            ..SnapshotParams::default()
        };
        let selector = SnapshotSelector::new(info, params)?;
        let camera = CameraModel::new(info.intrinsics);
        let noise = DepthNoise::of_sensor(info.sensor);
        Some(Gatherer {
            rays: RayGrid::new(camera),
            noise,
            fusion: Fusion::new(
                camera,
                noise,
                FusionParams {
                    min_surface_weight: MIN_SURFACE_WEIGHT,
                    ..fusion
                },
            ),
            selector: (info.sensor == Sensor::Kinect1).then_some(selector),
            is_wall: None,
            kept: Vec::new(),
            stride: 1,
            n_seen: 0,
            n_unused: 0,
        })
    }

    /// Takes in the next frame: a wall is not fused, since a bare plane does not hold the camera.
    pub fn observe(&mut self, frame: &Frame) {
        let outcome = self.locate(frame);
        match &mut self.selector {
            Some(selector) => selector.observe(&TrackedFrame {
                frame,
                outcome: &outcome,
                model: self.fusion.model(),
            }),
            None => self.keep(frame, &outcome),
        }
    }

    /// The images of the session and what they show; `radius` is what is known of the sphere.
    ///
    /// # Errors
    /// If neither a wall nor a sphere is in view, or no image under the light.
    pub fn finish(mut self, name: &str, radius: BallRadius) -> Result<Scan, Refusal> {
        if let Some(selector) = self.selector.take() {
            self.kept = selector.finish().accepted;
        }
        let Some(is_wall) = self.is_wall else {
            return Err(Refusal::NoDepth {
                session: name.to_owned(),
            });
        };
        let target = match is_wall {
            true => Target::Wall,
            false => Target::Sphere(find_sphere(&self.fusion.mesh(), radius, name)?),
        };
        let n_kept = self.kept.len();
        let kept = std::mem::take(&mut self.kept);
        let images: Vec<TargetImage> = kept
            .into_iter()
            .filter_map(|snapshot| self.placed(snapshot, target))
            .collect();
        let n_unused = self.n_unused + n_kept - images.len();
        if images.is_empty() {
            return Err(Refusal::NoImages {
                session: name.to_owned(),
                n_unused,
            });
        }
        Ok(Scan {
            name: name.to_owned(),
            target,
            images,
            n_unused,
        })
    }

    fn locate(&mut self, frame: &Frame) -> TrackingOutcome {
        let Some(depth) = &frame.depth else {
            return TrackingOutcome::NoDepth;
        };
        if !has_depth(depth) {
            // Nobody knows how the camera moves meanwhile.
            self.fusion.interrupt();
            return TrackingOutcome::NoDepth;
        }
        let (rays, noise) = (&self.rays, &self.noise);
        let is_wall = *self.is_wall.get_or_insert_with(|| {
            dominant_plane(depth, rays, noise).is_some_and(|plane| plane.share >= WALL_SHARE)
        });
        match is_wall {
            true => TrackingOutcome::Tracked {
                world_from_camera: Pose::identity(),
                fit: None,
            },
            false => self.fusion.fuse(depth, frame.device_time_secs),
        }
    }

    /// Kinect II: every tracked frame with IR is an image under the light.
    fn keep(&mut self, frame: &Frame, outcome: &TrackingOutcome) {
        let Some(ir) = &frame.ir else { return };
        let TrackingOutcome::Tracked {
            world_from_camera, ..
        } = *outcome
        else {
            self.n_unused += 1;
            return;
        };
        self.n_seen += 1;
        if !(self.n_seen - 1).is_multiple_of(self.stride) {
            return;
        }
        self.kept.push(ShadingSnapshot {
            frame_id: frame.frame_id,
            device_time_secs: frame.device_time_secs,
            n_exposures: 1,
            ir_counts: ir.map(|counts| f32::from(*counts)),
            unlit_counts: None,
            depth_m: frame.depth.clone().expect("a tracked frame has depth"),
            world_from_camera,
        });
        if self.kept.len() > MAX_IMAGES {
            let mut index = 0;
            self.kept.retain(|_| {
                index += 1;
                index % 2 == 1
            });
            self.stride *= 2;
        }
    }

    /// A snapshot with the place of the target in it; `None` where it shows none.
    fn placed(&self, snapshot: ShadingSnapshot, target: Target) -> Option<TargetImage> {
        let place = match target {
            Target::Wall => dominant_plane(&snapshot.depth_m, &self.rays, &self.noise)
                .filter(|plane| plane.share >= WALL_SHARE)
                .map(Place::Wall)?,
            Target::Sphere(sphere) => {
                let centre = snapshot.world_from_camera.inverse() * sphere.centre_world;
                // Nothing in an image without the ball would say where it is.
                let camera = self.rays.camera();
                let is_in_view = camera.contains(&camera.project(&centre)?, 0.0);
                (is_in_view && centre.z > sphere.radius_m).then_some(Place::Sphere(centre))?
            }
        };
        let both = &snapshot.ir_counts;
        let ambient = snapshot.unlit_counts.map(|unlit| Ambient {
            both: both.clone(),
            unlit,
        });
        Some(TargetImage {
            frame_id: snapshot.frame_id,
            n_exposures: snapshot.n_exposures,
            ir_counts: snapshot.ir_counts,
            ambient,
            depth_m: snapshot.depth_m,
            place,
        })
    }
}

fn has_depth(depth: &Image<f32>) -> bool {
    let n_valid = depth.data().iter().filter(|z| **z > 0.0).count();
    n_valid as f64 >= MIN_VALID_SHARE * depth.data().len() as f64
}

#[cfg(test)]
mod tests {
    use super::*;
    use depth_camera::DepthCamera;
    use simulated::SimulatedCamera;

    #[test]
    fn an_image_without_the_ball_is_none_of_the_ball() {
        let info = SimulatedCamera::kinect2_plaque(1, 0).info().clone();
        let gatherer = Gatherer::new(&info, FusionParams::default()).expect("it has a light");
        let (width, height) = (info.intrinsics.width, info.intrinsics.height);
        let is_used = |x: f64, z: f64| {
            let snapshot = ShadingSnapshot {
                frame_id: 0,
                device_time_secs: 0.0,
                n_exposures: 1,
                ir_counts: Image::filled(width, height, 1000.0),
                unlit_counts: None,
                depth_m: Image::filled(width, height, 1.0),
                world_from_camera: Pose::identity(),
            };
            let sphere = FoundSphere {
                centre_world: Point3::new(x, 0.0, z),
                radius_m: 0.1,
                radius_sigma_m: 0.001,
                coverage: 1.0,
            };
            gatherer.placed(snapshot, Target::Sphere(sphere)).is_some()
        };
        assert!(is_used(0.0, 0.6));
        assert!(!is_used(0.9, 0.6), "beside the picture");
        assert!(!is_used(0.0, -0.6), "behind the camera");
    }
}
