//! The end of a file behind its data: whether checksums, summary and footer agree with it.

use std::{
    fs::File,
    io::{self, Read, Seek, SeekFrom},
    path::Path,
};

use mcap::{
    MAGIC,
    records::{Record, op},
};

use crate::chunk::HEAD;

/// `DataEnd` with its checksum, and the footer with its two offsets and checksum.
const DATA_END: u64 = HEAD + 4;
const FOOTER: u64 = HEAD + 20;
/// A summary of more is none of ours.
const MAX_SUMMARY_BYTES: u64 = 256 << 20;

/// What is wrong with a file behind its data, if anything is: checksums, summary, footer.
pub fn check_ending(path: &Path, data_end: u64, saved_crc: u32) -> io::Result<Option<String>> {
    let mut file = File::open(path)?;
    let length = file.metadata()?.len();
    let summary_start = data_end + DATA_END;
    let tail = length.saturating_sub(summary_start);
    if tail < FOOTER + MAGIC.len() as u64 {
        return Ok(Some("the file ends before its footer".to_owned()));
    }
    if tail > MAX_SUMMARY_BYTES {
        return Ok(Some(format!(
            "{tail} bytes follow the data, must be at most {MAX_SUMMARY_BYTES}"
        )));
    }
    file.seek(SeekFrom::Start(summary_start))?;
    let mut bytes = Vec::with_capacity(tail as usize);
    file.read_to_end(&mut bytes)?;
    let Some((records, magic)) = bytes.split_last_chunk::<{ MAGIC.len() }>() else {
        return Ok(Some("the file ends before its footer".to_owned()));
    };
    if magic != MAGIC {
        return Ok(Some(
            "the file ends in other bytes than it should".to_owned(),
        ));
    }
    let (summary, footer) = records.split_at(records.len() - FOOTER as usize);
    let (head, body) = footer.split_at(HEAD as usize);
    let footer = match mcap::parse_record(op::FOOTER, body) {
        Ok(Record::Footer(footer)) if head == [op::FOOTER, 20, 0, 0, 0, 0, 0, 0, 0] => footer,
        _ => return Ok(Some("there is no footer where it should be".to_owned())),
    };
    let expected_start = if summary.is_empty() { 0 } else { summary_start };
    if footer.summary_start != expected_start {
        return Ok(Some(format!(
            "the footer looks for a summary at {}, must be {expected_start}",
            footer.summary_start
        )));
    }
    let found = crc32fast::hash(&records[..records.len() - 4]);
    if footer.summary_crc != 0 && footer.summary_crc != found {
        return Ok(Some(format!(
            "checksum {found:08x} of the summary, must be {:08x}",
            footer.summary_crc
        )));
    }
    let found = data_checksum(&mut file, data_end)?;
    Ok((saved_crc != 0 && found != saved_crc)
        .then(|| format!("checksum {found:08x} of the data, must be {saved_crc:08x}")))
}

/// The checksum of a file's first bytes.
///
/// # Errors
/// What the system says.
pub fn data_checksum(file: &mut File, end: u64) -> io::Result<u32> {
    file.seek(SeekFrom::Start(0))?;
    let mut data = file.take(end);
    let mut buffer = vec![0; 1 << 18];
    let mut hasher = crc32fast::Hasher::new();
    loop {
        match data.read(&mut buffer)? {
            0 => return Ok(hasher.finalize()),
            n => hasher.update(&buffer[..n]),
        }
    }
}
