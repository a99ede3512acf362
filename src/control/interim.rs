//! A scan as it was written down on the way becomes a session of its own, which is refined while the scan goes on.

use super::{
    data_folder::SessionId,
    scan_record::ScanRecord,
    supervisor::{SubmitError, Supervisor},
};
use crate::{
    jobs::{Job, JobState},
    pipeline::CALIBRATION,
};
use std::{fs, io, path::Path};

/// Makes a session of what `of` wrote into a folder of its own so far, and asks for its refinement, which takes the place of
/// one that still waits. Waits for the disk, but not for room on it. Returns the session.
///
/// # Errors
/// If the system or the refinement worker refuses; what was written down before is then refined as if nothing had been asked for.
pub fn refine(
    supervisor: &Supervisor,
    of: &ScanRecord,
    interim: &Path,
) -> Result<SessionId, SubmitError> {
    let adopted = adopt(supervisor, of, interim).inspect_err(|_| {
        // Nobody asks for it again.
        let _ = fs::remove_dir_all(interim);
    })?;
    let folder = supervisor.data.session(&adopted);
    let job = supervisor.worker.submit(&folder)?;
    cancel_waiting(supervisor, &of.id, &job);
    Ok(adopted)
}

/// Moves the folder among the sessions; it keeps its files.
fn adopt(supervisor: &Supervisor, of: &ScanRecord, interim: &Path) -> io::Result<SessionId> {
    let calibration = supervisor.data.session(&of.id).join(CALIBRATION);
    if calibration.is_file() {
        fs::copy(calibration, interim.join(CALIBRATION))?;
    }
    let record = of.clone().interim(SessionId::generate());
    record.write(interim)?;
    fs::rename(interim, supervisor.data.session(&record.id))?;
    tracing::info!(session_id = %of.id, interim_id = %record.id, "scan written down on the way");
    Ok(record.id)
}

/// Cancels the refinements of what a scan wrote down on the way that have not begun and are older than another.
pub fn cancel_waiting(supervisor: &Supervisor, of: &SessionId, newer: &Job) {
    let jobs = supervisor.worker.list().into_iter();
    for job in jobs.skip_while(|job| job.id != newer.id).skip(1) {
        let record = job
            .scan
            .parse()
            .ok()
            .and_then(|id| ScanRecord::read(&supervisor.data.session(&id), &id).ok());
        let is_of_scan = record.is_some_and(|record| record.interim_of.as_ref() == Some(of));
        if is_of_scan && job.state == JobState::Waiting {
            // What the disk refuses is refined as well.
            let _ = supervisor.worker.cancel_waiting(&job.id);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{
        control::{
            camera_source::{CameraSource, DeviceName},
            data_folder::DataFolder,
            settings::{Settings, SettingsPlaces},
        },
        jobs::{Worker, WorkerParams, WorkerSetup},
    };
    use std::{
        num::NonZeroUsize, os::unix::fs::PermissionsExt, path::PathBuf, thread, time::Duration,
    };

    /// A daemon's centre whose refinements never end by themselves.
    fn supervisor(root: &Path) -> Supervisor {
        let program = root.join("child");
        fs::write(&program, "#!/bin/sh\nexec sleep 600\n").unwrap();
        fs::set_permissions(&program, fs::Permissions::from_mode(0o755)).unwrap();
        let data = DataFolder::open(&root.join("data")).unwrap();
        let worker = Worker::spawn(WorkerSetup {
            data_dir: data.root().to_owned(),
            program,
            calibration_dir: root.to_owned(),
            n_threads: NonZeroUsize::MIN,
            params: WorkerParams::default(),
            settings: String::new(),
        });
        let settings = Settings::read(SettingsPlaces {
            config: None,
            calibration: None,
            calibration_dir: root.to_owned(),
            n_threads: NonZeroUsize::MIN,
            record: false,
        });
        let source = CameraSource::Live { serial: None };
        Supervisor::new(source, settings.unwrap(), data, worker.unwrap())
    }

    /// What a scan has written down on the way.
    fn written(scan: &Path, name: &str) -> PathBuf {
        let folder = scan.join(name);
        fs::create_dir_all(folder.join("snapshots/000")).unwrap();
        for file in ["base.ply", "trajectory.txt", "snapshots/000/ir.png"] {
            fs::write(folder.join(file), name).unwrap();
        }
        folder
    }

    #[test]
    fn what_was_written_down_before_is_refined_until_something_newer_is() {
        let root = tempfile::tempdir().unwrap();
        let supervisor = supervisor(root.path());
        let device = DeviceName {
            serial: "1".to_owned(),
            sensor: "kinect2".to_owned(),
        };
        let of = ScanRecord::started(SessionId::generate(), None, device);
        let scan = supervisor.data.session(&of.id);
        let refine = |folder: &Path| refine(&supervisor, &of, folder);
        let state = |id: &SessionId| supervisor.worker.of_scan(id.as_str()).unwrap().state;
        let first = refine(&written(&scan, "interim-001")).unwrap();
        for _ in 0..60_000 {
            if state(&first) == JobState::Running {
                break;
            }
            thread::sleep(Duration::from_millis(1));
        }
        let second = refine(&written(&scan, "interim-002")).unwrap();
        let third = written(&scan, "interim-003");
        // The record of the new session cannot be written.
        fs::create_dir(third.join(".scan.json.partial")).unwrap();
        refine(&third).unwrap_err();
        assert!(!third.exists(), "nobody asks for it again");
        assert_eq!(state(&second), JobState::Waiting);
        let fourth = refine(&written(&scan, "interim-004")).unwrap();
        assert_eq!(state(&first), JobState::Running, "it goes on");
        assert_eq!(state(&second), JobState::Cancelled);
        assert_eq!(state(&fourth), JobState::Waiting);
        supervisor.worker.stop();
    }
}
