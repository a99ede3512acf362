//! A recording, or somebody else's bag, as a camera.

use std::{
    collections::{BTreeMap, VecDeque},
    path::{Path, PathBuf},
    time::{Duration, Instant},
};

use depth_camera::{CameraError, CameraInfo, DepthCamera, Frame, Image};
use replay::{DepthScale, Pacer, Pacing, SAME_MOMENT_SECS, WriteError};

use crate::{
    error::RecordingError,
    folder,
    images::{Form, PackedImage, Pixels},
    messages::{Stamp, stamp_of},
    open_lock::OpenLock,
    plan::{self, Kind, Plan},
    reader::{MessageReader, Step},
    repair,
    session::{self, SessionRecord, State},
};

/// An image may come so much later than newer ones: IR that is recorded once it turns out to be wanted.
const MAX_LATENESS_NS: i64 = 1_500_000_000;
/// Images at most this far apart belong together, nanoseconds.
const SAME_MOMENT_NS: i64 = (SAME_MOMENT_SECS * 1e9) as i64;
/// Images that wait for their place, at most; more are of a file whose times make no sense.
const MAX_PENDING: usize = 512;
const MAX_PENDING_BYTES: usize = 256 << 20;
/// So many at most with those of the chunk that is read, before any finds its place: two minutes of both streams in one chunk.
const MAX_WITH_CHUNK: usize = 1 << 13;

/// An image message that waits for its place.
struct PendingImage {
    sequence: u32,
    form: Form,
    message: Vec<u8>,
}

/// One moment of the recording; at least one image is there.
struct Moment {
    stamp: Stamp,
    depth: Option<PendingImage>,
    infrared: Option<PendingImage>,
}

/// Images of one chunk that are not played, by topic: how many, and what is wrong with the first.
#[derive(Default)]
struct Lost(BTreeMap<String, (usize, String)>);

impl Lost {
    /// Counts an image of a topic; `what` says what is wrong with it.
    fn add(&mut self, topic: &str, what: impl FnOnce() -> String) {
        match self.0.get_mut(topic) {
            Some((n, _)) => *n += 1,
            None => drop(self.0.insert(topic.to_owned(), (1, what()))),
        }
    }

    /// One sentence for each topic.
    fn told(self) -> impl Iterator<Item = String> {
        self.0.into_iter().map(|(topic, (n, what))| match n {
            1 => format!("{topic}: {what}"),
            n => format!("{topic}: {what}; {} more of the chunk are lost", n - 1),
        })
    }
}

/// A recording played from its start to its end: one of Relief exactly as it was recorded, another bag as far as its topics tell.
///
/// `frame_id` is that of the recording; in other bags it counts the moments from 0. What is damaged costs its own frames.
pub struct McapCamera {
    path: PathBuf,
    plan: Plan,
    reader: MessageReader,
    has_ended: bool,
    pending: BTreeMap<(Stamp, Kind), PendingImage>,
    n_pending_bytes: usize,
    newest: Option<Stamp>,
    damages: VecDeque<String>,
    /// Files that end before their end.
    torn: Vec<String>,
    due: Option<Moment>,
    last: Option<Stamp>,
    next_frame_id: u64,
    /// Moments that `session.json` tells of.
    n_told: u64,
    /// Moments that came, damaged ones too.
    n_came: u64,
    pacer: Pacer,
}

impl McapCamera {
    /// Opens a recording's folder, a single file of it, or a bag. A recording that was left open is mended first, where it may be
    /// written to.
    ///
    /// # Errors
    /// [`CameraError::Invalid`] naming file, topic, value and bound; [`CameraError::Busy`] for a recording that is being written.
    pub fn open(path: &Path) -> Result<Self, CameraError> {
        let mut n_frames = None;
        let mut n_told = 0;
        if path.join(session::FILE_NAME).is_file() {
            make_whole(path)?;
            let SessionRecord {
                counters, state, ..
            } = SessionRecord::read(path)?;
            n_frames = usize::try_from(counters.frames).ok().filter(|&n| n > 0);
            // Repair counts a frame twice whose images lie in two segments.
            if state == State::Closed {
                n_told = counters.moments();
            }
        }
        let files = folder::files(path)?;
        let mut plan = plan::find(path, &files)?;
        plan.info.n_frames = n_frames;
        Ok(McapCamera {
            path: path.to_owned(),
            plan,
            reader: MessageReader::new(&files),
            has_ended: false,
            pending: BTreeMap::new(),
            n_pending_bytes: 0,
            newest: None,
            damages: VecDeque::new(),
            torn: Vec::new(),
            due: None,
            last: None,
            next_frame_id: 0,
            n_told,
            n_came: 0,
            pacer: Pacer::default(),
        })
    }

    /// The same recording at another pace.
    pub fn with_pacing(self, pacing: Pacing) -> Self {
        McapCamera {
            pacer: Pacer::new(pacing),
            ..self
        }
    }

    /// How depth is stored, for another recording of the same.
    pub fn depth_scale(&self) -> DepthScale {
        self.plan.depth_scale
    }

    /// Reads one more chunk.
    fn read_on(&mut self) -> Result<(), RecordingError> {
        let (plan, pending) = (&self.plan, &mut self.pending);
        let (bytes, newest) = (&mut self.n_pending_bytes, &mut self.newest);
        let mut lost = Lost::default();
        let step = self.reader.step(|channel, message| {
            let Some(kind) = plan.kind_of(&channel.topic) else {
                return;
            };
            let stamp = match stamp_of(message.data) {
                Ok(stamp) => stamp,
                Err(error) => return lost.add(&channel.topic, || error.to_string()),
            };
            if pending.len() >= MAX_WITH_CHUNK {
                let what = || format!("more than {MAX_WITH_CHUNK} images wait for their place");
                return lost.add(&channel.topic, what);
            }
            let image = PendingImage {
                sequence: message.header.sequence,
                // A segment may have lost what its messages are.
                form: Form::of(channel).unwrap_or(Form::Plain),
                message: message.data.to_vec(),
            };
            *bytes += image.message.len();
            *newest = (*newest).max(Some(stamp));
            if let Some(twin) = pending.insert((stamp, kind), image) {
                *bytes -= twin.message.len();
                lost.add(&channel.topic, || {
                    format!(
                        "an image of {:.9} s, which a later one has too",
                        stamp.secs()
                    )
                });
            }
        })?;
        self.damages.extend(lost.told());
        match step {
            Step::Read => {}
            Step::Damaged(what) => self.damages.push_back(what),
            Step::Torn(what) => self.torn.push(what),
            Step::End => self.has_ended = true,
        }
        Ok(())
    }

    /// The oldest moment, once nothing that belongs before or into it can come any more.
    fn next_moment(&mut self) -> Option<Moment> {
        let (&(oldest, kind), _) = self.pending.first_key_value()?;
        let lateness = self.newest.map_or(0, |newest| newest.0 - oldest.0);
        let is_settled = self.has_ended
            || lateness > MAX_LATENESS_NS
            || self.pending.len() >= MAX_PENDING
            || self.n_pending_bytes >= MAX_PENDING_BYTES;
        if !is_settled {
            return None;
        }
        let partner = self.partner(oldest, kind);
        let first = self.take((oldest, kind));
        let second = partner.and_then(|key| self.take(key));
        let (depth, infrared) = match kind {
            Kind::Depth => (first, second),
            Kind::Infrared => (second, first),
        };
        let stamp = match (kind, partner) {
            (Kind::Infrared, Some((stamp, _))) => stamp,
            _ => oldest,
        };
        Some(Moment {
            stamp,
            depth,
            infrared,
        })
    }

    /// The image that makes one moment with the oldest of all.
    fn partner(&self, oldest: Stamp, kind: Kind) -> Option<(Stamp, Kind)> {
        let sequence = self.pending.get(&(oldest, kind))?.sequence;
        // Where images are numbered, two of one moment that belong to two frames were recorded apart.
        let is_same = |image: &PendingImage| !self.plan.is_numbered || image.sequence == sequence;
        let up_to = |stamp: Stamp| {
            let reach = Stamp(stamp.0.saturating_add(SAME_MOMENT_NS));
            self.pending.range((oldest, kind)..=(reach, Kind::Infrared))
        };
        let mut near = up_to(oldest);
        let found = near.find(|((_, of), image)| *of != kind && is_same(image));
        let (&(stamp, other), _) = found?;
        // An IR image leaves a depth image to one that is nearer to it.
        let apart_ns = |at: Stamp| (at.0 - stamp.0).abs();
        let is_left = up_to(stamp).any(|((at, of), image)| {
            *of == Kind::Infrared && apart_ns(*at) < apart_ns(oldest) && is_same(image)
        });
        (kind == Kind::Depth || !is_left).then_some((stamp, other))
    }

    fn take(&mut self, key: (Stamp, Kind)) -> Option<PendingImage> {
        let image = self.pending.remove(&key)?;
        self.n_pending_bytes -= image.message.len();
        Some(image)
    }

    /// Decodes the images of a moment, depth into metres.
    fn decode(&self, frame_id: u64, moment: &Moment) -> Result<Frame, String> {
        if self.last.is_some_and(|last| moment.stamp <= last) {
            return Err(format!(
                "its time {:.9} s does not follow that of the frame before",
                moment.stamp.secs()
            ));
        }
        let depth = moment.depth.as_ref().map(|image| self.depth(image));
        let ir = moment.infrared.as_ref().map(|image| self.infrared(image));
        Ok(Frame {
            frame_id,
            device_time_secs: moment.stamp.secs(),
            host_time: Instant::now(),
            depth: depth.transpose()?,
            ir: ir.transpose()?,
        })
    }

    fn depth(&self, pending: &PendingImage) -> Result<Image<f32>, String> {
        let scale = self.plan.depth_scale;
        Ok(match self.pixels(pending)? {
            Pixels::Metres(metres) => metres.map(|&metres| measured(metres)),
            Pixels::U16(units) => units.map(|&units| scale.metres(units)),
        })
    }

    fn infrared(&self, pending: &PendingImage) -> Result<Image<u16>, String> {
        match self.pixels(pending)? {
            Pixels::U16(counts) => Ok(counts),
            Pixels::Metres(_) => Err("IR in 32FC1, must be mono16 or 16UC1".to_owned()),
        }
    }

    /// The pixels of an image of the size that the camera promises.
    fn pixels(&self, pending: &PendingImage) -> Result<Pixels, String> {
        let image = PackedImage::decode(pending.form, &pending.message);
        let image = image.map_err(|error| error.to_string())?;
        let (width, height) = image.size();
        let i = &self.plan.info.intrinsics;
        if (width, height) != (i.width, i.height) {
            return Err(format!(
                "{width}×{height} pixels, expected {}×{}",
                i.width, i.height
            ));
        }
        image.pixels().map_err(|error| error.to_string())
    }

    /// The end of the stream; before it, once, what is missing.
    fn end(&mut self) -> Result<Option<Frame>, CameraError> {
        let n_missing = self.n_told.saturating_sub(self.n_came);
        self.n_came += n_missing;
        let missing = (n_missing > 0).then(|| {
            let (n_told, name) = (self.n_told, session::FILE_NAME);
            format!("{n_missing} of the {n_told} frames that {name} tells of are missing")
        });
        let reasons: Vec<String> = missing.into_iter().chain(self.torn.drain(..)).collect();
        match reasons.is_empty() {
            true => Ok(None),
            false => Err(self.damaged(self.next_frame_id, reasons.join("; "))),
        }
    }

    fn damaged(&self, frame_id: u64, reason: String) -> CameraError {
        let reason = format!("{}: {reason}", self.path.display());
        CameraError::DamagedFrame { frame_id, reason }
    }
}

impl DepthCamera for McapCamera {
    fn info(&self) -> &CameraInfo {
        &self.plan.info
    }

    fn grab(&mut self, timeout: Duration) -> Result<Option<Frame>, CameraError> {
        while self.due.is_none() {
            if let Some(reason) = self.damages.pop_front() {
                return Err(self.damaged(self.next_frame_id, reason));
            }
            self.due = self.next_moment();
            match (&self.due, self.has_ended) {
                (Some(_), _) => {}
                (None, true) => return self.end(),
                (None, false) => self.read_on()?,
            }
        }
        let Some(due) = &self.due else {
            return Ok(None);
        };
        self.pacer.wait_until_due(due.stamp.secs(), timeout)?;
        let Some(moment) = self.due.take() else {
            return Ok(None);
        };
        let image = moment.depth.as_ref().or(moment.infrared.as_ref());
        let frame_id = match (self.plan.is_numbered, image) {
            (true, Some(image)) => u64::from(image.sequence),
            _ => self.next_frame_id,
        };
        self.next_frame_id = frame_id + 1;
        self.n_came += 1;
        let decoded = self.decode(frame_id, &moment);
        self.last = self.last.max(Some(moment.stamp));
        decoded
            .map(Some)
            .map_err(|reason| self.damaged(frame_id, reason))
    }
}

/// Depth that was measured, metres; 0 otherwise.
fn measured(metres: f32) -> f32 {
    match metres.is_finite() && metres > 0.0 {
        true => metres,
        false => 0.0,
    }
}

/// Mends a recording that was left open; one on a disk that cannot be written to is read as it is, and so is one with chunks that are
/// not read here, of which the reader tells.
fn make_whole(folder: &Path) -> Result<(), RecordingError> {
    if OpenLock::is_held(folder) {
        return Err(RecordingError::InUse(folder.to_owned()));
    }
    if !repair::is_abandoned(folder)? {
        return Ok(());
    }
    match repair::repair(folder) {
        Ok(_)
        | Err(RecordingError::Write(WriteError::Io { .. }) | RecordingError::Invalid { .. }) => {
            Ok(())
        }
        Err(error) => Err(error),
    }
}
