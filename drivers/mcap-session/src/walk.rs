//! From record to record through an MCAP file, past whatever is damaged.
//!
//! The file is data section (header, chunks with their message indexes, possibly bare messages), `DataEnd`, summary and footer;
//! the walk ends with the data section. A record is believed if its length agrees with what it holds; where one is not, the walk
//! goes on at the next chunk that agrees with itself. Nothing is allocated before its length is checked against its limit and
//! against the file.

use std::{
    fs::File,
    io::{self, BufReader, Read, Seek},
    path::Path,
};

use mcap::{
    MAGIC, McapError,
    records::{Record, op},
};

use crate::{
    chunk::{Chunk, HEAD, MAX_CHUNK_BYTES, MAX_CHUNK_HEAD},
    error::{RecordingError, io_error},
};

/// The largest record of another kind that is read.
const MAX_RECORD_BYTES: u64 = 1 << 20;

/// One step of the walk; offsets are those of the record in the file.
#[derive(Debug)]
pub enum Piece {
    /// A chunk whose lengths agree; its contents are not looked at yet.
    Chunk(Chunk),
    /// Another record of the data section.
    Record {
        /// What it is.
        opcode: u8,
        /// Where it begins.
        offset: u64,
        /// Its contents, without opcode and length.
        body: Vec<u8>,
    },
    /// A record that holds no messages, and is not read: an attachment, or one of a private kind.
    PassedOver,
    /// Bytes that are no records.
    Gap {
        /// Where they begin.
        offset: u64,
        /// How many there are.
        length: u64,
        /// What was found there.
        what: String,
    },
    /// The end of the data section.
    DataEnd {
        /// Where the record begins.
        offset: u64,
        /// The data's checksum as the record has it; 0 for none.
        saved_crc: u32,
    },
    /// Nothing whole follows.
    Torn {
        /// Where what is torn begins.
        offset: u64,
        /// What was found there.
        what: String,
    },
}

/// A walk through one file.
pub struct Walk {
    file: BufReader<File>,
    length: u64,
    /// Where the next record begins.
    offset: u64,
    ended: bool,
}

impl Walk {
    /// A walk from the first record of a file on.
    ///
    /// # Errors
    /// If the file cannot be read, or does not begin as an MCAP file does.
    pub fn open(path: &Path) -> Result<Self, RecordingError> {
        let file = File::open(path).map_err(io_error(path))?;
        let length = file.metadata().map_err(io_error(path))?.len();
        let mut file = BufReader::with_capacity(1 << 18, file);
        let mut magic = [0; MAGIC.len()];
        if length < MAGIC.len() as u64 {
            return Err(RecordingError::invalid(
                path,
                format!("{length} bytes, too few for an MCAP file"),
            ));
        }
        file.read_exact(&mut magic).map_err(io_error(path))?;
        if magic != *MAGIC {
            return Err(RecordingError::invalid(
                path,
                "not an MCAP file: it begins with other bytes",
            ));
        }
        Ok(Walk {
            file,
            length,
            offset: MAGIC.len() as u64,
            ended: false,
        })
    }

    /// Bytes of the file.
    pub fn file_length(&self) -> u64 {
        self.length
    }

    /// The next piece; `None` after the end.
    ///
    /// # Errors
    /// If the file cannot be read.
    pub fn next(&mut self) -> io::Result<Option<Piece>> {
        if self.ended {
            return Ok(None);
        }
        let offset = self.offset;
        let piece = match self.record(offset)? {
            Ok((piece, length)) => {
                self.offset = offset + length;
                piece
            }
            Err(what) => match self.next_chunk(offset + HEAD)? {
                Some(found) => {
                    self.offset = found;
                    Piece::Gap {
                        offset,
                        length: found - offset,
                        what,
                    }
                }
                None => Piece::Torn { offset, what },
            },
        };
        self.ended = matches!(piece, Piece::Torn { .. } | Piece::DataEnd { .. });
        Ok(Some(piece))
    }

    /// Reads the record at `offset`, with its length; or says why it is none.
    fn record(&mut self, offset: u64) -> io::Result<Result<(Piece, u64), String>> {
        let left = self.length - offset;
        if left < HEAD {
            return Ok(Err(format!("the file ends {left} bytes into a record")));
        }
        self.seek(offset)?;
        let mut head = [0; HEAD as usize];
        self.file.read_exact(&mut head)?;
        let [opcode, length @ ..] = head;
        let body = u64::from_le_bytes(length);
        if body > left - HEAD {
            return Ok(Err(format!(
                "a record of kind {opcode:02x} and {body} bytes, of which the file has {}",
                left - HEAD
            )));
        }
        let limit = match opcode {
            op::CHUNK | op::MESSAGE => MAX_CHUNK_BYTES,
            op::HEADER | op::SCHEMA | op::CHANNEL | op::MESSAGE_INDEX | op::DATA_END => {
                MAX_RECORD_BYTES
            }
            op::ATTACHMENT | op::METADATA | 0x80.. => {
                return Ok(Ok((Piece::PassedOver, HEAD + body)));
            }
            other => return Ok(Err(format!("no record of the data is of kind {other:02x}"))),
        };
        if body > limit {
            return Ok(Err(format!(
                "a record of kind {opcode:02x} and {body} bytes, must be at most {limit}"
            )));
        }
        let mut bytes = vec![0; body as usize];
        self.file.read_exact(&mut bytes)?;
        Ok(understood(opcode, offset, bytes).map(|piece| (piece, HEAD + body)))
    }

    /// Where the next chunk begins that agrees with itself, from `offset` on.
    fn next_chunk(&mut self, offset: u64) -> io::Result<Option<u64>> {
        const STEP: usize = 1 << 16;
        let mut at = offset;
        while at < self.length {
            self.seek(at)?;
            let mut window = Vec::with_capacity(STEP + MAX_CHUNK_HEAD);
            (&mut self.file)
                .take((STEP + MAX_CHUNK_HEAD) as u64)
                .read_to_end(&mut window)?;
            for start in 0..window.len().min(STEP) {
                let left = self.length - at - start as u64;
                if Chunk::begins(&window[start..], left) {
                    return Ok(Some(at + start as u64));
                }
            }
            at += STEP as u64;
        }
        Ok(None)
    }

    /// Goes to an offset, within the buffer where that is possible.
    fn seek(&mut self, offset: u64) -> io::Result<()> {
        let here = self.file.stream_position()?;
        self.file.seek_relative(offset as i64 - here as i64)
    }
}

/// A record whose length agrees with what it holds.
fn understood(opcode: u8, offset: u64, body: Vec<u8>) -> Result<Piece, String> {
    let parsed = mcap::parse_record(opcode, &body).map_err(|error| describe(opcode, &error))?;
    match parsed {
        Record::Chunk { header, data } => {
            Chunk::new(offset, body.len(), header, data.into_owned()).map(Piece::Chunk)
        }
        Record::DataEnd(end) if body.len() == 4 => Ok(Piece::DataEnd {
            offset,
            saved_crc: end.data_section_crc,
        }),
        Record::DataEnd(_) => Err(format!(
            "a record of the data's end of {} bytes",
            body.len()
        )),
        Record::MessageIndex(index) if body.len() != 6 + 16 * index.records.len() => Err(format!(
            "an index of {} messages in {} bytes",
            index.records.len(),
            body.len()
        )),
        _ => Ok(Piece::Record {
            opcode,
            offset,
            body,
        }),
    }
}

fn describe(opcode: u8, error: &McapError) -> String {
    format!("a record of kind {opcode:02x} that is damaged: {error}")
}
