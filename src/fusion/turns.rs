//! Blocks of the volume take turns: each takes in every second frame that sees it, and once it took eight, every fourth.
//!
//! Frames of one second show a place thirty times, with errors that are alike from frame to frame, and half of them make as good a
//! model to track by, or a quarter where it is not young. At the end of a scan all frames are fused anyhow, with their depth corrected
//! and loops closed.

use super::block::BlockCoord;
use super::fused_volume::FusedVolume;
use super::improvement::{Counted, GoesOn, Work};
use super::{Fusion, PoseCorrection};

/// How often blocks are fused, neighbours by turns.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Turns {
    /// In every frame.
    EveryFrame,
    /// In every second frame, and in every fourth once they are settled.
    ByAge,
}

/// A block that took so many frames is settled. While blocks are young, every fourth frame is too few where the camera is fast: of
/// every second frame of the real desk five are lost then.
const SETTLED_AFTER: u8 = 8;

impl Turns {
    /// Whether a block is settled that took so many frames.
    pub fn is_settled(self, n_taken: u8) -> bool {
        self == Turns::ByAge && n_taken >= SETTLED_AFTER
    }

    /// A block that took so many frames takes one of so many.
    pub fn period(self, n_taken: u8) -> i32 {
        match self {
            Turns::EveryFrame => 1,
            Turns::ByAge if self.is_settled(n_taken) => 4,
            Turns::ByAge => 2,
        }
    }

    /// Whether it is a block's turn in a frame, after it took so many.
    pub fn is_due(self, coord: BlockCoord, frame: u32, n_taken: u8) -> bool {
        let sum = coord
            .iter()
            .fold(frame as i32, |sum, c| sum.wrapping_add(*c));
        sum.rem_euclid(self.period(n_taken)) == 0
    }
}

impl Fusion {
    /// The same with blocks that take turns: half the work or less, and frames are tracked as well. The volume becomes whole at the end, by
    /// [`Self::close_loops`] or [`Self::complete`], from the frames that are kept; if none are, blocks take every frame.
    pub fn by_turns(mut self) -> Self {
        if self.params.loop_closing.max_memory_mb > 0 {
            self.turns = Turns::ByAge;
        }
        self
    }

    /// At the end of a scan whose blocks took turns, or whose first frames were moved: fuses the frames that are kept anew, where they
    /// lie, each into all that it sees. Whether it did: nothing is changed if there is nothing to be gained, as where memory held less
    /// than every second frame, or as soon as `goes_on` says no.
    pub fn complete(&mut self, goes_on: &GoesOn) -> bool {
        let is_fused_already = self.turns == Turns::EveryFrame && !self.is_outdated;
        if is_fused_already || !self.keyframes.are_dense() {
            return false;
        }
        let frames = self.keyframes.frames();
        let mut fused = FusedVolume::untouched(self.params.empty_volume());
        let step = Counted::new(Work::FuseWhole, frames.len(), goes_on);
        let nowhere = PoseCorrection::default();
        let is_whole = fused.fuse_again(frames, &nowhere, &self.eye, &|| step.goes_on());
        if is_whole {
            self.replace_volume(fused);
            self.turns = Turns::EveryFrame;
        }
        is_whole
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::fusion::tests::{frames, small_params};
    use crate::fusion::{DepthNoise, FusionParams, TrackingOutcome};
    use crate::geometry::{CameraModel, Pose, motion_between};
    use depth_camera::{Frame, Sensor};

    fn fusion(camera: CameraModel, params: FusionParams) -> Fusion {
        Fusion::new(camera, DepthNoise::of_sensor(Sensor::Kinect2), params)
    }

    fn n_touched(fusion: &Fusion) -> f64 {
        let touched = fusion.fused.band.touched().iter();
        touched.map(|touched| touched.blocks.len()).sum::<usize>() as f64
    }

    fn fuse(fusion: &mut Fusion, frame: &Frame) -> Pose {
        let depth = frame.depth.as_ref().expect("Kinect II");
        match fusion.fuse(depth, frame.device_time_secs) {
            TrackingOutcome::Tracked {
                world_from_camera, ..
            } => world_from_camera,
            other => panic!("frame {}: {other:?}", frame.frame_id),
        }
    }

    #[test]
    fn half_the_blocks_take_a_frame_and_tracking_is_as_good() {
        let (frames, truth, camera) = frames(8);
        let mut every = fusion(camera, small_params());
        let mut by_turns = fusion(camera, small_params()).by_turns();
        for (k, (frame, truth)) in frames.iter().zip(&truth).enumerate() {
            fuse(&mut every, frame);
            let off = motion_between(truth, &fuse(&mut by_turns, frame));
            assert!(
                off.translation_m < 0.004 && off.rotation_rad < 0.01,
                "{off:?}"
            );
            let share = n_touched(&by_turns) / n_touched(&every);
            let expected = if k == 0 { 1.0 } else { 0.5 };
            assert!((share - expected).abs() < 0.1, "frame {k}: {share}");
        }
        // No surface is missing meanwhile.
        let ratio = by_turns.mesh().area_m2() / every.mesh().area_m2();
        assert!((ratio - 1.0).abs() < 0.05, "{ratio}");
    }

    #[test]
    fn settled_blocks_take_a_quarter_of_the_frames_and_weigh_as_much() {
        let (frames, truth, camera) = frames(1);
        let depth = frames[0].depth.as_ref().expect("Kinect II");
        let mut every = fusion(camera, small_params());
        let mut by_turns = fusion(camera, small_params()).by_turns();
        let mut shares = Vec::new();
        for k in 0..32 {
            every.fuse_at(depth, f64::from(k) / 30.0, &truth[0]);
            by_turns.fuse_at(depth, f64::from(k) / 30.0, &truth[0]);
            shares.push(n_touched(&by_turns) / n_touched(&every));
        }
        // The first frame, then every second until there are eight.
        assert!((shares[12] - 0.5).abs() < 0.1, "{shares:?}");
        assert!((shares[24] - 0.25).abs() < 0.1, "{shares:?}");
        let weight = |fusion: &Fusion| {
            let blocks = fusion.fused.volume.blocks().iter();
            let weights = blocks.flat_map(|block| block.weight);
            weights.map(f64::from).sum::<f64>()
        };
        let ratio = weight(&by_turns) / weight(&every);
        assert!((ratio - 1.0).abs() < 0.1, "{ratio}");
    }

    #[test]
    fn a_completed_volume_is_that_of_blocks_that_took_every_frame() {
        let (frames, truth, camera) = frames(6);
        let fused = |mut fusion: Fusion| {
            for (frame, pose) in frames.iter().zip(&truth) {
                let depth = frame.depth.as_ref().expect("Kinect II");
                fusion.fuse_at(depth, frame.device_time_secs, pose);
            }
            fusion
        };
        let every = fused(fusion(camera, small_params()));
        let mut by_turns = fused(fusion(camera, small_params()).by_turns());
        let n_off = |by_turns: &Fusion| {
            let vertices = every.mesh().vertices;
            let far = vertices.iter().filter(|vertex| {
                let off = by_turns.signed_distance(vertex);
                off.is_none_or(|(distance, _)| distance.abs() > 2e-4)
            });
            (far.count(), vertices.len())
        };
        let (n_off_before, n_vertices) = n_off(&by_turns);
        assert!(n_off_before * 5 > n_vertices, "{n_off_before}");
        assert!(!by_turns.complete(&|_| false));
        assert_eq!(n_off(&by_turns).0, n_off_before);
        assert!(by_turns.complete(&|_| true));
        // Depth was packed in steps of 0.1 mm.
        let (n_off_after, _) = n_off(&by_turns);
        assert!(n_off_after * 100 < n_vertices, "{n_off_after}");
        // Once is enough.
        assert!(!by_turns.complete(&|_| true));
    }

    #[test]
    fn without_memory_for_frames_blocks_take_every_one() {
        let (frames, _, camera) = frames(3);
        let mut params = small_params();
        params.loop_closing.max_memory_mb = 0;
        let mut every = fusion(camera, params.clone());
        let mut by_turns = fusion(camera, params).by_turns();
        for frame in &frames {
            fuse(&mut every, frame);
            fuse(&mut by_turns, frame);
            assert_eq!(every.fused.band.touched(), by_turns.fused.band.touched());
        }
        assert!(!by_turns.complete(&|_| true));
    }
}
