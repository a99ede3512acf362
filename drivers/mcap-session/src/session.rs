//! `session.json`: what a recording is, how far it came, and how it ended.

use std::{fs, io::Write, path::Path};

use serde::{Deserialize, Serialize};

use crate::{
    error::{RecordingError, io_error},
    segment::SegmentSummary,
    streams::Stream,
};

/// The name of the file in a recording's folder.
pub const FILE_NAME: &str = "session.json";

/// The version of what is described here.
const FORMAT: u32 = 1;

/// Larger than any that is written.
const MAX_BYTES: u64 = 1 << 20;

/// How a recording stands.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum State {
    /// It is being written, or was when its process died.
    Open,
    /// It was ended in order.
    Closed,
    /// It was ended by repair.
    Repaired,
}

/// What was recorded.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(default)]
pub struct Counters {
    /// Frames, with one image or two.
    pub frames: u64,
    /// Depth images.
    pub depth: u64,
    /// IR images.
    pub infrared: u64,
    /// Poses.
    pub poses: u64,
    /// Events.
    pub events: u64,
    /// Bytes of all segments.
    pub bytes: u64,
}

impl Counters {
    /// Counts the messages of a segment by what they carry.
    pub(crate) fn add(&mut self, segment: &SegmentSummary) {
        for (topic, (_, n)) in &segment.topics {
            match Stream::of_topic(topic) {
                Some(Stream::Depth) => self.depth += n,
                Some(Stream::Infrared) => self.infrared += n,
                Some(Stream::Pose) => self.poses += n,
                Some(Stream::Events) => self.events += n,
                _ => {}
            }
        }
    }

    /// Frames of which an image was recorded: not of every frame that was given.
    pub(crate) fn moments(&self) -> u64 {
        self.frames.min(self.depth.saturating_add(self.infrared))
    }

    /// Which messages are other in number than those that were found, if any are.
    pub(crate) fn disagreement(&self, found: &Counters) -> Option<String> {
        let pairs = [
            ("depth images", self.depth, found.depth),
            ("IR images", self.infrared, found.infrared),
            ("poses", self.poses, found.poses),
            ("events", self.events, found.events),
        ];
        let differ = pairs.into_iter().filter(|(_, told, found)| told != found);
        let texts: Vec<String> = differ
            .map(|(what, told, found)| format!("{told} {what} of which {found} were found"))
            .collect();
        (!texts.is_empty()).then(|| format!("the recording has {}", texts.join(", ")))
    }
}

/// What repair found.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(default)]
pub struct RepairNote {
    /// Frames that are whole.
    pub frames_recovered: u64,
    /// Frames that the recorder had been given and that are not in the files; `None` where nothing tells.
    pub frames_lost: Option<u64>,
    /// Bytes cut off behind the last whole record.
    pub bytes_cut: u64,
    /// Bytes of damaged records in between, which readers now pass over.
    pub bytes_passed_over: u64,
}

/// The contents of `session.json`; keys that are not named here are for other readers.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct SessionRecord {
    /// Version of the format, 1.
    pub format: u32,
    /// How the recording stands.
    pub state: State,
    /// Name of the sensor, `kinect1` or `kinect2`.
    pub sensor: String,
    /// The device's serial number.
    pub serial: String,
    /// Stored depth is in steps of 1 / this many metres.
    pub depth_units_per_metre: f64,
    /// When the recording began, milliseconds since 1970.
    pub started_unix_ms: u64,
    /// The version of the program that wrote it.
    pub program: String,
    /// What was recorded; of an open recording, up to its last whole segment.
    pub counters: Counters,
    /// Why it ended before the scan did.
    #[serde(skip_serializing_if = "Option::is_none", default)]
    pub stopped_because: Option<String>,
    /// What repair found, where there was one.
    #[serde(skip_serializing_if = "Option::is_none", default)]
    pub repair: Option<RepairNote>,
}

impl SessionRecord {
    /// A recording that begins.
    pub fn begun(
        info: &depth_camera::CameraInfo,
        depth_units_per_metre: f64,
        started_unix_ms: u64,
    ) -> Self {
        SessionRecord {
            format: FORMAT,
            state: State::Open,
            sensor: info.sensor.name().to_owned(),
            serial: info.serial.clone(),
            depth_units_per_metre,
            started_unix_ms,
            program: concat!("relief ", env!("CARGO_PKG_VERSION")).to_owned(),
            counters: Counters::default(),
            stopped_because: None,
            repair: None,
        }
    }

    /// Reads the record of a recording.
    ///
    /// # Errors
    /// [`RecordingError`] naming the file and what is wrong with it.
    pub fn read(folder: &Path) -> Result<Self, RecordingError> {
        let path = folder.join(FILE_NAME);
        let n_bytes = fs::metadata(&path).map_err(io_error(&path))?.len();
        if n_bytes > MAX_BYTES {
            return Err(RecordingError::invalid(
                &path,
                format!("{n_bytes} bytes, must be at most {MAX_BYTES}"),
            ));
        }
        let text = replay::read_ordinary_text(&path).map_err(io_error(&path))?;
        let record: SessionRecord =
            serde_json::from_str(&text).map_err(|error| RecordingError::invalid(&path, error))?;
        if record.format != FORMAT {
            return Err(RecordingError::invalid(
                &path,
                format!(
                    "format is {}, must be {FORMAT}; a newer program wrote it",
                    record.format
                ),
            ));
        }
        Ok(record)
    }

    /// Writes the record, whole or not at all.
    ///
    /// # Errors
    /// What the system says.
    pub fn write(&self, folder: &Path) -> Result<(), RecordingError> {
        let path = folder.join(FILE_NAME);
        replay::write_whole_file(&path, |out| {
            serde_json::to_writer_pretty(&mut *out, self)?;
            // A name may reach the disk before what it names.
            out.flush()?;
            out.get_ref().sync_all()
        })?;
        Ok(())
    }
}
