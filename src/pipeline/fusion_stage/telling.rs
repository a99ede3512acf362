//! What the fusion thread tells: the status after every frame, the state, and events.

use super::FusionStage;
use crate::{
    capture::{Event, EventKind, Tracked},
    pipeline::{
        accounts::Place,
        standing::{Circumstances, standing},
        state::State,
        status::SequenceStatus,
    },
    snapshot::SnapshotSelector,
};
use depth_camera::Frame;

impl FusionStage {
    /// Share of a frame's infrared image at full scale, where images are of use.
    pub(super) fn saturated_share(&self, frame: &Frame) -> Option<f64> {
        let selector = self.selector.as_ref()?;
        Some(selector.saturated_share(frame.ir.as_ref()?))
    }

    /// Tells what became of a frame.
    pub(super) fn publish(&mut self, frame: &Frame, place: Place, saturated_share: Option<f64>) {
        let rate = self.pulse.beat();
        self.status.update(|status| {
            status.frames.arrived(place);
            status.n_in_model = self.trajectory.len();
            status.fitness = self.fitness;
            status.ir_saturated_share = saturated_share;
            status.fps = rate.unwrap_or(status.fps);
        });
        self.tell_standing(Some(frame));
    }

    /// Tells what the scan is doing, as an event if that is news.
    pub(super) fn tell_standing(&mut self, frame: Option<&Frame>) {
        let selector = self.selector.as_ref();
        let around = Circumstances {
            is_paused: self.operator.is_paused,
            is_snapshotting: selector.is_some_and(|s| s.is_requested() || s.is_exposing()),
        };
        let counts = selector.map(|s| (s.n_accepted(), s.rejected().count()));
        let guidance = selector.and_then(SnapshotSelector::guidance);
        let mut state = State::default();
        self.status.update(|status| {
            status.is_snapshotting = around.is_snapshotting;
            (status.snapshots.accepted, status.snapshots.rejected) = counts.unwrap_or_default();
            status.kinect1_sequence = guidance.map(SequenceStatus::from);
            status.state = standing(self.of_frames, around, status);
            state = status.state;
        });
        if std::mem::replace(&mut self.told, state) != state {
            let kind = EventKind::State {
                state: state.code(),
                reason: state.reason(),
            };
            self.tell_at(frame, kind);
        }
    }

    /// Nothing comes: what can be seen is kept up to date all the same.
    pub(super) fn look_around(&mut self) {
        if let Some(rate) = self.pulse.rest() {
            self.status.update(|status| status.fps = rate);
        }
        self.tell_standing(None);
        self.show(None);
    }

    pub(super) fn tell(&self, frame: &Frame, kind: EventKind) {
        self.tell_at(Some(frame), kind);
    }

    /// Tells of something at a frame, or at the last one that was fused.
    pub(super) fn tell_at(&self, frame: Option<&Frame>, kind: EventKind) {
        let (frame_id, time_secs) = match frame {
            Some(frame) => (frame.frame_id, Some(frame.device_time_secs)),
            None => (
                self.last_frame_id,
                self.trajectory.last().map(|last| last.0),
            ),
        };
        self.send(Tracked::Event(Event {
            frame_id,
            device_time_secs: time_secs,
            kind,
        }));
    }

    pub(super) fn send(&self, tracked: Tracked) {
        self.tracked.send(tracked);
    }
}
