//! The recorder: writes frames as a session, and events as lines of JSON, as they come.

use super::{
    CaptureParams, DeliveredFrame, Event, EventKind, Tracked, Unrecorded,
    event_file::EventFile,
    frame_recorder::{FrameRecorder, RecordingStanding, Stopped},
};
use crate::geometry::Pose;
use depth_camera::CameraInfo;
use mcap_session::RecordingError;
use replay::WriteError;
use std::path::{Path, PathBuf};

/// What the recorder wrote.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct RecorderSummary {
    /// Files and folders written.
    pub outputs: Vec<PathBuf>,
    /// Frames recorded.
    pub n_recorded: usize,
    /// Poses of the fused frames with their times, seconds, as they were told of at the end.
    pub trajectory: Vec<(f64, Pose)>,
    /// Data that could not be written.
    pub failures: Vec<Unrecorded>,
    /// What the operator should know although all that was recorded is in order, in sentences.
    pub warnings: Vec<String>,
}

/// Writes what it is given into one folder. The first failure to write a frame ends the recording of frames, and is told once;
/// events wait until they can be written.
pub struct Recorder {
    folder: PathBuf,
    frames: Option<FrameRecorder>,
    events: EventFile,
    /// The newest frame, which what happens to the recording itself is told of.
    newest: Option<(u64, f64)>,
    /// What happened to the recording itself and was not fetched yet.
    own_events: Vec<Event>,
    has_failed: bool,
    summary: RecorderSummary,
}

impl Recorder {
    /// A recorder of events into `events.jsonl` of `folder`, which must exist.
    ///
    /// # Errors
    /// If the file cannot be created, naming it.
    pub fn new(folder: &Path) -> Result<Self, WriteError> {
        let events = EventFile::create(folder)?;
        Ok(Recorder {
            folder: folder.to_owned(),
            frames: None,
            summary: RecorderSummary {
                outputs: vec![events.path().to_owned()],
                ..RecorderSummary::default()
            },
            events,
            newest: None,
            own_events: Vec::new(),
            has_failed: false,
        })
    }

    /// The same recorder, which also writes frames of a camera into a folder of its own beside the events. Of a frame with no more valid
    /// depth than `max_covered_depth_share` the projector is covered: its infrared is written at any rate.
    ///
    /// # Errors
    /// If the recording cannot be begun.
    pub fn with_frames(
        mut self,
        info: &CameraInfo,
        params: &CaptureParams,
        max_covered_depth_share: f64,
    ) -> Result<Self, RecordingError> {
        let frames = FrameRecorder::create(&self.folder, info, params, max_covered_depth_share)?;
        self.summary.outputs.push(frames.folder().to_owned());
        self.frames = Some(frames);
        Ok(self)
    }

    /// The same recorder, with a file of text beside the frames, if it records frames.
    ///
    /// # Errors
    /// If the file cannot be written.
    pub fn with_text(self, name: &str, text: &str) -> Result<Self, WriteError> {
        if let Some(frames) = &self.frames {
            frames.write_text(name, text)?;
        }
        Ok(self)
    }

    /// Records a frame.
    pub fn frame(&mut self, delivered: &DeliveredFrame) {
        let frame = &delivered.frame;
        self.newest = Some((frame.frame_id, frame.device_time_secs));
        self.with_recording(|frames| frames.frame(delivered));
        self.events.write_waiting();
    }

    /// Records what tracking tells.
    pub fn tracked(&mut self, tracked: Tracked) {
        match tracked {
            Tracked::Pose(time_secs, pose) => {
                self.with_recording(|frames| frames.pose(time_secs, &pose));
            }
            Tracked::Trajectory(trajectory) => self.summary.trajectory = trajectory,
            Tracked::Candidate(frame_id) => {
                self.with_recording(|frames| frames.candidate(frame_id));
            }
            Tracked::Event(event) => self.event(&event),
        }
        self.events.write_waiting();
    }

    /// Does what is due though nothing comes, at least every tenth of a second.
    pub fn tick(&mut self) {
        self.with_recording(FrameRecorder::tick);
        self.events.write_waiting();
    }

    /// Takes note of frames and infrared images that the recorder was too busy for.
    pub fn note_dropped(&mut self, frames: u64, infrared: u64) {
        if let Some(recording) = &mut self.frames {
            recording.note_dropped(frames, infrared);
        }
    }

    /// How the recording of frames stands, if there is one.
    pub fn standing(&self) -> Option<&RecordingStanding> {
        self.frames.as_ref().map(FrameRecorder::standing)
    }

    /// What happened to the recording itself since this was asked last; it is recorded already.
    pub fn take_events(&mut self) -> Vec<Event> {
        std::mem::take(&mut self.own_events)
    }

    /// Poses of the fused frames with their times, seconds, once they were told of.
    pub fn trajectory(&self) -> &[(f64, Pose)] {
        &self.summary.trajectory
    }

    /// Why events wait to be written; `None` if none does.
    pub fn events_refusal(&self) -> Option<&str> {
        self.events.refusal()
    }

    /// Whether the recording of frames ended by a failure, not by the room that is to stay free. Events that wait for the disk are
    /// [`Recorder::events_refusal`]; those that never found room, the summary's failures.
    pub fn has_failed(&self) -> bool {
        self.has_failed
    }

    /// Ends the recording of frames in order.
    pub fn end_frames(&mut self) {
        self.with_recording(FrameRecorder::finish);
    }

    /// Ends the recording.
    pub fn finish(mut self) -> RecorderSummary {
        self.end_frames();
        let recorded = self.standing().map_or(0, |standing| standing.recorded);
        self.summary.n_recorded = recorded as usize;
        if let Some(missing) = self.events.end() {
            self.tell(missing);
        }
        self.summary
    }

    /// Does something with the recording of frames, and tells of it if that ends it.
    fn with_recording(&mut self, act: impl FnOnce(&mut FrameRecorder) -> Option<Stopped>) {
        let Some(stopped) = self.frames.as_mut().and_then(act) else {
            return;
        };
        let reason = stopped.reason().to_owned();
        match stopped {
            Stopped::DiskFloor(reason) => {
                tracing::warn!("{reason}");
                self.summary.warnings.push(reason);
            }
            Stopped::Failed(failure) => {
                self.has_failed = true;
                self.tell(failure);
            }
        }
        let event = Event {
            frame_id: self.newest.map_or(0, |(frame_id, _)| frame_id),
            device_time_secs: self.newest.map(|(_, secs)| secs),
            kind: EventKind::RecordingStopped { reason },
        };
        self.event(&event);
        self.own_events.push(event);
    }

    fn event(&mut self, event: &Event) {
        let line = match serde_json::to_string(event) {
            Ok(line) => line,
            Err(error) => {
                let what = format!("an event is not written: {error}");
                return self.tell(Unrecorded { what, cause: None });
            }
        };
        self.with_event_in_recording(event, &line);
        self.events.push(&line);
    }

    fn with_event_in_recording(&mut self, event: &Event, line: &str) {
        // A recording that has ended takes no more, so that telling of its end ends here.
        self.with_recording(|frames| frames.event(event.device_time_secs, line));
    }

    fn tell(&mut self, failure: Unrecorded) {
        tracing::error!("{}", failure.what);
        self.summary.failures.push(failure);
    }
}

#[cfg(test)]
mod tests;
