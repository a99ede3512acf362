//! The file of events: whole lines, in their order. What the disk refuses waits for the next time.

use super::Unrecorded;
use replay::WriteError;
use std::{
    fs::{File, OpenOptions},
    io::{self, Write},
    path::{Path, PathBuf},
};

/// The file of events in a scan's folder.
pub const EVENTS_FILE: &str = "events.jsonl";

/// Lines that wait for the disk, bytes at most: thousands of them; what comes beyond is lost.
const MAX_WAITING_BYTES: usize = 1 << 20;

/// [`EVENTS_FILE`], open.
pub(super) struct EventFile {
    path: PathBuf,
    file: File,
    /// Length of the lines that were written.
    n_bytes: u64,
    waiting: String,
    n_lost: usize,
    refusal: Option<String>,
    /// What the system said when it refused last.
    last_cause: Option<io::ErrorKind>,
}

impl EventFile {
    /// Creates the file in a folder.
    pub(super) fn create(folder: &Path) -> Result<Self, WriteError> {
        let path = folder.join(EVENTS_FILE);
        let created = OpenOptions::new().append(true).create_new(true).open(&path);
        match created {
            Ok(file) => Ok(EventFile {
                path,
                file,
                n_bytes: 0,
                waiting: String::new(),
                n_lost: 0,
                refusal: None,
                last_cause: None,
            }),
            Err(source) => Err(WriteError::Io { path, source }),
        }
    }

    /// Where it lies.
    pub(super) fn path(&self) -> &Path {
        &self.path
    }

    /// Why lines wait; `None` if none does.
    pub(super) fn refusal(&self) -> Option<&str> {
        self.refusal.as_deref()
    }

    /// Writes a line after those that wait.
    pub(super) fn push(&mut self, line: &str) {
        match self.waiting.len() + line.len() < MAX_WAITING_BYTES {
            true => {
                self.waiting.push_str(line);
                self.waiting.push('\n');
            }
            false => self.n_lost += 1,
        }
        self.write_waiting();
    }

    /// Writes the lines that wait, if the disk takes them now.
    pub(super) fn write_waiting(&mut self) {
        if self.waiting.is_empty() {
            return;
        }
        let path = self.path.display();
        // Whole lines by one call, so that a process that is killed leaves no half of one.
        match self.file.write_all(self.waiting.as_bytes()) {
            Ok(()) => {
                self.n_bytes += self.waiting.len() as u64;
                self.waiting.clear();
                if self.refusal.take().is_some() {
                    tracing::info!(%path, "events are written again");
                }
            }
            Err(error) => {
                // Of lines that found room in part nothing stays: they are written again as a whole.
                let _ = self.file.set_len(self.n_bytes);
                self.last_cause = Some(error.kind());
                let refusal = format!("cannot write {path}: {error}");
                if self.refusal.is_none() {
                    tracing::error!("{refusal}; events wait until it can be written");
                }
                self.refusal = Some(refusal);
            }
        }
    }

    /// Writes what waits for the last time; says what is missing then.
    pub(super) fn end(&mut self) -> Option<Unrecorded> {
        self.write_waiting();
        let n_missing = self.n_lost + self.waiting.lines().count();
        let why = self.refusal.take().unwrap_or_else(|| {
            format!("{} could not be written for too long", self.path.display())
        });
        (n_missing > 0).then(|| Unrecorded {
            what: format!("{n_missing} events are missing: {why}"),
            cause: self.last_cause,
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::fs;

    /// A file into which nothing can be written, as on a disk that is full.
    fn full() -> File {
        OpenOptions::new().append(true).open("/dev/full").unwrap()
    }

    #[test]
    fn what_the_disk_refuses_is_written_in_its_order_when_it_lets_it() {
        let folder = tempfile::tempdir().unwrap();
        let mut events = EventFile::create(folder.path()).unwrap();
        events.push("first");
        let disk = std::mem::replace(&mut events.file, full());
        events.push("second");
        let refusal = events.refusal().unwrap();
        assert!(refusal.contains(EVENTS_FILE), "{refusal}");
        events.file = disk;
        events.push("third");
        assert_eq!(events.refusal(), None);
        assert_eq!(events.end(), None);
        let lines = fs::read_to_string(events.path()).unwrap();
        assert_eq!(lines, "first\nsecond\nthird\n");
    }

    #[test]
    fn what_never_finds_room_is_told_of_at_the_end() {
        let folder = tempfile::tempdir().unwrap();
        let mut events = EventFile::create(folder.path()).unwrap();
        events.file = full();
        let long = "x".repeat(MAX_WAITING_BYTES / 2);
        for line in ["first", long.as_str(), long.as_str()] {
            events.push(line);
        }
        let missing = events.end().unwrap();
        let what = &missing.what;
        assert!(what.starts_with("3 events are missing: "), "{what}");
        assert_eq!(missing.cause, Some(io::ErrorKind::StorageFull));
        assert!(events.waiting.len() < MAX_WAITING_BYTES);
    }
}
