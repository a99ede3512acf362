//! Tracking and fusion: KinectFusion (Newcombe et al. 2011) on the CPU, with exact lens distortion.
//!
//! One depth image after the other is aligned to the model and fused into it. The model's frame, `world`, is the camera
//! frame of the first image. When in doubt a frame is not fused: [`TrackingOutcome::Lost`] stops integration until a later
//! frame fits the model again from the last good pose.
//!
//! Not handled here: relocalising after a jump, moving objects.

mod fragment_alignment;
mod fragments;
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
            params,
        }
    }

    /// Tracks and fuses one depth image (metres, 0 is none) taken at `time_secs` of the device's clock.
    pub fn fuse(&mut self, depth: &Image<f32>, time_secs: f64) -> TrackingOutcome {
        let Some((depth, pyramid)) = self.prepare(depth) else {
            self.track.velocity = Vector6::zeros();
            return TrackingOutcome::NoDepth;
        };
        let Some(model) = &self.model else {
            self.accept(&depth, &pyramid, Pose::identity(), time_secs);
            self.remember(&depth);
            return TrackingOutcome::Tracked {
                world_from_camera: Pose::identity(),
                fit: None,
            };
        };
        match self.locate(&pyramid, model, time_secs) {
            Ok((world_from_camera, fit)) => {
                self.accept(&depth, &pyramid, world_from_camera, time_secs);
                self.remember(&depth);
                TrackingOutcome::Tracked {
                    world_from_camera,
                    fit: Some(fit),
                }
            }
            Err(reason) => {
                self.track.velocity = Vector6::zeros();
                self.stretch = self.n_fused;
                TrackingOutcome::Lost(reason)
            }
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
        let eye = Eye {
            rays: &self.rays,
            noise: &self.noise,
        };
        let frames = self.keyframes.frames();
        let closure = loop_closing::find(frames, &eye, &self.params, &self.volume)?;
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

    fn locate(
        &self,
        pyramid: &FramePyramid,
        model: &ModelMap,
        time_secs: f64,
    ) -> Result<(Pose, Fit), LossReason> {
        let elapsed = time_secs - self.track.time_secs;
        let predicted = increment(&(self.track.velocity * elapsed.clamp(0.0, MAX_PREDICTION_SECS)));
        let target = icp::Model {
            map: model,
            map_camera: self.rays.reduced(MODEL_LEVEL).camera(),
            world_from_camera: &self.track.world_from_camera,
            volume: &self.volume,
        };
        let guess = self.track.world_from_camera * predicted;
        let (pose, fit) = icp::align(
            &pyramid.reduced,
            &target,
            &guess,
            &self.noise,
            &self.params.icp,
        )
        .ok_or(LossReason::FewInliers { inlier_share: 0.0 })?;
        self.judge(&pose, &fit, pyramid, elapsed)?;
        Ok((pose, fit))
    }

    fn judge(
        &self,
        pose: &Pose,
        fit: &Fit,
        pyramid: &FramePyramid,
        elapsed: f64,
    ) -> Result<(), LossReason> {
        let motion = motion_between(&self.track.world_from_camera, pose);
        // A frame later than a tenth of a second ago does not entitle to a longer jump.
        let elapsed = elapsed.clamp(1.0 / 60.0, 0.1);
        let sigma_m = self.noise.sigma_m(median_depth(pyramid)) as f64;
        if fit.inlier_share < self.params.min_inlier_share {
            Err(LossReason::FewInliers {
                inlier_share: fit.inlier_share,
            })
        } else if fit.see_through_share > self.params.max_see_through_share {
            Err(LossReason::SeeThrough {
                share: fit.see_through_share,
            })
        } else if fit.rmse_m > self.params.max_rmse_sigmas * sigma_m {
            Err(LossReason::LargeResidual { rmse_m: fit.rmse_m })
        } else if fit.conditioning < self.params.min_conditioning {
            Err(LossReason::FlatScene {
                conditioning: fit.conditioning,
            })
        } else if motion.rotation_rad > self.params.max_rotation_rad_per_s * elapsed
            || motion.translation_m > self.params.max_speed_m_per_s * elapsed
        {
            Err(LossReason::Jump {
                rotation_rad: motion.rotation_rad,
                translation_m: motion.translation_m,
            })
        } else {
            Ok(())
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

    /// Keeps the frame that was just fused for closing loops.
    fn remember(&mut self, depth: &Image<f32>) {
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

/// Median depth of the coarsest level, metres.
fn median_depth(pyramid: &FramePyramid) -> f32 {
    let coarsest = &pyramid.reduced[preprocess::N_REDUCED - 1];
    let mut depths: Vec<f32> = coarsest
        .points
        .data()
        .iter()
        .map(|p| p.z)
        .filter(|z| *z > 0.0)
        .collect();
    if depths.is_empty() {
        return 1.0;
    }
    let middle = depths.len() / 2;
    *depths.select_nth_unstable_by(middle, f32::total_cmp).1
}
