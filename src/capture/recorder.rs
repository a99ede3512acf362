//! The recorder: writes frames as a session, and events as lines of JSON, as they come.

use super::{Event, Tracked};
use crate::geometry::Pose;
use depth_camera::{CameraInfo, Frame};
use replay::{SessionWriter, WriteError};
use std::{
    fs::{File, OpenOptions},
    io::{self, Write},
    path::{Path, PathBuf},
};

/// What the recorder wrote.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct RecorderSummary {
    /// Files and folders written.
    pub outputs: Vec<PathBuf>,
    /// Frames recorded.
    pub n_recorded: usize,
    /// The camera's poses with their times, seconds, in the order in which they came.
    pub trajectory: Vec<(f64, Pose)>,
    /// Data that could not be written, in sentences for the operator.
    pub failures: Vec<String>,
}

/// Writes what it is given into one folder, and collects the trajectory. The first failure to write ends that recording, and is told once.
#[derive(Debug)]
pub struct Recorder {
    session: Option<SessionWriter>,
    session_path: PathBuf,
    events: Option<File>,
    events_path: PathBuf,
    summary: RecorderSummary,
}

impl Recorder {
    /// A recorder of events into `events.jsonl` of `folder`, which must exist.
    ///
    /// # Errors
    /// If the file cannot be created, naming it.
    pub fn new(folder: &Path) -> Result<Self, WriteError> {
        let events_path = folder.join("events.jsonl");
        let events = OpenOptions::new()
            .append(true)
            .create_new(true)
            .open(&events_path)
            .map_err(|source| WriteError::Io {
                path: events_path.clone(),
                source,
            })?;
        Ok(Recorder {
            session: None,
            session_path: folder.join("session"),
            summary: RecorderSummary {
                outputs: vec![events_path.clone()],
                ..RecorderSummary::default()
            },
            events: Some(events),
            events_path,
        })
    }

    /// The same recorder, which also writes frames of a camera into `session` of its folder.
    ///
    /// # Errors
    /// If the recording cannot be begun.
    pub fn with_frames(
        mut self,
        info: &CameraInfo,
        depth_units_per_metre: f64,
    ) -> Result<Self, WriteError> {
        let session = SessionWriter::create(&self.session_path, info, depth_units_per_metre)?;
        self.session = Some(session);
        self.summary.outputs.push(self.session_path.clone());
        Ok(self)
    }

    /// The same recorder, with a file of text beside the frames, if it records frames.
    ///
    /// # Errors
    /// If the file cannot be written.
    pub fn with_text(mut self, name: &str, text: &str) -> Result<Self, WriteError> {
        if let Some(session) = &mut self.session {
            session.write_text(name, text)?;
        }
        Ok(self)
    }

    /// Records a frame.
    pub fn frame(&mut self, frame: &Frame) {
        let Some(session) = &mut self.session else {
            return;
        };
        match session.write(frame) {
            Ok(()) => self.summary.n_recorded += 1,
            Err(error @ WriteError::Frame { .. }) => {
                tracing::warn!(%error, "frame not recorded");
            }
            Err(error) => {
                self.fail(format!("recording stopped: {error}"));
                self.finish_session();
            }
        }
    }

    /// Records what tracking tells.
    pub fn tracked(&mut self, tracked: Tracked) {
        match tracked {
            Tracked::Pose(time_secs, pose) => self.summary.trajectory.push((time_secs, pose)),
            Tracked::Corrected(trajectory) => self.summary.trajectory = trajectory,
            Tracked::Event(event) => self.event(&event),
        }
    }

    fn event(&mut self, event: &Event) {
        let Some(file) = &mut self.events else {
            return;
        };
        if let Err(error) = write_line(file, event) {
            self.events = None;
            let path = self.events_path.display();
            self.fail(format!("events are no longer written: {path}: {error}"));
        }
    }

    /// Whether something could not be written.
    pub fn has_failed(&self) -> bool {
        !self.summary.failures.is_empty()
    }

    /// Ends the recording.
    pub fn finish(mut self) -> RecorderSummary {
        self.finish_session();
        self.summary
    }

    fn finish_session(&mut self) {
        let finished = self.session.take().map(SessionWriter::finish).transpose();
        if let Err(error) = finished {
            self.fail(format!("the recording is not safe on the disk: {error}"));
        }
    }

    fn fail(&mut self, what: String) {
        tracing::error!("{what}");
        self.summary.failures.push(what);
    }
}

/// Appends one whole line by one call, so that a process that is killed leaves no half of one.
fn write_line(file: &mut File, event: &Event) -> io::Result<()> {
    let mut line = serde_json::to_vec(event)?;
    line.push(b'\n');
    file.write_all(&line)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::capture::EventKind;
    use depth_camera::DepthCamera;
    use simulated::{Infrared, Scene, Setup, SimulatedCamera, Trajectory};
    use std::{fs, time::Duration};

    fn small_camera() -> SimulatedCamera {
        SimulatedCamera::new(Setup {
            scene: Scene::plaque(),
            trajectory: Trajectory::hand_held(nalgebra::Point3::origin(), 2),
            sensor: depth_camera::Sensor::Kinect2,
            infrared: Infrared::of_sensor(depth_camera::Sensor::Kinect2),
            n_moving_frames: 2,
            shading_frames: Vec::new(),
            reduction: 4,
            seed: 1,
        })
        .unwrap()
    }

    #[test]
    fn frames_and_events_are_read_back() {
        let folder = tempfile::tempdir().unwrap();
        let mut camera = small_camera();
        let mut recorder = Recorder::new(folder.path())
            .unwrap()
            .with_frames(camera.info(), 5000.0)
            .and_then(|recorder| recorder.with_text("note.txt", "by lamplight"))
            .unwrap();
        let event = Event {
            frame_id: 1,
            device_time_secs: Some(100.5),
            kind: EventKind::Lost {
                reason: "jump".into(),
                code: "too_fast",
            },
        };
        while let Some(frame) = camera.grab(Duration::ZERO).unwrap() {
            recorder.frame(&frame);
        }
        recorder.tracked(Tracked::Event(event));
        let summary = recorder.finish();
        assert_eq!((summary.n_recorded, summary.failures.len()), (2, 0));
        let replayed = replay::ReplayCamera::open(&folder.path().join("session")).unwrap();
        assert_eq!(replayed.info().n_frames, Some(2));
        let note = fs::read_to_string(folder.path().join("session/note.txt")).unwrap();
        assert_eq!(note, "by lamplight");
        let lines = fs::read_to_string(folder.path().join("events.jsonl")).unwrap();
        assert_eq!(
            lines,
            "{\"frame_id\":1,\"device_time_secs\":100.5,\"event\":\"lost\",\"reason\":\"jump\",\"code\":\"too_fast\"}\n"
        );
    }
}
