//! The worker's thread: takes jobs from the spool, one after the other, and brings each to an end.

use super::{
    JobError, JobState,
    child::{self, Attempt, AttemptEnd},
    inputs::job_id,
    landing::land,
    limits::Limits,
    refusal::note_refusal,
    spool::{self, Record},
    worker::Shared,
};
use crate::lock::lock;
use std::{fs, io, time::Duration};

/// After the disk has refused, or where all that wait pause for want of room, the worker looks again so much later.
const AFTER_REFUSAL: Duration = Duration::from_secs(5);
/// A scan that cannot be read is looked at so often before the attempt has failed, unless the error is one that passes. Arbitrary:
/// in five minutes a server of files has started again.
const MAX_LOOKS: u32 = 60;

impl Shared {
    /// Works until the worker is to stop.
    pub fn work(&self) {
        self.bell.ring();
        while self.bell.wait() {
            let worked = self.work_off();
            self.refresh();
            match worked {
                Ok(()) => self.tell_refusal(None),
                Err(error) => {
                    tracing::error!("refinement waits: {error}");
                    self.tell_refusal(Some(error.to_string()));
                    self.bell.rest(AFTER_REFUSAL);
                    self.bell.ring();
                }
            }
        }
    }

    /// Runs jobs until none waits or the worker is to stop.
    fn work_off(&self) -> Result<(), JobError> {
        self.take_up()?;
        loop {
            if self.bell.is_stopped() {
                return Ok(());
            }
            lock(&self.board).cancelled = None;
            let claimed = lock(&self.spool).claim()?;
            self.tell_refusal(None);
            self.refresh();
            let Some(record) = claimed else {
                if !self.has_waiting() {
                    return Ok(());
                }
                self.bell.rest(AFTER_REFUSAL);
                continue;
            };
            *lock(&self.progress) = None;
            self.run(&record)?;
            self.refresh();
        }
    }

    /// Whether a job waits, as the board tells.
    fn has_waiting(&self) -> bool {
        let board = lock(&self.board);
        let mut states = board.jobs.iter().map(|job| job.state);
        states.any(|state| state == JobState::Waiting)
    }

    /// Goes on with what lies among the running though nothing runs: what was landing lands, all else waits again.
    fn take_up(&self) -> Result<(), JobError> {
        let left = lock(&self.spool).left_running()?;
        for record in left {
            match record.is_landing {
                true => self.deliver(&record)?,
                false => self.put_back(&record)?,
            }
        }
        Ok(())
    }

    fn run(&self, record: &Record) -> Result<(), JobError> {
        if self.end_if_stale(record)? {
            return Ok(());
        }
        let number = record.failures.len() + 1;
        tracing::info!(job = %record.id, scan = record.scan, attempt = number, "refinement begins");
        let ended = self.attempt(record).unwrap_or_else(|error| {
            let program = self.setup.program.display();
            AttemptEnd::Failed(format!("{program} does not run: {error}"))
        });
        if ended != AttemptEnd::Refined {
            self.clear(record)?;
        }
        let spool = || lock(&self.spool);
        match ended {
            AttemptEnd::Refined => self.take_in(record),
            AttemptEnd::Refused(reason) => {
                tracing::warn!(job = %record.id, reason, "not refined");
                self.tell_in_report(record, &reason);
                spool().end(&record.id, JobState::Refused, Some(reason))
            }
            // Either somebody has ended the job, or it goes on when the daemon is back.
            AttemptEnd::Told => spool().put_back(&record.id),
            AttemptEnd::NoRoom(reason) => {
                // Nothing waits where somebody has ended it meanwhile.
                if let Some(n_times) = spool().put_behind(&record.id, reason.clone())? {
                    tracing::error!(job = %record.id, n_times, reason, "refinement waits for room");
                }
                Ok(())
            }
            AttemptEnd::Failed(reason) => {
                tracing::warn!(job = %record.id, attempt = number, reason, "refinement failed");
                spool().fail(&record.id, reason)
            }
            AttemptEnd::Hopeless(reason) => spool().give_up(&record.id, reason),
        }
    }

    /// Adds to the scan's report why it is not refined. A disk that refuses that holds nobody up: the job says it as well.
    fn tell_in_report(&self, record: &Record, reason: &str) {
        let scan = lock(&self.spool).scan_folder(record);
        if let Err(error) = note_refusal(&scan, reason) {
            tracing::warn!(job = %record.id, "the scan's report does not say why it is not refined: {error}");
        }
    }

    fn attempt(&self, record: &Record) -> io::Result<AttemptEnd> {
        let setup = &self.setup;
        let attempt = {
            let spool = lock(&self.spool);
            let out = spool.output_folder(record);
            Attempt {
                program: &setup.program,
                scan: spool.scan_folder(record),
                out: out.ok_or_else(|| io::Error::other("the job has no output folder"))?,
                settings: spool.settings_file(record),
                calibration_dir: &setup.calibration_dir,
                n_threads: setup.n_threads,
                limits: Limits::of_child(&setup.params),
                grace: Duration::from_secs_f64(setup.params.grace_secs),
                max_idle: Duration::from_secs_f64(setup.params.max_idle_secs),
            }
        };
        let is_told = || self.is_told(record);
        let slot = self.progress.clone();
        let on_progress = move |progress| *lock(&slot) = Some(progress);
        child::run(&attempt, is_told, on_progress)
    }

    /// Whether a job is to end, or the worker is.
    fn is_told(&self, record: &Record) -> bool {
        self.bell.is_stopped() || lock(&self.board).cancelled.as_ref() == Some(&record.id)
    }

    /// Takes the outputs of an attempt into the scan, unless the scan has changed or somebody has ended the job.
    fn take_in(&self, record: &Record) -> Result<(), JobError> {
        if self.end_if_stale(record)? {
            return Ok(());
        }
        match self.begin_landing(record)? {
            true => self.deliver(record),
            false => self.put_back(record),
        }
    }

    /// Notes that a job lands, as soon as the disk takes the note: until then nothing but this thread knows that the outputs are
    /// whole.
    fn begin_landing(&self, record: &Record) -> Result<bool, JobError> {
        loop {
            let begun = lock(&self.spool).begin_landing(&record.id);
            match begun {
                Err(error @ JobError::Io { .. }) if !self.bell.is_stopped() => {
                    self.await_disk(record, &error);
                }
                begun => {
                    self.tell_refusal(None);
                    return begun;
                }
            }
        }
    }

    /// Tells what the disk refuses to a job, and rests before that is tried again.
    fn await_disk(&self, record: &Record, error: &JobError) {
        tracing::error!(job = %record.id, "refinement waits: {error}");
        self.tell_refusal(Some(error.to_string()));
        self.bell.rest(AFTER_REFUSAL);
    }

    /// Tells why the worker waits for the disk, or with `None` that it does not any more.
    fn tell_refusal(&self, refusal: Option<String>) {
        lock(&self.board).refusal = refusal;
    }

    fn deliver(&self, record: &Record) -> Result<(), JobError> {
        let (scan, out) = {
            let spool = lock(&self.spool);
            (spool.scan_folder(record), spool.output_folder(record))
        };
        let landed = out.map_or(Ok(()), |out| land(&out, &scan));
        match landed.and_then(|()| self.clear(record)) {
            Ok(()) => {
                tracing::info!(job = %record.id, scan = record.scan, "refined");
                lock(&self.spool).end(&record.id, JobState::Done, None)
            }
            // The outputs stay where they are, and land later.
            Err(error) => self.fail_unless_passing(record, error),
        }
    }

    /// Ends an attempt that an error of the disk is in the way of. One that passes, or that stood in the way until the job or the
    /// worker was to end, is returned, and the attempt stays what it is.
    fn fail_unless_passing(&self, record: &Record, error: JobError) -> Result<(), JobError> {
        if error.is_passing() || self.is_told(record) {
            return Err(error);
        }
        tracing::error!(job = %record.id, "this attempt at refinement is given up: {error}");
        self.clear(record)?;
        lock(&self.spool).fail(&record.id, error.to_string())
    }

    /// Ends a job that is not about its scan any more, or an attempt at one that cannot be read; false if neither is so.
    fn end_if_stale(&self, record: &Record) -> Result<bool, JobError> {
        match self.why_stale(record) {
            Ok(None) => return Ok(false),
            Ok(Some(why)) => {
                self.clear(record)?;
                lock(&self.spool).end(&record.id, JobState::Superseded, Some(why))?;
            }
            Err(error) => self.fail_unless_passing(record, error)?,
        }
        Ok(true)
    }

    /// Why a job is not about its scan any more, as soon as the disk lets that be read.
    ///
    /// # Errors
    /// If the scan cannot be read for long, or not before the job or the worker is to end.
    fn why_stale(&self, record: &Record) -> Result<Option<String>, JobError> {
        let mut n_looks = 1;
        loop {
            match self.compare(record) {
                Err(error) if self.is_told(record) => return Err(error),
                Err(error) if n_looks >= MAX_LOOKS && !error.is_passing() => return Err(error),
                Err(error) => {
                    self.await_disk(record, &error);
                    n_looks += 1;
                }
                compared => {
                    self.tell_refusal(None);
                    return compared;
                }
            }
        }
    }

    /// Looks once why a job is not about its scan any more.
    fn compare(&self, record: &Record) -> Result<Option<String>, JobError> {
        let (scan, settings) = {
            let spool = lock(&self.spool);
            (spool.scan_folder(record), spool.settings_file(record))
        };
        let read = fs::read_to_string(&settings).map_err(spool::at(&settings));
        match read.and_then(|settings| job_id(&scan, &settings, &record.version)) {
            Ok(id) if id == record.id => Ok(None),
            Ok(_) => Ok(Some("the scan has changed since".to_owned())),
            Err(error) if error.is_absence() => Ok(Some(error.to_string())),
            Err(error) => Err(error),
        }
    }

    /// Removes what an attempt left, and lets its job wait again.
    fn put_back(&self, record: &Record) -> Result<(), JobError> {
        self.clear(record)?;
        lock(&self.spool).put_back(&record.id)
    }

    /// Removes what an attempt left. What cannot be removed, now or later, is left where it is: the next attempt takes another
    /// folder, and neither this job nor others wait for it.
    fn clear(&self, record: &Record) -> Result<(), JobError> {
        let out = lock(&self.spool).output_folder(record);
        match out.map_or(Ok(()), |out| spool::remove_folder(&out)) {
            Err(error) if !error.is_passing() => {
                tracing::warn!(job = %record.id, "what an attempt at refinement left stays: {error}");
                Ok(())
            }
            cleared => cleared,
        }
    }
}
