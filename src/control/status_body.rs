//! The daemon's status as clients see it.

use super::{
    camera_source::DeviceName,
    supervisor::{Scan, Supervisor},
};
use crate::{
    jobs::{Job, JobState},
    pipeline::{self, FrameAccounts, RecordingStatus, Status},
};
use serde::Serialize;
use utoipa::ToSchema;

/// What the daemon is doing.
#[derive(Clone, Debug, PartialEq, Serialize, ToSchema)]
pub struct StatusBody {
    /// `idle`, `warming`, `tracking`, `degraded`, `lost`, `relocalising`, `paused`, `snapshotting`, `draining`, `fault`.
    pub state: &'static str,
    /// Why, for the states that have reasons.
    pub reason: Option<&'static str>,
    /// What the operator can do.
    pub advice: Option<&'static str>,
    /// `idle`, `capturing`, `meshing`, `refining`, `exporting`.
    pub phase: &'static str,
    /// What cannot be written, naming the file, of the scan, else of the refinements; it is tried again until there is room.
    pub storage_error: Option<String>,
    /// What is done to the scan at its end, or while frames are taken back, and how far that is.
    pub improvement: Option<ImprovementBody>,
    /// The scan that goes on.
    pub scan: Option<ScanBody>,
    /// What became of its frames: all but `produced` and `missed` add up to `produced`.
    pub frames: FramesBody,
    /// Frames handled a second.
    pub fps: f64,
    /// How far the last frame was from being lost, 0 to 1.
    pub fitness: Option<f64>,
    /// Share of the infrared image at full scale.
    pub ir_saturated_share: Option<f64>,
    /// Shading images.
    pub snapshots: SnapshotsBody,
    /// Kinect I: the guided sequence.
    pub kinect1_sequence: Option<SequenceBody>,
    /// The refinement that runs, or the newest.
    pub refinement: RefinementBody,
    /// How many refinements wait, that one included if it does.
    pub refinements_waiting: usize,
    /// What is recorded beside the scan.
    pub recording: RecordingBody,
    /// The live mesh.
    pub mesh: Option<MeshBody>,
    /// The daemon itself.
    pub daemon: DaemonBody,
}

/// What is done to a scan at its end, or when frames are taken back.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, ToSchema)]
pub struct ImprovementBody {
    /// `correct_depth`, `fuse_fragments`, `find_loops`, `align_fragments`, `close_loops`, `fuse_whole`,
    /// `separate_thin_parts`; `take_back` in the midst of a scan.
    pub work: &'static str,
    /// Frames, fragments or pairs of them that are done.
    pub done: usize,
    /// Of so many.
    pub of: usize,
}

/// The scan that goes on.
#[derive(Clone, Debug, PartialEq, Serialize, ToSchema)]
pub struct ScanBody {
    /// Its name.
    pub id: String,
    /// What the operator calls it.
    pub label: Option<String>,
    /// When it started, milliseconds since 1970.
    pub started_unix_ms: u64,
    /// Its camera.
    pub device: DeviceName,
}

/// What became of the frames.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, ToSchema)]
pub struct FramesBody {
    /// Frames that came or were announced.
    pub produced: u64,
    /// Frames in the model, or that were in it before they were taken back.
    pub fused: u64,
    /// Frames whose pose was not found.
    pub lost: u64,
    /// Frames without depth in range.
    pub without_depth: u64,
    /// Frames that came during a pause.
    pub paused: u64,
    /// Frames that came damaged.
    pub damaged: u64,
    /// Frames that fusion was too busy for.
    pub dropped: u64,
    /// Frames on their way.
    pub in_flight: u64,
    /// Frames, and infrared images that frames lack, which the driver had and let go; none of them is among those produced.
    pub missed: u64,
}

impl From<FrameAccounts> for FramesBody {
    fn from(frames: FrameAccounts) -> Self {
        FramesBody {
            produced: frames.produced,
            fused: frames.fused,
            lost: frames.lost,
            without_depth: frames.without_depth,
            paused: frames.paused,
            damaged: frames.damaged,
            dropped: frames.dropped,
            in_flight: frames.in_flight,
            missed: frames.missed,
        }
    }
}

/// Shading images.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, ToSchema)]
pub struct SnapshotsBody {
    /// Kept at present.
    pub accepted: usize,
    /// Considered and not kept.
    pub rejected: usize,
    /// Kept at most.
    pub wanted: usize,
}

/// The guided sequence of a Kinect I.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, ToSchema)]
pub struct SequenceBody {
    /// `track`, `hold_still`, `cover_projector`, `lamp_on`, `uncover`.
    pub step: &'static str,
    /// Speckle energy, share of the local mean.
    pub speckle: f64,
    /// From this on speckle shows.
    pub speckle_limit: f64,
}

/// A refinement.
#[derive(Clone, Debug, Default, PartialEq, Serialize, ToSchema)]
pub struct RefinementBody {
    /// `none`, `waiting`, `running`, `done`, `refused`, `failed`, `cancelled`, `superseded`.
    pub state: &'static str,
    /// The job.
    pub job: Option<String>,
    /// The scan that it is of.
    pub scan: Option<String>,
    /// Outer round, of how many.
    pub round: [usize; 2],
    /// Steps made.
    pub step: usize,
    /// Energy of the last step, share of the first.
    pub energy_share: Option<f64>,
    /// Error of the intensity in images held out, share of its mean, root mean square, once it is done.
    pub rmse: Option<f64>,
    /// Seconds that are left, where the rounds that are over tell.
    pub secs_left: Option<f64>,
    /// What is to be said of its ending; of one that waits or runs, why its last attempt failed, or that its outputs found no room on the
    /// disk, for which it waits behind others.
    pub message: Option<String>,
}

/// What is recorded.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, ToSchema)]
pub struct RecordingBody {
    /// Whether frames are being recorded.
    pub active: bool,
    /// Bytes written.
    pub bytes: u64,
    /// Frames recorded.
    pub recorded: u64,
    /// What found no place.
    pub dropped: RecordingDropsBody,
    /// Room on the disk.
    pub disk_free_bytes: Option<u64>,
    /// Below this room recording stops.
    pub disk_floor_bytes: u64,
    /// Why recording stopped.
    pub reason: Option<String>,
}

/// What found no place in the recording.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, ToSchema)]
pub struct RecordingDropsBody {
    /// Frames recorded without infrared.
    pub ir: u64,
    /// Frames not recorded.
    pub frames: u64,
}

/// The size of the live mesh.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, ToSchema)]
pub struct MeshBody {
    /// Rises with every change.
    pub revision: u32,
    /// How many vertices.
    pub vertices: usize,
    /// How many faces.
    pub faces: usize,
}

/// The daemon itself.
#[derive(Clone, Debug, PartialEq, Serialize, ToSchema)]
pub struct DaemonBody {
    /// Of the program.
    pub version: &'static str,
    /// When it started, by its machine's clock: another one has another.
    pub started_unix_ms: u64,
    /// Since it started.
    pub uptime_secs: f64,
    /// Memory it holds.
    pub rss_bytes: Option<u64>,
    /// Who looks on: sockets and event streams.
    pub clients: usize,
    /// Why the newest configuration file is not in force.
    pub config_error: Option<String>,
}

impl StatusBody {
    /// The newest status, with so many clients that look on.
    pub fn of(supervisor: &Supervisor, n_clients: usize) -> Self {
        let scan = supervisor.scan();
        let status = scan.as_ref().map(|scan| scan.watch.status());
        let (state, reason, advice) = told_state(supervisor, status.as_ref());
        let is_capturing = status.is_some();
        let status = status.unwrap_or_default();
        let worker = supervisor.worker.status();
        StatusBody {
            state,
            reason,
            advice,
            phase: match is_capturing {
                true => status.phase.code(),
                false => "idle",
            },
            storage_error: storage_error(&status, worker.refusal),
            improvement: status.improvement.map(|improvement| ImprovementBody {
                work: improvement.work.code(),
                done: improvement.n_done,
                of: improvement.n_in_all,
            }),
            scan: scan.as_deref().map(ScanBody::of),
            frames: status.frames.into(),
            fps: status.fps,
            fitness: status.fitness,
            ir_saturated_share: status.ir_saturated_share,
            snapshots: SnapshotsBody {
                accepted: status.snapshots.accepted,
                rejected: status.snapshots.rejected,
                wanted: status.snapshots.wanted,
            },
            kinect1_sequence: status.kinect1_sequence.map(|sequence| SequenceBody {
                step: sequence.step.code(),
                speckle: sequence.speckle,
                speckle_limit: sequence.speckle_limit,
            }),
            refinement: refinement(supervisor, scan.as_deref(), worker.running),
            refinements_waiting: worker.n_waiting,
            recording: RecordingBody::of(&status.recording),
            mesh: status.mesh.map(|mesh| MeshBody {
                revision: mesh.revision,
                vertices: mesh.vertices,
                faces: mesh.faces,
            }),
            daemon: DaemonBody {
                version: env!("CARGO_PKG_VERSION"),
                started_unix_ms: supervisor.started_unix_ms,
                uptime_secs: supervisor.started.elapsed().as_secs_f64(),
                rss_bytes: pipeline::resident_memory_bytes(),
                clients: n_clients,
                config_error: supervisor.settings.error().map(|error| error.to_string()),
            },
        }
    }
}

/// What waits for the disk: of the scan, or else of the refinements.
fn storage_error(status: &Status, of_refinements: Option<String>) -> Option<String> {
    let of_scan = status.unwritten.values().next().cloned();
    of_scan.or(of_refinements)
}

/// State, reason and advice.
fn told_state(
    supervisor: &Supervisor,
    status: Option<&Status>,
) -> (&'static str, Option<&'static str>, Option<&'static str>) {
    match status {
        Some(status) => {
            let state = status.state;
            (state.code(), state.reason(), Some(state.advice()))
        }
        None if supervisor.is_draining() => ("draining", None, Some("The daemon is ending.")),
        None if supervisor.is_starting() => ("warming", None, Some("The camera is being opened.")),
        None => (
            "idle",
            None,
            Some("Start a scan when the camera sees the object."),
        ),
    }
}

impl ScanBody {
    fn of(scan: &Scan) -> Self {
        let record = &scan.record;
        ScanBody {
            id: record.id.to_string(),
            label: record.label.clone(),
            started_unix_ms: record.started_unix_ms,
            device: record.device.clone(),
        }
    }
}

impl RecordingBody {
    fn of(recording: &RecordingStatus) -> Self {
        RecordingBody {
            active: recording.active,
            bytes: recording.bytes,
            recorded: recording.recorded,
            dropped: RecordingDropsBody {
                ir: recording.dropped_ir,
                frames: recording.dropped_frames,
            },
            disk_free_bytes: recording.disk_free_bytes,
            disk_floor_bytes: recording.disk_floor_bytes,
            reason: recording.reason.clone(),
        }
    }
}

/// The refinement that concerns the operator most: the one that runs, else the newest of the scan that goes on or ended last, else
/// the newest of all.
fn refinement(
    supervisor: &Supervisor,
    scan: Option<&Scan>,
    running: Option<Job>,
) -> RefinementBody {
    let worker = &supervisor.worker;
    let id = scan.map(|scan| scan.record.id.clone());
    let newest = || worker.of_scan(id.or(supervisor.ended().last)?.as_str());
    let of_all = || worker.list().into_iter().next();
    let job = running.or_else(newest).or_else(of_all);
    let Some(job) = job else {
        return RefinementBody {
            state: "none",
            ..RefinementBody::default()
        };
    };
    RefinementBody {
        rmse: supervisor.refined_error.of_job(job.id.as_str()),
        ..RefinementBody::from(job)
    }
}

impl From<Job> for RefinementBody {
    fn from(job: Job) -> Self {
        let progress = job.progress.unwrap_or_default();
        let has_steps = progress.step > 0;
        // What an attempt failed by is no news of a job that ended well, or was ended, after that.
        let tells_of_attempts = matches!(
            job.state,
            JobState::Waiting | JobState::Running | JobState::Failed
        );
        let last_attempt = job.lacks_room.or(job.failures.last().cloned());
        RefinementBody {
            state: job.state.code(),
            job: Some(job.id.to_string()),
            scan: Some(job.scan),
            round: [progress.round.0, progress.round.1],
            step: progress.step,
            energy_share: has_steps.then_some(progress.energy_share),
            rmse: None,
            secs_left: progress
                .secs_left
                .filter(|_| job.state == JobState::Running),
            message: job.message.or(last_attempt.filter(|_| tells_of_attempts)),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_refinement_that_is_done_says_nothing_of_attempts_that_failed() {
        use JobState::{Cancelled, Done, Failed, Running, Superseded, Waiting};
        let message_in = |state| {
            let job = Job {
                id: format!("{:064x}", 1).parse().unwrap(),
                scan: "a".to_owned(),
                submitted_unix_ms: 1,
                state,
                failures: vec!["exit code 1".to_owned()],
                message: None,
                lacks_room: None,
                progress: None,
            };
            RefinementBody::from(job).message
        };
        for state in [Waiting, Running, Failed] {
            assert_eq!(message_in(state).as_deref(), Some("exit code 1"));
        }
        for state in [Done, Cancelled, Superseded] {
            assert_eq!(message_in(state), None, "{state:?}");
        }
    }
}
