//! Mends a recording whose process died, or whose bytes are damaged, in place.
//!
//! What is torn at the end is cut off behind the last whole record; damaged records become records of a private kind, which
//! readers pass over; checksum, summary and footer are written anew. Chunks that are whole are not moved, and none of their
//! bytes change, so that a repair that is itself interrupted is simply done again.

use std::{
    fs::{File, OpenOptions},
    io::{self, Seek, SeekFrom, Write},
    os::unix::fs::FileExt,
    path::{Path, PathBuf},
};

use mcap::MAGIC;

use crate::{
    bag_metadata,
    chunk::HEAD,
    ending::data_checksum,
    error::{RecordingError, io_error},
    folder::{recordings_in, segments},
    open_lock::OpenLock,
    scan::{Mend, Scan, scan},
    segment::{Segment, SegmentSummary},
    session::{Counters, RepairNote, SessionRecord, State},
    summary,
    verify::{FileReport, verify},
    walk::PASSED_OVER,
};

/// What the repair of one segment did.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct SegmentRepair {
    /// Frames of which an image is whole.
    pub n_frames: u64,
    /// Bytes cut off at the end.
    pub bytes_cut: u64,
    /// Bytes of damaged records in between.
    pub bytes_passed_over: u64,
    /// Whether anything was to be done.
    pub was_damaged: bool,
    /// What the segment holds now.
    pub summary: SegmentSummary,
}

/// Mends a recording that was left open or damaged; `None` if there was nothing to do.
///
/// # Errors
/// [`RecordingError::InUse`] while it is being recorded; what the system says, or what is wrong with its `session.json`;
/// [`RecordingError::Invalid`] for a segment with a chunk that is not read here, which is left as it is.
pub fn repair(folder: &Path) -> Result<Option<RepairNote>, RecordingError> {
    let record = SessionRecord::read(folder)?;
    let (mut lock, n_given) = OpenLock::take_over(folder)?;
    match record.state {
        State::Open => mend(folder, record, &mut lock, n_given).map(|mended| mended.repair),
        State::Closed | State::Repaired => {
            let is_whole = |report: &FileReport| report.problems.is_empty();
            match verify(folder).is_ok_and(|reports| reports.iter().all(is_whole)) {
                true => lock.remove().map(|()| None),
                false => mend(folder, record, &mut lock, None).map(|mended| mended.repair),
            }
        }
    }
}

/// What the repair of a recording came to.
pub type Repaired = (PathBuf, Result<Option<RepairNote>, RecordingError>);

/// All recordings in a folder and beneath it that were left open by a process that is gone, or cannot tell.
///
/// # Errors
/// If the folder cannot be read.
pub fn abandoned_in(folder: &Path) -> Result<Vec<PathBuf>, RecordingError> {
    let mut recordings = recordings_in(folder)?;
    recordings.retain(|path| is_abandoned(path).unwrap_or(true));
    Ok(recordings)
}

/// Mends those recordings, each with what was found.
///
/// # Errors
/// If the folder cannot be read.
pub fn repair_abandoned(folder: &Path) -> Result<Vec<Repaired>, RecordingError> {
    let abandoned = abandoned_in(folder)?.into_iter();
    Ok(abandoned
        .map(|path| {
            let repaired = repair(&path);
            (path, repaired)
        })
        .collect())
}

/// Mends a recording that this process holds, after a failure to write; what it then is.
pub(crate) fn repair_held(
    folder: &Path,
    lock: &mut OpenLock,
) -> Result<SessionRecord, RecordingError> {
    let n_given = lock.n_frames();
    lock.release_reserve();
    mend(folder, SessionRecord::read(folder)?, lock, Some(n_given))
}

/// Whether a recording was left open by a process that is gone.
///
/// # Errors
/// If its `session.json` cannot be read.
pub(crate) fn is_abandoned(folder: &Path) -> Result<bool, RecordingError> {
    let record = SessionRecord::read(folder)?;
    Ok(record.state == State::Open && !OpenLock::is_held(folder))
}

fn mend(
    folder: &Path,
    mut record: SessionRecord,
    lock: &mut OpenLock,
    n_given: Option<u64>,
) -> Result<SessionRecord, RecordingError> {
    let mut note = RepairNote::default();
    let mut counters = Counters::default();
    let mut bag = Vec::new();
    for path in segments(folder) {
        let repaired = repair_segment(&path, &record.serial)?;
        note.frames_recovered += repaired.n_frames;
        note.bytes_cut += repaired.bytes_cut;
        note.bytes_passed_over += repaired.bytes_passed_over;
        counters.bytes += path.metadata().map_err(io_error(&path))?.len();
        counters.add(&repaired.summary);
        let name = path.file_name().unwrap_or_default().to_string_lossy();
        bag.push((name.into_owned(), repaired.summary));
    }
    counters.frames = note.frames_recovered;
    note.frames_lost = n_given
        .or((record.state != State::Open).then_some(record.counters.frames))
        .map(|given| given.saturating_sub(note.frames_recovered));
    bag_metadata::write(folder, &bag)?;
    record.state = State::Repaired;
    record.counters = counters;
    record.repair = Some(note);
    record.write(folder)?;
    lock.remove()?;
    Ok(record)
}

/// Mends one segment of a recording of that device.
///
/// # Errors
/// What the system says, and for a chunk that is not read here; nothing but the file's first bytes has been mended then.
pub fn repair_segment(path: &Path, serial: &str) -> Result<SegmentRepair, RecordingError> {
    let file = OpenOptions::new().read(true).write(true).open(path);
    let mut file = file.map_err(io_error(path))?;
    let length = file.metadata().map_err(io_error(path))?.len();
    let magic_mended = mend_magic(&file, length).map_err(io_error(path))?;
    let scanned = match length > MAGIC.len() as u64 {
        true => scan(path)?,
        false => Scan::default(),
    };
    if scanned.is_whole() && scanned.has_header() && !magic_mended {
        return Ok(SegmentRepair {
            n_frames: scanned.n_frames,
            summary: scanned.summary,
            ..SegmentRepair::default()
        });
    }
    if scanned.chunks.is_empty() && scanned.n_frames == 0 {
        begin_anew(&mut file, serial).map_err(io_error(path))?;
        return Ok(SegmentRepair {
            bytes_cut: length,
            was_damaged: true,
            ..SegmentRepair::default()
        });
    }
    let bytes_passed_over = apply(&mut file, &scanned).map_err(io_error(path))?;
    Ok(SegmentRepair {
        n_frames: scanned.n_frames,
        bytes_cut: scanned.file_length - scanned.end_of_data,
        bytes_passed_over,
        was_damaged: true,
        summary: scanned.summary,
    })
}

/// Restores the first bytes of a file that is long enough to hold more.
fn mend_magic(file: &File, length: u64) -> io::Result<bool> {
    let mut magic = [0; MAGIC.len()];
    if length <= magic.len() as u64 {
        return Ok(false);
    }
    file.read_exact_at(&mut magic, 0)?;
    if magic == *MAGIC {
        return Ok(false);
    }
    file.write_all_at(MAGIC, 0)?;
    Ok(true)
}

/// Makes an empty segment of a file that holds nothing whole.
fn begin_anew(file: &mut File, serial: &str) -> io::Result<()> {
    file.set_len(0)?;
    file.seek(SeekFrom::Start(0))?;
    Segment::create(&mut *file, serial)?.finish()?;
    file.sync_all()
}

/// Mends what is damaged, cuts what is torn, and ends the file; bytes that readers now pass over.
fn apply(file: &mut File, scan: &Scan) -> io::Result<u64> {
    let mut bytes_passed_over = 0;
    for damage in &scan.damages {
        match damage.mend {
            Mend::PassOver { length } => {
                let mut head = vec![PASSED_OVER];
                head.extend((length - HEAD).to_le_bytes());
                file.write_all_at(&head, damage.offset)?;
                bytes_passed_over += length;
            }
            Mend::Times(start, end) => {
                let times = [start.to_le_bytes(), end.to_le_bytes()].concat();
                file.write_all_at(&times, damage.offset + HEAD)?;
            }
        }
    }
    if !scan.has_header() {
        restore_header(file, scan)?;
    }
    file.set_len(scan.end_of_data)?;
    let data_crc = data_checksum(file, scan.end_of_data)?;
    file.seek(SeekFrom::Start(scan.end_of_data))?;
    file.write_all(&summary::ending(scan, data_crc))?;
    file.sync_all().map(|()| bytes_passed_over)
}

/// Writes a header over the first record, if that is what is damaged; its library's name is padded to the same length.
fn restore_header(file: &File, scan: &Scan) -> io::Result<()> {
    let first = MAGIC.len() as u64;
    let lost = scan.damages.iter().find(|damage| damage.offset == first);
    let Some(Mend::PassOver { length }) = lost.map(|damage| damage.mend) else {
        return Ok(());
    };
    summary::header(length).map_or(Ok(()), |header| file.write_all_at(&header, first))
}
