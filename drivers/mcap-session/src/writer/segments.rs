//! The segments of a recording: begun, described, ended, one after the other.

use std::{fs::File, io, time::Instant};

use super::{OpenSegment, SegmentWriter, header, unix_ns};
use crate::{
    bag_metadata,
    disk::free_bytes,
    error::{RecordingError, io_error},
    folder::{segment_name, sync_folder},
    messages::{CameraInfoMessage, Stamp, encode_string},
    repair,
    segment::Segment,
    session::State,
    streams::Stream,
};

impl SegmentWriter {
    /// Says what is recorded, and how far it came: at the beginning and end of every segment and every second, in a chunk of its
    /// own, so that no damage takes it away.
    pub(super) fn describe(&mut self) -> Result<(), RecordingError> {
        let newest = self.newest();
        let description = encode_string(&self.description);
        self.append_next(Stream::Session, newest, &description)?;
        let camera = CameraInfoMessage::of_intrinsics(header(newest), &self.info.intrinsics);
        let camera = camera.encode();
        self.append_next(Stream::DepthInfo, newest, &camera)?;
        if self.info.has_infrared() {
            self.append_next(Stream::InfraredInfo, newest, &camera)?;
        }
        let stats = encode_string(&self.stats());
        self.append_next(Stream::Stats, newest, &stats)?;
        self.in_segment(|open| open.segment.flush())
    }

    /// The counters, with the clocks side by side.
    fn stats(&self) -> String {
        let c = &self.record.counters;
        serde_json::json!({
            "frames": c.frames,
            "depth": c.depth,
            "infrared": c.infrared,
            "poses": c.poses,
            "events": c.events,
            "bytes": c.bytes,
            "dropped_frames": self.dropped.frames,
            "dropped_infrared": self.dropped.infrared,
            "disk_free_bytes": self.disk_free_bytes,
            "device_time_secs": self.last_frame.map(Stamp::secs),
            "host_unix_ns": unix_ns(),
        })
        .to_string()
    }

    /// Ends the recording if the disk is about to be full.
    pub(super) fn check_disk(&mut self) -> Result<(), RecordingError> {
        self.disk_free_bytes = free_bytes(&self.folder)?;
        let (free_bytes, floor_bytes) = (self.disk_free_bytes, self.params.min_free_bytes);
        if free_bytes >= floor_bytes {
            return Ok(());
        }
        let stopped = RecordingError::DiskFloor {
            folder: self.folder.clone(),
            free_bytes,
            floor_bytes,
        };
        self.close(Some(stopped.to_string()))?;
        Err(stopped)
    }

    /// Begins the next segment; a failure ends the recording.
    pub(super) fn begin_segment(&mut self) -> Result<(), RecordingError> {
        let name = segment_name(self.finished.len());
        let path = self.folder.join(&name);
        let begin = || {
            let out = File::create_new(&path)?;
            let file = out.try_clone()?;
            Ok((Segment::create(out, &self.info.serial)?, file))
        };
        let begun = begin().map_err(io_error(&path));
        let (segment, file) = begun.map_err(|error| self.failed(error))?;
        let now = Instant::now();
        self.open = Some(OpenSegment {
            segment,
            file,
            path,
            name,
            begun: now,
            flushed: now,
            synced: now,
        });
        self.describe()?;
        sync_folder(&self.folder).map_err(|error| self.failed(error))
    }

    /// Ends the segment that is open; what the folder says of itself includes it from then on. A failure ends the recording.
    pub(super) fn end_segment(&mut self) -> Result<(), RecordingError> {
        if self.open.is_none() {
            return Ok(());
        }
        self.in_segment(|open| open.segment.flush())?;
        self.describe()?;
        let Some(open) = self.open.take() else {
            return Ok(());
        };
        let end = || {
            let summary = open.segment.finish()?;
            open.file.sync_all()?;
            Ok((summary, open.file.metadata()?.len()))
        };
        let ended = end().map_err(io_error(&open.path));
        let (summary, bytes) = ended.map_err(|error| self.failed(error))?;
        self.finished.push((open.name, summary));
        self.finished_bytes += bytes;
        self.record.counters.bytes = self.finished_bytes;
        let written = bag_metadata::write(&self.folder, &self.finished);
        let written = written.and_then(|()| self.record.write(&self.folder));
        written.map_err(|error| self.failed(error))
    }

    pub(super) fn close(&mut self, stopped_because: Option<String>) -> Result<(), RecordingError> {
        self.end_segment()?;
        self.record.state = State::Closed;
        self.record.stopped_because = stopped_because;
        let written = self.record.write(&self.folder);
        written.map_err(|error| self.failed(error))?;
        self.lock.remove()
    }

    /// Does something with the open segment; a failure ends the recording.
    pub(super) fn in_segment<T>(
        &mut self,
        act: impl FnOnce(&mut OpenSegment) -> io::Result<T>,
    ) -> Result<T, RecordingError> {
        let Some(open) = &mut self.open else {
            return Err(self.ended());
        };
        let path = open.path.clone();
        let done = act(open).map_err(io_error(&path));
        done.map_err(|error| self.failed(error))
    }

    /// Ends the recording after a failure to write; what is whole of it is kept.
    fn failed(&mut self, error: RecordingError) -> RecordingError {
        self.open = None;
        // Where even that fails, the next to open the recording tries again.
        if let Ok(mended) = repair::repair_held(&self.folder, &mut self.lock) {
            self.record = mended;
            self.record.stopped_because = Some(error.to_string());
            // Without a word of why it ended it is whole all the same.
            let _ = self.record.write(&self.folder);
        }
        error
    }
}
