//! Fragments: stretches of a scan so short that tracking did not drift, each fused for itself and seen from its middle frame.
//!
//! Averaging a fragment's frames takes most of the depth noise off before fragments are aligned to one another (Choi, Zhou,
//! Koltun 2015). A fragment's frame of reference, `anchor`, is the camera of its middle frame.

use super::band::Band;
use super::eye::Eye;
use super::keyframes::Keyframe;
use super::raycast::ModelMap;
use super::{FusionParams, LoopClosingParams};
use crate::geometry::{Pose, motion_between};
use nalgebra::Vector3;
use std::ops::Range;

/// The reduced level from which a fragment is seen: half the resolution of the frames.
pub(super) const FRAGMENT_LEVEL: usize = 0;

/// A stretch of frames.
#[derive(Clone, Debug)]
pub(super) struct Fragment {
    /// Its frames.
    pub frames: Range<usize>,
    /// The middle frame.
    pub anchor: usize,
    /// Its surface as the anchor sees it, anchor frame.
    pub map: ModelMap,
}

/// Cuts the frames where the camera has turned or moved far from where the stretch began, where tracking was broken, and
/// after a number of frames.
pub(super) fn cut(frames: &[Keyframe], params: &LoopClosingParams) -> Vec<Range<usize>> {
    let mut cuts = Vec::new();
    let mut start = 0;
    for (index, frame) in frames.iter().enumerate() {
        let first = &frames[start];
        let motion = motion_between(&first.world_from_camera, &frame.world_from_camera);
        if frame.stretch != first.stretch
            || motion.rotation_rad > params.fragment_rotation_rad
            || motion.translation_m > params.fragment_translation_m
            || index - start >= params.fragment_frames
        {
            cuts.push(start..index);
            start = index;
        }
    }
    if start < frames.len() {
        cuts.push(start..frames.len());
    }
    cuts
}

impl Fragment {
    /// Fuses the frames of a stretch into a volume of their own and looks at it from the middle one.
    pub(super) fn fuse(
        frames: &[Keyframe],
        stretch: Range<usize>,
        mut eye: Eye,
        params: &FusionParams,
    ) -> Fragment {
        let anchor = (stretch.start + stretch.end) / 2;
        let anchor_from_world = frames[anchor].world_from_camera.inverse();
        let (mut volume, mut band) = (params.fragment_volume(), Band::default());
        // The anchor comes last: its frame is then in hand to look from.
        let others = stretch.clone().filter(|&index| index != anchor);
        for index in others.chain([anchor]) {
            if eye.take(&frames[index].depth_m()) {
                let anchor_from_camera = anchor_from_world * frames[index].world_from_camera;
                eye.fuse_into(&mut volume, &mut band, &anchor_from_camera, &mut |_| {});
            }
        }
        let mut map = ModelMap::of_level(eye.level(FRAGMENT_LEVEL));
        eye.look(FRAGMENT_LEVEL, &volume, &Pose::identity(), &mut map);
        Fragment {
            frames: stretch,
            anchor,
            map,
        }
    }

    /// Its surface points, anchor frame, metres.
    pub fn points(&self) -> impl Iterator<Item = &Vector3<f32>> {
        let points = self.map.points.data().iter();
        points
            .zip(self.map.normals.data())
            .filter(|(_, normal)| **normal != Vector3::zeros())
            .map(|(point, _)| point)
    }
}
