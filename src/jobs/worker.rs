//! The thread that runs jobs, and what the rest of the daemon holds of it.

use super::{
    Job, JobError, JobId, JobProgress, JobState, WorkerParams,
    inputs::{VERSION, job_id},
    spool::{self, Place, Request, Spool},
};
use crate::{lock::lock, pipeline::REFINED_PLY};
use handover::Bell;
use std::{
    num::NonZeroUsize,
    path::{Path, PathBuf},
    sync::{Arc, Mutex},
    thread::{self, JoinHandle},
    time::{SystemTime, UNIX_EPOCH},
};

/// What a worker is started with.
#[derive(Clone, Debug)]
pub struct WorkerSetup {
    /// The data directory: scans in `sessions`, jobs in `spool`.
    pub data_dir: PathBuf,
    /// The program that is run as the child, `std::env::current_exe()` but in tests.
    pub program: PathBuf,
    /// Where calibrations named by serial number lie, for scans that hold none.
    pub calibration_dir: PathBuf,
    /// Threads of the child's pool.
    pub n_threads: NonZeroUsize,
    /// Priority, limits, retries; must have been validated.
    pub params: WorkerParams,
    /// What refinements are made with as TOML, given to the child and part of a job's name.
    pub settings: String,
}

/// What the worker is doing.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct WorkerStatus {
    /// The job that runs.
    pub running: Option<Job>,
    /// How many wait.
    pub n_waiting: usize,
    /// Why the worker waits for the disk, naming the file, and tries again every few seconds; else why the oldest of the jobs whose
    /// outputs found no room waits behind the others. `None` where nothing waits for the disk.
    pub refusal: Option<String>,
}

/// The worker.
pub struct Worker;

impl Worker {
    /// Opens the spool, takes up what was left there, and starts the thread.
    ///
    /// # Errors
    /// If another process works on the spool, or the system refuses.
    pub fn spawn(setup: WorkerSetup) -> Result<WorkerHandle, JobError> {
        let spool = Spool::open(&setup.data_dir, setup.params.max_retries)?;
        let board = Board {
            settings: Arc::from(setup.settings.as_str()),
            ..Board::default()
        };
        let shared = Arc::new(Shared {
            setup,
            spool: Mutex::new(spool),
            board: Mutex::new(board),
            progress: Arc::default(),
            bell: Bell::default(),
        });
        shared.refresh();
        let of_thread = shared.clone();
        let thread = thread::Builder::new()
            .name("jobs".to_owned())
            .spawn(move || of_thread.work())
            .map_err(spool::at(&shared.setup.data_dir))?;
        Ok(WorkerHandle {
            shared,
            thread: Arc::new(Mutex::new(Some(thread))),
        })
    }
}

/// Gives jobs to the worker and looks at them, from any thread.
#[derive(Clone)]
pub struct WorkerHandle {
    shared: Arc<Shared>,
    thread: Arc<Mutex<Option<JoinHandle<()>>>>,
}

impl WorkerHandle {
    /// What the worker is doing; returns at once.
    pub fn status(&self) -> WorkerStatus {
        let jobs = self.list();
        let n_waiting = jobs.iter().filter(|job| job.state == JobState::Waiting);
        let refusal = lock(&self.shared.board).refusal.clone();
        WorkerStatus {
            n_waiting: n_waiting.count(),
            refusal: refusal.or_else(|| without_room(&jobs)),
            running: jobs.into_iter().find(|job| job.state == JobState::Running),
        }
    }

    /// Asks for the refinement of a scan's folder. The same scan with the same settings is the same job; one whose result stands
    /// is not run again. A worker that stops leaves it to the next. Reads the inputs and waits for the disk.
    ///
    /// # Errors
    /// If the folder is no scan that can be refined, or the system refuses.
    pub fn submit(&self, session: &Path) -> Result<Job, JobError> {
        self.shared.submit(session)
    }

    /// Ends a waiting or running job. Waits for the disk, but not for a running child.
    ///
    /// # Errors
    /// If there is no such job, it is over, or the system refuses.
    pub fn cancel(&self, id: &JobId) -> Result<(), JobError> {
        let place = lock(&self.shared.spool).cancel(id)?;
        self.shared.refresh();
        if place == Place::Running {
            lock(&self.shared.board).cancelled = Some(id.clone());
        }
        Ok(())
    }

    /// Ends a job that waits; one that has begun goes on.
    ///
    /// # Errors
    /// If the system refuses.
    pub fn cancel_waiting(&self, id: &JobId) -> Result<(), JobError> {
        let cancelled = lock(&self.shared.spool).cancel_waiting(id);
        self.shared.refresh();
        cancelled
    }

    /// All jobs, the newest first; returns at once.
    pub fn list(&self) -> Vec<Job> {
        let mut jobs = lock(&self.shared.board).jobs.clone();
        let running = |job: &&mut Job| job.state == JobState::Running;
        if let Some(job) = jobs.iter_mut().find(running) {
            job.progress = *lock(&self.shared.progress);
        }
        jobs
    }

    /// The newest job of a scan.
    pub fn of_scan(&self, scan: &str) -> Option<Job> {
        self.list().into_iter().find(|job| job.scan == scan)
    }

    /// A job by which the scan's folder is still read or written: one that has not ended, or whose child is only about to end.
    pub fn at_work_on(&self, scan: &str) -> Option<Job> {
        let board = lock(&self.shared.board);
        let is_at_work = |job: &&Job| {
            job.scan == scan && (!job.state.is_ended() || board.held.contains(&job.id))
        };
        board.jobs.iter().find(is_at_work).cloned()
    }

    /// From now on jobs are made with these settings.
    pub fn set_settings(&self, settings: &str) {
        lock(&self.shared.board).settings = Arc::from(settings);
    }

    /// Tells the child to end; its job goes back among the waiting, and none is begun any more. Returns at once.
    pub fn begin_stop(&self) {
        self.shared.bell.stop();
    }

    /// Stops the child in order, puts its job back among the waiting, and waits for the thread.
    pub fn stop(&self) {
        self.begin_stop();
        let thread = lock(&self.thread).take();
        if thread.is_some_and(|thread| thread.join().is_err()) {
            tracing::error!("the worker ended by a fault of the program");
        }
    }
}

/// What the thread and the handles share.
pub(super) struct Shared {
    pub setup: WorkerSetup,
    /// Held while the disk is written.
    pub spool: Mutex<Spool>,
    /// Held for moments only.
    pub board: Mutex<Board>,
    /// How far the running job is.
    pub progress: Arc<Mutex<Option<JobProgress>>>,
    /// Calls the thread, and tells it to end.
    pub bell: Bell,
}

/// What is shown and asked, newest only.
#[derive(Default)]
pub(super) struct Board {
    pub jobs: Vec<Job>,
    /// Those that lie among the running, whatever their state: a child may be at work on them.
    pub held: Vec<JobId>,
    pub settings: Arc<str>,
    /// The running job that is to end.
    pub cancelled: Option<JobId>,
    /// Why the worker waits for the disk.
    pub refusal: Option<String>,
}

/// Of jobs, the newest first: why the oldest waits whose outputs found no room.
fn without_room(jobs: &[Job]) -> Option<String> {
    let told = |job: &Job| {
        let reason = job.lacks_room.as_ref()?;
        Some(format!("the refinement of {} waits: {reason}", job.scan))
    };
    jobs.iter().rev().find_map(told)
}

impl Shared {
    fn submit(&self, session: &Path) -> Result<Job, JobError> {
        let sessions = self.setup.data_dir.join("sessions");
        let scan = session.file_name().and_then(|name| name.to_str());
        let scan = scan.filter(|name| sessions.join(name) == session && session.is_dir());
        let scan = scan.ok_or_else(|| JobError::NoScan {
            session: session.to_owned(),
            sessions: sessions.clone(),
        })?;
        let settings = lock(&self.board).settings.clone();
        let since_1970 = SystemTime::now().duration_since(UNIX_EPOCH);
        let request = Request {
            id: job_id(session, &settings, VERSION)?,
            scan,
            settings: &settings,
            version: VERSION,
            now_unix_ms: since_1970.map_or(0, |time| time.as_millis() as u64),
            has_refined_mesh: session.join(REFINED_PLY).is_file(),
        };
        let submitted = lock(&self.spool).submit(&request);
        self.refresh();
        self.bell.ring();
        submitted.map(|(place, record)| record.job(place))
    }

    /// Puts on the board what the disk holds, before anybody can change it again.
    pub fn refresh(&self) {
        let spool = lock(&self.spool);
        match spool.list() {
            Ok(records) => {
                let jobs = records.iter().map(|(place, record)| record.job(*place));
                let held = records.iter().filter(|(place, _)| *place == Place::Running);
                let mut board = lock(&self.board);
                board.jobs = jobs.collect();
                board.held = held.map(|(_, record)| record.id.clone()).collect();
            }
            Err(error) => tracing::error!("the spool cannot be read: {error}"),
        }
    }
}
