//! From a stream of frames to the images that a calibration needs: of a wall, or of a sphere.

use super::lit_images::LitImages;
use super::plane::{Plane, dominant_plane};
use super::refusal::Refusal;
use super::sphere::{BallRadius, FoundSphere, MIN_COVERAGE, best_sphere};
use crate::fusion::{DepthNoise, Fusion, FusionParams, TrackingOutcome};
use crate::geometry::{CameraModel, RayGrid};
use crate::robust::median;
use crate::shading::{SATURATION, without_ambient};
use crate::snapshot::{HeldPose, ShadingSnapshot, TrackedFrame};
use depth_camera::{CameraInfo, Frame, Image};
use nalgebra::Point3;
use std::fmt;

/// What one session shows.
#[derive(Clone, Debug)]
pub struct Scan {
    /// The session's name.
    pub name: String,
    /// What is in view.
    pub target: Target,
    /// What that was told by.
    pub shares: Shares,
    /// The images, in order of time.
    pub images: Vec<TargetImage>,
    /// IR images that were not used: without depth, without a pose, under speckle; of a Kinect I those, too, that others outdo, and of
    /// a long session the latest thousands.
    pub n_unused: usize,
}

/// How much of a session is a plane, and how much of a sphere it shows.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Shares {
    /// Share of the depth that lies on one plane, median over the frames.
    pub plane: f64,
    /// Share of its front that the session shows of the best sphere; 0 without any.
    pub sphere: f64,
}

impl fmt::Display for Shares {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(
            f,
            "a plane holds {:.0} % of the depth, and the best sphere shows {:.0} % of its front, must be at least {:.0} %",
            100.0 * self.plane,
            100.0 * self.sphere,
            100.0 * MIN_COVERAGE
        )
    }
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

/// A wall is a plane that holds this share of the depth.
pub(super) const WALL_SHARE: f64 = 0.8;
/// What lies farther before a plane stands out of it, metres: the top of a ball on a table is as high as the ball is wide.
const STANDING_OUT_M: f64 = 0.03;
/// A plane is bare where a smaller share of the depth stands out of it. Recorded walls have none, a ball of 10 cm has 0.011 at 0.65 m.
const MIN_STANDING_OUT: f64 = 0.002;
/// A sphere is found in a mesh of a few frames, too: half a frontal view makes a surface.
const MIN_SURFACE_WEIGHT: f64 = 0.5;
/// Depth images with less valid pixels tell nothing; those of a covered Kinect I stay below 4 %.
const MIN_VALID_SHARE: f64 = 0.05;

/// Takes the frames of one session in.
///
/// A ball on a table may leave a plane as much of the depth as a wall has, so that a frame does not tell which of the two it shows. The
/// images are taken for both until all frames are seen: then it is a sphere if the frames fused show one, else a wall if most are planes.
pub struct Gatherer {
    rays: RayGrid,
    noise: DepthNoise,
    fusion: Fusion,
    /// The images if it is a wall: the camera is seen to be where the wall is.
    of_wall: LitImages,
    /// The images if it is a sphere: the camera is tracked.
    of_sphere: LitImages,
    /// Share of the depth on a plane, frame by frame.
    plane_shares: Vec<f64>,
}

impl Gatherer {
    /// A gatherer for one camera; `fusion` must have been validated. `None` if the camera gives no IR or has no light.
    pub fn new(info: &CameraInfo, fusion: FusionParams) -> Option<Self> {
        let camera = CameraModel::new(info.intrinsics);
        let noise = DepthNoise::of_sensor(info.sensor);
        let fusion = FusionParams {
            min_surface_weight: MIN_SURFACE_WEIGHT,
            ..fusion
        };
        Some(Gatherer {
            of_wall: LitImages::new(info, HeldPose::BetweenUnlessLate)?,
            of_sphere: LitImages::new(info, HeldPose::BetweenOrBefore)?,
            rays: RayGrid::new(camera),
            noise,
            fusion: Fusion::new(camera, noise, fusion),
            plane_shares: Vec::new(),
        })
    }

    /// Takes in the next frame.
    pub fn observe(&mut self, frame: &Frame) {
        let Located { on_wall, in_model } = self.locate(frame);
        self.of_wall.observe(&TrackedFrame {
            frame,
            outcome: &on_wall,
            model: None,
        });
        self.of_sphere.observe(&TrackedFrame {
            frame,
            outcome: &in_model,
            model: self.fusion.model(),
        });
    }

    /// The images of the session and what they show; `radius` is what is known of the sphere.
    ///
    /// # Errors
    /// If neither a wall nor a sphere is in view, or no image under the light.
    pub fn finish(mut self, name: &str, radius: BallRadius) -> Result<Scan, Refusal> {
        let session = name.to_owned();
        let Some(plane) = median(&mut self.plane_shares) else {
            return Err(Refusal::NoDepth { session });
        };
        let sphere = best_sphere(&self.fusion.mesh(), radius);
        let shares = Shares {
            plane,
            sphere: sphere.map_or(0.0, |sphere| sphere.coverage),
        };
        let (target, selection) = match sphere {
            Some(sphere) if sphere.coverage >= MIN_COVERAGE => {
                (Target::Sphere(sphere), self.of_sphere.finish())
            }
            _ if plane >= WALL_SHARE => (Target::Wall, self.of_wall.finish()),
            _ => return Err(Refusal::NoSphere { session, shares }),
        };
        let mut reasons = selection.reasons();
        let n_accepted = selection.accepted.len();
        let accepted = selection.accepted.into_iter();
        let images: Vec<TargetImage> = accepted
            .filter_map(|snapshot| placed(snapshot, target, &self.rays, &self.noise))
            .collect();
        let n_elsewhere = n_accepted - images.len();
        let n_unused = selection.rejected.len() + n_elsewhere;
        if images.is_empty() {
            if n_elsewhere > 0 {
                reasons.push(format!("{n_elsewhere} times: the target is not in view"));
            }
            return Err(Refusal::NoImages {
                session,
                n_unused,
                reasons: reasons.join("; "),
            });
        }
        Ok(Scan {
            name: session,
            target,
            shares,
            images,
            n_unused,
        })
    }

    /// Where the camera is. A bare plane is not fused, since it does not hold the camera.
    fn locate(&mut self, frame: &Frame) -> Located {
        let Some(depth) = &frame.depth else {
            return Located::NOWHERE;
        };
        if frame.depth_share() < MIN_VALID_SHARE {
            // Nobody knows how the camera moves meanwhile.
            self.fusion.interrupt();
            return Located::NOWHERE;
        }
        let plane = dominant_plane(depth, &self.rays, &self.noise);
        self.plane_shares
            .push(plane.map_or(0.0, |plane| plane.share));
        let wall = plane.filter(|plane| plane.share >= WALL_SHARE);
        let standing_out =
            |wall: Plane| wall.share_before(depth, &self.rays, STANDING_OUT_M) >= MIN_STANDING_OUT;
        let in_model = match wall.is_none_or(standing_out) {
            true => self.fusion.fuse(depth, frame.device_time_secs),
            false => {
                self.fusion.interrupt();
                TrackingOutcome::NoDepth
            }
        };
        let on_wall = wall.map_or(TrackingOutcome::NoDepth, |wall| TrackingOutcome::Tracked {
            world_from_camera: wall.plane_from_camera(),
            fit: None,
        });
        Located { on_wall, in_model }
    }
}

/// Where the camera was when a frame was taken.
struct Located {
    /// Against the wall that the frame shows.
    on_wall: TrackingOutcome,
    /// In the model of what stands out of planes.
    in_model: TrackingOutcome,
}

impl Located {
    const NOWHERE: Located = Located {
        on_wall: TrackingOutcome::NoDepth,
        in_model: TrackingOutcome::NoDepth,
    };
}

/// A snapshot with the place of the target in it; `None` where it shows none.
fn placed(
    snapshot: ShadingSnapshot,
    target: Target,
    rays: &RayGrid,
    noise: &DepthNoise,
) -> Option<TargetImage> {
    let place = match target {
        Target::Wall => dominant_plane(&snapshot.depth_m, rays, noise)
            .filter(|plane| plane.share >= WALL_SHARE)
            .map(Place::Wall)?,
        Target::Sphere(sphere) => {
            let centre = snapshot.world_from_camera.inverse() * sphere.centre_world;
            // Nothing in an image without the ball would say where it is.
            let camera = rays.camera();
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

#[cfg(test)]
mod tests;
