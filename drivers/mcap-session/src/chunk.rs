//! One chunk as it lies in a file: whether its lengths agree, and its records, decompressed and checked.

use std::io::Read;

use mcap::records::{ChunkHeader, op};

/// Opcode and length of any record.
pub const HEAD: u64 = 9;
/// The largest chunk, compressed or not, and the largest message outside of one: twice the largest image.
pub const MAX_CHUNK_BYTES: u64 = 128 << 20;
/// Start and end time, size, checksum, length of the compression's name, compressed size.
const CHUNK_HEADER: usize = 8 + 8 + 8 + 4 + 4 + 8;
/// A compression of other programs.
const LZ4: &str = "lz4";
/// The longest name of a compression that is looked for among bytes that are no records.
const MAX_COMPRESSION_NAME: usize = 4;
/// So many bytes are enough for [`Chunk::begins`].
pub const MAX_CHUNK_HEAD: usize = HEAD as usize + CHUNK_HEADER + MAX_COMPRESSION_NAME;

/// Says of a chunk that it is passed by as it is.
pub fn not_read(what: &str) -> String {
    format!("a chunk is not read: {what}")
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
    /// The chunk of a record whose contents have `n_bytes`.
    ///
    /// # Errors
    /// Which lengths do not agree.
    pub fn new(
        offset: u64,
        n_bytes: usize,
        header: ChunkHeader,
        data: Vec<u8>,
    ) -> Result<Self, String> {
        let start = CHUNK_HEADER + header.compression.len();
        if start as u64 + header.compressed_size != n_bytes as u64 {
            return Err(format!(
                "a chunk of {} bytes that says it has {}",
                n_bytes - start.min(n_bytes),
                header.compressed_size
            ));
        }
        let chunk = Chunk {
            offset,
            length: HEAD + n_bytes as u64,
            header,
            data,
        };
        // Of lz4 nothing is known but the checksum of what is not unpacked here.
        let is_known = chunk.header.compression != LZ4;
        match chunk.is_too_large() && is_known && !chunk.streams_whole() {
            true => Err(format!("a chunk of {}", chunk.size_and_limit())),
            false => Ok(chunk),
        }
    }

    /// Why its records are not read though it may well be whole; `None` for one that is read.
    pub fn unread(&self) -> Option<String> {
        match self.header.compression.as_str() {
            LZ4 => Some(format!("compression \"{LZ4}\", must be zstd or none")),
            _ => self.is_too_large().then(|| self.size_and_limit()),
        }
    }

    fn is_too_large(&self) -> bool {
        self.header.uncompressed_size > MAX_CHUNK_BYTES
    }

    fn size_and_limit(&self) -> String {
        let size = self.header.uncompressed_size;
        format!("{size} bytes when decompressed, must be at most {MAX_CHUNK_BYTES}")
    }

    /// Whether it decompresses to as many bytes as it says, of the checksum that it says; none of them are kept.
    fn streams_whole(&self) -> bool {
        let Ok(decoder) = zstd::Decoder::new(self.data.as_slice()) else {
            return false;
        };
        let mut left = decoder.take(self.header.uncompressed_size.saturating_add(1));
        let (mut size, mut hash) = (0, crc32fast::Hasher::new());
        let mut bytes = vec![0; 1 << 16];
        loop {
            match left.read(&mut bytes) {
                Ok(0) => break,
                Ok(n) => {
                    hash.update(&bytes[..n]);
                    size += n as u64;
                }
                Err(_) => return false,
            }
        }
        let saved = self.header.uncompressed_crc;
        size == self.header.uncompressed_size && (saved == 0 || hash.finalize() == saved)
    }

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

    /// Whether bytes begin a chunk of at most `left` bytes whose lengths agree, be it read or not; sixty bits or more must be right by
    /// chance otherwise.
    pub fn begins(bytes: &[u8], left: u64) -> bool {
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
        let (Some(body), Some(name)) = (number(1), compression(37)) else {
            return false;
        };
        let Some(compressed) = number(41 + name.len()) else {
            return false;
        };
        let header = (CHUNK_HEADER + name.len()) as u64;
        body <= left.saturating_sub(HEAD)
            && compressed.checked_add(header) == Some(body)
            && (matches!(name, b"" | b"zstd") || name == LZ4.as_bytes())
    }
}
