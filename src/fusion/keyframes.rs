//! The frames that were fused, kept small: packed depth with the pose at which each was fused.
//!
//! Memory is bounded: when the packed images outgrow it, every second frame is let go, and from then on every second frame
//! is kept, and so on.

use super::eye::Eye;
use super::packed_depth::PackedDepth;
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
    /// Which stretch of unbroken tracking it belongs to.
    pub stretch: usize,
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
    /// Frames offered since the last that was kept.
    n_skipped: usize,
}

impl Keyframes {
    /// No frames yet, and at most so many bytes of them.
    pub fn new(max_bytes: usize) -> Self {
        Keyframes {
            frames: Vec::new(),
            max_bytes,
            memory_bytes: 0,
            stride: 1,
            n_skipped: 0,
        }
    }

    /// The frames.
    pub fn frames(&self) -> &[Keyframe] {
        &self.frames
    }

    /// Takes the frame in hand in, unless it is one of those between.
    pub fn offer(&mut self, eye: &Eye, time_secs: f64, world_from_camera: &Pose, stretch: usize) {
        self.n_skipped += 1;
        if self.max_bytes == 0 || (self.n_skipped < self.stride && !self.frames.is_empty()) {
            return;
        }
        self.n_skipped = 0;
        let frame = &eye.frame;
        let depth = PackedDepth::pack(&frame.depth, frame.rays.width, eye.range.far_m);
        self.memory_bytes += depth.memory_bytes();
        self.frames.push(Keyframe {
            depth,
            time_secs,
            world_from_camera: *world_from_camera,
            stretch,
        });
        while self.memory_bytes > self.max_bytes && self.frames.len() > 1 {
            self.thin_out();
        }
    }

    /// Lets all but the first `n` frames go.
    pub fn truncate(&mut self, n: usize) {
        self.frames.truncate(n);
        self.memory_bytes = self.frames.iter().map(|f| f.depth.memory_bytes()).sum();
    }

    fn thin_out(&mut self) {
        let mut index = 0;
        self.frames.retain(|_| {
            index += 1;
            index % 2 == 1
        });
        self.stride *= 2;
        self.memory_bytes = self.frames.iter().map(|f| f.depth.memory_bytes()).sum();
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::fusion::{DepthNoise, FusionParams};
    use crate::geometry::camera::tests::distorted_camera;
    use depth_camera::Sensor;

    #[test]
    fn memory_stays_bounded_and_the_frames_evenly_spread() {
        let camera = distorted_camera();
        let noise = DepthNoise::of_sensor(Sensor::Kinect2);
        let mut eye = Eye::new(&camera, noise, FusionParams::default().depth_range());
        assert!(eye.take(&Image::filled(512, 424, 0.7f32)));
        let max_bytes = 20 * 512 * 424;
        let mut keyframes = Keyframes::new(max_bytes);
        for frame in 0..100 {
            keyframes.offer(&eye, frame as f64, &Pose::identity(), 0);
            assert!(keyframes.memory_bytes <= max_bytes);
        }
        let times: Vec<f64> = keyframes.frames().iter().map(|f| f.time_secs).collect();
        assert!(times.len() >= 9 && times[0] == 0.0, "{times:?}");
        let step = times[1];
        assert!(
            times
                .windows(2)
                .all(|pair| (pair[1] - pair[0] - step).abs() < 0.5 * step + 0.1)
        );
    }
}
