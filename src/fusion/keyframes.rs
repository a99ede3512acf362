//! The frames that were fused, kept small: packed depth with the pose at which each was fused.
//!
//! Memory is bounded: once the packed images have filled it, for each frame that comes the one is let go that those beside it in time
//! stand for best, because they lie near it and stand for few others. So memory is used in full, and never more; a camera that
//! rests keeps few frames, one that moves fast keeps most, and the newest frame is always there. A frame that is kept stands for
//! those beside it that are not, as far as tracking did not break, and counts for them, four at most, where it is fused again.

use super::beginning::N_FIRST;
use super::eye::{Eye, MOST_FRAMES_AS_ONE};
use super::packed_depth::PackedDepth;
use super::pose_correction::PoseCorrection;
use super::track::Track;
use crate::geometry::{Motion, Pose, motion_between};
use depth_camera::Image;
use std::ops::Range;

/// A frame that was fused.
#[derive(Clone, Debug)]
pub struct Keyframe {
    pub(super) depth: PackedDepth,
    /// When it was taken, on the device's clock, seconds.
    pub time_secs: f64,
    /// Where it was fused.
    pub world_from_camera: Pose,
    /// Where it was given to lie; `None` for one that was tracked.
    pub given: Option<Pose>,
    /// Which stretch of unbroken tracking it belongs to.
    pub stretch: usize,
    /// So many frames that were fused it stands for, itself included.
    pub n_frames: usize,
}

impl Keyframe {
    /// Depth as it was fused, metres, 0 is none, in steps of 0.1 mm.
    pub fn depth_m(&self) -> Image<f32> {
        self.depth.unpack()
    }
}

/// The frames, in order of time.
#[derive(Clone, Debug)]
pub struct Keyframes {
    frames: Vec<Keyframe>,
    /// How much would be missed without each of them.
    missed: Vec<f64>,
    max_bytes: usize,
    memory_bytes: usize,
    /// Where depth is packed.
    codes: Vec<u8>,
}

/// Frames that are so far apart, or so long, show as much that is new.
const APART: Motion = Motion {
    rotation_rad: 0.1,
    translation_m: 0.1,
};
const APART_SECS: f64 = 1.0;
/// How much more the ends of a stretch are missed than any frame within one.
const OF_AN_END: f64 = 1e9;

impl Keyframes {
    /// No frames yet, and at most so many bytes of them; with none, no frame is kept.
    pub fn new(max_bytes: usize) -> Self {
        Keyframes {
            frames: Vec::new(),
            missed: Vec::new(),
            max_bytes,
            memory_bytes: 0,
            codes: Vec::new(),
        }
    }

    /// The frames.
    pub fn frames(&self) -> &[Keyframe] {
        &self.frames
    }

    /// The frames that were taken later than `secs` of the device's clock.
    pub fn after(&self, secs: f64) -> &[Keyframe] {
        let n_before = self.frames.partition_point(|frame| frame.time_secs <= secs);
        &self.frames[n_before..]
    }

    /// Makes the frames after the first `n` those of another stretch.
    #[cfg(test)]
    pub fn break_after(&mut self, n: usize) {
        for frame in &mut self.frames[n..] {
            frame.stretch += 1;
        }
    }

    /// Whether at least every second frame is held.
    pub fn are_dense(&self) -> bool {
        let n_frames: usize = self.frames.iter().map(|frame| frame.n_frames).sum();
        !self.frames.is_empty() && n_frames <= 2 * self.frames.len()
    }

    /// At most so many of them, chosen as where memory is short.
    pub fn at_most(&self, n: usize) -> Vec<Keyframe> {
        let mut few = self.clone();
        while few.frames.len() > n.max(1) {
            few.let_one_go();
        }
        few.frames
    }

    /// Moves all frames.
    pub fn correct(&mut self, correction: &PoseCorrection) {
        for frame in &mut self.frames {
            frame.world_from_camera = correction.apply(frame.time_secs, &frame.world_from_camera);
        }
        self.weigh(0..self.frames.len());
    }

    /// Takes the frame in hand in, which was fused where the track now ends.
    pub fn offer(&mut self, eye: &Eye, track: &Track, given: Option<Pose>, stretch: usize) {
        if self.max_bytes == 0 {
            return;
        }
        let frame = &eye.frame;
        let (width, far_m) = (frame.rays.width, eye.range.far_m);
        let depth = PackedDepth::pack(&frame.depth, width, far_m, &mut self.codes);
        self.memory_bytes += depth.memory_bytes();
        self.frames.push(Keyframe {
            depth,
            time_secs: track.time_secs,
            world_from_camera: track.world_from_camera,
            given,
            stretch,
            n_frames: eye.n_frames,
        });
        self.missed.push(f64::INFINITY);
        let n = self.frames.len();
        self.weigh(n.saturating_sub(2)..n);
        while self.memory_bytes > self.max_bytes && self.frames.len() > 1 {
            self.let_one_go();
        }
    }

    /// Lets all but the first `n` frames go, with what they stand for; without any, all begins anew.
    pub fn truncate(&mut self, n: usize) {
        if n == 0 {
            *self = Keyframes::new(self.max_bytes);
            return;
        }
        self.frames.truncate(n);
        self.missed.truncate(n);
        self.weigh(n - 1..n);
        self.memory_bytes = self.frames.iter().map(|f| f.depth.memory_bytes()).sum();
    }

    /// Lets one of at least two frames go, neither the first nor, if there are more, the newest.
    fn let_one_go(&mut self) {
        let last = self.frames.len() - 1;
        // How the first ones settle on the finished model depends on how the camera moved between them.
        let first = N_FIRST.min(self.frames.len() / 4).max(1);
        let missed = |index: &usize| self.missed[*index];
        let least = (first..last).min_by(|a, b| missed(a).total_cmp(&missed(b)));
        let index = least.unwrap_or(1);
        let standing = self.standing_for(index);
        let gone = self.frames.remove(index);
        self.missed.remove(index);
        self.memory_bytes -= gone.depth.memory_bytes();
        // What came after it moved up.
        let standing = standing.map(|other| if other > index { other - 1 } else { other });
        if let Some(standing) = standing {
            self.frames[standing].n_frames += gone.n_frames;
        }
        self.weigh(index.saturating_sub(2)..index + 2);
    }

    /// Notes how much would be missed without each of these.
    fn weigh(&mut self, indices: Range<usize>) {
        for index in indices.start..indices.end.min(self.frames.len()) {
            self.missed[index] = self.missed_without(index);
        }
    }

    /// How much would be missed without a frame: by how far it is from the one that would stand for it, and for how many that then
    /// would, the more so where it would not count for all of them. The first and the last of a stretch stay as long as there are others:
    /// how poses are corrected is known between the first and the last of those that are kept.
    fn missed_without(&self, index: usize) -> f64 {
        let frame = &self.frames[index];
        let before = index.checked_sub(1).map(|before| &self.frames[before]);
        let beside = [before, self.frames.get(index + 1)];
        let is_end =
            |beside: Option<&Keyframe>| beside.is_none_or(|beside| beside.stretch != frame.stretch);
        match self.standing_for(index).map(|other| &self.frames[other]) {
            Some(other) if !beside.into_iter().any(is_end) => {
                let n_frames = (frame.n_frames + other.n_frames) as f64;
                let too_many = (n_frames / MOST_FRAMES_AS_ONE as f64).max(1.0);
                apart(frame, other) * n_frames * too_many * too_many
            }
            _ => {
                let beside = beside.into_iter().flatten();
                let nearest = beside.map(|beside| apart(frame, beside)).reduce(f64::min);
                OF_AN_END + nearest.unwrap_or(f64::INFINITY) * frame.n_frames as f64
            }
        }
    }

    /// The frame that stands for one that is let go: of those beside it in the same stretch the one that is nearer.
    fn standing_for(&self, index: usize) -> Option<usize> {
        let gone = &self.frames[index];
        let beside = [index.checked_sub(1), Some(index + 1)];
        let beside = beside.into_iter().flatten();
        let of_stretch = beside.filter(|&other| {
            let frame = self.frames.get(other);
            frame.is_some_and(|frame| frame.stretch == gone.stretch)
        });
        let distance = |other: &usize| apart(&self.frames[*other], gone);
        of_stretch.min_by(|a, b| distance(a).total_cmp(&distance(b)))
    }
}

/// How far two frames are apart in place and time.
fn apart(a: &Keyframe, b: &Keyframe) -> f64 {
    let motion = motion_between(&a.world_from_camera, &b.world_from_camera);
    motion.rotation_rad / APART.rotation_rad
        + motion.translation_m / APART.translation_m
        + (b.time_secs - a.time_secs).abs() / APART_SECS
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::fusion::{DepthNoise, FusionParams};
    use crate::geometry::camera::tests::distorted_camera;
    use depth_camera::Sensor;

    fn eye() -> Eye {
        let camera = distorted_camera();
        let noise = DepthNoise::of_sensor(Sensor::Kinect2);
        let mut eye = Eye::new(&camera, noise, FusionParams::default().depth_range());
        assert!(eye.take(&Image::filled(512, 424, 0.7f32)));
        eye
    }

    fn standing(keyframes: &Keyframes) -> usize {
        keyframes.frames().iter().map(|frame| frame.n_frames).sum()
    }

    #[test]
    fn memory_is_used_in_full_and_frames_that_are_let_go_are_stood_for() {
        let eye = eye();
        let at = |frame: i32| Track::at(Pose::identity(), f64::from(frame));
        let max_bytes = 20 * 512 * 424;
        let mut keyframes = Keyframes::new(max_bytes);
        let mut n_most = 0;
        for frame in 0..200 {
            // Tracking breaks on the way.
            keyframes.offer(&eye, &at(frame), None, usize::from(frame >= 131));
            let frames = keyframes.frames();
            let held: usize = frames.iter().map(|f| f.depth.memory_bytes()).sum();
            assert!(held == keyframes.memory_bytes && held <= max_bytes);
            assert_eq!(standing(&keyframes), frame as usize + 1);
            assert_eq!(frames[frames.len() - 1].time_secs, f64::from(frame));
            // What was full once stays full.
            assert!(frames.len() >= n_most);
            n_most = frames.len();
        }
        assert!(n_most >= 18, "{n_most}");
        let of_first = |f: &&Keyframe| f.stretch == 0;
        let n_of_first: usize = keyframes
            .frames()
            .iter()
            .filter(of_first)
            .map(|f| f.n_frames)
            .sum();
        assert_eq!(n_of_first, 131);
        // The first ones are there, and the others spread over the time of a camera that rests.
        let times: Vec<f64> = keyframes.frames().iter().map(|f| f.time_secs).collect();
        assert_eq!(times[..4], [0.0, 1.0, 2.0, 3.0]);
        // So are those between which tracking broke.
        assert!(times.windows(2).any(|pair| pair == [130.0, 131.0]));
        let later = times[4..].windows(2).map(|pair| pair[1] - pair[0]);
        assert!(later.fold(0.0, f64::max) <= 6.0 * 200.0 / n_most as f64);

        assert!(!keyframes.are_dense());
        keyframes.truncate(3);
        for frame in 200..400 {
            keyframes.offer(&eye, &at(frame), None, 0);
        }
        assert_eq!(keyframes.frames().len(), n_most);
        keyframes.truncate(0);
        for frame in 0..3 {
            keyframes.offer(&eye, &at(frame), None, 0);
        }
        assert!(keyframes.are_dense() && keyframes.frames().len() == 3);
    }

    #[test]
    fn a_camera_that_rests_gives_up_its_frames_before_one_that_moves() {
        let eye = eye();
        let mut keyframes = Keyframes::new(usize::MAX);
        for frame in 0..120 {
            // Forty frames of rest before it moves by 20 mm a frame, and after.
            let moved = f64::from((frame - 40).clamp(0, 40));
            let pose = Pose::translation(0.02 * moved, 0.0, 0.0);
            let track = Track::at(pose, f64::from(frame) / 30.0);
            keyframes.offer(&eye, &track, None, 0);
        }
        let few = keyframes.at_most(60);
        assert_eq!(few.len(), 60);
        let n_moving = few
            .iter()
            .filter(|f| (40.0..80.0).contains(&(30.0 * f.time_secs)))
            .count();
        // Of every second frame it would be half.
        assert!(n_moving >= 30, "{n_moving} of 40");
        assert_eq!(few.iter().map(|f| f.n_frames).sum::<usize>(), 120);
        assert_eq!(keyframes.at_most(200).len(), 120);
        assert_eq!(keyframes.at_most(0).len(), 1);
    }
}
