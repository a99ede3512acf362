//! The fusion thread: frames in, and at the end of the stream one scan out: base mesh, camera poses, shading images.

use super::{
    depth_correction::DepthCorrection,
    edges::FrameReceiver,
    given_poses::GivenPoses,
    losses::Losses,
    status::{Phase, StatusSlot},
    timing::StageClock,
};
use crate::{
    capture::{Event, EventKind, Tracked},
    export::StageTiming,
    fusion::{
        DepthNoise, Fusion, FusionParams, InfraredOptics, LoopClosure, PoseCorrection,
        TrackingOutcome,
    },
    geometry::{CameraModel, Pose, TriMesh, motion_between},
    snapshot::{SnapshotParams, SnapshotSelection, SnapshotSelector, TrackedFrame},
};
use crossbeam::channel::Sender;
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

/// Fuses frames until there are no more, then sends the scan.
pub fn run(
    setup: FusionSetup,
    frames: FrameReceiver,
    tracked: Sender<Tracked>,
    scans: Sender<Arc<FusedScan>>,
) -> FusionSummary {
    let mut stage = FusionStage::new(setup, tracked);
    while let Some(frame) = frames.recv() {
        stage.handle(&frame);
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
    tracked: Sender<Tracked>,
    summary: FusionSummary,
    /// Times (s) and poses of all fused frames.
    trajectory: Vec<(f64, Pose)>,
    last_depth: Option<Image<f32>>,
    had_depth: bool,
    /// Of the frame that was tracked last: see [`Fit::fitness`](crate::fusion::Fit::fitness).
    fitness: Option<f64>,
    correction_clock: StageClock,
    revision_clock: StageClock,
    fusion_clock: StageClock,
    selection_clock: StageClock,
}

impl FusionStage {
    fn new(setup: FusionSetup, tracked: Sender<Tracked>) -> Self {
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
            fitness: None,
            correction_clock: StageClock::new("multipath"),
            revision_clock: StageClock::new("fusing again with corrected depth"),
            fusion_clock: StageClock::new("tracking and fusion"),
            selection_clock: StageClock::new("selection of shading images"),
        }
    }

    /// One frame: track and fuse it, tell what became of it, and consider it for shading.
    fn handle(&mut self, frame: &Arc<Frame>) {
        let frame = &self.corrected(frame);
        match self.fuse(frame) {
            Some(outcome) => {
                self.account(frame, &outcome);
                self.consider(frame, &outcome);
            }
            None => self.lost(frame, "no given pose within 20 ms".to_owned()),
        }
        self.note_refusal();
        self.publish();
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

    fn account(&mut self, frame: &Frame, outcome: &TrackingOutcome) {
        match outcome {
            TrackingOutcome::Tracked {
                world_from_camera,
                fit,
            } => {
                self.found(frame, world_from_camera);
                self.note_fitness(frame, fit.map(|fit| fit.fitness));
            }
            TrackingOutcome::NoDepth => {
                self.summary.n_without_depth += 1;
                if std::mem::replace(&mut self.had_depth, false) {
                    self.tell(frame, EventKind::NoDepth);
                }
            }
            TrackingOutcome::Lost(reason) => self.lost(frame, super::losses::sentence(reason)),
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

    fn publish(&self) {
        let summary = &self.summary;
        let n_snapshots = self
            .selector
            .as_ref()
            .map_or(0, SnapshotSelector::n_accepted);
        self.status.update(|status| {
            status.n_handled += 1;
            status.n_fused = summary.n_fused;
            status.n_lost = summary.n_lost;
            status.is_lost = summary.losses.is_lost();
            status.fitness = self.fitness;
            status.n_snapshots = n_snapshots;
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
        // A recorder that is gone is told of where its thread is joined.
        let _ = self.tracked.send(tracked);
    }

    /// Closes loops and takes the mesh out of the volume, whose memory is free before refinement begins.
    fn finish(mut self) -> FusionSummary {
        let mut closing_clock = StageClock::new("loop closing");
        let mut meshing_clock = StageClock::new("mesh extraction");
        self.summary.n_relocalised = self.fusion.n_relocalised() as u64;
        self.summary.n_unpolished = self.fusion.n_unpolished() as u64;
        if self.summary.n_fused > 0 {
            self.status.update(|status| status.phase = Phase::Meshing);
            let mut snapshots = self.selector.take().map(SnapshotSelector::finish);
            self.revise(snapshots.as_mut());
            let closure = closing_clock.time(|| {
                let (fusion, pool) = (&mut self.fusion, &self.pool);
                pool.install(|| fusion.close_loops())
            });
            if let Some(closure) = &closure {
                tell_of(closure);
                self.correct(&closure.correction, snapshots.as_mut());
            }
            if self.poses.is_none() {
                self.settle(snapshots.as_mut());
            }
            self.summary.refusal = self.fusion.refusal();
            let (fusion, pool) = (&self.fusion, &self.pool);
            let base = meshing_clock.time(|| pool.install(|| fusion.mesh()));
            tracing::info!(
                n_fused = self.summary.n_fused,
                volume_mib = fusion.memory_bytes() >> 20,
                vertices = base.vertices.len(),
                faces = base.faces.len(),
                "base mesh extracted"
            );
            self.summary.scan = Some(Arc::new(FusedScan {
                base,
                world_from_cameras: self.trajectory.iter().map(|(_, pose)| *pose).collect(),
                snapshots,
                last_depth: self.last_depth,
            }));
        }
        self.summary.timings = [
            self.correction_clock,
            self.fusion_clock,
            self.selection_clock,
            self.revision_clock,
            closing_clock,
            meshing_clock,
        ]
        .iter()
        .filter_map(StageClock::timing)
        .collect();
        self.summary
    }

    /// Lets the shading images settle on the finished model.
    fn settle(&mut self, snapshots: Option<&mut SnapshotSelection>) {
        let (fusion, pool) = (&mut self.fusion, &self.pool);
        for snapshot in snapshots.into_iter().flat_map(|s| &mut s.accepted) {
            let settled =
                pool.install(|| fusion.settle(&snapshot.depth_m, &snapshot.world_from_camera));
            if let Some(pose) = settled {
                snapshot.world_from_camera = pose;
            }
        }
    }

    /// Fuses the scan again if it tells of errors of its depth that were not taken off.
    fn revise(&mut self, mut snapshots: Option<&mut SnapshotSelection>) {
        let (correction, fusion, pool) = (&self.correction, &self.fusion, &self.pool);
        let revised = self
            .revision_clock
            .time(|| pool.install(|| correction.revise(fusion)));
        let Some(revised) = revised else {
            return;
        };
        for snapshot in snapshots.iter_mut().flat_map(|s| &mut s.accepted) {
            let time_secs = snapshot.device_time_secs;
            snapshot.depth_m = correction.revised_depth(&snapshot.depth_m, time_secs, &revised);
        }
        self.fusion = revised.fusion;
        self.correct(&revised.correction, snapshots);
    }

    /// Moves all poses that were handed out.
    fn correct(&mut self, correction: &PoseCorrection, snapshots: Option<&mut SnapshotSelection>) {
        for (time_secs, pose) in &mut self.trajectory {
            *pose = correction.apply(*time_secs, pose);
        }
        for snapshot in snapshots.into_iter().flat_map(|s| &mut s.accepted) {
            snapshot.world_from_camera =
                correction.apply(snapshot.device_time_secs, &snapshot.world_from_camera);
        }
        self.summary.path_length_m = self
            .trajectory
            .windows(2)
            .map(|pair| motion_between(&pair[0].1, &pair[1].1).translation_m)
            .sum();
        self.send(Tracked::Corrected(self.trajectory.clone()));
    }
}

fn tell_of(closure: &LoopClosure) {
    tracing::info!(
        n_fragments = closure.n_fragments,
        n_loops = closure.n_loops,
        misfit_before_m = closure.misfit_before_m,
        misfit_after_m = closure.misfit_after_m,
        "loops closed"
    );
}
