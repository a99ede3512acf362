//! Recordings as MCAP files of ROS 2 messages: their writer, a reader that forgives, repair, and [`McapCamera`].
//! [`open_session`] opens recordings of this and of the other kind.
//!
//! A *recording* is one folder: *segments* of a minute, `segment-0000.mcap` and on, `metadata.yaml`, with which rosbag2 takes it
//! for a bag, and `session.json`, which says how far it came. Every segment can be read alone. Messages are of ROS 2's standard
//! types in CDR; the camera's description is one of them, so that a recording replays exactly as it was taken: depth in the
//! same steps, the device's times, light and full scale. What no message of ROS carries (calibration) lies beside as a file.
//! `docs/recording.md` describes layout, topics and units.
//!
//! Files are written so that they are whole up to the last flush whatever happens to the process ([`SegmentWriter`]), read as far
//! as they are whole ([`McapCamera`]), and mended in place ([`repair()`]). What is read may be damaged or hostile: lengths are
//! checked against the file and against limits before anything is allocated, checksums before anything is believed.
//!
//! Not handled: chunks compressed with lz4, images of 8 bits, in colour or compressed otherwise than by PNG, more than one camera in a
//! bag.

mod camera;
mod params;
mod writer;

mod describe;
mod remove;
mod repair;
mod verify;

mod foreign;
mod plan;

mod cdr;
mod images;
pub mod messages;
pub mod streams;

mod chunk;
mod contents;
mod ending;
mod reader;
mod scan;
mod segment;
mod summary;
mod walk;

mod bag_metadata;
mod disk;
mod folder;
mod open_lock;
mod session;

mod content;
mod error;
mod open;

pub use camera::McapCamera;
pub use cdr::CdrError;
pub use contents::{Channel, Message};
pub use describe::{Description, describe};
pub use disk::free_bytes;
pub use error::RecordingError;
pub use folder::{files, is_recording, recordings_in};
pub use open::{Session, content_hash, open_session};
pub use params::{Dropped, Progress, RecordingParams};
pub use reader::{MessageReader, Step};
pub use remove::remove;
pub use repair::{Repaired, SegmentRepair, abandoned_in, repair, repair_abandoned, repair_segment};
pub use segment::{Segment, SegmentSummary};
pub use session::{Counters, FILE_NAME as SESSION_FILE_NAME, RepairNote, SessionRecord, State};
pub use verify::{FileReport, verify};
pub use writer::SegmentWriter;
