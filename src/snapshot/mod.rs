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
mod pause;
mod rejection;

mod candidates;
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
pub use guide::Guidance;
pub use information::attention;
pub use next_view::Viewpoint;
pub use params::{HeldPose, SnapshotParams};
pub use pause::place_on_their_ways;
pub use rejection::{RejectReason, Rejection, Rejections};
pub use speckle::{Texture, texture};

use crate::fusion::{ModelMap, PoseCorrection, TrackingOutcome};
use crate::geometry::Pose;
use crate::shading::{SATURATION, without_ambient};
use candidates::Candidates;
use depth_camera::{CameraInfo, Frame, Image, Sensor};
use information::{ATTENTION_REACH_RAD, Optics};
use kinect1::ShadingSequence;
use kinect2::EmitterStream;
use std::borrow::Cow;
use std::cmp::Reverse;
use std::collections::BTreeMap;

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
    /// How the camera moved over the pause in which it was taken, where it did not rest, camera frame: from the frame before to the frame
    /// after. The image was taken somewhere on that way.
    pub moved: Option<Pose>,
}

impl ShadingSnapshot {
    /// A frame whose IR image the sensor lights itself, seen from a pose; `None` without depth or IR.
    pub fn of_frame(frame: &Frame, world_from_camera: Pose) -> Option<Self> {
        Some(ShadingSnapshot {
            frame_id: frame.frame_id,
            device_time_secs: frame.device_time_secs,
            n_exposures: 1,
            ir_counts: frame.ir.as_ref()?.map(|&counts| f32::from(counts)),
            unlit_counts: None,
            depth_m: frame.depth.clone()?,
            world_from_camera,
            moved: None,
        })
    }

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
    /// The model as seen after this frame was fused, world frame, where and as far as [`SnapshotSelector::looks_at`] says; its pixels are
    /// whole multiples of the frame's.
    pub model: Option<&'a ModelMap>,
}

/// What of the model is looked at for a frame.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum PartOfModel {
    /// It is not needed.
    Nothing,
    /// What lies so near to the optical axis, radians.
    NearAxis(f64),
    /// All that is in view.
    All,
}

/// Where the camera was, and when.
#[derive(Clone, Copy)]
struct Placed {
    world_from_camera: Pose,
    device_time_secs: f64,
}

impl Placed {
    /// Of a frame; `None` if it was not tracked.
    fn of(tracked: &TrackedFrame) -> Option<Self> {
        match *tracked.outcome {
            TrackingOutcome::Tracked {
                world_from_camera, ..
            } => Some(Placed {
                world_from_camera,
                device_time_secs: tracked.frame.device_time_secs,
            }),
            TrackingOutcome::Lost(_) | TrackingOutcome::NoDepth => None,
        }
    }

    fn correct(&mut self, correction: &PoseCorrection) {
        self.world_from_camera = correction.apply(self.device_time_secs, &self.world_from_camera);
    }
}

/// What a scan gave to refine with.
#[derive(Clone, Debug, Default)]
pub struct SnapshotSelection {
    /// The shading images, in order of time.
    pub accepted: Vec<ShadingSnapshot>,
    /// The newest of the IR frames that are not among them, in order of their number: see [`Rejections`].
    pub rejected: Vec<Rejection>,
}

impl SnapshotSelection {
    /// Why frames were rejected, each kind of reason once with how often, the most frequent first; its first frame stands for all.
    pub fn reasons(&self) -> Vec<String> {
        let mut kinds: BTreeMap<&'static str, (usize, RejectReason)> = BTreeMap::new();
        for Rejection { reason, .. } in &self.rejected {
            kinds.entry(reason.code()).or_insert((0, *reason)).0 += 1;
        }
        let mut kinds: Vec<_> = kinds.into_values().collect();
        kinds.sort_by_key(|(n, _)| Reverse(*n));
        kinds
            .iter()
            .map(|(n, reason)| format!("{n} times: {reason}"))
            .collect()
    }
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
    candidates: Candidates,
    method: Method,
}

/// How the sensor at hand comes by shading images.
enum Method {
    Sequence(Box<ShadingSequence>),
    Stream(EmitterStream),
}

impl SnapshotSelector {
    /// A selector for one camera, `None` if it delivers no IR or has no light; `params` must have been validated.
    pub fn new(info: &CameraInfo, params: SnapshotParams) -> Option<Self> {
        let optics = Optics::new(info)?;
        let (method, min_gain_share) = match info.sensor {
            // A pose that the operator took the trouble to hold is kept, however little it adds.
            Sensor::Kinect1 => (Method::Sequence(Box::default()), 0.0),
            Sensor::Kinect2 => (
                Method::Stream(EmitterStream::default()),
                params.min_gain_share,
            ),
        };
        let params = SnapshotParams {
            min_gain_share,
            ..params
        };
        Some(SnapshotSelector {
            candidates: Candidates::new(optics, params),
            method,
        })
    }

    /// Takes in the next frame of the stream.
    pub fn observe(&mut self, tracked: &TrackedFrame) {
        match &mut self.method {
            Method::Sequence(sequence) => sequence.observe(tracked, &mut self.candidates),
            Method::Stream(stream) => stream.observe(tracked, &mut self.candidates),
        }
    }

    /// What it looks at of the model for the next frame: near the axis at each with infrared where every tracked frame is a candidate, and
    /// at all of it, since their pose is not the model's, at the one after the exposures of a pose where there are such.
    pub fn looks_at(&self, frame: &Frame) -> PartOfModel {
        match &self.method {
            Method::Sequence(sequence) if sequence.is_exposing() => PartOfModel::All,
            Method::Stream(_) if frame.ir.is_some() => PartOfModel::NearAxis(ATTENTION_REACH_RAD),
            Method::Sequence(_) | Method::Stream(_) => PartOfModel::Nothing,
        }
    }

    /// How many shading images there are so far, at most `max_snapshots`; [`Self::finish`] may keep fewer.
    pub fn n_accepted(&self) -> usize {
        let Candidates { pool, params, .. } = &self.candidates;
        pool.len().min(params.max_snapshots)
    }

    /// The choice among everything seen.
    pub fn finish(mut self) -> SnapshotSelection {
        if let Method::Sequence(sequence) = &mut self.method {
            sequence.abandon(RejectReason::Unfinished, &mut self.candidates);
        }
        self.candidates.finish()
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
