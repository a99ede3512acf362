//! The thread that runs jobs.

use super::{Job, JobError, JobId, WorkerParams};
use std::{
    path::{Path, PathBuf},
    sync::{Arc, Mutex, PoisonError},
};

/// What a worker is started with.
#[derive(Clone, Debug)]
pub struct WorkerSetup {
    /// The data directory: scans in `sessions`, jobs in `spool`.
    pub data_dir: PathBuf,
    /// The program that is run as the child, `std::env::current_exe()` but in tests.
    pub program: PathBuf,
    /// Priority, limits, retries.
    pub params: WorkerParams,
    /// The whole configuration of refinement as TOML, given to the child and part of a job's name.
    pub settings: String,
}

/// What the worker is doing.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct WorkerStatus {
    /// The job that runs.
    pub running: Option<Job>,
    /// How many wait.
    pub n_waiting: usize,
}

/// The worker.
pub struct Worker;

impl Worker {
    /// Opens the spool, takes up what was left there, and starts the thread.
    ///
    /// # Errors
    /// If another process works on the spool, or the system refuses.
    pub fn spawn(_setup: WorkerSetup) -> Result<WorkerHandle, JobError> {
        Ok(WorkerHandle {
            jobs: Arc::default(),
        })
    }
}

/// Gives jobs to the worker and looks at them, from any thread.
#[derive(Clone, Debug)]
pub struct WorkerHandle {
    jobs: Arc<Mutex<Vec<Job>>>,
}

impl WorkerHandle {
    /// What the worker is doing; returns at once.
    pub fn status(&self) -> WorkerStatus {
        WorkerStatus::default()
    }

    /// Asks for the refinement of a scan's folder. The same scan with the same settings is the same job. Reads the inputs and
    /// waits for the disk.
    ///
    /// # Errors
    /// If the folder is no scan that can be refined, or the system refuses.
    pub fn submit(&self, session: &Path) -> Result<Job, JobError> {
        Err(JobError::NotRefinable {
            session: session.to_owned(),
            what: "the worker does not run".to_owned(),
        })
    }

    /// Ends a waiting or running job.
    ///
    /// # Errors
    /// If there is no such job, it is over, or the system refuses.
    pub fn cancel(&self, id: &JobId) -> Result<(), JobError> {
        Err(JobError::Unknown(id.clone()))
    }

    /// All jobs, the newest first.
    pub fn list(&self) -> Vec<Job> {
        self.jobs
            .lock()
            .unwrap_or_else(PoisonError::into_inner)
            .clone()
    }

    /// The newest job of a scan.
    pub fn of_scan(&self, scan: &str) -> Option<Job> {
        self.list().into_iter().find(|job| job.scan == scan)
    }

    /// From now on jobs are made with these settings.
    pub fn set_settings(&self, _settings: String) {}

    /// Stops the child in order, puts its job back among the waiting, and waits for the thread.
    pub fn stop(&self) {}
}
