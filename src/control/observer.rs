//! Looks at everything several times a second, and tells of what has changed.

use super::{
    events::Topic,
    interim, refined_error,
    status_body::{RefinementBody, StatusBody},
    supervisor::{Scan, Supervisor},
};
use crate::{
    jobs::{Job, JobId, JobState},
    pipeline::{DeviceHealth, EventKind},
};
use serde_json::json;
use std::{
    collections::BTreeMap,
    sync::Arc,
    time::{Duration, Instant},
};
use tokio::task;

/// How often the whole status is told to those who follow.
const STATUS_INTERVAL: Duration = Duration::from_secs(1);

/// What was told last.
#[derive(Debug, Default)]
pub struct Observer {
    state: Option<(&'static str, Option<&'static str>)>,
    jobs: SeenJobs,
    refinement: RefinementBody,
    scan: Option<ObservedScan>,
    status_told: Option<Instant>,
}

/// How the refinements stood at the last look; `None` before the first.
#[derive(Debug, Default)]
struct SeenJobs(Option<BTreeMap<JobId, JobState>>);

impl SeenJobs {
    /// Which of all jobs, the newest first, have ended since the last look, the oldest first. What ended before the first is no
    /// news.
    fn ended_since(&mut self, jobs: Vec<Job>) -> Vec<Job> {
        let states = jobs.iter().map(|job| (job.id.clone(), job.state));
        let Some(seen) = self.0.replace(states.collect()) else {
            return Vec::new();
        };
        let has_ended = |job: &Job| job.state.is_ended() && seen.get(&job.id) != Some(&job.state);
        jobs.into_iter().rev().filter(has_ended).collect()
    }
}

/// What was told of the scan that goes on.
#[derive(Debug)]
struct ObservedScan {
    scan: Arc<Scan>,
    device: DeviceHealth,
    /// Number of the first pipeline event that was not told.
    next_event: u64,
    /// Number of the interim scan that was given to the refinement worker last.
    interim: u32,
    has_lost_account: bool,
}

impl ObservedScan {
    fn new(scan: Arc<Scan>) -> Self {
        ObservedScan {
            scan,
            device: DeviceHealth::Streaming,
            next_event: 0,
            interim: 0,
            has_lost_account: false,
        }
    }

    fn is_of(&self, scan: &Arc<Scan>) -> bool {
        Arc::ptr_eq(&self.scan, scan)
    }
}

impl Observer {
    /// Looks once; returns the status in one line where that has changed.
    pub fn look(&mut self, supervisor: &Arc<Supervisor>, n_clients: usize) -> Option<String> {
        self.follow_scan(supervisor);
        let ended = self.jobs.ended_since(supervisor.worker.list());
        let status = StatusBody::of(supervisor, n_clients);
        let line = self.state_changed(&status).then(|| sentence(&status));
        if line.is_some() {
            let told = json!({
                "state": status.state, "reason": status.reason, "advice": status.advice, "scan": status.scan,
            });
            supervisor.events.tell(Topic::State, &told);
        }
        self.follow_refinements(supervisor, ended, &status.refinement);
        let is_due = |told: Instant| told.elapsed() >= STATUS_INTERVAL;
        if supervisor.events.is_followed() && self.status_told.is_none_or(is_due) {
            self.status_told = Some(Instant::now());
            supervisor.events.tell(Topic::Status, &status);
        }
        line
    }

    fn state_changed(&mut self, status: &StatusBody) -> bool {
        let state = Some((status.state, status.reason));
        std::mem::replace(&mut self.state, state) != state
    }

    /// Tells of the refinements that ended, and of the one that is shown if that has changed.
    fn follow_refinements(
        &mut self,
        supervisor: &Arc<Supervisor>,
        ended: Vec<Job>,
        shown: &RefinementBody,
    ) {
        for ended in ended.into_iter().map(RefinementBody::from) {
            let is_it = |told: &RefinementBody| told.job == ended.job && told.state == ended.state;
            // Where the next one has begun at once, this one is not shown any more.
            if !is_it(&self.refinement) && !is_it(shown) {
                supervisor.events.tell(Topic::Refinement, &ended);
            }
        }
        if *shown == self.refinement {
            return;
        }
        supervisor.events.tell(Topic::Refinement, shown);
        if let RefinementBody {
            state: "done",
            job: Some(job),
            scan: Some(scan),
            rmse: None,
            ..
        } = shown
        {
            refined_error::read_aside(supervisor, job.clone(), scan);
        }
        self.refinement = shown.clone();
    }

    fn follow_scan(&mut self, supervisor: &Arc<Supervisor>) {
        let scan = supervisor.scan();
        let is_over =
            |known: &mut ObservedScan| scan.as_ref().is_none_or(|scan| !known.is_of(scan));
        if let Some(mut ended) = self.scan.take_if(is_over) {
            // Its last events, and what was last written down on the way, came after the last look.
            ended.tell_events(supervisor);
            ended.refine_interim(supervisor);
        }
        let Some(scan) = scan else {
            return;
        };
        let observed = self.scan.get_or_insert_with(|| ObservedScan::new(scan));
        observed.tell_events(supervisor);
        observed.tell_device(supervisor);
        observed.refine_interim(supervisor);
        observed.check_accounts();
    }
}

impl ObservedScan {
    fn tell_events(&mut self, supervisor: &Supervisor) {
        for (number, event) in self.scan.watch.events().since(self.next_event) {
            self.next_event = number + 1;
            let topic = match event.kind {
                EventKind::Snapshot { .. } => Topic::Snapshot,
                // It is told of once it is a session.
                EventKind::Interim { .. } => continue,
                _ => Topic::Loss,
            };
            supervisor.events.tell(topic, &*event);
        }
    }

    fn tell_device(&mut self, supervisor: &Supervisor) {
        let device = self.scan.watch.status().device;
        if device == self.device {
            return;
        }
        self.device = device;
        let health = match device {
            DeviceHealth::Streaming => "streaming",
            DeviceHealth::Stalled => "stalled",
            DeviceHealth::Gone => "gone",
        };
        let told = json!({ "health": health, "device": self.scan.record.device });
        supervisor.events.tell(Topic::Device, &told);
    }

    /// A scan that was written down on the way is refined while it goes on; tells under which name, or why not.
    fn refine_interim(&mut self, supervisor: &Arc<Supervisor>) {
        let newest = self.scan.watch.live().interim();
        let Some(interim) = newest.filter(|newest| newest.number > self.interim) else {
            return;
        };
        self.interim = interim.number;
        let (supervisor, of) = (supervisor.clone(), self.scan.record.clone());
        task::spawn_blocking(move || {
            let refined = interim::refine(&supervisor, &of, &interim.folder);
            let told = match refined {
                Ok(session) => {
                    json!({ "event": "interim", "number": interim.number, "session": session })
                }
                Err(error) => {
                    tracing::warn!(%error, "no refinement of what was scanned so far");
                    json!({ "event": "refused", "command": "refine", "reason": error.to_string() })
                }
            };
            supervisor.events.tell(Topic::Loss, &told);
        });
    }

    fn check_accounts(&mut self) {
        let unaccounted = self.scan.watch.status().frames.unaccounted();
        if unaccounted != 0 && !self.has_lost_account {
            self.has_lost_account = true;
            tracing::error!(unaccounted, "frames are not accounted for");
        }
    }
}

/// The status in one line.
fn sentence(status: &StatusBody) -> String {
    match status.reason {
        Some(reason) => format!("{} ({reason})", status.state),
        None => status.state.to_owned(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn job(digit: u32, state: JobState) -> Job {
        Job {
            id: format!("{digit:064x}").parse().unwrap(),
            scan: "a".to_owned(),
            submitted_unix_ms: 1,
            state,
            failures: Vec::new(),
            message: None,
            lacks_room: None,
            progress: None,
        }
    }

    #[test]
    fn a_refinement_that_ends_is_noticed_though_the_next_one_begins_at_once() {
        use JobState::{Cancelled, Done, Running, Waiting};
        let mut seen = SeenJobs::default();
        let mut look = |states: &[JobState]| {
            let jobs = states.iter().enumerate();
            let jobs = jobs.map(|(digit, state)| job(digit as u32, *state));
            let ended = seen.ended_since(jobs.rev().collect());
            ended.iter().map(|job| job.state).collect::<Vec<_>>()
        };
        // What had ended before the daemon started is no news.
        assert!(look(&[Done, Running, Waiting]).is_empty());
        assert_eq!(look(&[Done, Done, Running]), [Done]);
        assert!(look(&[Done, Done, Running]).is_empty());
        // Also of one that is gone before it was seen.
        assert_eq!(look(&[Done, Done, Done, Cancelled]), [Done, Cancelled]);
        assert!(look(&[Running, Done, Done, Cancelled]).is_empty());
        assert_eq!(look(&[Done, Done, Done, Cancelled]), [Done]);
    }
}
