//! Shading images: when one is taken, and from where.

mod selector;

pub use selector::{
    RejectReason, Rejection, SnapshotParams, SnapshotSelection, SnapshotSelector, TrackedFrame,
};

use crate::geometry::Pose;
use depth_camera::Image;

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
    /// Depth from the same pose, metres, 0 is none; it tells what hides the object.
    pub depth_m: Image<f32>,
    /// Pose of the camera, from tracking.
    pub world_from_camera: Pose,
}
