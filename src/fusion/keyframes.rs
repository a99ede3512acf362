//! The frames that were fused, kept small: packed depth with the pose at which each was fused.
//!
//! Memory is bounded: once the packed images have filled it, every second frame is let go, from the first on and one for each
//! that comes, until all are twice as far apart; from then on every second frame is kept, and so on. So memory is always used
//! in full, and never more. A frame that is kept stands for those beside it that are not, as far as tracking did not break, and counts
//! for them, four at most, where it is fused again.

use super::eye::Eye;
use super::packed_depth::PackedDepth;
use super::pose_correction::PoseCorrection;
use super::track::Track;
use crate::geometry::Pose;
use depth_camera::Image;

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
    max_bytes: usize,
    memory_bytes: usize,
    /// One frame in so many is kept.
    stride: usize,
    /// The frame that is let go next: those before it are twice as far apart as those after it.
    next_to_go: usize,
    /// Frames offered since the last that was kept.
    n_skipped: usize,
    /// The frames that these stand for, and then the next that is kept.
    n_unkept: usize,
    /// The stretch of unbroken tracking that those not kept are of.
    unkept_stretch: usize,
}

impl Keyframes {
    /// No frames yet, and at most so many bytes of them.
    pub fn new(max_bytes: usize) -> Self {
        Keyframes {
            frames: Vec::new(),
            max_bytes,
            memory_bytes: 0,
            stride: 1,
            next_to_go: 1,
            n_skipped: 0,
            n_unkept: 0,
            unkept_stretch: 0,
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

    /// Whether every frame was kept at first, so that at least every second one is held.
    pub fn are_dense(&self) -> bool {
        self.stride == 1 && !self.frames.is_empty()
    }

    /// Moves all frames.
    pub fn correct(&mut self, correction: &PoseCorrection) {
        for frame in &mut self.frames {
            frame.world_from_camera = correction.apply(frame.time_secs, &frame.world_from_camera);
        }
    }

    /// Takes the frame in hand in, which was fused where the track now ends, unless it is one of those between.
    pub fn offer(&mut self, eye: &Eye, track: &Track, given: Option<Pose>, stretch: usize) {
        self.n_skipped += 1;
        if self.unkept_stretch != stretch {
            // The next frame that is kept may be elsewhere.
            let last = self.frames.last_mut();
            if let Some(last) = last.filter(|last| last.stretch == self.unkept_stretch) {
                last.n_frames += self.n_unkept;
            }
            (self.n_unkept, self.unkept_stretch) = (0, stretch);
        }
        self.n_unkept += eye.n_frames;
        if self.max_bytes == 0 || (self.n_skipped < self.stride && !self.frames.is_empty()) {
            return;
        }
        self.n_skipped = 0;
        let frame = &eye.frame;
        let depth = PackedDepth::pack(&frame.depth, frame.rays.width, eye.range.far_m);
        self.memory_bytes += depth.memory_bytes();
        self.frames.push(Keyframe {
            depth,
            time_secs: track.time_secs,
            world_from_camera: track.world_from_camera,
            given,
            stretch,
            n_frames: std::mem::take(&mut self.n_unkept),
        });
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
        self.next_to_go = self.next_to_go.clamp(1, n);
        (self.n_skipped, self.n_unkept) = (0, 0);
        self.memory_bytes = self.frames.iter().map(|f| f.depth.memory_bytes()).sum();
    }

    /// Lets one of at least two frames go: the one before it stands for it, or the one after it where tracking broke between.
    fn let_one_go(&mut self) {
        if self.next_to_go >= self.frames.len() {
            self.stride *= 2;
            self.next_to_go = 1;
        }
        let gone = self.frames.remove(self.next_to_go);
        self.memory_bytes -= gone.depth.memory_bytes();
        let beside = &mut self.frames[self.next_to_go - 1..];
        let standing = beside
            .iter_mut()
            .take(2)
            .find(|frame| frame.stretch == gone.stretch);
        if let Some(frame) = standing {
            frame.n_frames += gone.n_frames;
        }
        self.next_to_go += 1;
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::fusion::{DepthNoise, FusionParams};
    use crate::geometry::camera::tests::distorted_camera;
    use depth_camera::Sensor;

    #[test]
    fn memory_is_used_in_full_and_the_frames_are_evenly_spread() {
        let camera = distorted_camera();
        let noise = DepthNoise::of_sensor(Sensor::Kinect2);
        let mut eye = Eye::new(&camera, noise, FusionParams::default().depth_range());
        assert!(eye.take(&Image::filled(512, 424, 0.7f32)));
        let at = |frame: i32| Track::at(Pose::identity(), f64::from(frame));
        let max_bytes = 20 * 512 * 424;
        let mut keyframes = Keyframes::new(max_bytes);
        let mut n_most = 0;
        for frame in 0..200 {
            // Tracking breaks in the midst of a stride.
            keyframes.offer(&eye, &at(frame), None, usize::from(frame >= 131));
            let frames = keyframes.frames();
            let held: usize = frames.iter().map(|f| f.depth.memory_bytes()).sum();
            assert!(held == keyframes.memory_bytes && held <= max_bytes);
            let n_frames: usize = frames.iter().map(|f| f.n_frames).sum();
            assert_eq!(n_frames + keyframes.n_unkept, frame as usize + 1);
            // What was full once stays full.
            assert!(frames.len() >= n_most);
            n_most = frames.len();
            let gaps = frames.windows(2).map(|f| f[1].time_secs - f[0].time_secs);
            let (least, most) = gaps.fold((f64::INFINITY, 0.0), |(least, most), gap| {
                (gap.min(least), gap.max(most))
            });
            assert!(frames[0].time_secs == 0.0 && most <= 2.0 * least);
            assert!(f64::from(frame) - frames[frames.len() - 1].time_secs <= most);
        }
        assert!(n_most >= 18, "{n_most}");
        keyframes.truncate(3);
        for frame in 200..400 {
            keyframes.offer(&eye, &at(frame), None, 0);
        }
        assert_eq!(keyframes.frames().len(), n_most);
        assert!(!keyframes.are_dense());
        keyframes.truncate(0);
        for frame in 0..3 {
            keyframes.offer(&eye, &at(frame), None, 0);
        }
        assert!(keyframes.are_dense() && keyframes.frames().len() == 3);
    }
}
