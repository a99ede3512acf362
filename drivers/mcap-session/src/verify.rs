//! Looks whether a recording is whole, without changing it.

use std::path::{Path, PathBuf};

use crate::{
    error::RecordingError,
    folder,
    scan::scan,
    segment::SegmentSummary,
    session::{self, Counters, SessionRecord, State},
};

/// What one file of a recording holds.
#[derive(Clone, Debug, PartialEq)]
pub struct FileReport {
    /// The file.
    pub path: PathBuf,
    /// Its bytes.
    pub n_bytes: u64,
    /// Frames of which an image is whole.
    pub n_frames: u64,
    /// Messages by topic.
    pub summary: SegmentSummary,
    /// What is wrong with it, in sentences; empty for a file that is whole.
    pub problems: Vec<String>,
}

/// Reads every byte of a recording or bag: lengths, checksums, indexes, summaries; and in a recording that was ended whether all
/// is there that `session.json` counts, which is reported on if it is not.
///
/// # Errors
/// If there is no file, or the system refuses to read one.
pub fn verify(path: &Path) -> Result<Vec<FileReport>, RecordingError> {
    let files = folder::files(path)?.into_iter();
    let reports: Result<Vec<FileReport>, _> = files.map(|path| file_report(&path)).collect();
    let mut reports = reports?;
    if path.join(session::FILE_NAME).is_file() {
        reports.extend(record_report(path, &reports)?);
    }
    Ok(reports)
}

/// What is wrong with what a recording says of itself, if anything is.
fn record_report(
    folder: &Path,
    segments: &[FileReport],
) -> Result<Option<FileReport>, RecordingError> {
    let problem = match SessionRecord::read(folder) {
        Ok(record) if record.state == State::Open => None,
        Ok(record) => {
            let mut found = Counters::default();
            segments.iter().for_each(|file| found.add(&file.summary));
            record.counters.disagreement(&found)
        }
        Err(RecordingError::Invalid { what, .. }) => Some(what),
        Err(error) => return Err(error),
    };
    Ok(problem.map(|what| bad_file(&folder.join(session::FILE_NAME), what)))
}

/// The report of a file that says nothing but what is wrong with it.
fn bad_file(path: &Path, what: String) -> FileReport {
    FileReport {
        path: path.to_owned(),
        n_bytes: path.metadata().map_or(0, |metadata| metadata.len()),
        n_frames: 0,
        summary: SegmentSummary::default(),
        problems: vec![what],
    }
}

fn file_report(path: &Path) -> Result<FileReport, RecordingError> {
    let scan = match scan(path) {
        Ok(scan) => scan,
        Err(RecordingError::Invalid { what, .. }) => return Ok(bad_file(path, what)),
        Err(error) => return Err(error),
    };
    let damages = scan
        .damages
        .iter()
        .map(|damage| format!("{} bytes into it: {}", damage.offset, damage.what));
    Ok(FileReport {
        path: path.to_owned(),
        n_bytes: scan.file_length,
        n_frames: scan.n_frames,
        problems: damages.chain(scan.bad_ending.clone()).collect(),
        summary: scan.summary,
    })
}
