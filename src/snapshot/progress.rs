//! What can be asked of a selector, and told to it, while the scan goes on.

use super::candidates::Candidates;
use super::coverage::Coverage;
use super::exposures::saturated_share;
use super::guide::Guidance;
use super::next_view::{Viewpoint, next_viewpoint};
use super::rejection::{RejectReason, Rejections};
use super::{Method, ShadingSnapshot, SnapshotSelection, SnapshotSelector};
use crate::fusion::{ModelMap, PoseCorrection};
use crate::geometry::Pose;
use depth_camera::Image;

impl SnapshotSelector {
    /// Asks for the next image that passes the gates of quality, however little it adds.
    pub fn request(&mut self) {
        self.candidates.is_requested = true;
    }

    /// Takes back what was asked for and has not come.
    pub fn cancel_request(&mut self) {
        self.candidates.is_requested = false;
    }

    /// Whether an image was asked for that has not come yet.
    pub fn is_requested(&self) -> bool {
        self.candidates.is_requested
    }

    /// Kinect I: how many images were shading images until it turned out that the lamp had not lit them.
    pub fn n_revoked(&self) -> usize {
        self.candidates.n_revoked
    }

    /// Kinect I: whether exposures of a pose are being taken.
    pub fn is_exposing(&self) -> bool {
        match &self.method {
            Method::Sequence(sequence) => sequence.is_exposing(),
            Method::Stream(_) => false,
        }
    }

    /// Kinect I: what the operator is to do next.
    pub fn guidance(&self) -> Option<Guidance> {
        match &self.method {
            Method::Sequence(sequence) => Some(sequence.guidance()),
            Method::Stream(_) => None,
        }
    }

    /// The frames that are no shading images so far.
    pub fn rejected(&self) -> &Rejections {
        &self.candidates.rejected
    }

    /// Whether a frame is among the candidates; of a Kinect I it is the first exposure that is.
    pub fn holds(&self, frame_id: u64) -> bool {
        let mut held = self.candidates.pool.snapshots();
        held.any(|snapshot| snapshot.frame_id == frame_id)
    }

    /// The candidates at present, in order of arrival, with why each would not be chosen if the scan ended now.
    pub fn held(&self) -> Vec<(&ShadingSnapshot, Option<RejectReason>)> {
        let Candidates { pool, params, .. } = &self.candidates;
        pool.held(params.max_snapshots, params.min_gain_share)
    }

    /// What would be chosen if the scan ended now, copied.
    pub fn selection(&self) -> SnapshotSelection {
        let Candidates { pool, params, .. } = &self.candidates;
        pool.chosen(params.max_snapshots, params.min_gain_share)
    }

    /// Forgets what was taken later than `after_secs` of the device's clock.
    pub fn forget_after(&mut self, after_secs: f64) {
        self.candidates.pool.forget_after(after_secs);
        match &mut self.method {
            Method::Sequence(sequence) => sequence.interrupt(&self.candidates),
            Method::Stream(stream) => stream.interrupt(),
        }
    }

    /// Moves all poses that it was shown, as the model moved.
    pub fn correct(&mut self, correction: &PoseCorrection) {
        self.candidates.pool.correct(correction);
        match &mut self.method {
            Method::Sequence(sequence) => sequence.correct(correction),
            Method::Stream(stream) => stream.correct(correction),
        }
    }

    /// What the candidates tell of the surface.
    pub fn coverage(&self) -> Coverage {
        self.candidates.pool.coverage()
    }

    /// From where a camera at this pose, which sees the model so, should take the next image.
    pub fn next_viewpoint(&self, model: &ModelMap, world_from_camera: &Pose) -> Option<Viewpoint> {
        let optics = &self.candidates.optics;
        next_viewpoint(&self.coverage(), model, world_from_camera, optics)
    }

    /// Share of an infrared image's pixels at full scale.
    pub fn saturated_share(&self, counts: &Image<u16>) -> f64 {
        saturated_share(counts, self.candidates.optics.full_scale)
    }
}
