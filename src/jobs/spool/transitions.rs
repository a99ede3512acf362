//! What can become of a job.

use super::{Ending, Place, Record, Spool, at, attempt_folder, durable, record::NoRoom};
use crate::jobs::{JobError, JobId, JobState};
use std::collections::BTreeMap;

/// So often a daemon may end while a job runs: more often than those who start it let it fail, and rarely enough for a refinement
/// that takes the machine with it to end.
const MAX_INTERRUPTIONS: u32 = 10;

/// So many jobs that are over are kept.
const MAX_KEPT: usize = 200;

/// A job that is asked for.
#[derive(Clone, Debug)]
pub struct Request<'a> {
    /// What it is made from.
    pub id: JobId,
    /// Name of the scan's folder.
    pub scan: &'a str,
    /// What it is run with, TOML.
    pub settings: &'a str,
    /// The version of the program that it is named by.
    pub version: &'a str,
    /// The present moment, milliseconds since 1970.
    pub now_unix_ms: u64,
    /// Whether the scan's folder holds a refined mesh.
    pub has_refined_mesh: bool,
}

impl Spool {
    /// Lets a job wait, in the place of older ones of the same scan that wait. One that waits or runs already, or whose result
    /// stands, stays what it is; one that ended otherwise begins anew, and one that is being cancelled does once its child is gone.
    /// One that pauses for want of room has its turn again.
    ///
    /// # Errors
    /// If the system refuses.
    pub fn submit(&self, request: &Request) -> Result<(Place, Record), JobError> {
        self.pauses.borrow_mut().end(&request.id);
        let all = self.list()?;
        let sequence = all.first().map_or(0, |(_, newest)| newest.sequence + 1);
        let known = all.iter().find(|(_, record)| record.id == request.id);
        let submitted = match known {
            Some((place, record)) if stays(*place, record, request, &all) => {
                (*place, record.clone())
            }
            _ => {
                let (from, to, attempt) = match known {
                    Some((Place::Running, cancelled)) => {
                        (Place::Running, Place::Running, cancelled.attempt)
                    }
                    Some((place, _)) => (*place, Place::Waiting, None),
                    None => (Place::Waiting, Place::Waiting, None),
                };
                let record = Record {
                    id: request.id.clone(),
                    scan: request.scan.to_owned(),
                    sequence,
                    submitted_unix_ms: request.now_unix_ms,
                    settings: self.keep_settings(request.settings)?,
                    version: request.version.to_owned(),
                    failures: Vec::new(),
                    n_interruptions: 0,
                    no_room: None,
                    attempt,
                    is_landing: false,
                    ending: None,
                };
                self.settle(from, &record, to)?;
                (to, record)
            }
        };
        self.supersede()?;
        Ok(submitted)
    }

    /// Leaves of the waiting jobs of each scan the newest; returns these in the order of asking.
    pub(super) fn supersede(&self) -> Result<Vec<Record>, JobError> {
        let mut newest: BTreeMap<String, Record> = BTreeMap::new();
        for record in self.records(Place::Waiting)? {
            if let Some(older) = newest.insert(record.scan.clone(), record) {
                self.end_at(
                    Place::Waiting,
                    older,
                    JobState::Superseded,
                    Some("a newer job of the scan took its place".to_owned()),
                )?;
            }
        }
        let mut waiting: Vec<Record> = newest.into_values().collect();
        waiting.sort_by_key(|record| record.sequence);
        Ok(waiting)
    }

    /// Takes the job that waits longest, with a number for its output folder that is still free. Those whose outputs found no room
    /// come after all others, and not while they pause.
    ///
    /// # Errors
    /// If the system refuses.
    pub fn claim(&self) -> Result<Option<Record>, JobError> {
        let mut waiting = self.supersede()?;
        waiting.sort_by_key(Record::n_times_without_room);
        let pauses = self.pauses.borrow();
        let next = waiting.into_iter().find(|job| !pauses.hold(&job.id));
        let Some(mut record) = next else {
            return Ok(None);
        };
        self.move_record(Place::Waiting, &record.id, Place::Running)?;
        let scan = self.scan_folder(&record);
        record.attempt = (1..).find(|&number| !attempt_folder(&scan, number).exists());
        self.settle(Place::Running, &record, Place::Running)?;
        Ok(Some(record))
    }

    /// The jobs that lie among the running; while no child runs, those that the end of the process or a refusal of the disk left
    /// there.
    ///
    /// # Errors
    /// If the system refuses.
    pub fn left_running(&self) -> Result<Vec<Record>, JobError> {
        self.records(Place::Running)
    }

    /// Notes that the running job's outputs are whole and go to the scan's folder; false if somebody has ended it meanwhile.
    ///
    /// # Errors
    /// If it does not run, or the system refuses.
    pub fn begin_landing(&self, id: &JobId) -> Result<bool, JobError> {
        let mut record = self.running(id)?;
        if record.ending.is_some() {
            return Ok(false);
        }
        record.is_landing = true;
        self.settle(Place::Running, &record, Place::Running)?;
        Ok(true)
    }

    /// Ends the running job; an ending that it has already stays.
    ///
    /// # Errors
    /// If it does not run, or the system refuses.
    pub fn end(
        &self,
        id: &JobId,
        state: JobState,
        message: Option<String>,
    ) -> Result<(), JobError> {
        let record = self.running(id)?;
        self.end_at(Place::Running, record, state, message)?;
        self.prune()
    }

    fn end_at(
        &self,
        place: Place,
        mut record: Record,
        state: JobState,
        message: Option<String>,
    ) -> Result<(), JobError> {
        let ending = record
            .ending
            .get_or_insert(Ending { state, message })
            .clone();
        record.attempt = None;
        record.is_landing = false;
        self.settle(place, &record, ending.place())
    }

    /// Notes why the running job's attempt failed: it waits again, unless that was too often.
    ///
    /// # Errors
    /// If it does not run, or the system refuses.
    pub fn fail(&self, id: &JobId, reason: String) -> Result<(), JobError> {
        let record = self.with_failure(id, &reason)?;
        match record.failures.len() > self.max_retries as usize {
            true => self.end_failed(record, reason),
            false => self.let_wait(record),
        }
    }

    /// Notes why the running job's attempt failed, as any other of it would: it does not wait again.
    ///
    /// # Errors
    /// If it does not run, or the system refuses.
    pub fn give_up(&self, id: &JobId, reason: String) -> Result<(), JobError> {
        let record = self.with_failure(id, &reason)?;
        self.end_failed(record, reason)
    }

    /// The running job with one failure more.
    fn with_failure(&self, id: &JobId, reason: &str) -> Result<Record, JobError> {
        let mut record = self.running(id)?;
        record.failures.push(reason.to_owned());
        record.no_room = None;
        Ok(record)
    }

    /// Notes that the daemon ended while a job ran: that costs it no attempt, unless it was too often.
    pub(super) fn note_interruption(&self, mut record: Record) -> Result<(), JobError> {
        record.n_interruptions += 1;
        let n_times = record.n_interruptions;
        tracing::warn!(job = %record.id, n_times, "the daemon ended while this refinement ran");
        match n_times > MAX_INTERRUPTIONS {
            true => {
                let reason = format!("the daemon ended {n_times} times while it ran");
                self.end_failed(record, reason)
            }
            false => self.let_wait(record),
        }
    }

    /// Lets the running job wait again as if it had not begun.
    ///
    /// # Errors
    /// If it does not run, or the system refuses.
    pub fn put_back(&self, id: &JobId) -> Result<(), JobError> {
        self.let_wait(self.running(id)?)
    }

    /// Notes that the outputs of the running job's attempt found no room, for this reason: it waits behind all others, and pauses,
    /// each time for longer. Returns how often that was; `None` if somebody has ended the job meanwhile.
    ///
    /// # Errors
    /// If it does not run, or the system refuses.
    pub fn put_behind(&self, id: &JobId, reason: String) -> Result<Option<u32>, JobError> {
        let mut record = self.running(id)?;
        if record.ending.is_some() {
            return self.let_wait(record).map(|()| None);
        }
        let n_times = record.n_times_without_room().saturating_add(1);
        record.no_room = Some(NoRoom { n_times, reason });
        self.let_wait(record)?;
        self.pauses.borrow_mut().begin(id, n_times);
        Ok(Some(n_times))
    }

    /// Lets a job that ran wait again; one that somebody has ended goes where it belongs.
    fn let_wait(&self, mut record: Record) -> Result<(), JobError> {
        record.attempt = None;
        record.is_landing = false;
        let to = record.ending.as_ref().map_or(Place::Waiting, Ending::place);
        self.settle(Place::Running, &record, to)
    }

    /// Gives a job that ran up; one that somebody has ended keeps that ending.
    fn end_failed(&self, record: Record, reason: String) -> Result<(), JobError> {
        if record.ending.is_none() {
            tracing::warn!(job = %record.id, scan = record.scan, reason, "refinement given up");
        }
        self.end_at(Place::Running, record, JobState::Failed, Some(reason))
    }

    /// Ends a job that waits, or notes that the one that runs is to end; the worker then moves it.
    ///
    /// # Errors
    /// If there is no such job, it is over or its outputs are being moved, or the system refuses.
    pub fn cancel(&self, id: &JobId) -> Result<Place, JobError> {
        let (place, mut record) = self
            .find(id)?
            .ok_or_else(|| JobError::Unknown(id.clone()))?;
        let ended = |state| JobError::Ended {
            id: id.clone(),
            state,
        };
        match (&record.ending, record.is_landing, place) {
            (Some(ending), ..) => Err(ended(ending.state)),
            (None, true, _) => Err(ended(JobState::Done)),
            (None, false, Place::Running) => {
                record.ending = Some(Ending {
                    state: JobState::Cancelled,
                    message: None,
                });
                self.settle(place, &record, place)?;
                Ok(place)
            }
            (None, false, _) => {
                self.end_at(place, record, JobState::Cancelled, None)?;
                Ok(place)
            }
        }
    }

    /// Ends a job that waits; one that has begun, or is over, stays as it is.
    ///
    /// # Errors
    /// If the system refuses.
    pub fn cancel_waiting(&self, id: &JobId) -> Result<(), JobError> {
        match self.find(id)? {
            Some((Place::Waiting, record)) if record.ending.is_none() => {
                self.end_at(Place::Waiting, record, JobState::Cancelled, None)
            }
            _ => Ok(()),
        }
    }

    fn running(&self, id: &JobId) -> Result<Record, JobError> {
        match self.find(id)? {
            Some((Place::Running, record)) => Ok(record),
            _ => Err(JobError::Unknown(id.clone())),
        }
    }

    /// Forgets the oldest of the jobs that are over, beyond so many.
    fn prune(&self) -> Result<(), JobError> {
        let over = self.list()?.into_iter();
        let over = over.filter(|(place, _)| matches!(place, Place::Done | Place::Failed));
        for (place, record) in over.skip(MAX_KEPT) {
            let path = self.path(place, &record.id);
            durable::remove(&path).map_err(at(&path))?;
        }
        Ok(())
    }
}

/// Whether a known job answers a request as it stands.
fn stays(place: Place, record: &Record, request: &Request, all: &[(Place, Record)]) -> bool {
    match (place, record.ending.as_ref().map(|ending| ending.state)) {
        (Place::Waiting | Place::Running, None) | (_, Some(JobState::Refused)) => true,
        // The refined mesh in the scan's folder is that of the newest job that is done.
        (_, Some(JobState::Done)) => {
            let newest = all.iter().find(|(_, other)| {
                let state = other.ending.as_ref().map(|ending| ending.state);
                other.scan == record.scan && state == Some(JobState::Done)
            });
            request.has_refined_mesh && newest.is_some_and(|(_, newest)| newest.id == record.id)
        }
        _ => false,
    }
}
