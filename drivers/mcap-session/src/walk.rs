//! From record to record through an MCAP file, past whatever is damaged.
//!
//! The file is data section (header, chunks with their message indexes, possibly bare messages), `DataEnd`, summary and footer;
//! the walk ends with the data section. A record is believed if its length agrees with what it holds; where one is not, the walk
//! goes on at the next chunk that agrees with itself. Nothing is allocated before its length is checked against its limit and
//! against the file.
//!
//! Repair writes the checksum of all data anew, so that whatever is believed then is believed for ever. In a recording of Relief
//! only that is believed what something else vouches for: chunks by their checksums, indexes by their chunks, the header by what
//! it must say. A record of any other kind was something else before it was damaged: a single bit lies between an index and a
//! message, which has no checksum of its own.

use std::{
    fs::File,
    io::{self, BufReader, Read, Seek},
    path::Path,
};

use mcap::{
    MAGIC, McapError,
    records::{Header, Record, op},
};

use crate::{
    chunk::{Chunk, HEAD, MAX_CHUNK_BYTES, MAX_CHUNK_HEAD},
    error::{RecordingError, io_error},
    folder::is_segment,
    segment::{LIBRARY, PROFILE},
};

/// The largest record of another kind that is read.
const MAX_RECORD_BYTES: u64 = 1 << 20;

/// What damaged records of a recording of Relief become, for readers to pass over: the specification leaves the kinds from 0x80 on
/// to applications.
pub const PASSED_OVER: u8 = 0x80;

/// One step of the walk; offsets are those of the record in the file.
#[derive(Debug)]
pub enum Piece {
    /// A chunk whose lengths agree; its contents are not looked at yet.
    Chunk(Chunk),
    /// A chunk that may well be whole, and is not read here.
    Unread {
        /// Where the record begins.
        offset: u64,
        /// Why it is not read.
        what: String,
    },
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
    /// Whether it belongs to a recording of Relief.
    is_own: bool,
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
            is_own: is_segment(path),
            ended: false,
        })
    }

    /// Whether the file belongs to a recording of Relief, whatever it says itself.
    pub fn is_own(&self) -> bool {
        self.is_own
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
            Err(what) => match self.next_chunk(offset + HEAD, self.length)? {
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
        let [opcode, length @ ..] = self.head()?;
        let body = u64::from_le_bytes(length);
        if body > left - HEAD {
            return Ok(Err(format!(
                "a record of kind {opcode:02x} and {body} bytes, of which the file has {}",
                left - HEAD
            )));
        }
        if self.is_own && !is_written(opcode, offset) {
            return Ok(Err(format!(
                "a record of kind {opcode:02x}, which no recording of Relief has there"
            )));
        }
        let limit = match opcode {
            op::CHUNK | op::MESSAGE => MAX_CHUNK_BYTES,
            op::HEADER | op::SCHEMA | op::CHANNEL | op::MESSAGE_INDEX | op::DATA_END => {
                MAX_RECORD_BYTES
            }
            PASSED_OVER if self.is_own && !self.is_passed_over(offset + HEAD, body)? => {
                return Ok(Err(format!(
                    "{body} bytes to pass over, with a whole chunk among them or no record behind them"
                )));
            }
            op::ATTACHMENT | op::METADATA | 0x80.. => {
                return Ok(Ok((Piece::PassedOver, HEAD + body)));
            }
            other => return Ok(Err(format!("no record of the data is of kind {other:02x}"))),
        };
        if opcode == op::CHUNK && body > limit && self.begins_chunk(offset)? {
            let what = format!("{body} bytes, must be at most {limit}");
            return Ok(Ok((Piece::Unread { offset, what }, HEAD + body)));
        }
        if body > limit {
            return Ok(Err(format!(
                "a record of kind {opcode:02x} and {body} bytes, must be at most {limit}"
            )));
        }
        let mut bytes = vec![0; body as usize];
        self.file.read_exact(&mut bytes)?;
        let understood = self.understood(opcode, offset, bytes);
        Ok(understood.map(|piece| (piece, HEAD + body)))
    }

    /// A record whose length agrees with what it holds.
    fn understood(&self, opcode: u8, offset: u64, body: Vec<u8>) -> Result<Piece, String> {
        let parsed = mcap::parse_record(opcode, &body).map_err(|error| describe(opcode, &error))?;
        match parsed {
            Record::Chunk { header, data } => {
                let chunk = Chunk::new(offset, body.len(), header, data.into_owned())?;
                Ok(match chunk.unread() {
                    Some(what) => Piece::Unread { offset, what },
                    None => Piece::Chunk(chunk),
                })
            }
            Record::Header(header) if self.is_own && !is_own_header(&header, body.len()) => {
                Err(format!(
                    "a header of profile \"{}\" and library \"{}\", which Relief does not write",
                    header.profile, header.library
                ))
            }
            Record::DataEnd(end) if body.len() == 4 => Ok(Piece::DataEnd {
                offset,
                saved_crc: end.data_section_crc,
            }),
            Record::DataEnd(_) => Err(format!(
                "a record of the data's end of {} bytes",
                body.len()
            )),
            Record::MessageIndex(index) if body.len() != 6 + 16 * index.records.len() => {
                Err(format!(
                    "an index of {} messages in {} bytes",
                    index.records.len(),
                    body.len()
                ))
            }
            _ => Ok(Piece::Record {
                opcode,
                offset,
                body,
            }),
        }
    }

    /// Goes on behind a record whose contents are damaged; the bytes that are lost with it. Its length is not believed if it reaches
    /// into a chunk that is whole, or does not reach up to a record: bytes are missing then, or too many.
    ///
    /// # Errors
    /// If the file cannot be read.
    pub fn reject(&mut self, offset: u64, length: u64) -> io::Result<u64> {
        let start = offset + HEAD;
        let next = match self.is_own && !self.is_passed_over(start, length - HEAD)? {
            true => self.next_chunk(start, self.length)?,
            false => None,
        };
        self.offset = next.unwrap_or(offset + length);
        Ok(self.offset - offset)
    }

    /// Whether so many bytes from `start` on can be what repair passes over: no chunk that is whole, up to a record.
    fn is_passed_over(&mut self, start: u64, n_bytes: u64) -> io::Result<bool> {
        let end = start + n_bytes;
        let mut at = start;
        while let Some(found) = self.next_chunk(at, end)? {
            at = match self.record(found)? {
                Ok((Piece::Chunk(chunk), length)) if chunk.records().is_err() => found + length,
                Ok((Piece::Chunk(_) | Piece::Unread { .. }, _)) => return Ok(false),
                _ => found + HEAD,
            };
        }
        let left = self.length - end;
        if left < HEAD {
            return Ok(true);
        }
        self.seek(end)?;
        let [opcode, length @ ..] = self.head()?;
        Ok(is_written(opcode, end) && u64::from_le_bytes(length) <= left - HEAD)
    }

    /// Whether the lengths of a chunk agree that is said to begin at `offset`.
    fn begins_chunk(&mut self, offset: u64) -> io::Result<bool> {
        self.seek(offset)?;
        let mut head = Vec::with_capacity(MAX_CHUNK_HEAD);
        let file = &mut self.file;
        file.take(MAX_CHUNK_HEAD as u64).read_to_end(&mut head)?;
        Ok(Chunk::begins(&head, self.length - offset))
    }

    /// Opcode and length of the record that follows.
    fn head(&mut self) -> io::Result<[u8; HEAD as usize]> {
        let mut head = [0; HEAD as usize];
        self.file.read_exact(&mut head).map(|()| head)
    }

    /// Where the first chunk that agrees with itself begins, from `offset` on and before `end`.
    fn next_chunk(&mut self, offset: u64, end: u64) -> io::Result<Option<u64>> {
        const STEP: usize = 1 << 16;
        let mut at = offset;
        while at < end {
            self.seek(at)?;
            let mut window = Vec::with_capacity(STEP + MAX_CHUNK_HEAD);
            (&mut self.file)
                .take((STEP + MAX_CHUNK_HEAD) as u64)
                .read_to_end(&mut window)?;
            for start in 0..window.len().min(STEP).min((end - at) as usize) {
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

/// Whether a recording of Relief has records of that kind there.
fn is_written(opcode: u8, offset: u64) -> bool {
    match opcode {
        op::HEADER => offset == MAGIC.len() as u64,
        op::CHUNK | op::MESSAGE_INDEX | op::DATA_END | PASSED_OVER => true,
        _ => false,
    }
}

/// Whether a header of so many bytes is one that Relief writes, which nothing but its own words vouches for.
fn is_own_header(header: &Header, n_bytes: usize) -> bool {
    let lengths = 2 * size_of::<u32>();
    header.profile == PROFILE
        && header.library.starts_with(LIBRARY)
        && n_bytes == lengths + header.profile.len() + header.library.len()
}

fn describe(opcode: u8, error: &McapError) -> String {
    format!("a record of kind {opcode:02x} that is damaged: {error}")
}
