//! Shading images: which moments of a scan become one, and from where they were seen.
//!
//! A *shading image* is lit by the sensor's light alone and its pose is known. A Kinect II lights every IR frame itself, so
//! the question is which frames are worth refining with: those that see the surface from tilts that the others lack. A
//! Kinect I shows its projector's speckle until the operator holds still, covers the projector and lights the lamp: that
//! sequence is recognised from the images, and its exposures are averaged; images from before the lamp was lit tell what light there is
//! beside it. What a view is worth is its *information*: the
//! tilts of the surface that change its brightness, see `information.rs`.
//!
//! Pure: frames in, a selection out; memory is bounded by [`SnapshotParams::max_snapshots`] but for one line per 20 mm of
//! surface and side that it was lit from. Not handled: a lamp that is moved by hand, IR that is not aligned with depth.

mod kinect1;
mod kinect2;
mod params;
mod rejection;

mod exposures;
mod guide;
mod information;
mod lamp_group;
mod pool;
mod speckle;

mod coverage;
mod next_view;
mod progress;

#[cfg(test)]
mod bench_tests;
#[cfg(test)]
mod scenes;

pub use coverage::Coverage;
pub use exposures::{SATURATION, saturated_share};
pub use guide::Guidance;
pub use next_view::Viewpoint;
pub use params::{HeldPose, SnapshotParams};
pub use rejection::{RejectReason, Rejection, Rejections};
pub use speckle::{Texture, texture};

use crate::fusion::{ModelMap, TrackingOutcome};
use crate::geometry::Pose;
use crate::shading::without_ambient;
use depth_camera::{CameraInfo, Frame, Image, Sensor};
use information::Optics;
use kinect1::ShadingSequence;
use kinect2::EmitterStream;
use std::borrow::Cow;

/// An IR image that refinement can use: lit by the sensor's light alone, the camera still and its pose known.
#[derive(Clone, Debug)]
pub struct ShadingSnapshot {
    /// The (first) frame that it comes from.
    pub frame_id: u64,
    /// When that was, on the device's clock, seconds.
    pub device_time_secs: f64,
    /// How many exposures were averaged.
    pub n_exposures: usize,
    /// IR counts, response not removed.
    pub ir_counts: Image<f32>,
    /// Counts of the same pose without its light, where they were taken: what ambient light makes.
    pub unlit_counts: Option<Image<f32>>,
    /// Depth from the same pose, metres, 0 is none; it tells what hides the object.
    pub depth_m: Image<f32>,
    /// Pose of the camera, from tracking.
    pub world_from_camera: Pose,
}

impl ShadingSnapshot {
    /// IR counts that its light alone would make, through the same response.
    pub fn lit_counts(&self, full_scale: f64, gamma: f64) -> Cow<'_, Image<f32>> {
        match &self.unlit_counts {
            None => Cow::Borrowed(&self.ir_counts),
            Some(unlit) => Cow::Owned(without_ambient(
                &self.ir_counts,
                unlit,
                SATURATION * full_scale,
                gamma,
            )),
        }
    }
}

/// A frame with what tracking made of it.
#[derive(Clone, Copy, Debug)]
pub struct TrackedFrame<'a> {
    /// What the camera delivered.
    pub frame: &'a Frame,
    /// Whether its pose is known.
    pub outcome: &'a TrackingOutcome,
    /// The model as seen after this frame was fused, world frame; its pixels are whole multiples of the frame's.
    pub model: Option<&'a ModelMap>,
}

/// What a scan gave to refine with.
#[derive(Clone, Debug, Default)]
pub struct SnapshotSelection {
    /// The shading images, in order of time.
    pub accepted: Vec<ShadingSnapshot>,
    /// The newest of the IR frames that are not among them, in order of their number: see [`Rejections`].
    pub rejected: Vec<Rejection>,
}

/// What the operator of a Kinect I is to do next for a shading image.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum SequenceStep {
    /// Move to where the next shading image is to be taken.
    #[default]
    Track,
    /// Hold still there.
    HoldStill,
    /// Cover the projector.
    CoverProjector,
    /// Light the lamp.
    LampOn,
    /// Enough exposures: uncover the projector again.
    Uncover,
}

impl SequenceStep {
    /// The step's stable name.
    pub fn code(self) -> &'static str {
        match self {
            SequenceStep::Track => "track",
            SequenceStep::HoldStill => "hold_still",
            SequenceStep::CoverProjector => "cover_projector",
            SequenceStep::LampOn => "lamp_on",
            SequenceStep::Uncover => "uncover",
        }
    }
}

/// Chooses shading images while a scan goes on; the same frames give the same selection.
pub struct SnapshotSelector {
    optics: Optics,
    method: Method,
}

/// How the sensor at hand comes by shading images.
enum Method {
    Sequence(ShadingSequence),
    Stream(EmitterStream),
}

impl SnapshotSelector {
    /// A selector for one camera, `None` if it delivers no IR or has no light; `params` must have been validated.
    pub fn new(info: &CameraInfo, params: SnapshotParams) -> Option<Self> {
        let optics = Optics::new(info)?;
        let method = match info.sensor {
            Sensor::Kinect1 => Method::Sequence(ShadingSequence::new(optics, params)),
            Sensor::Kinect2 => Method::Stream(EmitterStream::new(optics, params)),
        };
        Some(SnapshotSelector { optics, method })
    }

    /// Takes in the next frame of the stream.
    pub fn observe(&mut self, tracked: &TrackedFrame) {
        match &mut self.method {
            Method::Sequence(sequence) => sequence.observe(tracked),
            Method::Stream(stream) => stream.observe(tracked),
        }
    }

    /// How many shading images there are so far, at most `max_snapshots`; [`Self::finish`] may keep fewer.
    pub fn n_accepted(&self) -> usize {
        match &self.method {
            Method::Sequence(sequence) => sequence.n_accepted(),
            Method::Stream(stream) => stream.n_accepted(),
        }
    }

    /// The choice among everything seen.
    pub fn finish(self) -> SnapshotSelection {
        match self.method {
            Method::Sequence(sequence) => sequence.finish(),
            Method::Stream(stream) => stream.finish(),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_camera_without_ir_or_light_gives_no_shading_images() {
        let info = scenes::camera_info(Sensor::Kinect2);
        assert!(SnapshotSelector::new(&info, SnapshotParams::default()).is_some());
        let dark = CameraInfo {
            light: None,
            ..info.clone()
        };
        assert!(SnapshotSelector::new(&dark, SnapshotParams::default()).is_none());
        let blind = CameraInfo {
            ir_full_scale: None,
            ..info
        };
        assert!(SnapshotSelector::new(&blind, SnapshotParams::default()).is_none());
    }
}
