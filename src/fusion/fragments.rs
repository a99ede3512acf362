//! Fragments: stretches of a scan so short that tracking did not drift, each fused for itself and seen from its middle frame.
//!
//! Averaging a fragment's frames takes most of the depth noise off before fragments are aligned to one another (Choi, Zhou,
//! Koltun 2015). A fragment's frame of reference, `anchor`, is the camera of its middle frame.

use super::eye::Eye;
use super::fragment_alignment::AlignedPoints;
use super::fused_volume::FusedVolume;
use super::keyframes::Keyframe;
use super::raycast::ModelMap;
use super::turns::Turns;
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
    /// Of these, the points by which it is aligned.
    pub points: AlignedPoints,
}

/// Fragments of an unbroken scan at most, of 2 to 3 MB each; two more for each time that tracking was broken.
const MAX_FRAGMENTS: usize = 200;

/// Cuts the frames where the camera has turned or moved far from where the stretch began, where tracking was broken, and
/// after a number of frames. Of a long scan not all of these are fragments, but the first and the last of all that tracking did not
/// break between, and some that lie evenly between them. Longer ones would drift: with five times as long ones a bust had 0.4 mm too
/// much on all sides.
pub(super) fn cut(frames: &[Keyframe], params: &LoopClosingParams) -> Vec<Range<usize>> {
    let cuts = cut_at(frames, params);
    if cuts.len() <= MAX_FRAGMENTS {
        return cuts;
    }
    let share = MAX_FRAGMENTS as f64 / cuts.len() as f64;
    let stretch = |cut: &Range<usize>| frames[cut.start].stretch;
    cuts.chunk_by(|a, b| stretch(a) == stretch(b))
        .flat_map(|unbroken| evenly_with_ends(unbroken, share))
        .collect()
}

/// Such a share of them and two at least, evenly, with the first and the last.
fn evenly_with_ends(cuts: &[Range<usize>], share: f64) -> impl Iterator<Item = Range<usize>> {
    let n_wanted = (share * cuts.len() as f64).round() as usize;
    let n = n_wanted.max(2).min(cuts.len());
    (0..n).map(move |k| cuts[k * (cuts.len() - 1) / (n - 1).max(1)].clone())
}

fn cut_at(frames: &[Keyframe], params: &LoopClosingParams) -> Vec<Range<usize>> {
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
        let mut fused = FusedVolume::untouched(params.fragment_volume());
        // The anchor comes last: its frame is then in hand to look from.
        let others = stretch.clone().filter(|&index| index != anchor);
        for index in others.chain([anchor]) {
            let frame = &frames[index];
            eye.take_kept(&frame.depth_m(), frame.n_frames);
            let anchor_from_camera = anchor_from_world * frame.world_from_camera;
            eye.fuse_into(
                &mut fused,
                &anchor_from_camera,
                Turns::EveryFrame,
                &mut |_| {},
            );
        }
        let mut map = ModelMap::of_level(eye.level(FRAGMENT_LEVEL));
        eye.look(FRAGMENT_LEVEL, &fused.volume, &Pose::identity(), &mut map);
        Fragment {
            frames: stretch,
            anchor,
            points: AlignedPoints::of(&map, &eye.noise),
            map,
        }
    }

    /// Its surface points, anchor frame, metres.
    pub fn surface_points(&self) -> impl Iterator<Item = &Vector3<f32>> {
        let points = self.map.points.data().iter();
        points
            .zip(self.map.normals.data())
            .filter(|(_, normal)| **normal != Vector3::zeros())
            .map(|(point, _)| point)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::fusion::DepthNoise;
    use crate::fusion::keyframes::Keyframes;
    use crate::fusion::track::Track;
    use crate::geometry::camera::tests::distorted_camera;
    use depth_camera::Sensor;

    /// Frames of a camera that moves 22 mm from one to the next; tracking breaks every `unbroken` frames.
    fn frames(n_frames: usize, unbroken: usize) -> Vec<Keyframe> {
        let noise = DepthNoise::of_sensor(Sensor::Kinect2);
        let eye = Eye::new(
            &distorted_camera(),
            noise,
            FusionParams::default().depth_range(),
        );
        let mut keyframes = Keyframes::new(usize::MAX);
        for k in 0..n_frames {
            let pose = Pose::translation(0.022 * k as f64, 0.0, 0.0);
            keyframes.offer(&eye, &Track::at(pose, k as f64), None, k / unbroken);
        }
        keyframes.frames().to_vec()
    }

    #[test]
    fn long_scans_have_fragments_between_which_frames_are_left_out() {
        let params = LoopClosingParams::default();
        let cut = |n_frames, unbroken| cut(&frames(n_frames, unbroken), &params);
        // 0.1 m is exceeded by the fifth step.
        assert_eq!(cut(600, usize::MAX).len(), 120);
        let many = cut(6000, usize::MAX);
        assert_eq!(many.len(), MAX_FRAGMENTS);
        assert!(many.iter().all(|cut| cut.len() == 5));
        assert_eq!((many[0].start, many[many.len() - 1].end), (0, 6000));
        let apart = many.windows(2).map(|pair| pair[1].start - pair[0].start);
        assert!(apart.clone().min() >= Some(30) && apart.max() <= Some(35));

        assert_eq!(cut(1200, 4).len(), 300, "broken more often than that");
        assert_eq!(cut(1520, 8).len(), 380, "190 stretches of two each");
        let ends = cut(3000, 20);
        assert_eq!(ends.len(), 300, "150 stretches of four each");
        for (index, cut) in ends.iter().enumerate() {
            let first = index / 2 * 20;
            let expected = if index % 2 == 0 {
                first..first + 5
            } else {
                first + 15..first + 20
            };
            assert_eq!(*cut, expected);
        }
    }
}
