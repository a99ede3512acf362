//! One MCAP file being written: chunks of compressed messages, appended and never gone back to.

use std::{
    collections::BTreeMap,
    io::{self, Write},
};

use mcap::{
    Compression, McapError, McapResult, WriteOptions, Writer, records::MessageHeader, write::NoSeek,
};

use crate::streams::Stream;

/// A chunk is closed before its messages take more than this; a larger message has a chunk of its own.
pub const MAX_CHUNK_BYTES: usize = 4 << 20;

/// The profile in the header of a file.
pub const PROFILE: &str = "ros2";
/// What the library in the header of a file begins with; the version follows.
pub const LIBRARY: &str = "relief ";

/// The fastest level: of 1, 3 and 9 the higher ones gain a tenth on depth and nothing on the noise of IR.
const ZSTD_LEVEL: u32 = 1;

/// What a segment holds, which rosbag2's `metadata.yaml` tells of it.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct SegmentSummary {
    /// Log times of the first and last message, nanoseconds; `None` for an empty segment.
    pub time_ns: Option<(u64, u64)>,
    /// Type and number of the messages on each topic.
    pub topics: BTreeMap<String, (String, u64)>,
}

impl SegmentSummary {
    /// Takes one message into account.
    pub fn add(&mut self, topic: &str, message_type: &str, log_time_ns: u64) {
        let (start, end) = self.time_ns.unwrap_or((log_time_ns, log_time_ns));
        self.time_ns = Some((start.min(log_time_ns), end.max(log_time_ns)));
        match self.topics.get_mut(topic) {
            Some((_, n_messages)) => *n_messages += 1,
            None => {
                self.topics
                    .insert(topic.to_owned(), (message_type.to_owned(), 1));
            }
        }
    }

    /// Messages in all.
    pub fn n_messages(&self) -> u64 {
        self.topics.values().map(|(_, n_messages)| n_messages).sum()
    }
}

/// A segment being written to `W`, which is never sought in: what is written stays, whatever happens next.
///
/// Messages are in memory until [`Segment::flush`] or until their chunk is full. After an error nothing more can be written; what
/// came before can be repaired.
pub struct Segment<W: Write> {
    writer: Writer<NoSeek<W>>,
    topics: [String; Stream::ALL.len()],
    channels: [u16; Stream::ALL.len()],
    n_chunk_bytes: usize,
    summary: SegmentSummary,
}

impl<W: Write> Segment<W> {
    /// Begins a segment of a device's streams: header and a small first chunk that defines them.
    ///
    /// # Errors
    /// What the output says.
    pub fn create(out: W, serial: &str) -> io::Result<Self> {
        let options = WriteOptions::new()
            .profile(PROFILE)
            .library(format!("{LIBRARY}{}", env!("CARGO_PKG_VERSION")))
            .compression(Some(Compression::Zstd))
            .compression_level(ZSTD_LEVEL)
            .compression_threads(0)
            .disable_seeking(true)
            .chunk_size(None);
        let mut writer = options.create(NoSeek::new(out)).map_err(io_error)?;
        let topics = Stream::ALL.map(|stream| stream.topic(serial));
        let mut channels = [0; Stream::ALL.len()];
        for (stream, channel) in Stream::ALL.into_iter().zip(&mut channels) {
            *channel = add_channel(&mut writer, stream, serial).map_err(io_error)?;
        }
        writer.flush().map_err(io_error)?;
        Ok(Segment {
            writer,
            topics,
            channels,
            n_chunk_bytes: 0,
            summary: SegmentSummary::default(),
        })
    }

    /// Appends a message, which is on its way to the disk after the next [`Self::flush`].
    ///
    /// # Errors
    /// What the output says.
    pub fn write(
        &mut self,
        stream: Stream,
        sequence: u32,
        log_time_ns: u64,
        message: &[u8],
    ) -> io::Result<()> {
        if self.n_chunk_bytes > 0 && self.n_chunk_bytes + message.len() > MAX_CHUNK_BYTES {
            self.flush()?;
        }
        self.n_chunk_bytes += message.len();
        let header = MessageHeader {
            channel_id: self.channels[stream as usize],
            sequence,
            log_time: log_time_ns,
            publish_time: log_time_ns,
        };
        self.writer
            .write_to_known_channel(&header, message)
            .map_err(io_error)?;
        let topic = &self.topics[stream as usize];
        self.summary.add(topic, stream.schema().name, log_time_ns);
        Ok(())
    }

    /// Closes the chunk and hands it to the output.
    ///
    /// # Errors
    /// What the output says.
    pub fn flush(&mut self) -> io::Result<()> {
        self.n_chunk_bytes = 0;
        self.writer.flush().map_err(io_error)
    }

    /// Ends the segment with its summary and footer.
    ///
    /// # Errors
    /// What the output says; the segment then needs repair.
    pub fn finish(mut self) -> io::Result<SegmentSummary> {
        self.writer.finish().map_err(io_error)?;
        Ok(self.summary)
    }
}

/// Defines a stream.
fn add_channel<W: Write>(
    writer: &mut Writer<NoSeek<W>>,
    stream: Stream,
    serial: &str,
) -> McapResult<u16> {
    let schema = stream.schema();
    let schema_id = writer.add_schema(schema.name, "ros2msg", schema.text.as_bytes())?;
    // Without it rosbag2 warns that a topic has no quality of service.
    let metadata = BTreeMap::from([("offered_qos_profiles".to_owned(), String::new())]);
    writer.add_channel(schema_id, &stream.topic(serial), "cdr", &metadata)
}

fn io_error(error: McapError) -> io::Error {
    match error {
        McapError::Io(error) => error,
        other => io::Error::other(other),
    }
}
