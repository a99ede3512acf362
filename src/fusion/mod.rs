//! Tracking and fusion: KinectFusion (Newcombe et al. 2011) on the CPU, with exact lens distortion.
//!
//! One depth image after the other is aligned to the model and fused into it. The model's frame, `world`, is the camera
//! frame of the first image, or, where poses are given, the frame of those. When in doubt a frame is not fused:
//! [`TrackingOutcome::Lost`] stops integration until a later frame fits the model again from the last good pose, or two
//! frames from a place where the camera has been.
//!
//! What was fused and is gone is taken back where a later frame sees through it. Not handled: what moves while it is seen.

mod improvement;
mod noise;
mod outcome;
mod params;
mod steps;

mod eye;
mod normals;
mod preprocess;
mod pyramid;

mod align;
mod carry_on;
mod degeneracy;
mod gates;
mod icp;
mod infrared;
mod model_view;
mod normal_equations;
mod points;
mod sdf_alignment;
mod track;
mod turns;

mod band;
mod band_ends;
mod block;
mod free_space;
mod fused_volume;
mod integrate;
mod observe;
mod sampling;
mod view;
mod volume;

mod raycast;
mod sight;

mod beginning;
mod polish;
mod relocalise;
mod revisit;
mod take_back;
mod thin_parts;

mod depth_field;
mod fragment_alignment;
mod fragments;
mod frame_patches;
mod keyframes;
mod loop_closing;
mod loops_aside;
mod misfit;
mod packed_depth;
mod pose_correction;
mod pose_graph;
mod rolling_shutter;

#[cfg(test)]
pub(crate) mod bench_tests;
mod block_masks;
mod crossings;
mod cube_cases;
mod live_mesh;
mod locate;
mod marching_cubes;
mod surface_patch;
#[cfg(test)]
mod tests;

pub use depth_field::DepthField;
pub use icp::IcpParams;
pub use improvement::{GoesOn, Improvement, Work};
pub use infrared::InfraredOptics;
pub use keyframes::Keyframe;
pub use live_mesh::LiveMesh;
pub use loop_closing::{LoopClosingParams, LoopClosure};
pub use loops_aside::{LoopSearch, LoopsAside};
pub use noise::DepthNoise;
pub use outcome::{Fit, LossReason, TrackingOutcome};
pub use params::FusionParams;
pub use polish::PolishParams;
pub use pose_correction::PoseCorrection;
pub use raycast::ModelMap;
pub use rolling_shutter::{RollingShutter, Waypoint, velocities};
pub use steps::{FusionStep, OnStep};
pub use surface_patch::{LatticeEdge, SurfacePatch};

use crate::geometry::{CameraModel, Motion, Pose, RayGrid, TriMesh, motion_between};
use degeneracy::{CommonShape, HARDLY_HELD_SHARE};
use depth_camera::Image;
use eye::Eye;
use fused_volume::FusedVolume;
use infrared::Infrared;
use keyframes::Keyframes;
use locate::Before;
use model_view::ModelView;
use nalgebra::{Point3, Vector3};
use relocalise::{Hypothesis, Places};
use revisit::Revisits;
use track::Track;
use turns::Turns;

/// The model image has 1/4 of the frame's resolution; the signed distances themselves give the last accuracy.
const MODEL_LEVEL: usize = 1;

/// Settling on the finished model: iterations as of [`IcpParams::sdf_iterations`], and how far a view may go. Closing a turn
/// of 2 m moved views by up to 10 mm against one another, of which interpolation leaves a part.
const SETTLING_ITERATIONS: [usize; 2] = [4, 8];
const MAX_SETTLING: Motion = Motion {
    rotation_rad: 0.02,
    translation_m: 0.01,
};

/// The model and the camera's place in it.
#[derive(Clone)]
pub struct Fusion {
    params: FusionParams,
    eye: Eye,
    /// `None` without infrared images that show a scene lit by the sensor.
    infrared: Option<Infrared>,
    fused: FusedVolume,
    /// Rises when the volume is replaced by another.
    volume_number: usize,
    /// The model from where the last frame was fused.
    seen: Option<ModelView>,
    track: Track,
    /// What frames and model have in common, since the camera was found last.
    common: Option<CommonShape>,
    n_fused: usize,
    keyframes: Keyframes,
    /// Number of the stretch of unbroken tracking.
    stretch: usize,
    places: Places,
    revisits: Revisits,
    /// Where the frame before may have been taken, if it was lost.
    hypothesis: Option<(Hypothesis, Track)>,
    n_relocalised: usize,
    /// Frames whose given pose was not polished.
    n_unpolished: usize,
    /// Whether frames lie where they were given to lie.
    is_given: bool,
    /// What became of the frame before.
    before: Before,
    /// How often blocks of the volume are fused.
    turns: Turns,
    /// Whether frames were moved since they were fused.
    is_outdated: bool,
}

impl Fusion {
    /// An empty model for one camera; `params` must have been validated.
    pub fn new(camera: CameraModel, noise: DepthNoise, params: FusionParams) -> Self {
        Fusion {
            eye: Eye::new(&camera, noise, params.depth_range()),
            infrared: None,
            fused: FusedVolume::untouched(params.empty_volume()),
            volume_number: 0,
            seen: None,
            track: Track::at(Pose::identity(), 0.0),
            common: None,
            n_fused: 0,
            keyframes: Keyframes::new(params.loop_closing.max_memory_mb << 20),
            stretch: 0,
            places: Places::default(),
            revisits: Revisits::default(),
            hypothesis: None,
            n_relocalised: 0,
            n_unpolished: 0,
            is_given: false,
            before: Before::Tracked,
            turns: Turns::EveryFrame,
            is_outdated: false,
            params,
        }
    }

    /// The same with infrared images, which hold the camera where the geometry lets it slide: see [`Self::see`].
    pub fn with_infrared(mut self, camera: CameraModel, optics: InfraredOptics) -> Self {
        self.infrared = Some(Infrared::new(camera, optics));
        self
    }

    /// Takes the infrared image (counts) of the depth image that is tracked next.
    pub fn see(&mut self, counts: &Image<u16>) {
        if let Some(infrared) = &mut self.infrared {
            infrared.take(counts);
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
        let outcome = self.track_and_fuse(depth, time_secs, on_step);
        if let Some(infrared) = &mut self.infrared {
            infrared.forget();
        }
        outcome
    }

    fn track_and_fuse(
        &mut self,
        depth: &Image<f32>,
        time_secs: f64,
        on_step: &mut OnStep,
    ) -> TrackingOutcome {
        // A first frame of specks would be a model that no later one is found in.
        if !self.eye.take(depth) {
            self.interrupt();
            return TrackingOutcome::NoDepth;
        }
        if self.before == Before::Tracked && self.track.is_outdated(time_secs) {
            self.interrupt();
        }
        on_step(FusionStep::Preprocess);
        match self.find(time_secs, on_step) {
            Ok((world_from_camera, fit)) => {
                let (common, volume) = (self.common.as_ref(), &self.fused.volume);
                self.common = CommonShape::after(common, &self.eye, volume, &world_from_camera);
                self.accept(world_from_camera, time_secs, on_step);
                self.remember(fit.as_ref());
                on_step(FusionStep::Remember);
                TrackingOutcome::Tracked {
                    world_from_camera,
                    fit,
                }
            }
            Err(reason) => TrackingOutcome::Lost(self.search(time_secs, reason)),
        }
    }

    /// At the end of a scan: takes back the drift between visits of one place and fuses every frame anew. The poses handed
    /// out so far are then to be moved by [`LoopClosure::correction`], and no more frames can be tracked. `None`, and nothing
    /// is changed, if poses were given, if the camera never came back, if its frames would not fit one another as well, or as soon as
    /// `goes_on` says no.
    pub fn close_loops(&mut self, goes_on: &GoesOn) -> Option<LoopClosure> {
        if self.is_given {
            return None;
        }
        let frames = self.keyframes.frames();
        let found = loop_closing::find(frames, &self.eye, &self.params, goes_on)?;
        let closed = found.judged(&self.fused.volume)?;
        self.replace_volume(closed.fused);
        self.turns = Turns::EveryFrame;
        Some(closed.closure)
    }

    /// Where a depth image (m) lies best on the finished model, near a pose that is known: what was tracked against half a
    /// model, or moved by closing a loop, settles on the surface that is delivered. `None` if it would go further than
    /// tracking and correction err, or hardly lies on the model.
    pub fn settle(&mut self, depth: &Image<f32>, world_from_camera: &Pose) -> Option<Pose> {
        if !self.eye.take(depth) {
            return None;
        }
        let eye = &self.eye;
        let (levels, volume, noise) = (&eye.frame.reduced, &self.fused.volume, &eye.noise);
        let (arch, guess) = (eye.arch, world_from_camera);
        let (pose, _) =
            sdf_alignment::align(arch, levels, volume, guess, noise, SETTLING_ITERATIONS)?;
        let is_near = motion_between(world_from_camera, &pose).is_within(&MAX_SETTLING);
        is_near.then_some(pose)
    }

    /// The frames that were tracked and fused, in order of time; where memory for them is short, some of them, which stand for
    /// those beside them.
    pub fn keyframes(&self) -> &[Keyframe] {
        self.keyframes.frames()
    }

    /// At most so many of them, which stand for the others as where memory is short.
    pub fn keyframes_at_most(&self, n: usize) -> Vec<Keyframe> {
        self.keyframes.at_most(n)
    }

    /// Distance to the model's surface (m, positive outside) and its gradient at a point of the world; `None` where the model
    /// knows nothing.
    pub fn signed_distance(&self, point_world: &Point3<f64>) -> Option<(f64, Vector3<f64>)> {
        let volume = &self.fused.volume;
        let sample = volume.sample_with_gradient(&point_world.coords.cast());
        sample.map(|(distance, gradient)| (f64::from(distance), gradient.cast()))
    }

    /// The slow error of a Kinect I's depth that the fused frames show against the model; `None` if they show none.
    pub fn depth_field(&self, rays: &RayGrid) -> Option<DepthField> {
        DepthField::measure(self.keyframes(), &self.fused.volume, rays)
    }

    /// How long the rows of a Kinect I take to be read, as the fused frames show against the model; `None` if they do not show it.
    pub fn rolling_shutter(&self, rays: &RayGrid) -> Option<RollingShutter> {
        RollingShutter::measure(self.keyframes(), &self.fused.volume, rays)
    }

    /// Says that frames are missing between the last one and the next, which may show another place.
    pub fn interrupt(&mut self) {
        self.track.stop();
        self.common = None;
        self.hypothesis = None;
        self.before = Before::Missing;
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
        self.fused.volume.memory_bytes()
    }

    /// What was seen and found no place in the volume, as a sentence; `None` as long as everything did.
    pub fn refusal(&self) -> Option<String> {
        let refused = self.fused.band.refused();
        let model_mb = self.params.volume_budget_bytes() >> 20;
        refused.sentence(self.params.memory_budget_mb, model_mb)
    }

    /// The model's surface, world frame.
    pub fn mesh(&self) -> TriMesh {
        let min_weight = self.params.surface_weight();
        marching_cubes::marching_cubes(self.eye.arch, &self.fused.volume, min_weight)
    }

    /// Fuses the frame in hand at a pose, from where the model is seen then.
    fn accept(&mut self, world_from_camera: Pose, time_secs: f64, on_step: &mut OnStep) {
        self.take_in(world_from_camera, time_secs, on_step);
        self.stand_at(&world_from_camera);
    }

    /// Fuses the frame in hand at a pose.
    fn take_in(&mut self, world_from_camera: Pose, time_secs: f64, on_step: &mut OnStep) {
        let (eye, fused) = (&mut self.eye, &mut self.fused);
        eye.fuse_into(fused, &world_from_camera, self.turns, on_step);
        self.places.forget_views();
        self.track = self
            .track
            .moved_to(world_from_camera, time_secs, self.n_fused > 0);
        self.n_fused += 1;
    }

    /// Keeps the frame that was just fused for closing loops and for finding back.
    fn remember(&mut self, fit: Option<&Fit>) {
        self.hypothesis = None;
        self.before = Before::Tracked;
        self.places.visit(&self.eye, &self.track);
        self.revisits.visit(&self.track);
        self.keep(None);
        let is_hardly_held = fit.is_none_or(|fit| fit.held_share < HARDLY_HELD_SHARE);
        if is_hardly_held && self.infrared.is_some() {
            self.look();
            if let (Some(infrared), Some(seen)) = (&mut self.infrared, &self.seen) {
                infrared.remember(self.eye.level(MODEL_LEVEL), seen.map(), &self.track);
            }
        }
    }

    fn replace_volume(&mut self, fused: FusedVolume) {
        self.fused = fused;
        if let Some(seen) = &mut self.seen {
            seen.moved(&self.track.world_from_camera);
        }
        self.is_outdated = false;
        self.volume_number += 1;
    }

    fn keep(&mut self, given: Option<Pose>) {
        self.keyframes
            .offer(&self.eye, &self.track, given, self.stretch);
    }
}
