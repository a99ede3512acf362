//! The daemon's data directory: one folder for each scan, held by one daemon at a time.

use serde::{Deserialize, Serialize};
use std::{
    env, fmt,
    fs::{self, File, OpenOptions, TryLockError},
    io,
    net::SocketAddr,
    ops::Range,
    os::unix::fs::{DirBuilderExt, FileExt, OpenOptionsExt},
    path::{Path, PathBuf},
    str::FromStr,
    time::{SystemTime, UNIX_EPOCH},
};

/// The file that one daemon locks, and that says where it listens.
const LOCK_NAME: &str = "daemon.lock";

/// Why a data directory cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum DataFolderError {
    /// Another daemon has it.
    #[error("data directory {} is in use by another daemon", .0.display())]
    InUse(PathBuf),
    /// Nothing says where it is.
    #[error(
        "no data directory is known: give --data, or set STATE_DIRECTORY, XDG_STATE_HOME or HOME"
    )]
    Unknown,
    /// The system refused.
    #[error("cannot use data directory {}: {source}", folder.display())]
    Io {
        /// The folder.
        folder: PathBuf,
        /// What the system said.
        source: io::Error,
    },
}

/// There is too little room for a scan.
#[derive(Debug, thiserror::Error)]
#[error(
    "there are {free_bytes} bytes free on the disk of {}, no scan starts below {floor_bytes} (capture.min_free_disk_mb)",
    .folder.display()
)]
pub struct NoRoom {
    folder: PathBuf,
    free_bytes: u64,
    floor_bytes: u64,
}

/// A data directory held by this process until this is dropped.
#[derive(Debug)]
pub struct DataFolder {
    root: PathBuf,
    lock: File,
}

impl DataFolder {
    /// Takes hold of a data directory, which is made for this user alone if it is missing.
    ///
    /// # Errors
    /// If another daemon has it, or the system refuses.
    pub fn open(root: &Path) -> Result<Self, DataFolderError> {
        let io_error = |source| DataFolderError::Io {
            folder: root.to_owned(),
            source,
        };
        let make = |folder: &Path| {
            fs::DirBuilder::new()
                .recursive(true)
                .mode(0o700)
                .create(folder)
        };
        make(&root.join("sessions")).map_err(io_error)?;
        // Names of files are told to clients and children: they must not depend on the working directory.
        let root = root.canonicalize().map_err(io_error)?;
        let lock = OpenOptions::new()
            .write(true)
            .create(true)
            .truncate(false)
            .mode(0o600)
            .open(root.join(LOCK_NAME))
            .map_err(io_error)?;
        match lock.try_lock() {
            Ok(()) => {
                // A daemon that ended may have left its address.
                lock.set_len(0).map_err(io_error)?;
                Ok(DataFolder { root, lock })
            }
            Err(TryLockError::WouldBlock) => Err(DataFolderError::InUse(root)),
            Err(TryLockError::Error(source)) => Err(io_error(source)),
        }
    }

    /// Where the data directory is by the system's conventions: `$STATE_DIRECTORY`, else `$XDG_STATE_HOME/relief`, else
    /// `~/.local/state/relief`.
    ///
    /// # Errors
    /// If none of these variables is set.
    pub fn conventional() -> Result<PathBuf, DataFolderError> {
        let variable = |name| env::var_os(name).filter(|value| !value.is_empty());
        // systemd lists several state directories with colons between them; the first is ours.
        let of_service = variable("STATE_DIRECTORY")
            .and_then(|paths| env::split_paths(&paths).next())
            .filter(|path| path.is_absolute());
        let of_user = || variable("XDG_STATE_HOME").map(|path| Path::new(&path).join("relief"));
        let of_home = || variable("HOME").map(|path| Path::new(&path).join(".local/state/relief"));
        of_service
            .or_else(of_user)
            .or_else(of_home)
            .ok_or(DataFolderError::Unknown)
    }

    /// Writes down where the daemon that has this directory listens: one line in `daemon.lock`.
    ///
    /// # Errors
    /// If the system refuses.
    pub fn tell_address(&self, scheme: &str, address: SocketAddr) -> io::Result<()> {
        self.lock.set_len(0)?;
        self.lock
            .write_all_at(format!("{scheme}://{address}/\n").as_bytes(), 0)
    }

    /// Checks that the disk has room for a scan; one that does not say how much it has is let be.
    ///
    /// # Errors
    /// If there is less than so much.
    pub fn check_room(&self, floor_bytes: u64) -> Result<(), NoRoom> {
        let folder = self.sessions();
        match mcap_session::free_bytes(&folder) {
            Ok(free_bytes) if free_bytes < floor_bytes => Err(NoRoom {
                folder,
                free_bytes,
                floor_bytes,
            }),
            _ => Ok(()),
        }
    }

    /// The directory.
    pub fn root(&self) -> &Path {
        &self.root
    }

    /// Where the scans lie.
    pub fn sessions(&self) -> PathBuf {
        self.root.join("sessions")
    }

    /// Where a scan lies, whether or not it is there.
    pub fn session(&self, id: &SessionId) -> PathBuf {
        self.sessions().join(&id.0)
    }
}

/// Names a scan by its start, and four digits that tell scans of one second apart: `20261121T153000Z-4f2a`.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Deserialize, Serialize)]
#[serde(try_from = "String", into = "String")]
pub struct SessionId(String);

impl SessionId {
    /// A new name.
    pub fn generate() -> Self {
        let now = humantime::format_rfc3339_seconds(SystemTime::now()).to_string();
        let compact: String = now.chars().filter(|c| !matches!(c, '-' | ':')).collect();
        SessionId(format!("{compact}-{:04x}", fastrand::u16(..)))
    }

    /// The start that it tells of, milliseconds since 1970; 0 where that is no time.
    pub fn started_unix_ms(&self) -> u64 {
        let digits = |range: Range<usize>| self.0.get(range).unwrap_or_default();
        let [year, month, day] = [0..4, 4..6, 6..8].map(digits);
        let [hour, minute, second] = [9..11, 11..13, 13..15].map(digits);
        let text = format!("{year}-{month}-{day}T{hour}:{minute}:{second}Z");
        let started = humantime::parse_rfc3339(&text).ok();
        let since_1970 = started.and_then(|time| time.duration_since(UNIX_EPOCH).ok());
        since_1970.map_or(0, |since| since.as_millis() as u64)
    }

    /// The name.
    pub fn as_str(&self) -> &str {
        &self.0
    }
}

impl fmt::Display for SessionId {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.0)
    }
}

impl FromStr for SessionId {
    type Err = String;

    /// Accepts what [`SessionId::generate`] makes and nothing else, so that a name never leads out of a folder.
    fn from_str(text: &str) -> Result<Self, String> {
        const SHAPE: &[u8] = b"00000000T000000Z-xxxx";
        let fits = |(byte, shape): (u8, &u8)| match shape {
            b'0' => byte.is_ascii_digit(),
            b'x' => matches!(byte, b'0'..=b'9' | b'a'..=b'f'),
            exact => byte == *exact,
        };
        match text.len() == SHAPE.len() && text.bytes().zip(SHAPE).all(fits) {
            true => Ok(SessionId(text.to_owned())),
            false => Err("names of scans look like 20261121T153000Z-4f2a".to_owned()),
        }
    }
}

impl TryFrom<String> for SessionId {
    type Error = String;

    fn try_from(text: String) -> Result<Self, String> {
        text.parse()
    }
}

impl From<SessionId> for String {
    fn from(id: SessionId) -> String {
        id.0
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_data_directory_is_held_by_one_daemon() {
        let root = tempfile::tempdir().unwrap();
        let path = root.path().join("state/relief");
        let held = DataFolder::open(&path).unwrap();
        let error = DataFolder::open(&path).unwrap_err();
        assert!(matches!(error, DataFolderError::InUse(_)), "{error}");
        drop(held);
        drop(DataFolder::open(&path).unwrap());
    }

    #[test]
    fn a_disk_below_the_floor_is_told_with_both_figures() {
        let root = tempfile::tempdir().unwrap();
        let data = DataFolder::open(root.path()).unwrap();
        data.check_room(0).unwrap();
        let error = data.check_room(u64::MAX).unwrap_err().to_string();
        let floor = u64::MAX.to_string();
        assert!(
            error.contains("sessions") && error.contains(&floor),
            "{error}"
        );
    }

    #[test]
    fn only_generated_names_are_names() {
        let id = SessionId::generate();
        assert_eq!(id.as_str().parse::<SessionId>(), Ok(id));
        let started = |text: &str| text.parse::<SessionId>().unwrap().started_unix_ms();
        assert_eq!(started("20261121T153000Z-4f2a"), 1_795_275_000_000);
        assert_eq!(started("20269921T153000Z-4f2a"), 0);
        for text in [
            "",
            "..",
            "20261121T153000Z-4F2A",
            "20261121T153000Z-4f2a/",
            "../sessions/20261121",
            "20261121T153000Z-4f2",
        ] {
            assert!(text.parse::<SessionId>().is_err(), "{text}");
        }
    }
}
