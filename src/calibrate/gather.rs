//! From a stream of frames to the images that a calibration needs: of a wall, or of a sphere.

use super::ball::{Sightings, are_alike, ball_before};
use super::lit_images::LitImages;
use super::plane::{DominantPlane, dominant_plane};
use super::refusal::Refusal;
use super::sphere::{BallRadius, FoundSphere, MIN_COVERAGE, best_sphere};
use crate::fusion::{DepthNoise, Fusion, FusionParams, TrackingOutcome};
use crate::geometry::{CameraModel, Plane, Pose, RayGrid};
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
/// A sphere is found in a mesh of a few frames, too: half a frontal view makes a surface of voxels of 2 mm.
const MIN_SURFACE_WEIGHT: f64 = 0.5;
/// Depth images with less valid pixels tell nothing; those of a covered Kinect I stay below 4 %.
const MIN_VALID_SHARE: f64 = 0.05;

/// Takes the frames of one session in.
///
/// A ball on a table may leave a plane as much of the depth as a wall has, and before a camera that moves the frames fused do not show
/// it. The images are taken for all that they may show until all frames are seen. Where a plane fills most of them it is a sphere if
/// they show one, each by itself; else it is one if the frames fused do; else a wall if most are planes.
pub struct Gatherer {
    rays: RayGrid,
    noise: DepthNoise,
    fusion: Fusion,
    /// The images if it is a wall: the camera is seen to be where the wall is.
    of_wall: LitImages,
    /// The images if it is a ball on a plane that fills them: the camera is seen to be where the ball is.
    of_ball: LitImages,
    /// The images if it is another sphere: the camera is tracked.
    of_sphere: LitImages,
    /// Share of the depth on a plane, frame by frame.
    plane_shares: Vec<f64>,
    /// Of the frames that a plane fills.
    sightings: Sightings,
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
            of_ball: LitImages::new(info, HeldPose::BetweenOrBefore)?,
            of_sphere: LitImages::new(info, HeldPose::BetweenOrBefore)?,
            rays: RayGrid::new(camera),
            noise,
            fusion: Fusion::new(camera, noise, fusion),
            plane_shares: Vec::new(),
            sightings: Sightings::default(),
        })
    }

    /// Takes in the next frame.
    pub fn observe(&mut self, frame: &Frame) {
        let Located {
            on_wall,
            by_ball,
            in_model,
        } = self.locate(frame);
        for (images, outcome) in [(&mut self.of_wall, on_wall), (&mut self.of_ball, by_ball)] {
            images.observe(&TrackedFrame {
                frame,
                outcome: &outcome,
                model: None,
            });
        }
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
        let is_plane = plane >= WALL_SHARE;
        let ball = self.sightings.agreed(radius).filter(|_| is_plane);
        let fused = || best_sphere(&self.fusion.mesh(), radius);
        let sphere = ball.or_else(fused);
        let shares = Shares {
            plane,
            sphere: sphere.map_or(0.0, |sphere| sphere.coverage),
        };
        let (shown, selection) = match (ball, sphere) {
            (Some(ball), _) => (Shown::Ball(ball), self.of_ball.finish()),
            (None, Some(sphere)) if sphere.coverage >= MIN_COVERAGE => {
                (Shown::Fused(sphere), self.of_sphere.finish())
            }
            _ if is_plane => (Shown::Wall, self.of_wall.finish()),
            _ => return Err(Refusal::NoSphere { session, shares }),
        };
        let mut reasons = selection.reasons();
        let n_accepted = selection.accepted.len();
        let accepted = selection.accepted.into_iter();
        let images: Vec<TargetImage> = accepted
            .filter_map(|snapshot| placed(snapshot, shown, &self.rays, &self.noise))
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
            target: shown.target(),
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
        let mut by_ball = TrackingOutcome::NoDepth;
        if let Some(wall) = &wall {
            let ball = ball_before(&wall.plane, depth, &self.rays, &self.noise);
            self.sightings.add(ball);
            by_ball = seen_from(ball.map(|ball| wall.thing_from_camera(&ball.centre)));
        }
        let standing_out = |wall: DominantPlane| {
            wall.share_before(depth, &self.rays, STANDING_OUT_M) >= MIN_STANDING_OUT
        };
        let in_model = match wall.is_none_or(standing_out) {
            true => self.fusion.fuse(depth, frame.device_time_secs),
            false => {
                self.fusion.interrupt();
                TrackingOutcome::NoDepth
            }
        };
        Located {
            on_wall: seen_from(wall.map(|wall| wall.plane_from_camera())),
            by_ball,
            in_model,
        }
    }
}

/// What becomes of a frame that itself tells where it was seen from, or does not.
fn seen_from(world_from_camera: Option<Pose>) -> TrackingOutcome {
    world_from_camera.map_or(TrackingOutcome::NoDepth, |world_from_camera| {
        TrackingOutcome::Tracked {
            world_from_camera,
            fit: None,
        }
    })
}

/// Where the camera was when a frame was taken.
struct Located {
    /// Against the wall that the frame shows.
    on_wall: TrackingOutcome,
    /// Against the ball on the plane that fills the frame.
    by_ball: TrackingOutcome,
    /// In the model of what stands out of planes.
    in_model: TrackingOutcome,
}

impl Located {
    const NOWHERE: Located = Located {
        on_wall: TrackingOutcome::NoDepth,
        by_ball: TrackingOutcome::NoDepth,
        in_model: TrackingOutcome::NoDepth,
    };
}

/// What a session shows, and by what its place in an image is told.
#[derive(Clone, Copy)]
enum Shown {
    /// A wall, by the image's own depth.
    Wall,
    /// A ball on a plane that fills the image, by its own depth too.
    Ball(FoundSphere),
    /// Another sphere, by the image's pose.
    Fused(FoundSphere),
}

impl Shown {
    fn target(self) -> Target {
        match self {
            Shown::Wall => Target::Wall,
            Shown::Ball(sphere) | Shown::Fused(sphere) => Target::Sphere(sphere),
        }
    }
}

/// A snapshot with the place of the target in it; `None` where it shows none.
fn placed(
    snapshot: ShadingSnapshot,
    shown: Shown,
    rays: &RayGrid,
    noise: &DepthNoise,
) -> Option<TargetImage> {
    let depth_m = &snapshot.depth_m;
    let filling_plane =
        || dominant_plane(depth_m, rays, noise).filter(|plane| plane.share >= WALL_SHARE);
    let place = match shown {
        Shown::Wall => Place::Wall(filling_plane()?.plane),
        Shown::Ball(sphere) => ball_before(&filling_plane()?.plane, depth_m, rays, noise)
            .filter(|ball| are_alike(ball.radius_m, sphere.radius_m))
            .map(|ball| Place::Sphere(ball.centre))?,
        Shown::Fused(sphere) => {
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
