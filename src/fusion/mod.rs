//! Tracking and fusion: KinectFusion (Newcombe et al. 2011) on the CPU, with exact lens distortion.
//!
//! One depth image after the other is aligned to the model and fused into it. The model's frame, `world`, is the camera
//! frame of the first image. When in doubt a frame is not fused: [`TrackingOutcome::Lost`] stops integration until a later
//! frame fits the model again from the last good pose, or two frames from a place where the camera has been.
//!
//! Not handled here: moving objects.

#[cfg(test)]
mod bench_tests;
mod fragment_alignment;
mod fragments;
mod gates;
mod icp;
mod integrate;
mod keyframes;
mod loop_closing;
mod marching_cubes;
mod noise;
mod packed_depth;
mod params;
mod pose_correction;
mod pose_graph;
mod preprocess;
mod raycast;
mod relocalise;
#[cfg(test)]
mod tests;
mod volume;

pub use icp::{Fit, IcpParams};
pub use loop_closing::{LoopClosingParams, LoopClosure};
pub use noise::DepthNoise;
pub use params::FusionParams;
pub use pose_correction::PoseCorrection;
pub use raycast::ModelMap;

use crate::geometry::{CameraModel, Pose, TriMesh, increment, motion_between};
use depth_camera::Image;
use keyframes::Keyframes;
use nalgebra::Vector6;
use preprocess::{FramePyramid, PyramidRays, VertexMap};
use relocalise::{Hypothesis, Places};
use serde::Serialize;
use volume::TsdfVolume;

/// Why the camera is lost.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
#[serde(tag = "reason", rename_all = "snake_case")]
pub enum LossReason {
    /// Too few points of the frame lie on the model: too fast, too close, or another place.
    FewInliers {
        /// Share of the points that lie on the model.
        inlier_share: f64,
    },
    /// The camera would look through surfaces of the model: it is elsewhere, however well the rest fits.
    SeeThrough {
        /// Share of the points that lie behind the model.
        share: f64,
    },
    /// The frame lies on the model badly.
    LargeResidual {
        /// Root mean square distance of the inliers, metres.
        rmse_m: f64,
    },
    /// The geometry in view does not hold the camera: a flat or round scene.
    FlatScene {
        /// Smallest over largest eigenvalue of the alignment.
        conditioning: f64,
    },
    /// The camera would have moved faster than a hand does.
    Jump {
        /// Turn since the last good pose, radians.
        rotation_rad: f64,
        /// Distance from the last good pose, metres.
        translation_m: f64,
    },
    /// A place was found where the frame may have been taken; the next one has to confirm it.
    Unconfirmed,
    /// After an interruption the frame does not show what the model shows from where it seems to be.
    Elsewhere,
}

/// What became of a frame.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum TrackingOutcome {
    /// The frame was aligned and fused.
    Tracked {
        /// Pose of the camera.
        world_from_camera: Pose,
        /// How well it fits; `None` for the first frame and for given poses.
        fit: Option<Fit>,
    },
    /// The frame holds (almost) no depth: covered lens or projector, or nothing in range. Tracking waits.
    NoDepth,
    /// The frame does not fit the model and was not fused.
    Lost(LossReason),
}

/// Below this share of valid pixels a frame is taken for empty; arbitrary, speckle of a covered Kinect I stays below.
const MIN_VALID_SHARE: f64 = 0.02;
/// The model image has 1/4 of the frame's resolution; the signed distances themselves give the last accuracy.
const MODEL_LEVEL: usize = 1;
/// The motion of the last frame is carried on over gaps up to this long.
const MAX_PREDICTION_SECS: f64 = 0.12;

/// The model and the camera's place in it.
#[derive(Clone)]
pub struct Fusion {
    params: FusionParams,
    noise: DepthNoise,
    rays: PyramidRays,
    volume: TsdfVolume,
    model: Option<ModelMap>,
    track: Track,
    n_fused: usize,
    keyframes: Keyframes,
    /// Number of the stretch of unbroken tracking.
    stretch: usize,
    places: Places,
    /// Where the frame before may have been taken, if it was lost.
    hypothesis: Option<(Hypothesis, Track)>,
    n_relocalised: usize,
    /// Whether the frame before was not tracked.
    is_interrupted: bool,
}

/// What turns a depth image into measurements.
struct Eye<'a> {
    rays: &'a PyramidRays,
    noise: &'a DepthNoise,
}

/// The camera's recent motion.
#[derive(Clone, Copy)]
struct Track {
    world_from_camera: Pose,
    time_secs: f64,
    /// Turn and move per second in the camera frame.
    velocity: Vector6<f64>,
}

impl Fusion {
    /// An empty model for one camera; `params` must have been validated.
    pub fn new(camera: CameraModel, noise: DepthNoise, params: FusionParams) -> Self {
        Fusion {
            noise,
            rays: PyramidRays::new(camera),
            volume: params.empty_volume(),
            model: None,
            track: Track {
                world_from_camera: Pose::identity(),
                time_secs: 0.0,
                velocity: Vector6::zeros(),
            },
            n_fused: 0,
            keyframes: Keyframes::new(params.loop_closing.max_memory_mb << 20),
            stretch: 0,
            places: Places::default(),
            hypothesis: None,
            n_relocalised: 0,
            is_interrupted: false,
            params,
        }
    }

    /// Tracks and fuses one depth image (metres, 0 is none) taken at `time_secs` of the device's clock.
    pub fn fuse(&mut self, depth: &Image<f32>, time_secs: f64) -> TrackingOutcome {
        let Some((depth, pyramid)) = self.prepare(depth) else {
            self.track.velocity = Vector6::zeros();
            self.hypothesis = None;
            self.is_interrupted = true;
            return TrackingOutcome::NoDepth;
        };
        let Some(model) = &self.model else {
            self.accept(&depth, &pyramid, Pose::identity(), time_secs);
            self.remember(&depth, &pyramid);
            return TrackingOutcome::Tracked {
                world_from_camera: Pose::identity(),
                fit: None,
            };
        };
        let tracked = self
            .locate(&pyramid, model, &self.track, time_secs)
            .and_then(|found| self.resume(found, &pyramid));
        match tracked.or_else(|reason| self.confirm(&pyramid, time_secs).ok_or(reason)) {
            Ok((world_from_camera, fit)) => {
                self.accept(&depth, &pyramid, world_from_camera, time_secs);
                self.remember(&depth, &pyramid);
                TrackingOutcome::Tracked {
                    world_from_camera,
                    fit: Some(fit),
                }
            }
            Err(reason) => TrackingOutcome::Lost(self.search(&pyramid, time_secs, reason)),
        }
    }

    /// Fuses one depth image at a pose that is known.
    pub fn fuse_at(
        &mut self,
        depth: &Image<f32>,
        time_secs: f64,
        world_from_camera: &Pose,
    ) -> TrackingOutcome {
        let Some((depth, pyramid)) = self.prepare(depth) else {
            return TrackingOutcome::NoDepth;
        };
        self.accept(&depth, &pyramid, *world_from_camera, time_secs);
        TrackingOutcome::Tracked {
            world_from_camera: *world_from_camera,
            fit: None,
        }
    }

    /// At the end of a scan: takes back the drift between visits of one place and fuses every frame anew. The poses handed
    /// out so far are then to be moved by [`LoopClosure::correction`], and no more frames can be tracked. `None`, and nothing
    /// is changed, if the camera never came back or its frames would not fit one another better.
    pub fn close_loops(&mut self) -> Option<LoopClosure> {
        let frames = self.keyframes.frames();
        let closure = loop_closing::find(frames, &self.eye(), &self.params, &self.volume)?;
        self.volume = closure.volume;
        Some(closure.closure)
    }

    /// The model as the camera saw it after the last fused frame, at a quarter of the resolution.
    pub fn model(&self) -> Option<&ModelMap> {
        self.model.as_ref()
    }

    /// Number of frames in the model.
    pub fn n_fused(&self) -> usize {
        self.n_fused
    }

    /// How often a lost camera was found in another place than it was lost at.
    pub fn n_relocalised(&self) -> usize {
        self.n_relocalised
    }

    /// Bytes held by the volume.
    pub fn memory_bytes(&self) -> usize {
        self.volume.memory_bytes()
    }

    /// The model's surface, world frame.
    pub fn mesh(&self) -> TriMesh {
        marching_cubes::marching_cubes(&self.volume, self.params.min_surface_weight as f32)
    }

    fn prepare(&self, depth: &Image<f32>) -> Option<(Image<f32>, FramePyramid)> {
        let (near, far) = (
            self.params.depth_min_m as f32,
            self.params.depth_max_m as f32,
        );
        let depth = preprocess::clip_depth(depth, near, far);
        let n_valid = depth.data().iter().filter(|z| **z > 0.0).count();
        if (n_valid as f64) < MIN_VALID_SHARE * depth.data().len() as f64 {
            return None;
        }
        let pyramid = preprocess::build_pyramid(&depth, &self.rays, &self.noise);
        Some((depth, pyramid))
    }

    /// Aligns a frame to the model as seen from the pose of a track, and judges the result.
    fn locate(
        &self,
        pyramid: &FramePyramid,
        model: &ModelMap,
        track: &Track,
        time_secs: f64,
    ) -> Result<(Pose, Fit), LossReason> {
        let elapsed = time_secs - track.time_secs;
        let predicted = increment(&(track.velocity * elapsed.clamp(0.0, MAX_PREDICTION_SECS)));
        let target = icp::Model {
            map: model,
            map_camera: self.rays.reduced(MODEL_LEVEL).camera(),
            world_from_camera: &track.world_from_camera,
            volume: &self.volume,
        };
        let guess = track.world_from_camera * predicted;
        let (pose, fit) = icp::align(
            &pyramid.reduced,
            &target,
            &guess,
            &self.noise,
            &self.params.icp,
        )
        .ok_or(LossReason::FewInliers { inlier_share: 0.0 })?;
        gates::judge_fit(&fit, pyramid, &self.noise, &self.params)?;
        let motion = motion_between(&track.world_from_camera, &pose);
        gates::judge_motion(&motion, elapsed, &self.params)?;
        Ok((pose, fit))
    }

    /// After an interruption the camera may be elsewhere: a pose is then believed as one that was searched for.
    fn resume(
        &self,
        (pose, fit): (Pose, Fit),
        pyramid: &FramePyramid,
    ) -> Result<(Pose, Fit), LossReason> {
        if !self.is_interrupted {
            return Ok((pose, fit));
        }
        relocalise::believe(
            &pose,
            &fit,
            pyramid,
            &self.volume,
            &self.eye(),
            &self.params,
        )
        .map(|_| (pose, fit))
        .ok_or(LossReason::Elsewhere)
    }

    fn eye(&self) -> Eye<'_> {
        Eye {
            rays: &self.rays,
            noise: &self.noise,
        }
    }

    /// Tracks from the place that the frame before was found at, if there is one.
    fn confirm(&mut self, pyramid: &FramePyramid, time_secs: f64) -> Option<(Pose, Fit)> {
        let (hypothesis, track) = self.hypothesis.take()?;
        let found = self
            .locate(pyramid, &hypothesis.model, &track, time_secs)
            .ok()?;
        self.n_relocalised += 1;
        // The new stretch of path is no motion from where tracking was lost.
        self.track = track;
        Some(found)
    }

    /// Looks for a lost frame in the whole model; tells why it is not fused.
    fn search(&mut self, pyramid: &FramePyramid, time_secs: f64, reason: LossReason) -> LossReason {
        self.track.velocity = Vector6::zeros();
        self.stretch = self.n_fused;
        self.is_interrupted = true;
        let found = self
            .places
            .relocalise(pyramid, &self.volume, &self.eye(), &self.params);
        self.hypothesis = found.map(|hypothesis| {
            let track = Track {
                world_from_camera: hypothesis.world_from_camera,
                time_secs,
                velocity: Vector6::zeros(),
            };
            (hypothesis, track)
        });
        match self.hypothesis {
            Some(_) => LossReason::Unconfirmed,
            None => reason,
        }
    }

    fn accept(
        &mut self,
        depth: &Image<f32>,
        pyramid: &FramePyramid,
        world_from_camera: Pose,
        time_secs: f64,
    ) {
        let eye = Eye {
            rays: &self.rays,
            noise: &self.noise,
        };
        integrate_frame(
            &mut self.volume,
            depth,
            &pyramid.full,
            &eye,
            &world_from_camera,
        );
        let rays = self.rays.reduced(MODEL_LEVEL);
        self.model = Some(raycast::raycast(
            &self.volume,
            rays,
            depth,
            &world_from_camera,
            self.params.depth_range(),
        ));
        self.track = self
            .track
            .moved_to(world_from_camera, time_secs, self.n_fused > 0);
        self.n_fused += 1;
    }

    /// Keeps the frame that was just fused for closing loops and for finding back.
    fn remember(&mut self, depth: &Image<f32>, pyramid: &FramePyramid) {
        self.hypothesis = None;
        self.is_interrupted = false;
        self.places.visit(pyramid, &self.track.world_from_camera);
        self.keyframes.offer(
            depth,
            self.params.depth_max_m as f32,
            self.track.time_secs,
            &self.track.world_from_camera,
            self.stretch,
        );
    }
}

/// Fuses a clipped depth image with its filtered vertex map.
fn integrate_frame(
    volume: &mut TsdfVolume,
    depth: &Image<f32>,
    map: &VertexMap,
    eye: &Eye,
    world_from_camera: &Pose,
) {
    let observations = integrate::observe(depth, map, eye.noise);
    let rays = eye.rays.full();
    let band = integrate::blocks_in_band(volume, &observations, rays, world_from_camera);
    integrate::integrate(
        volume,
        &band,
        &observations,
        rays.camera(),
        world_from_camera,
    );
}

impl Track {
    fn moved_to(&self, world_from_camera: Pose, time_secs: f64, has_moved: bool) -> Track {
        let elapsed = time_secs - self.time_secs;
        let step = self.world_from_camera.inverse() * world_from_camera;
        let velocity = if has_moved && elapsed > 0.0 && elapsed < MAX_PREDICTION_SECS {
            let (turn, shift) = (step.rotation.scaled_axis(), step.translation.vector);
            Vector6::new(turn.x, turn.y, turn.z, shift.x, shift.y, shift.z) / elapsed
        } else {
            Vector6::zeros()
        };
        Track {
            world_from_camera,
            time_secs,
            velocity,
        }
    }
}
