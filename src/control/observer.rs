//! Looks at everything several times a second, and tells of what has changed.

use super::{
    events::Topic,
    interim, refined_error,
    status_body::{RefinementBody, StatusBody},
    supervisor::{Scan, Supervisor},
};
use crate::pipeline::{DeviceHealth, EventKind};
use serde_json::json;
use std::{
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
    refinement: RefinementBody,
    scan: Option<ObservedScan>,
    status_told: Option<Instant>,
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
        let status = StatusBody::of(supervisor, n_clients);
        let line = self.state_changed(&status).then(|| sentence(&status));
        if line.is_some() {
            let told = json!({
                "state": status.state, "reason": status.reason, "advice": status.advice, "scan": status.scan,
            });
            supervisor.events.tell(Topic::State, &told);
        }
        if status.refinement != self.refinement {
            supervisor
                .events
                .tell(Topic::Refinement, &status.refinement);
            if let RefinementBody {
                state: "done",
                job: Some(job),
                scan: Some(scan),
                rmse: None,
                ..
            } = &status.refinement
            {
                refined_error::read_aside(supervisor, job.clone(), scan);
            }
            self.refinement = status.refinement.clone();
        }
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

    fn follow_scan(&mut self, supervisor: &Arc<Supervisor>) {
        let Some(scan) = supervisor.scan() else {
            if let Some(mut ended) = self.scan.take() {
                // Its last events came after the last look.
                ended.tell_events(supervisor);
            }
            return;
        };
        let is_known = self.scan.as_ref().is_some_and(|known| known.is_of(&scan));
        if !is_known {
            self.scan = Some(ObservedScan::new(scan));
        }
        if let Some(observed) = &mut self.scan {
            observed.tell_events(supervisor);
            observed.tell_device(supervisor);
            observed.refine_interim(supervisor);
            observed.check_accounts();
        }
    }
}

impl ObservedScan {
    fn tell_events(&mut self, supervisor: &Supervisor) {
        for (number, event) in self.scan.watch.events().since(self.next_event) {
            let topic = match event.kind {
                EventKind::Snapshot { .. } => Topic::Snapshot,
                _ => Topic::Loss,
            };
            supervisor.events.tell(topic, &*event);
            self.next_event = number + 1;
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

    /// A scan that was written down on the way is refined while it goes on.
    fn refine_interim(&mut self, supervisor: &Arc<Supervisor>) {
        let newest = self.scan.watch.live().interim();
        let Some(interim) = newest.filter(|newest| newest.number > self.interim) else {
            return;
        };
        self.interim = interim.number;
        let of = self.scan.record.clone();
        let refined = interim::refine(supervisor.clone(), of, interim.folder.clone());
        task::spawn(async move {
            if let Err(error) = refined.await {
                tracing::warn!(%error, "no refinement of what was scanned so far");
            }
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
