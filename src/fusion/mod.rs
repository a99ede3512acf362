//! Tracking and fusion: KinectFusion (Newcombe et al. 2011) on the CPU, with exact lens distortion.
//!
//! One depth image after the other is aligned to the model and fused into it. The model's frame, `world`, is the camera
//! frame of the first image. When in doubt a frame is not fused: [`TrackingOutcome::Lost`] stops integration until a later
//! frame fits the model again from the last good pose.
//!
//! Not handled here: relocalising after a jump, closing loops, moving objects.

mod noise;
mod params;
mod steps;

mod lens;
mod preprocess;
mod pyramid;

mod icp;
mod normal_equations;
mod sdf_alignment;

mod band;
mod integrate;
mod observe;
mod volume;

mod raycast;

mod block_masks;
mod cube_cases;
mod marching_cubes;
#[cfg(test)]
mod tests;

pub use icp::IcpParams;
pub use noise::DepthNoise;
pub use params::FusionParams;
pub use raycast::ModelMap;
pub use steps::{FusionStep, OnStep};

use crate::geometry::{CameraModel, Pose, TriMesh, increment, motion_between};
use band::Band;
use depth_camera::Image;
use integrate::View;
use lens::Lens;
use nalgebra::Vector6;
use observe::Observations;
use preprocess::DepthRange;
use pulp::Arch;
use pyramid::{FramePyramid, N_REDUCED};
use serde::Serialize;
use volume::TsdfVolume;

/// How well a frame fits the model.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Fit {
    /// Share of the frame's points that found their place on the model.
    pub inlier_share: f64,
    /// Weighted root mean square distance of the inliers to the model, metres.
    pub rmse_m: f64,
    /// Smallest over largest eigenvalue of the normal equations: near zero the geometry lets the camera slide.
    pub conditioning: f64,
    /// Share of the frame's points that lie behind a surface of the model: the camera would look through it.
    pub see_through_share: f64,
}

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
    /// Instruction set of the kernels; results do not depend on it.
    arch: Arch,
    lens: Lens,
    /// The frame in hand.
    frame: FramePyramid,
    observations: Observations,
    band: Band,
    volume: TsdfVolume,
    model: Option<ModelMap>,
    track: Track,
    n_fused: usize,
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
        let truncation_m = params.voxel_size_m * params.truncation_voxels;
        let frame = FramePyramid::new(&camera);
        Fusion {
            noise,
            arch: Arch::new(),
            lens: Lens::new(&camera),
            observations: Observations::new(&frame),
            frame,
            band: Band::default(),
            volume: TsdfVolume::new(
                params.voxel_size_m as f32,
                truncation_m as f32,
                params.memory_budget_mb << 20,
            ),
            model: None,
            track: Track {
                world_from_camera: Pose::identity(),
                time_secs: 0.0,
                velocity: Vector6::zeros(),
            },
            n_fused: 0,
            params,
        }
    }

    /// Tracks and fuses one depth image (metres, 0 is none) taken at `time_secs` of the device's clock.
    pub fn fuse(&mut self, depth: &Image<f32>, time_secs: f64) -> TrackingOutcome {
        self.fuse_observed(depth, time_secs, &mut |_| {})
    }

    /// Like [`Self::fuse`], telling of each step when it ends.
    pub fn fuse_observed(
        &mut self,
        depth: &Image<f32>,
        time_secs: f64,
        on_step: &mut OnStep,
    ) -> TrackingOutcome {
        if !self.prepare(depth) {
            self.track.velocity = Vector6::zeros();
            return TrackingOutcome::NoDepth;
        }
        on_step(FusionStep::Preprocess);
        let located = match &self.model {
            Some(model) => self
                .locate(model, time_secs, on_step)
                .map(|(pose, fit)| (pose, Some(fit))),
            None => Ok((Pose::identity(), None)),
        };
        match located {
            Ok((world_from_camera, fit)) => {
                self.accept(world_from_camera, time_secs, on_step);
                TrackingOutcome::Tracked {
                    world_from_camera,
                    fit,
                }
            }
            Err(reason) => {
                self.track.velocity = Vector6::zeros();
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
        if !self.prepare(depth) {
            return TrackingOutcome::NoDepth;
        }
        self.accept(*world_from_camera, time_secs, &mut |_| {});
        TrackingOutcome::Tracked {
            world_from_camera: *world_from_camera,
            fit: None,
        }
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

    /// What was seen and found no place in the volume, as a sentence; `None` as long as everything did.
    pub fn refusal(&self) -> Option<String> {
        self.band.refused().sentence(self.params.memory_budget_mb)
    }

    /// The model's surface, world frame.
    pub fn mesh(&self) -> TriMesh {
        let min_weight = self.params.min_surface_weight as f32;
        marching_cubes::marching_cubes(self.arch, &self.volume, min_weight)
    }

    /// Takes a frame in hand; `false` if it holds (almost) no depth.
    fn prepare(&mut self, depth: &Image<f32>) -> bool {
        let n_valid = preprocess::clip_depth(self.arch, depth, self.range(), &mut self.frame);
        if (n_valid as f64) < MIN_VALID_SHARE * depth.data().len() as f64 {
            return false;
        }
        preprocess::build_levels(self.arch, &self.noise, &mut self.frame);
        true
    }

    fn range(&self) -> DepthRange {
        DepthRange {
            near_m: self.params.depth_min_m as f32,
            far_m: self.params.depth_max_m as f32,
        }
    }

    fn locate(
        &self,
        model: &ModelMap,
        time_secs: f64,
        on_step: &mut OnStep,
    ) -> Result<(Pose, Fit), LossReason> {
        let elapsed = time_secs - self.track.time_secs;
        let predicted = increment(&(self.track.velocity * elapsed.clamp(0.0, MAX_PREDICTION_SECS)));
        let guess = self.track.world_from_camera * predicted;
        let (pose, fit) = self
            .align(model, &guess, on_step)
            .ok_or(LossReason::FewInliers { inlier_share: 0.0 })?;
        self.judge(&pose, &fit, elapsed)?;
        Ok((pose, fit))
    }

    /// Aligns the frame in hand to the raycast model, then to the signed distances; `None` where nothing matches at all.
    fn align(&self, model: &ModelMap, guess: &Pose, on_step: &mut OnStep) -> Option<(Pose, Fit)> {
        let (frame, level) = (&self.frame, &self.frame.reduced[MODEL_LEVEL]);
        let model = icp::CastModel {
            map: model,
            lens: &level.lens,
            world_from_camera: &self.track.world_from_camera,
        };
        let (arch, noise, icp) = (self.arch, &self.noise, &self.params.icp);
        let pose = icp::align(arch, frame, &model, guess, noise, icp)?;
        on_step(FusionStep::Icp);
        let (pose, equations) = sdf_alignment::align(
            arch,
            &frame.reduced,
            &self.volume,
            &pose,
            noise,
            icp.sdf_iterations,
        )?;
        let fit = Fit {
            inlier_share: equations.n_inliers as f64 / equations.n_points.max(1) as f64,
            rmse_m: equations.rmse_m(),
            conditioning: equations.conditioning(0.5),
            see_through_share: icp::see_through_share(
                level,
                &model,
                &pose,
                self.volume.truncation_m(),
            ),
        };
        on_step(FusionStep::SdfAlignment);
        Some((pose, fit))
    }

    fn judge(&self, pose: &Pose, fit: &Fit, elapsed: f64) -> Result<(), LossReason> {
        let motion = motion_between(&self.track.world_from_camera, pose);
        // A frame later than a tenth of a second ago does not entitle to a longer jump.
        let elapsed = elapsed.clamp(1.0 / 60.0, 0.1);
        let sigma_m = self.noise.sigma_m(median_depth(&self.frame)) as f64;
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

    /// Fuses the frame in hand at a pose, and looks at the model from there.
    fn accept(&mut self, world_from_camera: Pose, time_secs: f64, on_step: &mut OnStep) {
        self.observations.fill(self.arch, &self.frame, &self.noise);
        self.band
            .find(&mut self.volume, &self.frame, &world_from_camera);
        on_step(FusionStep::Allocate);
        let view = View::new(&self.volume, self.lens, &world_from_camera);
        let (touched, pixels) = (self.band.touched(), self.observations.pixels());
        integrate::integrate(self.arch, &mut self.volume, touched, pixels, &view);
        on_step(FusionStep::Integrate);
        let range = self.range();
        let level = &self.frame.reduced[MODEL_LEVEL];
        let (width, height) = (level.rays.width, level.rays.height);
        let map = self
            .model
            .get_or_insert_with(|| ModelMap::empty(width, height));
        raycast::raycast(&self.volume, level, &world_from_camera, range, map);
        on_step(FusionStep::Raycast);
        self.track = self
            .track
            .moved_to(world_from_camera, time_secs, self.n_fused > 0);
        self.n_fused += 1;
    }
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
fn median_depth(frame: &FramePyramid) -> f32 {
    let coarsest = &frame.reduced[N_REDUCED - 1].depth;
    let mut depths: Vec<f32> = coarsest.iter().copied().filter(|z| *z > 0.0).collect();
    if depths.is_empty() {
        return 1.0;
    }
    let middle = depths.len() / 2;
    *depths.select_nth_unstable_by(middle, f32::total_cmp).1
}

/// The instruction sets that this processor has.
#[cfg(test)]
pub(crate) fn arch_levels() -> Vec<Arch> {
    let mut levels = vec![Arch::Scalar];
    #[cfg(target_arch = "x86_64")]
    {
        levels.extend(pulp::x86::V3::try_new().map(Arch::V3));
        levels.extend(pulp::x86::V4::try_new().map(Arch::V4));
    }
    levels
}
