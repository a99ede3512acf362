//! Writes a recording: a folder of segments, its description, and how far it came.

mod segments;

use std::{
    fs::File,
    path::{Path, PathBuf},
    time::{Duration, Instant, SystemTime, UNIX_EPOCH},
};

use depth_camera::{CameraInfo, Frame, Image};
use replay::{DepthScale, SessionFile, WriteError, check_frame, create_empty_folder};

use crate::{
    error::RecordingError,
    messages::{Encoding, Header, MAX_SIDE_PX, PoseMessage, Stamp, encode_image, encode_string},
    open_lock::OpenLock,
    params::{Dropped, Progress, RecordingParams},
    segment::{Segment, SegmentSummary},
    session::{Counters, SessionRecord},
    streams::Stream,
};

/// The frame of reference of images: x right, y down, z forward, as ROS has it for `_optical_frame`.
const OPTICAL_FRAME: &str = "ir_optical_frame";
/// The frame of reference of poses: that of the first camera.
const WORLD_FRAME: &str = "world";

/// A recording being written.
///
/// What was given is on its way to the disk [`RecordingParams::flush_every`] later, if [`SegmentWriter::tick`] is called as often,
/// and as soon as frames of so much of the device's time wait.
/// A recording whose process died is whole up to there once it is repaired, see [`crate::repair()`]. After
/// [`RecordingError::DiskFloor`] or a failure to write, the recording has ended and every call says so.
pub struct SegmentWriter {
    folder: PathBuf,
    info: CameraInfo,
    params: RecordingParams,
    description: String,
    record: SessionRecord,
    lock: OpenLock,
    open: Option<OpenSegment>,
    finished: Vec<(String, SegmentSummary)>,
    finished_bytes: u64,
    dropped: Dropped,
    disk_free_bytes: u64,
    /// Device time of the first frame and the wall clock then, which all log times go by.
    start: Option<(Stamp, u64)>,
    last_frame: Option<Stamp>,
    /// The first frame that was not handed to the disk yet.
    waits_since: Option<Stamp>,
    next_sequence: [u32; Stream::ALL.len()],
}

/// The segment that is being written, and when what was last done with it.
struct OpenSegment {
    segment: Segment<File>,
    file: File,
    path: PathBuf,
    name: String,
    begun: Instant,
    flushed: Instant,
    synced: Instant,
}

impl SegmentWriter {
    /// Begins a recording in `folder`, which is created and must be empty otherwise.
    ///
    /// # Errors
    /// [`RecordingError::Write`] for a description that makes no sense, a folder that holds something, or what the system says;
    /// [`RecordingError::DiskFloor`] if there is too little space to begin with.
    pub fn create(
        folder: &Path,
        info: &CameraInfo,
        params: RecordingParams,
    ) -> Result<Self, RecordingError> {
        let name = folder.file_name().map(|name| name.to_string_lossy());
        let name = name.as_deref().unwrap_or("recording");
        let described = SessionFile::of_camera(name, info, params.depth_units_per_metre);
        described
            .camera_info(folder, described.images())
            .map_err(WriteError::Camera)?;
        check_size(folder, info)?;
        let description = described.to_text(folder).map_err(WriteError::Camera)?;

        create_empty_folder(folder)?;
        let lock = OpenLock::create(folder)?;
        let started_unix_ms = unix_ns() / 1_000_000;
        let record = SessionRecord::begun(info, params.depth_units_per_metre, started_unix_ms);
        record.write(folder)?;
        let mut writer = SegmentWriter {
            folder: folder.to_owned(),
            info: info.clone(),
            params,
            description,
            record,
            lock,
            open: None,
            finished: Vec::new(),
            finished_bytes: 0,
            dropped: Dropped::default(),
            disk_free_bytes: u64::MAX,
            start: None,
            last_frame: None,
            waits_since: None,
            next_sequence: [0; Stream::ALL.len()],
        };
        writer.check_disk()?;
        writer.begin_segment()?;
        Ok(writer)
    }

    /// Records a frame.
    ///
    /// # Errors
    /// [`WriteError::Frame`] for a frame of the wrong size, out of order, without an image, or with IR from a camera said to
    /// have none: nothing of it was written, and the next may be. All other errors end the recording.
    pub fn write(&mut self, frame: &Frame) -> Result<(), RecordingError> {
        self.write_with_infrared(frame, frame.ir.as_ref())
    }

    /// Records the IR of a frame whose depth was recorded at most a second before, when it turns out to be wanted.
    ///
    /// # Errors
    /// As of [`Self::write`].
    pub fn write_infrared(&mut self, frame: &Frame) -> Result<(), RecordingError> {
        let stamp = self.check(frame, None)?;
        if let Some(ir) = &frame.ir {
            self.append_infrared(frame.frame_id, stamp, ir)?;
        }
        self.tick()
    }

    /// Records a frame with that IR in place of its own, or without any, which may still follow by [`Self::write_infrared`].
    ///
    /// # Errors
    /// As of [`Self::write`].
    pub fn write_with_infrared(
        &mut self,
        frame: &Frame,
        ir: Option<&Image<u16>>,
    ) -> Result<(), RecordingError> {
        let stamp = self.check(frame, self.last_frame)?;
        self.last_frame = Some(stamp);
        self.waits_since.get_or_insert(stamp);
        self.start.get_or_insert_with(|| (stamp, unix_ns()));
        self.lock.count_frame();
        if let Some(depth) = &frame.depth {
            let scale = self.depth_scale();
            let units = depth.data().iter().map(|&metres| scale.units(metres));
            let message = encode_image(&header(stamp), Encoding::U16, depth.width(), units);
            self.append(Stream::Depth, frame.frame_id as u32, stamp, &message)?;
            self.record.counters.depth += 1;
        }
        if let Some(ir) = ir {
            self.append_infrared(frame.frame_id, stamp, ir)?;
        }
        self.record.counters.frames += 1;
        self.tick()
    }

    /// Records where the camera was at a time of its own clock: world from camera, as metres and a quaternion x y z w.
    ///
    /// # Errors
    /// What the system says, which ends the recording.
    pub fn pose(
        &mut self,
        device_time_secs: f64,
        position_m: [f64; 3],
        orientation: [f64; 4],
    ) -> Result<(), RecordingError> {
        let Some(stamp) = Stamp::from_secs(device_time_secs) else {
            return Ok(());
        };
        let pose = PoseMessage {
            header: Header {
                stamp,
                frame_id: WORLD_FRAME.to_owned(),
            },
            position_m,
            orientation,
        };
        self.append_next(Stream::Pose, stamp, &pose.encode())?;
        self.record.counters.poses += 1;
        Ok(())
    }

    /// Records what happened, one JSON object, at a time of the device or now.
    ///
    /// # Errors
    /// What the system says, which ends the recording.
    pub fn event(
        &mut self,
        device_time_secs: Option<f64>,
        json: &str,
    ) -> Result<(), RecordingError> {
        let stamp = device_time_secs.and_then(Stamp::from_secs);
        let stamp = stamp.unwrap_or_else(|| self.newest());
        self.append_next(Stream::Events, stamp, &encode_string(json))?;
        self.record.counters.events += 1;
        Ok(())
    }

    /// Takes note of what never reached the recorder, for the counters in the recording.
    pub fn note_dropped(&mut self, dropped: Dropped) {
        self.dropped = dropped;
    }

    /// Does what is due: hands messages to the disk, looks at the space that is left, begins the next segment.
    ///
    /// # Errors
    /// [`RecordingError::DiskFloor`], or what the system says; both end the recording.
    pub fn tick(&mut self) -> Result<(), RecordingError> {
        let Some(open) = &self.open else {
            return Err(self.ended());
        };
        let is_due = open.flushed.elapsed() >= self.params.flush_every;
        match is_due || self.waiting() >= self.params.flush_every {
            true => self.flush(),
            false => Ok(()),
        }
    }

    /// How much of the device's time waits in memory: after a pause of the process frames come faster than the clock goes.
    fn waiting(&self) -> Duration {
        let span = self.waits_since.zip(self.last_frame);
        let nanos = span.map_or(0, |(first, last)| last.0 - first.0);
        Duration::from_nanos(nanos.unsigned_abs())
    }

    /// Hands to the disk what was given so far, and does what else is due.
    ///
    /// # Errors
    /// As of [`Self::tick`].
    pub fn flush(&mut self) -> Result<(), RecordingError> {
        self.check_disk()?;
        let now = Instant::now();
        let is_due = |open: &OpenSegment| now - open.synced >= self.params.sync_every;
        let sync = self.open.as_ref().is_some_and(is_due);
        self.in_segment(|open| open.segment.flush())?;
        self.waits_since = None;
        if sync {
            self.describe()?;
        }
        let bytes = self.in_segment(|open| {
            open.flushed = now;
            if sync {
                open.file.sync_data()?;
                open.synced = now;
            }
            Ok(open.file.metadata()?.len())
        })?;
        self.record.counters.bytes = self.finished_bytes + bytes;
        let is_old = |open: &OpenSegment| now - open.begun >= self.params.max_segment;
        if bytes >= self.params.max_segment_bytes || self.open.as_ref().is_some_and(is_old) {
            self.end_segment()?;
            self.begin_segment()?;
        }
        Ok(())
    }

    /// How far the recording came; of one that ended by a failure to write, what is left of it.
    pub fn progress(&self) -> Progress {
        Progress {
            counters: self.record.counters,
            disk_free_bytes: self.disk_free_bytes,
        }
    }

    /// Ends the recording in order.
    ///
    /// # Errors
    /// What the system says; what is whole of the recording has been kept, as after any failure to write.
    /// [`RecordingError::Ended`] if it ended before.
    pub fn finish(mut self) -> Result<Counters, RecordingError> {
        if self.open.is_none() {
            return Err(self.ended());
        }
        self.close(None)?;
        Ok(self.record.counters)
    }

    /// Whether the frame fits the recording, and comes after `previous`; its time.
    fn check(&self, frame: &Frame, previous: Option<Stamp>) -> Result<Stamp, RecordingError> {
        let refuse = |reason| {
            RecordingError::Write(WriteError::Frame {
                frame_id: frame.frame_id,
                reason,
            })
        };
        check_frame(frame, &self.info).map_err(refuse)?;
        let secs = frame.device_time_secs;
        let stamp = Stamp::from_secs(secs).ok_or_else(|| {
            refuse(format!(
                "its time is {secs} s, must fit 32 bits of whole seconds"
            ))
        })?;
        match previous {
            Some(previous) if stamp <= previous => Err(refuse(format!(
                "its time {secs:.9} s follows {:.9} s, must be later",
                previous.secs()
            ))),
            _ => Ok(stamp),
        }
    }

    fn depth_scale(&self) -> DepthScale {
        DepthScale {
            units_per_metre: self.params.depth_units_per_metre,
        }
    }

    fn append_infrared(
        &mut self,
        frame_id: u64,
        stamp: Stamp,
        ir: &Image<u16>,
    ) -> Result<(), RecordingError> {
        let counts = ir.data().iter().copied();
        let message = encode_image(&header(stamp), Encoding::Mono16, ir.width(), counts);
        self.append(Stream::Infrared, frame_id as u32, stamp, &message)?;
        self.record.counters.infrared += 1;
        Ok(())
    }

    /// Appends a message that counts itself.
    fn append_next(
        &mut self,
        stream: Stream,
        stamp: Stamp,
        message: &[u8],
    ) -> Result<(), RecordingError> {
        let sequence = self.next_sequence[stream as usize];
        self.next_sequence[stream as usize] = sequence.wrapping_add(1);
        self.append(stream, sequence, stamp, message)
    }

    fn append(
        &mut self,
        stream: Stream,
        sequence: u32,
        stamp: Stamp,
        message: &[u8],
    ) -> Result<(), RecordingError> {
        let log_time_ns = self.log_time_ns(stamp);
        self.in_segment(|open| open.segment.write(stream, sequence, log_time_ns, message))
    }

    /// The wall clock at a time of the device, by the first frame: one clock for all streams, at the pace of the device.
    fn log_time_ns(&self, stamp: Stamp) -> u64 {
        match self.start {
            Some((first, unix_ns)) => unix_ns.saturating_add_signed(stamp.0 - first.0),
            None => unix_ns(),
        }
    }

    /// The time of the newest frame.
    fn newest(&self) -> Stamp {
        self.last_frame.unwrap_or(Stamp(0))
    }

    fn ended(&self) -> RecordingError {
        RecordingError::Ended(self.folder.clone())
    }
}

fn header(stamp: Stamp) -> Header {
    Header {
        stamp,
        frame_id: OPTICAL_FRAME.to_owned(),
    }
}

/// What is not read again is not written.
fn check_size(folder: &Path, info: &CameraInfo) -> Result<(), RecordingError> {
    let i = &info.intrinsics;
    if i.width.max(i.height) <= MAX_SIDE_PX as usize {
        return Ok(());
    }
    Err(RecordingError::invalid(
        folder,
        format!(
            "images are {}×{}, must be at most {MAX_SIDE_PX} each",
            i.width, i.height
        ),
    ))
}

/// The wall clock; 0 on a machine that is before 1970.
fn unix_ns() -> u64 {
    let since = SystemTime::now().duration_since(UNIX_EPOCH);
    since.map_or(0, |since| since.as_nanos() as u64)
}
