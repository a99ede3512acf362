//! The scans in the data directory: what there is, which files can be had, and how one goes.

use super::{
    camera_source::DeviceName,
    data_folder::{DataFolder, SessionId},
    scan_record::ScanRecord,
};
use crate::pipeline::{
    BASE_PLY, EVENTS_FILE, INTERIM, REFINED_GLB, REFINED_PLY, REPORT_HTML, REPORT_JSON, TRAJECTORY,
};
use serde::Serialize;
use serde_json::Value;
use std::{
    fs, io,
    path::{Path, PathBuf},
};
use utoipa::ToSchema;

/// A file that clients may have, and its kind.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct SessionFile {
    /// Its name in the scan's folder, and in the address.
    pub name: &'static str,
    /// Its kind.
    pub media_type: &'static str,
}

/// The name of a scan's folder that is being removed begins so, which no scan's own name does.
const REMOVING: &str = ".removing-";

const PLY: &str = "application/octet-stream";

/// All that clients may have of a scan.
pub const FILES: [SessionFile; 7] = [
    SessionFile {
        name: BASE_PLY,
        media_type: PLY,
    },
    SessionFile {
        name: REFINED_PLY,
        media_type: PLY,
    },
    SessionFile {
        name: REFINED_GLB,
        media_type: "model/gltf-binary",
    },
    SessionFile {
        name: TRAJECTORY,
        media_type: "text/plain; charset=utf-8",
    },
    SessionFile {
        name: REPORT_HTML,
        media_type: "text/html; charset=utf-8",
    },
    SessionFile {
        name: REPORT_JSON,
        media_type: "application/json",
    },
    SessionFile {
        name: EVENTS_FILE,
        media_type: "application/x-ndjson",
    },
];

/// A scan, as clients see it.
#[derive(Clone, Debug, PartialEq, Serialize, ToSchema)]
pub struct SessionBody {
    /// Its name.
    pub id: String,
    /// What the operator calls it.
    pub label: Option<String>,
    /// The scan that it is a part of, if it was written down on the way.
    pub interim_of: Option<String>,
    /// When it started, milliseconds since 1970.
    pub started_unix_ms: u64,
    /// When it ended.
    pub ended_unix_ms: Option<u64>,
    /// `scanning`, `complete`, `failed`, `interrupted` if the daemon ended before it, or `damaged` if its record is not there, cannot
    /// be read, or is of another scan.
    pub state: &'static str,
    /// What went wrong.
    pub failures: Vec<String>,
    /// The camera.
    pub device: DeviceName,
    /// Files that can be had.
    pub files: Vec<FileBody>,
    /// Room that the folder takes, bytes.
    pub bytes: u64,
}

/// A file that can be had.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, ToSchema)]
pub struct FileBody {
    /// Its name.
    pub name: &'static str,
    /// Its length.
    pub bytes: u64,
}

/// The scans, the newest first; `running` is the one that goes on.
pub fn list(data: &DataFolder, running: Option<&SessionId>) -> io::Result<Vec<SessionBody>> {
    let mut ids = ids(data)?;
    ids.sort_unstable_by(|a, b| b.cmp(a));
    // A folder that goes while it is looked at is none.
    let sessions = ids.iter().filter_map(|id| read(data, id, running).ok());
    Ok(sessions.collect())
}

/// One scan.
///
/// # Errors
/// [`io::ErrorKind::NotFound`] if there is no such scan.
pub fn read(
    data: &DataFolder,
    id: &SessionId,
    running: Option<&SessionId>,
) -> io::Result<SessionBody> {
    let folder = existing(data, id)?;
    let (state, record) = match ScanRecord::read(&folder, id) {
        Ok(record) => (state(&record, running), record),
        Err(error) => ("damaged", ScanRecord::unreadable(id.clone(), &error)),
    };
    let bytes = match folder_bytes(&folder) {
        Err(error) if error.kind() == io::ErrorKind::NotFound => return Err(error),
        bytes => bytes.unwrap_or_default(),
    };
    Ok(SessionBody {
        state,
        files: FILES.iter().filter_map(|file| file.body(&folder)).collect(),
        bytes,
        id: record.id.into(),
        label: record.label,
        interim_of: record.interim_of.map(String::from),
        started_unix_ms: record.started_unix_ms,
        ended_unix_ms: record.ended_unix_ms,
        failures: record.failures,
        device: record.device,
    })
}

/// A scan's report, once it is written.
pub fn report(data: &DataFolder, id: &SessionId) -> Option<Value> {
    let text = fs::read_to_string(data.session(id).join(REPORT_JSON)).ok()?;
    serde_json::from_str(&text).ok()
}

/// Where a file lies that clients may have; `None` for any other name.
///
/// # Errors
/// [`io::ErrorKind::NotFound`] if there is no such scan or file.
pub fn file(data: &DataFolder, id: &SessionId, name: &str) -> io::Result<(SessionFile, PathBuf)> {
    let file = FILES.into_iter().find(|file| file.name == name);
    let file = file.ok_or(io::ErrorKind::NotFound)?;
    let path = existing(data, id)?.join(file.name);
    match fs::symlink_metadata(&path)?.is_file() {
        true => Ok((file, path)),
        false => Err(io::ErrorKind::NotFound.into()),
    }
}

/// Removes a scan and all that belongs to it. It is none at once, and whole until then; where the removal is cut off, or something
/// cannot be removed, [`sweep`] ends it.
///
/// # Errors
/// If there is no such scan, or the system refuses.
pub fn remove(data: &DataFolder, id: &SessionId) -> io::Result<()> {
    let folder = existing(data, id)?;
    let aside = data.sessions().join(format!("{REMOVING}{id}"));
    // One of that name was removed before, and came back.
    match fs::remove_dir_all(&aside) {
        Err(error) if error.kind() != io::ErrorKind::NotFound => return Err(error),
        _ => {}
    }
    fs::rename(folder, &aside)?;
    if let Err(error) = fs::remove_dir_all(&aside) {
        tracing::warn!(path = %aside.display(), %error, "what is left of a scan stays until the next start");
    }
    Ok(())
}

/// Removes what is left of scans whose removal was cut off, and what scans that have ended wrote down on the way and nobody took. To be
/// called before a scan begins.
///
/// # Errors
/// If it cannot be seen what is left; what cannot be removed is warned of.
pub fn sweep(data: &DataFolder) -> io::Result<()> {
    remove_begun_with(REMOVING, &data.sessions())?;
    for id in ids(data)? {
        let Ok(folder) = existing(data, &id) else {
            continue;
        };
        let record = ScanRecord::read(&folder, &id);
        // Of a scan that was interrupted, or failed, it may be all that there is.
        let is_complete =
            |record: ScanRecord| record.ended_unix_ms.is_some() && record.failures.is_empty();
        if record.is_ok_and(is_complete)
            && let Err(error) = remove_begun_with(INTERIM, &folder)
        {
            tracing::warn!(path = %folder.display(), %error, "what a scan wrote on the way stays");
        }
    }
    Ok(())
}

/// Removes the folders in a folder whose names begin so.
fn remove_begun_with(beginning: &str, folder: &Path) -> io::Result<()> {
    for entry in fs::read_dir(folder)? {
        let entry = entry?;
        if entry.file_name().to_string_lossy().starts_with(beginning)
            && let Err(error) = fs::remove_dir_all(entry.path())
        {
            let path = entry.path();
            tracing::warn!(path = %path.display(), %error, "what is left of a scan stays");
        }
    }
    Ok(())
}

/// The names of all scans, in no order.
fn ids(data: &DataFolder) -> io::Result<Vec<SessionId>> {
    let mut ids = Vec::new();
    for entry in fs::read_dir(data.sessions())? {
        let name = entry?.file_name();
        ids.extend(name.to_str().and_then(|name| name.parse().ok()));
    }
    Ok(ids)
}

impl SessionFile {
    fn body(&self, folder: &Path) -> Option<FileBody> {
        let metadata = fs::symlink_metadata(folder.join(self.name)).ok()?;
        metadata.is_file().then_some(FileBody {
            name: self.name,
            bytes: metadata.len(),
        })
    }
}

/// The folder of a scan that is there, and is no link to elsewhere.
fn existing(data: &DataFolder, id: &SessionId) -> io::Result<PathBuf> {
    let folder = data.session(id);
    match fs::symlink_metadata(&folder)?.is_dir() {
        true => Ok(folder),
        false => Err(io::ErrorKind::NotFound.into()),
    }
}

fn state(record: &ScanRecord, running: Option<&SessionId>) -> &'static str {
    match record.ended_unix_ms {
        None if running == Some(&record.id) => "scanning",
        None => "interrupted",
        Some(_) if record.failures.is_empty() => "complete",
        Some(_) => "failed",
    }
}

/// Bytes of all files in a folder and the folders in it; links are not followed, and what goes meanwhile or cannot be read within it
/// counts for nothing.
fn folder_bytes(folder: &Path) -> io::Result<u64> {
    let mut bytes = 0;
    for entry in fs::read_dir(folder)? {
        let entry = entry?;
        let Ok(metadata) = entry.metadata() else {
            // Files come and go while a scan goes on.
            continue;
        };
        bytes += match metadata.is_dir() {
            true => folder_bytes(&entry.path()).unwrap_or_default(),
            false => metadata.len(),
        };
    }
    Ok(bytes)
}

#[cfg(test)]
mod tests {
    use super::*;
    use rustix::fs::{Mode, OFlags, mkdirat, openat};
    use std::os::unix::fs::symlink;

    fn device() -> DeviceName {
        DeviceName {
            serial: "1".to_owned(),
            sensor: "kinect2".to_owned(),
        }
    }

    #[test]
    fn only_what_is_a_scan_is_listed_and_only_files_of_the_table_are_had() {
        let root = tempfile::tempdir().unwrap();
        let data = DataFolder::open(root.path()).unwrap();
        let id = SessionId::generate();
        let folder = data.session(&id);
        fs::create_dir(&folder).unwrap();
        let record = ScanRecord::started(id.clone(), Some("vase".to_owned()), device());
        record.write(&folder).unwrap();
        fs::write(folder.join("base.ply"), "12345").unwrap();
        symlink("/etc/passwd", folder.join("report.json")).unwrap();
        fs::create_dir(data.sessions().join("other")).unwrap();

        let sessions = list(&data, None).unwrap();
        assert_eq!(sessions.len(), 1);
        assert_eq!(sessions[0].state, "interrupted");
        let files: Vec<_> = sessions[0]
            .files
            .iter()
            .map(|f| (f.name, f.bytes))
            .collect();
        assert_eq!(files, [("base.ply", 5)]);
        assert_eq!(list(&data, Some(&id)).unwrap()[0].state, "scanning");

        fs::write(folder.join("scan.json"), "{").unwrap();
        let damaged = read(&data, &id, None).unwrap();
        assert_eq!(damaged.state, "damaged");
        assert_eq!((damaged.id.as_str(), damaged.files.len()), (id.as_str(), 1));
        let path = folder.join("scan.json").display().to_string();
        assert!(damaged.failures[0].contains(&path), "{damaged:?}");
        assert_eq!(list(&data, None).unwrap(), [damaged]);
        // A folder that was copied is no second scan of the first one's name.
        record.write(&folder).unwrap();
        let copy = "20000101T000000Z-0000".parse::<SessionId>().unwrap();
        fs::rename(&folder, data.session(&copy)).unwrap();
        let copied = list(&data, None).unwrap().remove(0);
        assert_eq!(
            (copied.id.as_str(), copied.state),
            (copy.as_str(), "damaged")
        );
        for name in [id.as_str(), copy.as_str()] {
            assert!(copied.failures[0].contains(name), "{copied:?}");
        }
        fs::rename(data.session(&copy), &folder).unwrap();
        fs::remove_file(folder.join("scan.json")).unwrap();
        assert_eq!(list(&data, None).unwrap()[0].state, "damaged");

        assert!(file(&data, &id, "base.ply").is_ok());
        for name in ["report.json", "scan.json", "../base.ply", "refined.ply"] {
            let error = file(&data, &id, name).unwrap_err();
            assert_eq!(error.kind(), io::ErrorKind::NotFound, "{name}");
        }
        remove(&data, &id).unwrap();
        assert!(list(&data, None).unwrap().is_empty());
        assert!(remove(&data, &id).is_err());
    }

    #[test]
    fn what_a_scan_that_ended_wrote_on_the_way_and_nobody_took_goes_at_the_start() {
        let root = tempfile::tempdir().unwrap();
        let data = DataFolder::open(root.path()).unwrap();
        let failed = vec!["no mesh".to_owned()];
        for (ended, stays) in [
            (None, true),
            (Some(failed), true),
            (Some(Vec::new()), false),
        ] {
            let record = ScanRecord::started(SessionId::generate(), None, device());
            let folder = data.session(&record.id);
            let interim = folder.join("interim-001");
            fs::create_dir_all(&interim).unwrap();
            let record = match ended {
                Some(failures) => record.ended(failures),
                None => record,
            };
            record.write(&folder).unwrap();
            sweep(&data).unwrap();
            assert_eq!(interim.exists(), stays);
        }
    }

    #[test]
    fn a_scan_is_listed_though_a_folder_in_it_cannot_be_read() {
        let root = tempfile::tempdir().unwrap();
        let data = DataFolder::open(root.path()).unwrap();
        let id = SessionId::generate();
        let folder = data.session(&id);
        fs::create_dir(&folder).unwrap();
        fs::write(folder.join("base.ply"), "12345").unwrap();
        // Folders so deep that their names together are longer than a path may be, whoever reads it.
        let mut inner = fs::File::open(&folder).unwrap();
        for _ in 0..20 {
            let name = "x".repeat(250);
            mkdirat(&inner, &name, Mode::RWXU).unwrap();
            inner = openat(&inner, &name, OFlags::DIRECTORY, Mode::empty())
                .unwrap()
                .into();
        }
        assert_eq!(list(&data, None).unwrap()[0].bytes, 5);
        remove(&data, &id).unwrap();
        assert!(list(&data, None).unwrap().is_empty());
    }

    #[test]
    fn a_removal_that_was_cut_off_is_ended_by_the_next_one_or_at_the_start() {
        let root = tempfile::tempdir().unwrap();
        let data = DataFolder::open(root.path()).unwrap();
        let id = SessionId::generate();
        let left = data.sessions().join(format!(".removing-{id}"));
        let removals: [fn(&DataFolder, &SessionId) -> io::Result<()>; 2] =
            [remove, |data, _| sweep(data)];
        for (n_left, removed) in removals.into_iter().enumerate() {
            fs::create_dir_all(left.join("recording")).unwrap();
            fs::write(left.join("recording/0.mcap"), "frames").unwrap();
            fs::create_dir(data.session(&id)).unwrap();
            removed(&data, &id).unwrap();
            assert!(!left.exists());
            assert_eq!(list(&data, None).unwrap().len(), n_left);
        }
    }
}
