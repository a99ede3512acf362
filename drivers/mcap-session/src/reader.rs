//! Reads the messages of a recording or of somebody else's bag, in the order in which they were written, past what is damaged.

use std::{
    collections::VecDeque,
    path::{Path, PathBuf},
};

use mcap::records::op;

use crate::{
    chunk::not_read,
    contents::{Channel, Definitions, Message, message, read_records},
    error::{RecordingError, io_error},
    session::{SessionRecord, State},
    walk::{Piece, Walk},
};

/// What one step of reading came to.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Step {
    /// Some messages were read, or none.
    Read,
    /// Bytes were passed over: file, place and what was found there.
    Damaged(String),
    /// A file ends before its end: file, place and what was found there.
    Torn(String),
    /// There are no more.
    End,
}

/// Reads one file after the other. A file that ends in the middle of a record is read up to there; without a word where its
/// recording was left open, for so one ends that was not closed.
pub struct MessageReader {
    files: VecDeque<PathBuf>,
    open: Option<OpenFile>,
    /// Whether a file has been opened.
    has_begun: bool,
}

struct OpenFile {
    path: PathBuf,
    walk: Walk,
    definitions: Definitions,
    /// Whether it belongs to a recording that was left open.
    was_left_open: bool,
}

impl MessageReader {
    /// A reader of files.
    pub fn new(files: &[PathBuf]) -> Self {
        MessageReader {
            files: files.iter().cloned().collect(),
            open: None,
            has_begun: false,
        }
    }

    /// Reads the next chunk or record.
    ///
    /// # Errors
    /// If a file cannot be read.
    pub fn step(
        &mut self,
        mut on_message: impl FnMut(&Channel, &Message),
    ) -> Result<Step, RecordingError> {
        let Some(open) = &mut self.open else {
            return self.open_next();
        };
        let Some(piece) = open.walk.next().map_err(io_error(&open.path))? else {
            self.open = None;
            return Ok(Step::Read);
        };
        if let Piece::Torn { offset, what } = &piece {
            return Ok(match open.was_left_open {
                true => Step::Read,
                false => Step::Torn(open.told(*offset, &format!("the rest is missing: {what}"))),
            });
        }
        let mut hand_on = |definitions: &Definitions, message: Message| {
            if let Some(channel) = definitions.channels.get(&message.header.channel_id) {
                on_message(channel, &message);
            }
        };
        let damage = match piece {
            Piece::Chunk(chunk) => {
                let read = chunk
                    .records()
                    .and_then(|records| read_records(&records, &mut open.definitions, hand_on));
                if read.is_err() {
                    let rejected = open.walk.reject(chunk.offset, chunk.length);
                    rejected.map_err(io_error(&open.path))?;
                }
                read.err()
                    .map(|what| (chunk.offset, format!("a chunk is lost: {what}")))
            }
            Piece::Unread { offset, what } => Some((offset, not_read(&what))),
            Piece::Record {
                opcode: op::MESSAGE,
                body,
                ..
            } => {
                if let Some((header, data)) = message(&body) {
                    let message = Message {
                        header,
                        offset_in_chunk: 0,
                        data,
                    };
                    hand_on(&open.definitions, message);
                }
                None
            }
            Piece::Record {
                opcode,
                offset,
                body,
            } => define(&mut open.definitions, opcode, &body).map(|what| (offset, what)),
            Piece::Gap {
                offset,
                length,
                what,
            } => Some((offset, format!("{length} bytes are lost: {what}"))),
            Piece::PassedOver | Piece::DataEnd { .. } | Piece::Torn { .. } => None,
        };
        Ok(damage.map_or(Step::Read, |(offset, what)| {
            Step::Damaged(open.told(offset, &what))
        }))
    }

    fn open_next(&mut self) -> Result<Step, RecordingError> {
        let Some(path) = self.files.pop_front() else {
            return Ok(Step::End);
        };
        let walk = match Walk::open(&path) {
            Ok(walk) => walk,
            // In the midst of a recording it costs itself; those behind it are read.
            Err(error) if self.has_begun => return Ok(Step::Damaged(error.to_string())),
            Err(error) => return Err(error),
        };
        self.has_begun = true;
        let mut definitions = Definitions::default();
        if walk.is_own() {
            definitions.add_own();
        }
        self.open = Some(OpenFile {
            was_left_open: walk.is_own() && was_left_open(&path),
            path,
            walk,
            definitions,
        });
        Ok(Step::Read)
    }
}

impl OpenFile {
    fn told(&self, offset: u64, what: &str) -> String {
        format!("{}: {offset} bytes into it {what}", self.path.display())
    }
}

/// Whether the recording that a segment belongs to was never closed, or is being written.
fn was_left_open(segment: &Path) -> bool {
    let record = segment.parent().map(SessionRecord::read);
    record.is_some_and(|read| read.is_ok_and(|record| record.state == State::Open))
}

/// Takes up a record that defines something; what is wrong with it, if anything is.
fn define(definitions: &mut Definitions, opcode: u8, body: &[u8]) -> Option<String> {
    match opcode {
        op::SCHEMA | op::CHANNEL => definitions.add(opcode, body).err(),
        op::HEADER => {
            definitions.begin(body);
            None
        }
        _ => None,
    }
}
