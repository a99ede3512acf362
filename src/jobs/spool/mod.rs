//! The spool: jobs as files, which survive the end of the process at any moment.
//!
//! ```text
//! DIR/spool/{waiting,running,done,failed}/<id>.json    one file a job, in one of the four
//! DIR/spool/settings/<sha-256>.toml                    what jobs are run with
//! DIR/spool/lock                                       held by the process that works here
//! DIR/sessions/<scan>/refined-<n>/                     outputs of the attempt that is under way
//! ```
//!
//! The disk is the only truth: every change reads the file, writes it anew where it lies, and then moves it. A process that ends
//! between the two leaves a file that says where it belongs, and [`Spool::open`] takes it there. Files are synced, and folders where
//! the file system can. Not written down is how long a job pauses whose outputs found no room: another process may find some.

mod durable;
mod pauses;
mod record;
mod transitions;

#[cfg(test)]
mod tests;

pub use record::{Ending, Place, Record};
pub use transitions::Request;

use super::{JobError, JobId};
use pauses::Pauses;
use sha2::{Digest, Sha256};
use std::{
    cell::RefCell,
    collections::BTreeSet,
    fs::{self, File, TryLockError},
    io,
    path::{Path, PathBuf},
};

/// The folder of what jobs are run with.
const SETTINGS: &str = "settings";

/// A spool that this process works on.
#[derive(Debug)]
pub struct Spool {
    root: PathBuf,
    sessions: PathBuf,
    max_retries: u32,
    pauses: RefCell<Pauses>,
    _lock: File,
}

impl Spool {
    /// Takes hold of the spool of a data directory, and takes every job to where it belongs: one that was running when the process
    /// ended waits again, unless that was too often. Where the disk has no room to write that down, the job stays among the
    /// running, for the worker to put it back when there is some, and that end is not counted.
    ///
    /// # Errors
    /// If another process works on it, or the system refuses.
    pub fn open(data_dir: &Path, max_retries: u32) -> Result<Self, JobError> {
        let root = data_dir.join("spool");
        for name in Place::ALL.map(Place::folder).iter().chain([&SETTINGS]) {
            let folder = root.join(name);
            fs::create_dir_all(&folder).map_err(at(&folder))?;
        }
        let spool = Spool {
            _lock: lock(&root)?,
            root,
            sessions: data_dir.join("sessions"),
            max_retries,
            pauses: RefCell::default(),
        };
        spool.recover()?;
        Ok(spool)
    }

    /// The folder of a job's scan.
    pub fn scan_folder(&self, record: &Record) -> PathBuf {
        self.sessions.join(&record.scan)
    }

    /// Where the attempt that is under way writes.
    pub fn output_folder(&self, record: &Record) -> Option<PathBuf> {
        let number = record.attempt?;
        Some(attempt_folder(&self.scan_folder(record), number))
    }

    /// The file of a job's settings.
    pub fn settings_file(&self, record: &Record) -> PathBuf {
        self.root.join(SETTINGS).join(&record.settings)
    }

    /// All jobs with the folders they lie in, the newest first.
    ///
    /// # Errors
    /// If the system refuses.
    pub fn list(&self) -> Result<Vec<(Place, Record)>, JobError> {
        let mut all = Vec::new();
        for place in Place::ALL {
            let records = self.records(place)?;
            all.extend(records.into_iter().map(|record| (place, record)));
        }
        all.sort_by_key(|(_, record)| std::cmp::Reverse(record.sequence));
        Ok(all)
    }

    fn path(&self, place: Place, id: &JobId) -> PathBuf {
        self.root.join(place.folder()).join(format!("{id}.json"))
    }

    /// The jobs in a folder, in the order of asking. A file that is no job's is set aside.
    fn records(&self, place: Place) -> Result<Vec<Record>, JobError> {
        let folder = self.root.join(place.folder());
        let mut records = Vec::new();
        for entry in fs::read_dir(&folder).map_err(at(&folder))? {
            let path = entry.map_err(at(&folder))?.path();
            if path.extension().is_none_or(|extension| extension != "json") {
                continue;
            }
            match read(&path)? {
                Ok(record) => records.push(record),
                Err(reason) => set_aside(&path, &reason)?,
            }
        }
        records.sort_by_key(|record: &Record| record.sequence);
        Ok(records)
    }

    fn find(&self, id: &JobId) -> Result<Option<(Place, Record)>, JobError> {
        for place in Place::ALL {
            let path = self.path(place, id);
            match path.exists().then(|| read(&path)).transpose()? {
                Some(Ok(record)) => return Ok(Some((place, record))),
                Some(Err(reason)) => set_aside(&path, &reason)?,
                None => {}
            }
        }
        Ok(None)
    }

    /// Writes a job's file where it lies, then moves it.
    fn settle(&self, from: Place, record: &Record, to: Place) -> Result<(), JobError> {
        let path = self.path(from, &record.id);
        durable::write_json(&path, record).map_err(at(&path))?;
        self.move_record(from, &record.id, to)
    }

    fn move_record(&self, from: Place, id: &JobId, to: Place) -> Result<(), JobError> {
        if from == to {
            return Ok(());
        }
        let path = self.path(from, id);
        durable::rename(&path, &self.path(to, id)).map_err(at(&path))
    }

    /// Keeps settings under the name of their contents.
    fn keep_settings(&self, settings: &str) -> Result<String, JobError> {
        let name = format!("{}.toml", hex(&Sha256::digest(settings)));
        let path = self.root.join(SETTINGS).join(&name);
        if !path.exists() {
            durable::write(&path, settings.as_bytes()).map_err(at(&path))?;
        }
        Ok(name)
    }

    fn recover(&self) -> Result<(), JobError> {
        self.sweep()?;
        for (place, mut record) in self.list()? {
            if record.is_landing && record.ending.is_none() {
                // The worker goes on moving its outputs.
                continue;
            }
            let cleared = match self.output_folder(&record) {
                Some(folder) => remove_folder(&folder),
                None => Ok(()),
            };
            if let Err(error) = cleared {
                tracing::warn!(job = %record.id, "what an attempt at refinement left stays: {error}");
                if error.is_passing() {
                    // The worker removes it later, and puts the job back.
                    continue;
                }
            }
            let attempt = record.attempt.take();
            let taken = match (&record.ending, attempt) {
                (Some(ending), None) => self.move_record(place, &record.id, ending.place()),
                (Some(ending), Some(_)) => self.settle(place, &record, ending.place()),
                (None, Some(_)) => self.note_interruption(record),
                (None, None) => self.move_record(place, &record.id, Place::Waiting),
            };
            match place {
                Place::Running => unless_passing(taken)?,
                Place::Waiting | Place::Done | Place::Failed => taken?,
            }
        }
        // Whoever claims a job does it again.
        unless_passing(self.supersede().map(drop))
    }

    /// Removes partial files, and settings that no job has.
    fn sweep(&self) -> Result<(), JobError> {
        let jobs = self.list()?;
        let used: BTreeSet<&str> = jobs.iter().map(|(_, job)| job.settings.as_str()).collect();
        for name in Place::ALL.map(Place::folder).iter().chain([&SETTINGS]) {
            let folder = self.root.join(name);
            for entry in fs::read_dir(&folder).map_err(at(&folder))? {
                let entry = entry.map_err(at(&folder))?;
                let file_name = entry.file_name();
                let file_name = file_name.to_string_lossy();
                let is_unused = *name == SETTINGS && !used.contains(file_name.as_ref());
                if is_unused || file_name.ends_with(".partial") {
                    durable::remove(&entry.path()).map_err(at(&entry.path()))?;
                }
            }
        }
        Ok(())
    }
}

/// What the disk may do later is told of, and left to the worker.
fn unless_passing(done: Result<(), JobError>) -> Result<(), JobError> {
    match done {
        Err(error) if error.is_passing() => {
            tracing::warn!("what the last daemon left to refine waits: {error}");
            Ok(())
        }
        done => done,
    }
}

/// The output folder of an attempt of that number.
fn attempt_folder(scan: &Path, number: u32) -> PathBuf {
    scan.join(format!("refined-{number}"))
}

fn lock(root: &Path) -> Result<File, JobError> {
    let path = root.join("lock");
    let file = File::create(&path).map_err(at(&path))?;
    match file.try_lock() {
        Ok(()) => Ok(file),
        Err(TryLockError::WouldBlock) => Err(JobError::InUse(root.to_owned())),
        Err(TryLockError::Error(source)) => Err(JobError::Io { path, source }),
    }
}

/// Reads a job's file; the inner error says why it is none.
fn read(path: &Path) -> Result<Result<Record, String>, JobError> {
    let bytes = fs::read(path).map_err(at(path))?;
    let record: Record = match serde_json::from_slice(&bytes) {
        Ok(record) => record,
        Err(error) => return Ok(Err(error.to_string())),
    };
    if path.file_stem().and_then(|name| name.to_str()) != Some(record.id.as_str()) {
        return Ok(Err(format!("it is of job {}", record.id)));
    }
    if !is_folder_name(&record.scan) || !is_folder_name(&record.settings) {
        return Ok(Err("its scan or settings lie elsewhere".to_owned()));
    }
    Ok(Ok(record))
}

fn set_aside(path: &Path, reason: &str) -> Result<(), JobError> {
    tracing::error!(path = %path.display(), reason, "not a job's file, set aside");
    let aside = path.with_extension("damaged");
    durable::rename(path, &aside).map_err(at(path))
}

/// Removes a folder, if it exists.
pub(super) fn remove_folder(path: &Path) -> Result<(), JobError> {
    durable::remove_folder(path).map_err(at(path))
}

/// Whether a text names something directly in a folder.
pub(super) fn is_folder_name(text: &str) -> bool {
    let mut components = Path::new(text).components();
    matches!(
        (components.next(), components.next()),
        (Some(std::path::Component::Normal(name)), None) if name == text
    )
}

/// An error of the system at that path.
pub(super) fn at(path: &Path) -> impl FnOnce(io::Error) -> JobError {
    let path = path.to_owned();
    move |source| JobError::Io { path, source }
}

/// Bytes as lower-case hexadecimal digits.
pub(super) fn hex(bytes: &[u8]) -> String {
    bytes.iter().map(|byte| format!("{byte:02x}")).collect()
}
