//! The frame in hand, from a depth image to measurements, and those into a volume; its buffers are kept from frame to frame.

use super::MODEL_LEVEL;
use super::free_space::LOOKS_EVERY;
use super::fused_volume::FusedVolume;
use super::integrate::integrate;
use super::noise::DepthNoise;
use super::observe::Observations;
use super::preprocess::{DepthRange, build_levels, clip_depth};
use super::pyramid::{FramePyramid, Level};
use super::raycast::{ModelMap, Window, raycast};
use super::steps::{FusionStep, OnStep};
use super::turns::Turns;
use super::view::View;
use super::volume::TsdfVolume;
use crate::geometry::Lens;
use crate::geometry::{CameraModel, Pose};
use depth_camera::Image;
use pulp::Arch;

/// A frame is fused for no more than so many: weights of a voxel end at 256 frames, which fewer images would fill with their own noise.
pub(super) const MOST_FRAMES_AS_ONE: usize = 4;

/// A frame of which a smaller share of the model's pixels has a normal shows specks, no surface; arbitrary, a square of 8 cm alone
/// in the working range, 0.7 m before a Kinect II, has as much.
const MIN_SURFACE_SHARE: f64 = 0.005;

/// A camera with the frame that it took last.
#[derive(Clone, Debug)]
pub struct Eye {
    /// Instruction set of the kernels; results do not depend on it.
    pub arch: Arch,
    /// The depth noise.
    pub noise: DepthNoise,
    /// The working range.
    pub range: DepthRange,
    /// The frame in hand.
    pub frame: FramePyramid,
    /// So many frames it stands for, itself included.
    pub n_frames: usize,
    lens: Lens,
    observations: Observations,
}

impl Eye {
    /// A camera without a frame.
    pub fn new(camera: &CameraModel, noise: DepthNoise, range: DepthRange) -> Self {
        let frame = FramePyramid::new(camera);
        Eye {
            arch: Arch::new(),
            noise,
            range,
            lens: Lens::new(camera),
            observations: Observations::new(&frame, range.far_m),
            frame,
            n_frames: 1,
        }
    }

    /// Takes a depth image (metres, 0 is none) in hand; `false` if it shows no surface.
    pub fn take(&mut self, depth: &Image<f32>) -> bool {
        self.take_kept(depth, 1);
        self.sees_surface()
    }

    /// Takes the depth (m) of a frame in hand that was fused before, and stands for so many, itself included.
    pub fn take_kept(&mut self, depth: &Image<f32>, n_frames: usize) {
        clip_depth(self.arch, depth, self.range, &mut self.frame);
        build_levels(self.arch, &self.noise, &mut self.frame);
        self.n_frames = n_frames;
    }

    /// Fuses the frame in hand into a volume, by the weight of what it stands for.
    pub fn fuse_into(
        &mut self,
        FusedVolume { volume, band }: &mut FusedVolume,
        world_from_camera: &Pose,
        turns: Turns,
        on_step: &mut OnStep,
    ) {
        let truncation_m = volume.truncation_m();
        self.observations
            .fill(self.arch, &self.frame, &self.noise, truncation_m);
        band.find(
            self.arch,
            volume,
            &self.frame,
            &self.noise,
            world_from_camera,
            turns,
        );
        on_step(FusionStep::Allocate);
        let n_frames = self.n_frames.min(MOST_FRAMES_AS_ONE) as f32;
        let view = View::new(volume, self.lens, world_from_camera);
        for touched in band.touched() {
            let counted = view.counting(n_frames * touched.n_frames as f32);
            integrate(
                self.arch,
                volume,
                &touched.blocks,
                &self.observations,
                &counted,
            );
        }
        band.look_through(volume, &self.observations, &view);
        let through = view
            .looking_through(self.noise)
            .counting(LOOKS_EVERY as f32 * n_frames);
        integrate(
            self.arch,
            volume,
            band.filled(),
            &self.observations,
            &through,
        );
        on_step(FusionStep::Integrate);
    }

    /// Looks at a volume from where the frame in hand was fused, with the pixels of a reduced level.
    pub fn look(
        &self,
        level: usize,
        volume: &TsdfVolume,
        world_from_camera: &Pose,
        map: &mut ModelMap,
    ) {
        let level = self.level(level);
        let all = (level, &Window::whole(level));
        raycast(self.arch, volume, all, world_from_camera, self.range, map);
    }

    /// A reduced level of the frame in hand, the finest first.
    pub fn level(&self, level: usize) -> &Level {
        &self.frame.reduced[level]
    }

    /// Whether the frame in hand shows surface, and not specks alone.
    fn sees_surface(&self) -> bool {
        let normals = &self.level(MODEL_LEVEL).normals[2];
        let n_there = normals.iter().filter(|&&z| z < 0.0).count();
        n_there as f64 >= MIN_SURFACE_SHARE * normals.len() as f64
    }
}
