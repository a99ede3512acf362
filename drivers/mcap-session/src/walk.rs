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
    records::{ChunkHeader, Record, op},
};

use crate::error::{RecordingError, io_error};

/// The largest chunk, compressed or not, and the largest message outside of one: twice the largest image.
pub const MAX_CHUNK_BYTES: u64 = 128 << 20;
/// The largest record of another kind that is read.
const MAX_RECORD_BYTES: u64 = 1 << 20;
/// Opcode and length.
pub const HEAD: u64 = 9;
/// Start and end time, size, checksum, length of the compression's name, compressed size.
const CHUNK_HEADER: usize = 8 + 8 + 8 + 4 + 4 + 8;
/// The longest name of a compression that is looked for when the walk has lost its way.
const MAX_COMPRESSION_NAME: usize = 4;

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

/// A chunk as it lies in the file.
#[derive(Debug)]
pub struct Chunk {
    /// Where the record begins.
    pub offset: u64,
    /// Bytes of the record, with opcode and length.
    pub length: u64,
    /// What it says of itself.
    pub header: ChunkHeader,
    data: Vec<u8>,
}

impl Chunk {
    /// The records in the chunk, decompressed and checked.
    ///
    /// # Errors
    /// What is wrong with them.
    pub fn records(&self) -> Result<Vec<u8>, String> {
        let size = self.header.uncompressed_size as usize;
        let records = match self.header.compression.as_str() {
            "" => self.data.clone(),
            "zstd" => {
                zstd::bulk::decompress(&self.data, size).map_err(|error| error.to_string())?
            }
            other => {
                return Err(format!(
                    "compression \"{other}\" is not read, must be zstd or none"
                ));
            }
        };
        if records.len() != size {
            return Err(format!("{} bytes, must be {size}", records.len()));
        }
        let saved = self.header.uncompressed_crc;
        let found = crc32fast::hash(&records);
        if saved != 0 && found != saved {
            return Err(format!("checksum {found:08x}, must be {saved:08x}"));
        }
        Ok(records)
    }
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
        let head = HEAD as usize + CHUNK_HEADER + MAX_COMPRESSION_NAME;
        let mut at = offset;
        while at < self.length {
            self.seek(at)?;
            let mut window = Vec::with_capacity(STEP + head);
            (&mut self.file)
                .take((STEP + head) as u64)
                .read_to_end(&mut window)?;
            for start in 0..window.len().min(STEP) {
                let left = self.length - at - start as u64;
                if is_chunk(&window[start..], left) {
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
    if opcode == op::CHUNK {
        return chunk(offset, body).map(Piece::Chunk);
    }
    let parsed = mcap::parse_record(opcode, &body).map_err(|error| describe(opcode, &error))?;
    match parsed {
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

fn chunk(offset: u64, body: Vec<u8>) -> Result<Chunk, String> {
    let length = HEAD + body.len() as u64;
    let parsed =
        mcap::parse_record(op::CHUNK, &body).map_err(|error| describe(op::CHUNK, &error))?;
    let Record::Chunk { header, data } = parsed else {
        return Err("not a chunk".to_owned());
    };
    let start = CHUNK_HEADER + header.compression.len();
    if start as u64 + header.compressed_size != body.len() as u64 {
        return Err(format!(
            "a chunk of {} bytes that says it has {}",
            body.len() - start.min(body.len()),
            header.compressed_size
        ));
    }
    if header.uncompressed_size > MAX_CHUNK_BYTES {
        return Err(format!(
            "a chunk of {} bytes when decompressed, must be at most {MAX_CHUNK_BYTES}",
            header.uncompressed_size
        ));
    }
    let data = data.into_owned();
    Ok(Chunk {
        offset,
        length,
        header,
        data,
    })
}

fn describe(opcode: u8, error: &McapError) -> String {
    format!("a record of kind {opcode:02x} that is damaged: {error}")
}

/// Whether bytes begin a chunk of at most `left` bytes whose lengths agree; sixty bits or more must be right by chance otherwise.
fn is_chunk(bytes: &[u8], left: u64) -> bool {
    if bytes.first() != Some(&op::CHUNK) {
        return false;
    }
    let number = |at: usize| {
        let bytes = bytes.get(at..at + 8)?;
        Some(u64::from_le_bytes(std::array::from_fn(|k| bytes[k])))
    };
    let compression = |at: usize| {
        let length = bytes.get(at..at + 4)?;
        let length = u32::from_le_bytes(std::array::from_fn(|k| length[k])) as usize;
        match length <= MAX_COMPRESSION_NAME {
            true => bytes.get(at + 4..at + 4 + length),
            false => None,
        }
    };
    let (Some(body), Some(uncompressed), Some(name)) = (number(1), number(25), compression(37))
    else {
        return false;
    };
    let Some(compressed) = number(41 + name.len()) else {
        return false;
    };
    let header = (CHUNK_HEADER + name.len()) as u64;
    let fits = body <= left.saturating_sub(HEAD)
        && body <= MAX_CHUNK_BYTES
        && uncompressed <= MAX_CHUNK_BYTES;
    fits && compressed.checked_add(header) == Some(body) && matches!(name, b"" | b"zstd" | b"lz4")
}
