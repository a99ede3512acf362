//! What is to be read of a recording: which camera it is, which topics carry its images, and in which units.

use std::path::{Path, PathBuf};

use depth_camera::{CameraError, CameraInfo};
use replay::{DepthScale, SessionFile};

use crate::{
    contents::Channel,
    foreign::{self, Bag},
    messages::decode_string,
    reader::{MessageReader, Step},
    streams::{STRING, Stream},
};

/// Of another bag so much is looked at, nanoseconds, unless something is missing then; a recording of Relief says what it is.
const LOOKED_AT_NS: u64 = 5_000_000_000;

/// What is to be read of a recording.
#[derive(Clone, Debug, PartialEq)]
pub struct Plan {
    /// The camera.
    pub info: CameraInfo,
    /// The topic of the depth images.
    pub depth_topic: String,
    /// The topic of the IR images, if there are any.
    pub infrared_topic: Option<String>,
    /// What 16-bit depth is stored in.
    pub depth_scale: DepthScale,
    /// Whether a message's sequence number is the number of its frame.
    pub is_numbered: bool,
}

/// The two images of a frame.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Kind {
    /// Depth.
    Depth,
    /// IR.
    Infrared,
}

impl Plan {
    /// Which image a topic carries, if it is one of those that are read.
    pub fn kind_of(&self, topic: &str) -> Option<Kind> {
        // A segment that has lost its definitions has lost the serial number in its topics, and nothing else.
        let stream = Stream::of_topic(topic).filter(|_| self.is_numbered);
        let has_infrared = self.infrared_topic.is_some();
        match stream {
            Some(Stream::Depth) => Some(Kind::Depth),
            Some(Stream::Infrared) if has_infrared => Some(Kind::Infrared),
            _ if topic == self.depth_topic => Some(Kind::Depth),
            _ if Some(topic) == self.infrared_topic.as_deref() => Some(Kind::Infrared),
            _ => None,
        }
    }
}

/// Finds out what the files hold.
///
/// # Errors
/// [`CameraError::Invalid`] naming file, topic and what is missing.
pub fn find(path: &Path, files: &[PathBuf]) -> Result<Plan, CameraError> {
    let mut reader = MessageReader::new(files);
    let mut own = None;
    let mut bag = Bag::default();
    let mut start_ns = None;
    let mut newest_ns = 0;
    let mut is_own = false;
    loop {
        let step = reader.step(|channel, message| {
            if own.is_none() && is_description(channel) {
                own = Some((channel.topic.clone(), message.data.to_vec()));
            }
            is_own |= Stream::of_topic(&channel.topic).is_some();
            bag.see(channel, message.data);
            start_ns.get_or_insert(message.header.log_time);
            newest_ns = message.header.log_time;
        })?;
        if let Some((topic, description)) = &own {
            return of_description(path, topic, description);
        }
        let looked_at_ns = newest_ns.saturating_sub(start_ns.unwrap_or(newest_ns));
        if step == Step::End {
            return foreign::plan(path, &bag);
        }
        // What is missing may still come.
        if looked_at_ns > LOOKED_AT_NS
            && !is_own
            && let Ok(plan) = foreign::plan(path, &bag)
        {
            return Ok(plan);
        }
    }
}

fn is_description(channel: &Channel) -> bool {
    channel.message_type == STRING.name && Stream::of_topic(&channel.topic) == Some(Stream::Session)
}

/// The plan of a recording of Relief.
fn of_description(path: &Path, topic: &str, message: &[u8]) -> Result<Plan, CameraError> {
    let text = decode_string(message)
        .map_err(|error| CameraError::Invalid(format!("{}: {topic}: {error}", path.display())))?;
    let session = SessionFile::parse(path, text)?;
    let info = session.camera_info(path, session.images())?;
    let beside = |stream: Stream| {
        let stem = topic.strip_suffix(Stream::Session.suffix());
        format!("{}{}", stem.unwrap_or_default(), stream.suffix())
    };
    Ok(Plan {
        depth_topic: beside(Stream::Depth),
        infrared_topic: info.has_infrared().then(|| beside(Stream::Infrared)),
        info,
        depth_scale: session.depth_scale(),
        is_numbered: true,
    })
}
