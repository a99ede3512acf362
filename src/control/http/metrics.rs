//! What a Prometheus server reads: counters over the daemon's life, and how it is now.

use crate::{
    control::{
        status_body::StatusBody,
        supervisor::{Supervisor, sum},
    },
    jobs::JobState,
    pipeline::FrameAccounts,
};
use prometheus_client::{
    encoding::text,
    metrics::{counter::Counter, family::Family, gauge::Gauge},
    registry::Registry,
};
use std::{fmt, sync::atomic::AtomicU64};

/// States that a gauge of 1 or 0 is given for.
const STATES: [&str; 10] = [
    "idle",
    "warming",
    "tracking",
    "degraded",
    "lost",
    "relocalising",
    "paused",
    "snapshotting",
    "draining",
    "fault",
];

const JOB_STATES: [JobState; 7] = [
    JobState::Waiting,
    JobState::Running,
    JobState::Done,
    JobState::Refused,
    JobState::Failed,
    JobState::Cancelled,
    JobState::Superseded,
];

/// All metrics in OpenMetrics' text format.
///
/// # Errors
/// If a value has no form in text.
pub fn encode(supervisor: &Supervisor, n_clients: usize) -> Result<String, fmt::Error> {
    let mut scrape = Scrape::default();
    let status = StatusBody::of(supervisor, n_clients);
    scans(&mut scrape, supervisor);
    now(&mut scrape, &status);
    daemon(&mut scrape, supervisor, &status);
    let mut encoded = String::new();
    text::encode(&mut encoded, &scrape.registry)?;
    Ok(encoded)
}

/// What all scans amount to, the one that goes on too.
fn scans(scrape: &mut Scrape, supervisor: &Supervisor) {
    let ended = supervisor.ended();
    let running = supervisor.scan().map(|scan| scan.watch.status());
    let running = running.unwrap_or_default();
    let frames: FrameAccounts = sum(&ended.frames, &running.frames);
    let outcomes = [
        ("fused", frames.fused),
        ("lost", frames.lost),
        ("without_depth", frames.without_depth),
        ("paused", frames.paused),
        ("damaged", frames.damaged),
        ("dropped", frames.dropped),
    ];
    scrape.counter(
        "frames_produced",
        "Frames that came or were announced",
        frames.produced,
    );
    scrape.counters(
        "frames",
        "Frames by what became of them",
        "outcome",
        &outcomes,
    );
    scrape.counter(
        "frames_missed",
        "Frames, and infrared images that frames lack, which the driver had and let go",
        frames.missed,
    );
    scrape.gauge(
        "snapshots_kept",
        "Shading images of the scan that goes on",
        running.snapshots.accepted as f64,
    );
    scrape.counter("scans_ended", "Scans that ended", ended.n_scans);
    scrape.counter(
        "scans_failed",
        "Scans that ended with a failure",
        ended.n_failed,
    );
    scrape.gauge(
        "frames_in_flight",
        "Frames on their way to fusion",
        frames.in_flight as f64,
    );
    let unaccounted = frames.unaccounted() as f64;
    scrape.gauge(
        "frames_unaccounted",
        "Frames that are in no place: 0",
        unaccounted,
    );
}

fn now(scrape: &mut Scrape, status: &StatusBody) {
    let states = STATES.map(|state| (state, f64::from(u8::from(state == status.state))));
    scrape.gauges(
        "tracking_state",
        "1 for the state there is",
        "state",
        &states,
    );
    scrape.gauge("fps", "Frames handled a second", status.fps);
    if let Some(fitness) = status.fitness {
        scrape.gauge(
            "fitness",
            "How far tracking is from being lost, 0 to 1",
            fitness,
        );
    }
    if let Some(share) = status.ir_saturated_share {
        scrape.gauge(
            "ir_saturated_share",
            "Share of the infrared image at full scale",
            share,
        );
    }
    let recording = &status.recording;
    scrape.gauge(
        "recording_bytes",
        "Bytes recorded of this scan",
        recording.bytes as f64,
    );
    let dropped = [
        ("ir", recording.dropped.ir as f64),
        ("frames", recording.dropped.frames as f64),
    ];
    scrape.gauges(
        "recording_dropped",
        "What this scan's recording lacks",
        "what",
        &dropped,
    );
    if let Some(free) = recording.disk_free_bytes {
        scrape.gauge("disk_free_bytes", "Room on the disk", free as f64);
    }
}

fn daemon(scrape: &mut Scrape, supervisor: &Supervisor, status: &StatusBody) {
    let jobs = supervisor.worker.list();
    let jobs = JOB_STATES.map(|state| {
        let n = jobs.iter().filter(|job| job.state == state).count();
        (state.code(), n as f64)
    });
    scrape.gauges("jobs", "Refinements by where they stand", "state", &jobs);
    let refinement = &status.refinement;
    scrape.gauge(
        "refine_step",
        "Steps of the refinement that runs",
        refinement.step as f64,
    );
    if let Some(share) = refinement.energy_share {
        scrape.gauge(
            "refine_energy_share",
            "Its energy, share of the first",
            share,
        );
    }
    let daemon = &status.daemon;
    scrape.gauge(
        "uptime_seconds",
        "Since the daemon started",
        daemon.uptime_secs,
    );
    scrape.gauge(
        "clients",
        "Sockets and streams of events",
        daemon.clients as f64,
    );
    if let Some(bytes) = daemon.rss_bytes {
        scrape.gauge(
            "resident_memory_bytes",
            "Memory of the daemon",
            bytes as f64,
        );
    }
}

/// One label and its value.
type Label = [(&'static str, &'static str); 1];

type FloatGauge = Gauge<f64, AtomicU64>;

/// The metrics of one answer.
struct Scrape {
    registry: Registry,
}

impl Default for Scrape {
    fn default() -> Self {
        Scrape {
            registry: Registry::with_prefix("relief"),
        }
    }
}

impl Scrape {
    fn counter(&mut self, name: &str, help: &str, value: u64) {
        let counter = Counter::<u64>::default();
        counter.inc_by(value);
        self.registry.register(name, help, counter);
    }

    fn counters(
        &mut self,
        name: &str,
        help: &str,
        label: &'static str,
        values: &[(&'static str, u64)],
    ) {
        let family = Family::<Label, Counter>::default();
        for (of, value) in values {
            family.get_or_create(&[(label, *of)]).inc_by(*value);
        }
        self.registry.register(name, help, family);
    }

    fn gauge(&mut self, name: &str, help: &str, value: f64) {
        let gauge = FloatGauge::default();
        gauge.set(value);
        self.registry.register(name, help, gauge);
    }

    fn gauges(
        &mut self,
        name: &str,
        help: &str,
        label: &'static str,
        values: &[(&'static str, f64)],
    ) {
        let family = Family::<Label, FloatGauge>::default();
        for (of, value) in values {
            family.get_or_create(&[(label, *of)]).set(*value);
        }
        self.registry.register(name, help, family);
    }
}
