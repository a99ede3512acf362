//! A scan's end: its refinement is asked for, and how it ended written down.

use super::{Scan, Slot, Supervisor, sum};
use crate::{
    atomic_file::is_passing,
    control::{
        interim,
        scan_record::{self, ScanRecord},
    },
    export::ExportError,
    jobs::{Job, JobError, JobState},
    lock::lock,
    pipeline::{Handle, Outcome},
};
use std::{
    path::Path,
    sync::{Arc, atomic::Ordering},
};
use tokio::task;

impl Supervisor {
    /// Waits for a scan's end, asks for its refinement, and writes down how it ended.
    pub(super) async fn accompany(self: Arc<Self>, handle: Handle, scan: Arc<Scan>) {
        let joined = task::spawn_blocking(|| handle.join()).await;
        let failures = match &joined {
            Ok(outcome) => outcome.failures.clone(),
            Err(error) => vec![format!("the scan ended by a fault of the program: {error}")],
        };
        let id = &scan.record.id;
        for failure in &failures {
            tracing::error!(session_id = %id, failure, "scan failed");
        }
        tracing::info!(session_id = %id, "scan ended");
        let folder = self.data.session(id);
        let record = scan.record.clone().ended(failures);
        if !joined.is_ok_and(has_mesh) {
            scan.wants_refinement.store(false, Ordering::Relaxed);
        }
        let (supervisor, ended) = (self.clone(), record.clone());
        let of_scan = scan.clone();
        let concluded =
            task::spawn_blocking(move || supervisor.conclude(&of_scan, &ended, &folder));
        if let Err(error) = concluded.await {
            tracing::error!(session_id = %id, %error, "the scan's end failed by a fault of the program");
        }
        self.account(&scan, &record);
        self.occupy(Slot::Idle);
    }

    /// Asks for a scan's refinement, and writes down how the scan ended; waits for the disk, as its files did. In this order: if the
    /// daemon ends in between, the scan is told of as interrupted, and refined all the same.
    fn conclude(&self, scan: &Scan, record: &ScanRecord, folder: &Path) {
        let id = &record.id;
        let asked = scan
            .wants_refinement()
            .then(|| self.submit_patiently(scan, folder));
        if let Err(error) = write_patiently(scan, record, folder) {
            tracing::error!(session_id = %id, %error, "the scan's record cannot be written");
        }
        match asked.map(|asked| self.unless_abandoned(scan, asked?)) {
            None => {}
            Some(Ok(job)) => {
                tracing::info!(session_id = %id, job = %job.id, "refinement asked for");
            }
            Some(Err(error)) => tracing::warn!(session_id = %id, error, "no refinement"),
        }
    }

    /// Gives an ended scan to the refinement worker as soon as the disk has room for the job, or says why not.
    fn submit_patiently(&self, scan: &Scan, folder: &Path) -> Result<Job, String> {
        let submitted = scan.watch.write_patiently("refinement", || {
            if !scan.wants_refinement() {
                return Ok(None);
            }
            match self.worker.submit(folder) {
                Err(JobError::Io { path, source }) if is_passing(&source) => {
                    Err(ExportError::Write {
                        path,
                        cause: source,
                    })
                }
                ended => Ok(Some(ended)),
            }
        });
        let job = submitted.map_err(|error| error.to_string())?;
        let job = job.ok_or_else(abandoned)?;
        let job = job.map_err(|error| error.to_string())?;
        interim::cancel_waiting(self, &scan.record.id, &job);
        Ok(job)
    }

    /// Takes a job back if somebody has abandoned the scan since it was asked for: that takes seconds for a large one, and the disk
    /// may be waited for.
    fn unless_abandoned(&self, scan: &Scan, job: Job) -> Result<Job, String> {
        if scan.wants_refinement() {
            return Ok(job);
        }
        match self.worker.cancel(&job.id) {
            Ok(()) => Err(abandoned()),
            // It was refined before.
            Err(JobError::Ended {
                state: JobState::Done,
                ..
            }) => Ok(job),
            Err(error) => Err(error.to_string()),
        }
    }

    fn account(&self, scan: &Scan, record: &ScanRecord) {
        let status = scan.watch.status();
        let mut ended = lock(&self.ended);
        ended.n_scans += 1;
        ended.n_failed += u64::from(!record.failures.is_empty());
        ended.frames = sum(&ended.frames, &status.frames);
        ended.last = Some(record.id.clone());
    }
}

/// Writes down how a scan ended, as soon as the disk has room for it.
fn write_patiently(scan: &Scan, record: &ScanRecord, folder: &Path) -> Result<(), ExportError> {
    let path = folder.join(scan_record::NAME);
    scan.watch.write_patiently(scan_record::NAME, || {
        let refused = |cause| ExportError::Write {
            path: path.clone(),
            cause,
        };
        record.write(folder).map_err(refused)
    })
}

fn abandoned() -> String {
    "the scan was abandoned".to_owned()
}

fn has_mesh(outcome: Outcome) -> bool {
    outcome.report.base_mesh.faces > 0
}
