//! The fusion thread: frames in, and at the end of the stream one scan out: base mesh, camera poses, shading images.

mod ending;

use super::{
    accounts::Place,
    command::Command,
    depth_correction::DepthCorrection,
    edges::{FrameReceiver, TrackedSender},
    given_poses::GivenPoses,
    losses::Losses,
    state::State,
    status::StatusSlot,
    timing::StageClock,
};
use crate::{
    capture::{Event, EventKind, Tracked},
    export::StageTiming,
    fusion::{DepthNoise, Fusion, FusionParams, InfraredOptics, TrackingOutcome},
    geometry::{CameraModel, Pose, TriMesh, motion_between},
    snapshot::{SnapshotParams, SnapshotSelection, SnapshotSelector, TrackedFrame},
};
use crossbeam::{
    channel::{Receiver, Sender},
    select,
};
use depth_camera::{CameraInfo, Frame, Image};
use rayon::ThreadPool;
use std::sync::Arc;

/// Below this fitness the operator is told that tracking is weak.
const WEAK_FITNESS: f64 = 0.25;

/// What the fusion thread needs to know.
pub struct FusionSetup {
    /// The camera.
    pub info: CameraInfo,
    /// Tracking and fusion.
    pub fusion: FusionParams,
    /// Infrared images that hold the camera where the geometry does not; `None` without such images.
    pub infrared: Option<InfraredOptics>,
    /// Selection of shading images.
    pub snapshot: SnapshotParams,
    /// What is taken off the depth.
    pub correction: DepthCorrection,
    /// Poses to fuse at, or to polish, instead of tracking.
    pub poses: Option<GivenPoses>,
    /// Where tracking computes.
    pub pool: ThreadPool,
    /// Where the status goes.
    pub status: StatusSlot,
}

/// A scan ready to be refined.
#[derive(Clone, Debug)]
pub struct FusedScan {
    /// The surface, world frame.
    pub base: TriMesh,
    /// Poses of all fused frames, world from camera.
    pub world_from_cameras: Vec<Pose>,
    /// The shading images; `None` if the camera gives none.
    pub snapshots: Option<SnapshotSelection>,
    /// The last depth image that was fused, metres.
    pub last_depth: Option<Image<f32>>,
}

/// What became of the frames.
#[derive(Clone, Debug, Default)]
pub struct FusionSummary {
    /// Frames in the model.
    pub n_fused: u64,
    /// Frames during which tracking was lost.
    pub n_lost: u64,
    /// How often a lost camera was found in another place than it was lost at.
    pub n_relocalised: u64,
    /// Frames fused at their given pose although it was to be polished.
    pub n_unpolished: u64,
    /// Frames without depth.
    pub n_without_depth: u64,
    /// When tracking was lost.
    pub losses: Losses,
    /// What of the scene found no place in the model.
    pub refusal: Option<String>,
    /// Length of the camera's path, metres.
    pub path_length_m: f64,
    /// The scan; `None` if nothing was fused.
    pub scan: Option<Arc<FusedScan>>,
    /// Times of the steps that ran.
    pub timings: Vec<StageTiming>,
}

/// Fuses frames and does what it is asked between them until there are no more frames, then sends the scan.
pub fn run(
    setup: FusionSetup,
    frames: FrameReceiver,
    commands: &Receiver<Command>,
    tracked: TrackedSender,
    scans: Sender<Arc<FusedScan>>,
) -> FusionSummary {
    let mut stage = FusionStage::new(setup, tracked);
    loop {
        select! {
            recv(frames.channel()) -> frame => match frame {
                Ok(frame) => stage.handle(&frame),
                Err(_) => break,
            },
            recv(commands) -> command => {
                // The other end lives as long as anybody may ask.
                let Ok(command) = command else { break };
                stage.obey(command);
            }
        }
    }
    let summary = stage.finish();
    if let Some(scan) = &summary.scan {
        // A refinement that is gone is told of where its thread is joined.
        let _ = scans.send(scan.clone());
    }
    summary
}

/// Sends a scan that was fused before.
pub fn send(scan: FusedScan, scans: &Sender<Arc<FusedScan>>) -> FusionSummary {
    let scan = Arc::new(scan);
    // A refinement that is gone is told of where its thread is joined.
    let _ = scans.send(scan.clone());
    FusionSummary {
        n_fused: scan.world_from_cameras.len() as u64,
        scan: Some(scan),
        ..FusionSummary::default()
    }
}

/// What the fusion thread has in hand.
struct FusionStage {
    fusion: Fusion,
    correction: DepthCorrection,
    selector: Option<SnapshotSelector>,
    poses: Option<GivenPoses>,
    /// Whether given poses are polished.
    polish: bool,
    pool: ThreadPool,
    status: StatusSlot,
    tracked: TrackedSender,
    summary: FusionSummary,
    /// Times (s) and poses of all fused frames.
    trajectory: Vec<(f64, Pose)>,
    last_depth: Option<Image<f32>>,
    had_depth: bool,
    is_paused: bool,
    /// Of the frame that was tracked last: see [`Fit::fitness`](crate::fusion::Fit::fitness).
    fitness: Option<f64>,
    correction_clock: StageClock,
    revision_clock: StageClock,
    fusion_clock: StageClock,
    selection_clock: StageClock,
}

impl FusionStage {
    fn new(setup: FusionSetup, tracked: TrackedSender) -> Self {
        let camera = CameraModel::new(setup.info.intrinsics);
        let noise = DepthNoise::of_sensor(setup.info.sensor);
        FusionStage {
            polish: setup.fusion.polish.enabled,
            fusion: setup.pool.install(|| {
                let fusion = Fusion::new(camera, noise, setup.fusion);
                match setup.infrared {
                    Some(optics) => fusion.with_infrared(camera, optics),
                    None => fusion,
                }
            }),
            selector: SnapshotSelector::new(&setup.info, setup.snapshot),
            correction: setup.correction,
            poses: setup.poses,
            pool: setup.pool,
            status: setup.status,
            tracked,
            summary: FusionSummary::default(),
            trajectory: Vec::new(),
            last_depth: None,
            had_depth: true,
            is_paused: false,
            fitness: None,
            correction_clock: StageClock::new("multipath"),
            revision_clock: StageClock::new("fusing again with corrected depth"),
            fusion_clock: StageClock::new("tracking and fusion"),
            selection_clock: StageClock::new("selection of shading images"),
        }
    }

    /// Does what the operator asks.
    fn obey(&mut self, command: Command) {
        tracing::info!(?command, "the operator asks");
        match command {
            Command::Pause => self.is_paused = true,
            Command::Resume => {
                self.is_paused = false;
                self.fusion.interrupt();
            }
            // The device thread ends its stream, and with it this loop.
            Command::Finish | Command::Abandon => {}
            Command::Snapshot | Command::Undo { .. } | Command::Refine | Command::Reset => {}
        }
        let is_paused = self.is_paused;
        self.status.update(|status| {
            status.state = match is_paused {
                true => State::Paused,
                false => status.state,
            };
        });
    }

    /// One frame: track and fuse it, tell what became of it, and consider it for shading.
    fn handle(&mut self, frame: &Arc<Frame>) {
        if self.is_paused {
            return self.publish(Place::Paused);
        }
        let frame = &self.corrected(frame);
        let place = match self.fuse(frame) {
            Some(outcome) => {
                let place = self.account(frame, &outcome);
                self.consider(frame, &outcome);
                place
            }
            None => {
                self.lost(frame, "no given pose within 20 ms".to_owned());
                Place::Lost
            }
        };
        self.note_refusal();
        self.publish(place);
    }

    /// The frame without multipath, as far as that is known now.
    fn corrected(&mut self, frame: &Arc<Frame>) -> Arc<Frame> {
        let (correction, pool) = (&mut self.correction, &self.pool);
        correction.thin_out(&self.fusion);
        let corrected = self
            .correction_clock
            .time(|| pool.install(|| correction.correct(frame)));
        corrected.map_or_else(|| frame.clone(), Arc::new)
    }

    /// Says once that the model takes nothing more.
    fn note_refusal(&mut self) {
        if self.summary.refusal.is_some() {
            return;
        }
        self.summary.refusal = self.fusion.refusal();
        if let Some(refusal) = &self.summary.refusal {
            tracing::warn!("{refusal}");
        }
    }

    /// What became of a frame; `None` where poses are given and none is near.
    fn fuse(&mut self, frame: &Frame) -> Option<TrackingOutcome> {
        let Some(depth) = &frame.depth else {
            return Some(TrackingOutcome::NoDepth);
        };
        let time_secs = frame.device_time_secs;
        let given = match &self.poses {
            Some(poses) => Some(poses.at(time_secs)?),
            None => None,
        };
        if let (Some(ir), None) = (&frame.ir, &given) {
            self.fusion.see(ir);
        }
        let (fusion, pool, polish) = (&mut self.fusion, &self.pool, self.polish);
        let outcome = self.fusion_clock.time(|| {
            pool.install(|| match given {
                Some(pose) if polish => fusion.fuse_near(depth, time_secs, &pose),
                Some(pose) => fusion.fuse_at(depth, time_secs, &pose),
                None => fusion.fuse(depth, time_secs),
            })
        });
        Some(outcome)
    }

    fn account(&mut self, frame: &Frame, outcome: &TrackingOutcome) -> Place {
        match outcome {
            TrackingOutcome::Tracked {
                world_from_camera,
                fit,
            } => {
                self.found(frame, world_from_camera);
                self.note_fitness(frame, fit.map(|fit| fit.fitness));
                Place::Fused
            }
            TrackingOutcome::NoDepth => {
                self.summary.n_without_depth += 1;
                if std::mem::replace(&mut self.had_depth, false) {
                    self.tell(frame, EventKind::NoDepth);
                }
                Place::WithoutDepth
            }
            TrackingOutcome::Lost(reason) => {
                self.lost(frame, super::losses::sentence(reason));
                Place::Lost
            }
        }
    }

    fn found(&mut self, frame: &Frame, world_from_camera: &Pose) {
        self.had_depth = true;
        self.summary.n_fused += 1;
        if self.summary.losses.end() {
            tracing::info!(frame_id = frame.frame_id, "tracking found back");
            self.tell(frame, EventKind::Found);
        }
        if let Some((_, previous)) = self.trajectory.last() {
            self.summary.path_length_m += motion_between(previous, world_from_camera).translation_m;
        }
        self.trajectory
            .push((frame.device_time_secs, *world_from_camera));
        self.send(Tracked::Pose(frame.device_time_secs, *world_from_camera));
        self.last_depth.clone_from(&frame.depth);
    }

    /// Tells when the camera is about to be lost, once each time.
    fn note_fitness(&mut self, frame: &Frame, fitness: Option<f64>) {
        let is_weak = |fitness: Option<f64>| fitness.is_some_and(|fitness| fitness < WEAK_FITNESS);
        let was_weak = is_weak(std::mem::replace(&mut self.fitness, fitness));
        if let Some(fitness) = fitness
            && is_weak(self.fitness)
            && !was_weak
        {
            self.tell(frame, EventKind::Weak { fitness });
        }
    }

    fn lost(&mut self, frame: &Frame, reason: String) {
        self.had_depth = true;
        self.fitness = Some(0.0);
        self.summary.n_lost += 1;
        let time_secs = frame.device_time_secs;
        let is_new = self
            .summary
            .losses
            .extend(frame.frame_id, time_secs, &reason);
        if is_new {
            tracing::warn!(frame_id = frame.frame_id, reason, "tracking lost");
            self.tell(frame, EventKind::Lost { reason });
        }
    }

    /// Shows a frame to the selector of shading images.
    fn consider(&mut self, frame: &Arc<Frame>, outcome: &TrackingOutcome) {
        let Some(selector) = &mut self.selector else {
            return;
        };
        let tracked = TrackedFrame {
            frame,
            outcome,
            model: self.fusion.model(),
        };
        let n_before = selector.n_accepted();
        let pool = &self.pool;
        self.selection_clock
            .time(|| pool.install(|| selector.observe(&tracked)));
        let n_snapshots = selector.n_accepted();
        if n_snapshots > n_before {
            self.tell(frame, EventKind::Snapshot { n_snapshots });
        }
    }

    fn publish(&self, place: Place) {
        let n_snapshots = self
            .selector
            .as_ref()
            .map_or(0, SnapshotSelector::n_accepted);
        self.status.update(|status| {
            status.frames.arrived(place);
            status.fitness = self.fitness;
            status.snapshots.accepted = n_snapshots;
        });
    }

    fn tell(&self, frame: &Frame, kind: EventKind) {
        self.send(Tracked::Event(Event {
            frame_id: frame.frame_id,
            device_time_secs: Some(frame.device_time_secs),
            kind,
        }));
    }

    fn send(&self, tracked: Tracked) {
        self.tracked.send(tracked);
    }
}
