//! The frames that were fused, kept small: packed depth with the pose at which each was fused.
//!
//! Memory is bounded: when the packed images outgrow it, every second frame is let go, and from then on every second frame
//! is kept, and so on.

use super::packed_depth::PackedDepth;
use crate::geometry::Pose;
use depth_camera::Image;

/// A frame that was fused.
#[derive(Clone, Debug)]
pub struct Keyframe {
    /// Clipped depth.
    pub depth: PackedDepth,
    /// When it was taken, on the device's clock, seconds.
    pub time_secs: f64,
    /// Where it was fused.
    pub world_from_camera: Pose,
    /// Which stretch of unbroken tracking it belongs to.
    pub stretch: usize,
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

    /// Takes a frame in, whose depth (metres, 0 is none) is at most `far_m`, unless it is one of those between.
    pub fn offer(
        &mut self,
        depth: &Image<f32>,
        far_m: f32,
        time_secs: f64,
        world_from_camera: &Pose,
        stretch: usize,
    ) {
        self.n_skipped += 1;
        if self.max_bytes == 0 || (self.n_skipped < self.stride && !self.frames.is_empty()) {
            return;
        }
        self.n_skipped = 0;
        let depth = PackedDepth::pack(depth, far_m);
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

    #[test]
    fn memory_stays_bounded_and_the_frames_evenly_spread() {
        let depth = Image::filled(100, 10, 0.7f32);
        let mut keyframes = Keyframes::new(20_000);
        for frame in 0..100 {
            keyframes.offer(&depth, 2.0, frame as f64, &Pose::identity(), 0);
            assert!(keyframes.memory_bytes <= 20_000);
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
