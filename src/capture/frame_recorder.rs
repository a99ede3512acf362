//! Frames on their way to the disk, in either format.

use super::{
    CaptureParams, DeliveredFrame, Unrecorded,
    infrared_rate::{InfraredGate, InfraredRate},
};
use crate::geometry::Pose;
use depth_camera::CameraInfo;
use mcap_session::{Dropped, RecordingError, RecordingParams, SegmentWriter, free_bytes};
use replay::{SessionWriter, WriteError, write_whole_file};
use serde::{Deserialize, Serialize};
use std::{
    io::Write,
    path::{Path, PathBuf},
    time::{Duration, Instant},
};

/// How long the room on a disk is taken to be what it was.
const DISK_ASKED_EVERY: Duration = Duration::from_millis(500);

/// What frames are recorded as.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Deserialize, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum RecordFormat {
    /// MCAP segments of ROS 2 messages in `recording`, which keep up with any device and survive a process that is killed.
    #[default]
    Mcap,
    /// PNG images and lists in `session`, as benchmarks have them; too slow for a live device.
    Folder,
}

impl RecordFormat {
    /// The recording's folder within the output folder.
    pub fn folder_name(self) -> &'static str {
        match self {
            RecordFormat::Mcap => "recording",
            RecordFormat::Folder => "session",
        }
    }
}

/// How a recording stands.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct RecordingStanding {
    /// Whether frames are being recorded now.
    pub active: bool,
    /// Bytes written; 0 in a folder of images, where nobody counts them.
    pub bytes: u64,
    /// Frames recorded; of a recording that ended by a failure to write, those that are left.
    pub recorded: u64,
    /// Room on the disk; `None` where it cannot be asked.
    pub disk_free_bytes: Option<u64>,
    /// Below this room recording stops.
    pub disk_floor_bytes: u64,
    /// Why recording stopped before the scan did.
    pub reason: Option<String>,
}

/// Why a recording ended before the scan did.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) enum Stopped {
    /// The disk is about to be full; what was recorded is in order.
    DiskFloor(String),
    /// Something could not be written.
    Failed(Unrecorded),
}

impl Stopped {
    /// In a sentence for the operator.
    pub(super) fn reason(&self) -> &str {
        match self {
            Stopped::DiskFloor(reason) => reason,
            Stopped::Failed(failure) => &failure.what,
        }
    }
}

/// A recording of frames.
pub(super) struct FrameRecorder {
    folder: PathBuf,
    /// Until the recording ends.
    writer: Option<FrameWriter>,
    gate: InfraredGate,
    pub(super) standing: RecordingStanding,
    /// When the disk was asked for its room last.
    disk_asked: Option<Instant>,
}

enum FrameWriter {
    Mcap(Box<SegmentWriter>),
    Folder(Box<SessionWriter>),
}

impl FrameRecorder {
    /// Begins a recording in its own folder beneath `folder`; a frame with no more valid depth than `max_covered_depth_share` is one of
    /// a covered projector.
    pub(super) fn create(
        folder: &Path,
        info: &CameraInfo,
        params: &CaptureParams,
        max_covered_depth_share: f64,
    ) -> Result<Self, RecordingError> {
        let folder = folder.join(params.record_format.folder_name());
        let depth_units_per_metre = params.record_depth_units_per_metre;
        let (writer, rate) = match params.record_format {
            RecordFormat::Mcap => {
                let recording = RecordingParams {
                    depth_units_per_metre,
                    min_free_bytes: params.min_free_bytes(),
                    ..RecordingParams::default()
                };
                let writer = SegmentWriter::create(&folder, info, recording)?;
                (FrameWriter::Mcap(Box::new(writer)), params.record_ir)
            }
            RecordFormat::Folder => {
                let writer = SessionWriter::create(&folder, info, depth_units_per_metre)?;
                // Lists have their order: an image that was left out cannot be put in later.
                (FrameWriter::Folder(Box::new(writer)), InfraredRate::All)
            }
        };
        let mut recorder = FrameRecorder {
            folder,
            writer: Some(writer),
            gate: InfraredGate::new(rate, max_covered_depth_share),
            standing: RecordingStanding {
                active: true,
                disk_floor_bytes: params.min_free_bytes(),
                ..RecordingStanding::default()
            },
            disk_asked: None,
        };
        recorder.ask_disk();
        Ok(recorder)
    }

    /// The recording's folder.
    pub(super) fn folder(&self) -> &Path {
        &self.folder
    }

    /// How the recording stands.
    pub(super) fn standing(&self) -> &RecordingStanding {
        &self.standing
    }

    /// Puts a file of text beside the frames.
    pub(super) fn write_text(&self, name: &str, text: &str) -> Result<(), WriteError> {
        write_whole_file(&self.folder.join(name), |out| {
            out.write_all(text.as_bytes())
        })
    }

    /// Records a frame; why the recording ended, if it did now.
    pub(super) fn frame(&mut self, delivered: &DeliveredFrame) -> Option<Stopped> {
        self.ask_disk();
        let (frame, ir) = (&delivered.frame, delivered.infrared());
        let written = match &mut self.writer {
            None => return None,
            Some(FrameWriter::Folder(writer)) => {
                let written = writer.write_with_infrared(frame, ir);
                self.standing.recorded += u64::from(written.is_ok());
                written.map_err(RecordingError::from)
            }
            Some(FrameWriter::Mcap(writer)) => match self.gate.admits(delivered) {
                true => writer.write_with_infrared(frame, ir),
                false => writer.write_with_infrared(frame, None),
            },
        };
        self.after(written).or_else(|| self.tick())
    }

    /// A frame is a candidate for a shading image: the infrared around it is recorded.
    pub(super) fn candidate(&mut self, frame_id: u64) -> Option<Stopped> {
        let frames = self.gate.candidate(frame_id);
        let Some(FrameWriter::Mcap(writer)) = &mut self.writer else {
            return None;
        };
        let written = frames
            .iter()
            .try_for_each(|frame| writer.write_infrared(frame));
        self.after(written)
    }

    /// Records a pose, world from camera.
    pub(super) fn pose(&mut self, device_time_secs: f64, pose: &Pose) -> Option<Stopped> {
        self.ask_disk();
        let Some(FrameWriter::Mcap(writer)) = &mut self.writer else {
            return None;
        };
        let position_m = pose.translation.vector.into();
        let orientation = pose.rotation.coords.into();
        let written = writer.pose(device_time_secs, position_m, orientation);
        self.after(written)
    }

    /// Records what happened, one JSON object.
    pub(super) fn event(&mut self, device_time_secs: Option<f64>, json: &str) -> Option<Stopped> {
        let Some(FrameWriter::Mcap(writer)) = &mut self.writer else {
            return None;
        };
        let written = writer.event(device_time_secs, json);
        self.after(written)
    }

    /// Takes note of frames and infrared images that the recorder was too busy for.
    pub(super) fn note_dropped(&mut self, frames: u64, infrared: u64) {
        if let Some(FrameWriter::Mcap(writer)) = &mut self.writer {
            writer.note_dropped(Dropped { frames, infrared });
        }
    }

    /// Does what is due though no frame comes.
    pub(super) fn tick(&mut self) -> Option<Stopped> {
        self.ask_disk();
        let is_low = self
            .standing
            .disk_free_bytes
            .is_some_and(|free| free < self.standing.disk_floor_bytes);
        let ticked = match &mut self.writer {
            None => return None,
            Some(FrameWriter::Mcap(writer)) => writer.tick(),
            Some(FrameWriter::Folder(_)) if is_low => Err(RecordingError::DiskFloor {
                folder: self.folder.clone(),
                free_bytes: self.standing.disk_free_bytes.unwrap_or_default(),
                floor_bytes: self.standing.disk_floor_bytes,
            }),
            Some(FrameWriter::Folder(_)) => Ok(()),
        };
        self.after(ticked)
    }

    /// Ends the recording in order.
    pub(super) fn finish(&mut self) -> Option<Stopped> {
        let finished = match self.writer.take()? {
            FrameWriter::Mcap(writer) => writer.finish().map(|counters| counters.bytes),
            FrameWriter::Folder(writer) => writer.finish().map(|_| 0).map_err(RecordingError::from),
        };
        self.standing.active = false;
        match finished {
            Ok(bytes) => {
                self.standing.bytes = bytes;
                None
            }
            Err(error) => {
                let what = format!("the recording is not safe on the disk: {error}");
                Some(Stopped::Failed(Unrecorded::by(&error, what)))
            }
        }
    }

    /// What a call came to: a frame that does not belong costs itself, anything else ends the recording.
    fn after(&mut self, written: Result<(), RecordingError>) -> Option<Stopped> {
        if let Some(FrameWriter::Mcap(writer)) = &self.writer {
            let counters = writer.progress().counters;
            (self.standing.bytes, self.standing.recorded) = (counters.bytes, counters.frames);
        }
        let stopped = match written {
            Ok(()) => return None,
            Err(error @ RecordingError::Write(WriteError::Frame { .. })) => {
                tracing::warn!(%error, "frame not recorded");
                return None;
            }
            Err(error @ RecordingError::DiskFloor { .. }) => Stopped::DiskFloor(error.to_string()),
            Err(error) => {
                let what = format!("recording stopped: {error}");
                Stopped::Failed(Unrecorded::by(&error, what))
            }
        };
        self.standing.active = false;
        self.standing.reason = Some(stopped.reason().to_owned());
        // A recording in segments has ended itself; of a folder the lists are handed to the disk, as far as that goes.
        if let Some(FrameWriter::Folder(writer)) = self.writer.take() {
            let _ = writer.finish();
        }
        Some(stopped)
    }

    /// Asks for the room on the disk now and then, also when the recording has ended: it may have become enough.
    fn ask_disk(&mut self) {
        let is_known = |asked: Instant| asked.elapsed() < DISK_ASKED_EVERY;
        if self.disk_asked.is_some_and(is_known) {
            return;
        }
        self.disk_asked = Some(Instant::now());
        self.standing.disk_free_bytes = free_bytes(&self.folder).ok();
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use depth_camera::DepthCamera;
    use simulated::SimulatedCamera;
    use std::sync::Arc;

    /// What a scan does at every frame.
    type Act<'a> = &'a dyn Fn(&mut FrameRecorder) -> Option<Stopped>;

    #[test]
    fn the_disk_is_asked_by_what_comes_though_the_recording_has_ended() {
        let folder = tempfile::tempdir().unwrap();
        let mut camera = SimulatedCamera::kinect1_plaque(1, 0);
        let params = CaptureParams {
            min_free_disk_mb: 0,
            ..CaptureParams::default()
        };
        let mut recorder =
            FrameRecorder::create(folder.path(), camera.info(), &params, 0.0).unwrap();
        recorder.writer = None;
        let frame = camera.grab(Duration::ZERO).unwrap().unwrap();
        let delivered = DeliveredFrame::unmoved(Arc::new(frame));
        let acts: [Act; 2] = [&|recorder| recorder.frame(&delivered), &|recorder| {
            recorder.pose(0.0, &Pose::identity())
        }];
        for act in acts {
            recorder.disk_asked = None;
            recorder.standing.disk_free_bytes = None;
            assert_eq!(act(&mut recorder), None);
            assert!(recorder.standing.disk_free_bytes.is_some());
        }
    }
}
