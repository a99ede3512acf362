//! What the operator asks for, done between two frames.

use super::{
    FusionStage,
    interim::{Interim, InterimWriter},
};
use crate::{
    capture::EventKind,
    geometry::path_length_m,
    pipeline::{
        command::Command,
        state::State,
        status::Phase,
        stop_depth::{ShadingOutcome, ShadingRequest},
    },
    snapshot::RejectReason,
};
use crossbeam::channel::Receiver;
use depth_camera::{CameraInfo, Frame, Sensor};
use std::path::PathBuf;

/// A shading image that does not come for so long, seconds of the device's clock, is given up; a Kinect I's takes as long
/// as the operator takes.
const REQUEST_SECS: f64 = 3.0;

/// What the operator asked for so far.
pub(super) struct Operator {
    pub(super) is_paused: bool,
    /// When a shading image was asked for: at the first frame after that.
    requested_secs: Option<f64>,
    /// Whether its exposures were taken with depth stopped: what they come to is seen once depth is back.
    is_exposed: bool,
    /// Whether a frame without depth has come since.
    was_without_depth: bool,
    /// Stops depth for a shading image; `None` where the operator covers the projector, or nothing has to be covered.
    shading: Option<ShadingRequest>,
    /// Writes down what there is, to be refined meanwhile.
    pub(super) interim: InterimWriter,
}

impl Operator {
    pub(super) fn new(info: CameraInfo, folder: PathBuf, shading: Option<ShadingRequest>) -> Self {
        Operator {
            is_paused: false,
            requested_secs: None,
            is_exposed: false,
            was_without_depth: false,
            shading,
            interim: InterimWriter::new(info, folder),
        }
    }
}

impl FusionStage {
    /// Does what the operator asks.
    pub(super) fn obey(&mut self, command: Command) {
        tracing::info!(?command, "the operator asks");
        match command {
            Command::Pause => {
                self.operator.is_paused = true;
                self.tell_at(None, EventKind::Paused);
            }
            Command::Resume => {
                self.operator.is_paused = false;
                self.interrupt();
                self.tell_at(None, EventKind::Resumed);
            }
            Command::Snapshot => self.request_snapshot(),
            Command::Undo { secs } => self.undo(secs),
            Command::Refine => self.write_interim(),
            Command::Reset => self.reset(),
            // The device thread ends its stream, and with it this one.
            Command::Finish | Command::Abandon => {}
        }
        self.tell_standing(None);
    }

    /// Does what was asked for before capture ended. Who asks from now on is refused.
    pub(super) fn obey_last(&mut self, commands: &Receiver<Command>) {
        self.status.update(|status| status.phase = Phase::Meshing);
        for command in commands.try_iter() {
            match command {
                Command::Refine => self.refuse(
                    "refine",
                    "capture has ended: the whole scan can be refined".to_owned(),
                ),
                _ => self.obey(command),
            }
        }
    }

    fn refuse(&self, command: &'static str, reason: String) {
        tracing::warn!(command, reason, "refused");
        self.tell_at(None, EventKind::Refused { command, reason });
    }

    fn request_snapshot(&mut self) {
        self.operator.requested_secs = None;
        self.operator.is_exposed = false;
        self.operator.was_without_depth = false;
        if let Some(selector) = &mut self.selector {
            selector.request();
        }
        if let Some(shading) = &self.operator.shading {
            shading.ask();
        }
    }

    /// Hears how stopping depth for a shading image ended, and tells of one that could not be had.
    fn hear_of_shading(&mut self) {
        let outcome = self
            .operator
            .shading
            .as_ref()
            .and_then(ShadingRequest::take_outcome);
        match outcome {
            Some(ShadingOutcome::Refused(refusal)) => {
                if let Some(selector) = &mut self.selector {
                    selector.cancel_request();
                }
                self.refuse("snapshot", refusal.to_string());
            }
            Some(ShadingOutcome::Taken { .. }) => self.operator.is_exposed = true,
            None => {}
        }
    }

    /// Gives a shading image up that does not come, or whose exposures with depth stopped came to nothing, and tells what was wrong with
    /// the last frame.
    pub(super) fn give_up_request(&mut self, frame: &Frame) {
        self.hear_of_shading();
        let Some(selector) = self.selector.as_mut().filter(|s| s.is_requested()) else {
            return;
        };
        let operator = &mut self.operator;
        let now = frame.device_time_secs;
        let since = *operator.requested_secs.get_or_insert(now);
        let is_late = now - since >= REQUEST_SECS && operator.interim.sensor() != Sensor::Kinect1;
        operator.was_without_depth |= frame.depth.is_none();
        let is_over = operator.is_exposed && operator.was_without_depth;
        let came_to_nothing = is_over && frame.depth.is_some() && !selector.is_exposing();
        if !is_late && !came_to_nothing {
            return;
        }
        selector.cancel_request();
        let newest = selector.rejected().newest().iter().rev();
        // Frames that show the projector again tell nothing of those before.
        let last = newest.map(|rejection| rejection.reason).find(|reason| {
            !matches!(
                reason,
                RejectReason::Speckle { .. } | RejectReason::Uncovered { .. }
            )
        });
        let reason = last.map_or_else(
            || "no infrared image came".to_owned(),
            |last| format!("{last}. {}", last.advice()),
        );
        self.refuse("snapshot", reason);
    }

    fn undo(&mut self, secs: f64) {
        let Some((last_secs, _)) = self.trajectory.last() else {
            return self.refuse("undo", "nothing has been fused yet".to_owned());
        };
        let after_secs = last_secs - secs;
        match self.forget_after(after_secs) {
            Some(n_frames) => self.tell_at(None, EventKind::Undone { n_frames }),
            None => self.refuse(
                "undo",
                "the frames before are not kept, so that they cannot be fused again".to_owned(),
            ),
        }
    }

    fn reset(&mut self) {
        if self.forget_after(f64::NEG_INFINITY).is_some() {
            self.of_frames = State::Warming;
            self.tell_at(None, EventKind::Reset);
        }
    }

    /// Forgets all that is later than a time of the device's clock; returns how many frames that were, `None` if it cannot
    /// be done.
    fn forget_after(&mut self, after_secs: f64) -> Option<usize> {
        self.loops.give_up();
        let (fusion, pool, status) = (&mut self.fusion, &self.pool, &self.status);
        let tell = |improvement| status.update(|status| status.improvement = Some(improvement));
        let is_taken_back = pool.install(|| fusion.take_back(after_secs, &tell));
        status.update(|status| status.improvement = None);
        if !is_taken_back {
            return None;
        }
        self.conditions.interrupt();
        if let Some(selector) = &mut self.selector {
            selector.forget_after(after_secs);
        }
        self.showing.begin_anew();
        let n_left = self
            .trajectory
            .partition_point(|(time_secs, _)| *time_secs <= after_secs);
        let n_frames = self.trajectory.len() - n_left;
        self.trajectory.truncate(n_left);
        self.summary.n_taken_back += n_frames as u64;
        self.status.update(|status| status.n_in_model = n_left);
        self.measure_path();
        Some(n_frames)
    }

    /// Measures the path of the camera as it is known now.
    pub(super) fn measure_path(&mut self) {
        self.summary.path_length_m = path_length_m(self.trajectory.iter().map(|(_, pose)| pose));
    }

    fn write_interim(&mut self) {
        let snapshots = self.selector.as_ref().map(|selector| selector.selection());
        let snapshots = snapshots.map_or_else(Vec::new, |selection| selection.accepted);
        if snapshots.is_empty() {
            let reason = "there are no shading images yet".to_owned();
            return self.refuse("refine", reason);
        }
        let (fusion, pool) = (&self.fusion, &self.pool);
        let interim = Interim {
            base: pool.install(|| fusion.mesh()),
            trajectory: self.trajectory.clone(),
            snapshots,
            frame_id: self.last_frame_id,
        };
        let slot = self.showing.interim_slot();
        let begun = self.operator.interim.begin(interim, &self.tracked, slot);
        if let Err(reason) = begun {
            self.refuse("refine", reason);
        }
    }
}
