//! Looks through a whole segment: what it holds, what is damaged, and what would mend it.

use std::{
    collections::{BTreeMap, BTreeSet},
    path::Path,
};

use mcap::{
    MAGIC,
    records::{MessageHeader, Record, op},
};

use crate::{
    chunk::{Chunk, HEAD, not_read},
    contents::{Definitions, message, read_records},
    ending::check_ending,
    error::{RecordingError, io_error},
    segment::SegmentSummary,
    streams::Stream,
    walk::{Piece, Walk},
};

/// An image of the same frame comes at most so many frames later.
const FRAMES_REMEMBERED: usize = 256;

/// What a segment holds.
#[derive(Debug, Default)]
pub struct Scan {
    /// Schemas and channels.
    pub definitions: Definitions,
    /// The chunks that are whole.
    pub chunks: Vec<ChunkEntry>,
    /// Messages by channel.
    pub n_messages: BTreeMap<u16, u64>,
    /// Types, numbers and times of the messages.
    pub summary: SegmentSummary,
    /// Frames of which an image is whole.
    pub n_frames: u64,
    /// What is wrong, in order.
    pub damages: Vec<Damage>,
    /// Where the last whole record of the data ends.
    pub end_of_data: u64,
    /// What is wrong with the end of the file: with a torn record, summary, or checksums.
    pub bad_ending: Option<String>,
    /// Bytes of the file.
    pub file_length: u64,
    has_header: bool,
    /// Whether message indexes belong to the last of the chunks: not behind a damaged one.
    takes_indexes: bool,
    recent_frames: BTreeSet<u32>,
}

/// A chunk as the summary tells of it.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct ChunkEntry {
    /// Where its record begins.
    pub offset: u64,
    /// Bytes of its record.
    pub length: u64,
    /// Name of the compression.
    pub compression: String,
    /// Bytes of its contents as they lie in the file.
    pub compressed_size: u64,
    /// Bytes of its contents.
    pub uncompressed_size: u64,
    /// Log times of its first and last message, nanoseconds.
    pub time_ns: (u64, u64),
    /// Where the message indexes lie that agree with its messages, by channel.
    pub index_offsets: BTreeMap<u16, u64>,
    /// Bytes of all its message indexes.
    pub index_length: u64,
    /// Log time and place of its messages by channel, as an index would have them.
    messages: BTreeMap<u16, Vec<(u64, u64)>>,
}

impl ChunkEntry {
    /// Whether every message is in an index.
    pub fn is_indexed(&self) -> bool {
        self.index_offsets.keys().eq(self.messages.keys())
    }
}

/// Bytes that are not what they should be.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Damage {
    /// Where they begin.
    pub offset: u64,
    /// What was found there.
    pub what: String,
    /// What mends the file, as far as it can be mended.
    pub mend: Mend,
}

/// What is done about damaged bytes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Mend {
    /// They become one record of a private kind, so that readers pass over them.
    PassOver {
        /// How many there are.
        length: u64,
    },
    /// The times in a chunk's header become those of its messages, nanoseconds.
    Times(u64, u64),
}

/// Looks through a segment.
///
/// # Errors
/// If the file cannot be read, does not begin as an MCAP file does, or holds a chunk that is whole as far as can be told, and not read:
/// nothing of such a file may be taken for damage.
pub fn scan(path: &Path) -> Result<Scan, RecordingError> {
    let mut walk = Walk::open(path)?;
    let mut scan = Scan {
        end_of_data: MAGIC.len() as u64,
        file_length: walk.file_length(),
        ..Scan::default()
    };
    if walk.is_own() {
        scan.definitions.add_own();
    }
    while let Some(piece) = walk.next().map_err(io_error(path))? {
        let (offset, length, looked_at) = match piece {
            Piece::Chunk(chunk) => {
                let looked_at = scan.chunk(&chunk);
                scan.takes_indexes = looked_at.is_ok();
                (chunk.offset, chunk.length, looked_at)
            }
            Piece::Record {
                opcode,
                offset,
                body,
            } => {
                let looked_at = scan.record(opcode, offset, &body);
                (offset, HEAD + body.len() as u64, looked_at)
            }
            Piece::Unread { offset, what } => {
                let what = format!("{offset} bytes into it {}", not_read(&what));
                return Err(RecordingError::invalid(path, what));
            }
            Piece::PassedOver => continue,
            Piece::Gap {
                offset,
                length,
                what,
            } => {
                scan.takes_indexes = false;
                scan.pass_over(offset, length, what);
                continue;
            }
            Piece::DataEnd { offset, saved_crc } => {
                scan.end_of_data = offset;
                scan.bad_ending = check_ending(path, offset, saved_crc).map_err(io_error(path))?;
                return Ok(scan);
            }
            Piece::Torn { offset, what } => {
                scan.end_of_data = offset;
                scan.bad_ending = Some(what);
                return Ok(scan);
            }
        };
        if let Err(what) = looked_at {
            let length = walk.reject(offset, length).map_err(io_error(path))?;
            scan.pass_over(offset, length, what);
        }
    }
    Ok(scan)
}

impl Scan {
    /// Whether the file begins with a header of its own.
    pub fn has_header(&self) -> bool {
        self.has_header
    }

    /// Whether nothing is wrong.
    pub fn is_whole(&self) -> bool {
        self.damages.is_empty() && self.bad_ending.is_none()
    }

    /// Takes up a chunk, or says what is wrong with its contents.
    fn chunk(&mut self, chunk: &Chunk) -> Result<(), String> {
        let mut entry = ChunkEntry {
            offset: chunk.offset,
            length: chunk.length,
            compression: chunk.header.compression.clone(),
            compressed_size: chunk.header.compressed_size,
            uncompressed_size: chunk.header.uncompressed_size,
            time_ns: (0, 0),
            index_offsets: BTreeMap::new(),
            index_length: 0,
            messages: BTreeMap::new(),
        };
        // Counted only if the whole chunk is good.
        let mut definitions = self.definitions.clone();
        let read = chunk.records().and_then(|records| {
            read_records(&records, &mut definitions, |_, message| {
                let places = entry.messages.entry(message.header.channel_id);
                let place = (message.header.log_time, message.offset_in_chunk);
                places.or_default().push(place);
            })?;
            Ok(records)
        });
        let records = read.map_err(|what| format!("a chunk: {what}"))?;
        let counted = read_records(&records, &mut definitions, |definitions, message| {
            self.count(definitions, &message.header);
        });
        debug_assert!(counted.is_ok(), "the records were read before");
        self.definitions = definitions;

        let times = entry.messages.values().flatten().map(|(time, _)| *time);
        let times = times.map(|time| (time, time));
        entry.time_ns = times
            .reduce(|a, b| (a.0.min(b.0), a.1.max(b.1)))
            .unwrap_or_default();
        let told = (
            chunk.header.message_start_time,
            chunk.header.message_end_time,
        );
        if told != entry.time_ns {
            self.damages.push(Damage {
                offset: chunk.offset,
                what: format!("a chunk of other times than its messages: {told:?}"),
                mend: Mend::Times(entry.time_ns.0, entry.time_ns.1),
            });
        }
        self.chunks.push(entry);
        Ok(())
    }

    /// Takes up another record, or says what is wrong with it.
    fn record(&mut self, opcode: u8, offset: u64, body: &[u8]) -> Result<(), String> {
        match opcode {
            op::HEADER => {
                self.has_header = true;
                self.definitions.begin(body);
            }
            op::SCHEMA | op::CHANNEL => self.definitions.add(opcode, body)?,
            op::MESSAGE => {
                let (header, _) = message(body).ok_or("a message without its header")?;
                let definitions = std::mem::take(&mut self.definitions);
                self.count(&definitions, &header);
                self.definitions = definitions;
            }
            op::MESSAGE_INDEX => self.message_index(offset, body)?,
            _ => {}
        }
        Ok(())
    }

    /// Takes up an index if it belongs to a good chunk and agrees with it.
    fn message_index(&mut self, offset: u64, body: &[u8]) -> Result<(), String> {
        let length = HEAD + body.len() as u64;
        let chunk = self.chunks.last_mut().filter(|_| self.takes_indexes);
        let index = match mcap::parse_record(op::MESSAGE_INDEX, body) {
            Ok(Record::MessageIndex(index)) => Some(index),
            _ => None,
        };
        if let (Some(chunk), Some(index)) = (chunk, index) {
            let told = index
                .records
                .iter()
                .map(|entry| (entry.log_time, entry.offset));
            let messages = chunk.messages.get(&index.channel_id);
            if messages.is_some_and(|messages| messages.iter().copied().eq(told)) {
                chunk.index_offsets.insert(index.channel_id, offset);
                chunk.index_length += length;
                return Ok(());
            }
        }
        Err("an index that agrees with no chunk before it".to_owned())
    }

    fn count(&mut self, definitions: &Definitions, header: &MessageHeader) {
        let Some(channel) = definitions.channels.get(&header.channel_id) else {
            return;
        };
        *self.n_messages.entry(header.channel_id).or_default() += 1;
        self.summary
            .add(&channel.topic, &channel.message_type, header.log_time);
        let is_image = matches!(
            Stream::of_topic(&channel.topic),
            Some(Stream::Depth | Stream::Infrared)
        );
        if is_image && self.recent_frames.insert(header.sequence) {
            self.n_frames += 1;
            if self.recent_frames.len() > FRAMES_REMEMBERED {
                self.recent_frames.pop_first();
            }
        }
    }

    fn pass_over(&mut self, offset: u64, length: u64, what: String) {
        self.damages.push(Damage {
            offset,
            what,
            mend: Mend::PassOver { length },
        });
    }
}
