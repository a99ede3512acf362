//! The images under the sensor's light in a stream of frames, given where the camera was.

use crate::fusion::TrackingOutcome;
use crate::geometry::Motion;
use crate::snapshot::{
    HeldPose, RejectReason, Rejection, ShadingSnapshot, SnapshotParams, SnapshotSelection,
    SnapshotSelector, TrackedFrame,
};
use depth_camera::{CameraInfo, Sensor};

/// Images of one scan at most; a scan with more keeps every second, every fourth, …
const MAX_IMAGES: usize = 32;

/// How far a camera that was held may seem to have moved: a plane that is fitted to a single frame of a far wall is not told better.
const STILL: Motion = Motion {
    rotation_rad: 0.01,
    translation_m: 0.01,
};

/// Takes the images under the light.
pub(super) enum LitImages {
    /// Kinect I: those under the lamp, at poses that the camera held.
    Lamp(Box<SnapshotSelector>),
    /// Kinect II: all, its emitter is always on.
    Emitter(Thinned),
}

impl LitImages {
    /// Of one camera; `None` if it gives no IR or has no light.
    pub(super) fn new(info: &CameraInfo, held_pose: HeldPose) -> Option<Self> {
        let params = SnapshotParams {
            max_snapshots: 2 * MAX_IMAGES,
            held_pose,
            max_still_translation_m: STILL.translation_m,
            max_still_rotation_rad: STILL.rotation_rad,
            ..SnapshotParams::default()
        };
        let selector = SnapshotSelector::new(info, params)?;
        Some(match info.sensor {
            Sensor::Kinect1 => LitImages::Lamp(Box::new(selector)),
            Sensor::Kinect2 => LitImages::Emitter(Thinned::default()),
        })
    }

    pub(super) fn observe(&mut self, tracked: &TrackedFrame) {
        match self {
            LitImages::Lamp(selector) => selector.observe(tracked),
            LitImages::Emitter(images) => images.observe(tracked),
        }
    }

    pub(super) fn finish(self) -> SnapshotSelection {
        match self {
            LitImages::Lamp(selector) => selector.finish(),
            LitImages::Emitter(Thinned { kept, rejected, .. }) => SnapshotSelection {
                accepted: kept,
                rejected,
            },
        }
    }
}

/// Every so many of the tracked frames with IR.
#[derive(Default)]
pub(super) struct Thinned {
    kept: Vec<ShadingSnapshot>,
    rejected: Vec<Rejection>,
    /// Of 2 to this power frames one is kept.
    n_halvings: u32,
    n_seen: usize,
}

impl Thinned {
    fn observe(&mut self, tracked: &TrackedFrame) {
        let frame = tracked.frame;
        if frame.ir.is_none() {
            return;
        }
        let TrackingOutcome::Tracked {
            world_from_camera, ..
        } = *tracked.outcome
        else {
            self.rejected.push(Rejection {
                frame_id: frame.frame_id,
                reason: RejectReason::NotTracked,
            });
            return;
        };
        let is_kept = self.n_seen.is_multiple_of(1 << self.n_halvings);
        self.n_seen += 1;
        if !is_kept {
            return;
        }
        self.kept
            .extend(ShadingSnapshot::of_frame(frame, world_from_camera));
        if self.kept.len() > MAX_IMAGES {
            let mut index = 0;
            self.kept.retain(|_| {
                index += 1;
                index % 2 == 1
            });
            self.n_halvings += 1;
        }
    }
}
