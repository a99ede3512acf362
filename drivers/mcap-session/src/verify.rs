//! Looks whether a recording is whole, without changing it.

use std::path::{Path, PathBuf};

use crate::{error::RecordingError, folder, scan::scan, segment::SegmentSummary};

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

/// Reads every byte of a recording or bag: lengths, checksums, indexes, summaries.
///
/// # Errors
/// If there is no file, or the system refuses to read one.
pub fn verify(path: &Path) -> Result<Vec<FileReport>, RecordingError> {
    folder::files(path)?
        .into_iter()
        .map(|path| file_report(&path))
        .collect()
}

fn file_report(path: &Path) -> Result<FileReport, RecordingError> {
    let scan = match scan(path) {
        Ok(scan) => scan,
        Err(RecordingError::Invalid { what, .. }) => {
            return Ok(FileReport {
                path: path.to_owned(),
                n_bytes: path.metadata().map_or(0, |metadata| metadata.len()),
                n_frames: 0,
                summary: SegmentSummary::default(),
                problems: vec![what],
            });
        }
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
