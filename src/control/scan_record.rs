//! `scan.json` in a scan's folder: what the daemon knows of it.

use super::{camera_source::DeviceName, data_folder::SessionId};
use crate::atomic_file::write_atomically;
use serde::{Deserialize, Serialize};
use std::{
    fs, io,
    io::Write,
    path::Path,
    time::{SystemTime, UNIX_EPOCH},
};

/// The file.
pub const NAME: &str = "scan.json";

/// What the daemon knows of a scan.
#[derive(Clone, Debug, PartialEq, Eq, Deserialize, Serialize)]
pub struct ScanRecord {
    /// Its name.
    pub id: SessionId,
    /// What the operator calls it.
    pub label: Option<String>,
    /// The scan that it is a part of, written down on the way.
    #[serde(default)]
    pub interim_of: Option<SessionId>,
    /// When it started, milliseconds since 1970.
    pub started_unix_ms: u64,
    /// When it ended; `None` as long as it goes on, or if the daemon ended before it.
    pub ended_unix_ms: Option<u64>,
    /// The camera.
    pub device: DeviceName,
    /// What went wrong, in sentences for the operator.
    pub failures: Vec<String>,
}

impl ScanRecord {
    /// A scan that starts now.
    pub fn started(id: SessionId, label: Option<String>, device: DeviceName) -> Self {
        ScanRecord {
            id,
            label,
            interim_of: None,
            started_unix_ms: unix_ms(),
            ended_unix_ms: None,
            device,
            failures: Vec::new(),
        }
    }

    /// What the scan is so far, under a name of its own.
    pub fn interim(self, id: SessionId) -> Self {
        ScanRecord {
            interim_of: Some(self.id),
            id,
            ended_unix_ms: Some(unix_ms()),
            ..self
        }
    }

    /// The scan, that ends now.
    pub fn ended(self, failures: Vec<String>) -> Self {
        ScanRecord {
            ended_unix_ms: Some(unix_ms()),
            failures,
            ..self
        }
    }

    /// Writes it into the scan's folder.
    ///
    /// # Errors
    /// If the system refuses.
    pub fn write(&self, folder: &Path) -> io::Result<()> {
        write_atomically(&folder.join(NAME), |file| {
            serde_json::to_writer_pretty(&mut *file, self)?;
            writeln!(file)
        })
    }

    /// Reads it from the folder of the scan of that name.
    ///
    /// # Errors
    /// If it is not there, is not one, or is of another scan, naming it.
    pub fn read(folder: &Path, id: &SessionId) -> io::Result<Self> {
        let path = folder.join(NAME);
        let read = || -> io::Result<Self> {
            let record: Self = serde_json::from_slice(&fs::read(&path)?)?;
            match record.id == *id {
                true => Ok(record),
                false => Err(io::Error::other(format!(
                    "it is of scan {}, and not of {id}",
                    record.id
                ))),
            }
        };
        read().map_err(|error| io::Error::new(error.kind(), format!("{}: {error}", path.display())))
    }

    /// What stands in for a record that cannot be read: the scan's name, and the start that it tells of.
    pub fn unreadable(id: SessionId, why: &io::Error) -> Self {
        let unknown = || "unknown".to_owned();
        ScanRecord {
            label: None,
            interim_of: None,
            started_unix_ms: id.started_unix_ms(),
            ended_unix_ms: None,
            device: DeviceName {
                serial: unknown(),
                sensor: unknown(),
            },
            failures: vec![format!("the scan's record cannot be read: {why}")],
            id,
        }
    }
}

/// Milliseconds since 1970.
pub fn unix_ms() -> u64 {
    let since = SystemTime::now().duration_since(UNIX_EPOCH);
    since.map_or(0, |since| since.as_millis() as u64)
}
