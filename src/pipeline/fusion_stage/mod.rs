//! The fusion thread: frames in, and at the end of the stream one scan out: base mesh, camera poses, shading images.

mod ending;
mod interim;
mod loops;
mod operator;
mod pulse;
mod showing;
mod surface_round;
mod telling;
mod tracking;

use super::{
    accounts::Place,
    command::Command,
    conditions::{Conditions, Observed},
    depth_statistics::DepthStatistics,
    edges::{FrameReceiver, TrackedSender},
    given_poses::GivenPoses,
    live::{Live, surface::SurfaceUpdate},
    losses::Losses,
    self_calibration::SelfCalibration,
    state::State,
    status::{StatusSlot, StopToken},
    stop_depth::ShadingRequest,
    timing::StageClock,
};
use crate::{
    depth_correction::DepthCorrection,
    export::StageTiming,
    fusion::{DepthNoise, Fusion, FusionParams, InfraredOptics},
    geometry::{CameraModel, Pose, TriMesh, path_length_m},
    refine::{Crop, Roi, select_roi},
    snapshot::{SnapshotParams, SnapshotSelection, SnapshotSelector},
};
use crossbeam::{
    channel::{Receiver, Sender},
    select,
};
use depth_camera::{CameraInfo, Frame, Image, Intrinsics};
pub use loops::LoopTiming;
use loops::LoopsUnderWay;
use operator::Operator;
use pulse::Pulse;
use rayon::ThreadPool;
use showing::Showing;
use std::{path::PathBuf, sync::Arc, time::Duration};

/// How often a stage that gets no frames looks around: a device may be silent, somebody may begin to look.
const LOOK_AROUND: Duration = Duration::from_millis(100);

/// What the fusion thread needs to know.
pub struct FusionSetup {
    /// The camera.
    pub info: CameraInfo,
    /// Tracking and fusion.
    pub fusion: FusionParams,
    /// Infrared images that hold the camera where the geometry does not; `None` without such images.
    pub infrared: Option<InfraredOptics>,
    /// Shading images of a lamp, which tell where the camera was when they were taken; `None` for a camera that needs none.
    pub lamp: Option<InfraredOptics>,
    /// Selection of shading images.
    pub snapshot: SnapshotParams,
    /// What is taken off the depth.
    pub correction: DepthCorrection,
    /// What asks the images for the calibration by which depth is corrected; `None` where it does not depend on it.
    pub self_calibration: Option<SelfCalibration>,
    /// Poses to fuse at, or to polish, instead of tracking.
    pub poses: Option<GivenPoses>,
    /// Where tracking computes.
    pub pool: ThreadPool,
    /// When loops are closed before the scan ends.
    pub loops: LoopTiming,
    /// Where the status goes.
    pub status: StatusSlot,
    /// Where those look who look on.
    pub live: Live,
    /// What has changed of the surface, to those who sew it together.
    pub surfaces: Sender<SurfaceUpdate>,
    /// The run's output folder.
    pub folder: PathBuf,
    /// Asks the camera to stop depth for a shading image, where that is the strategy.
    pub shading: Option<ShadingRequest>,
    /// Ends the scan with what is fused.
    pub stop: StopToken,
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
    /// The camera as they were fused in the end, which may have found its lens to be another than it is said to be.
    pub intrinsics: Intrinsics,
    /// The last depth image that was fused, metres.
    pub last_depth: Option<Image<f32>>,
    /// The part of the surface that was delivered when the scan was made; `None` if that is all, or none has been yet.
    pub delivered: Option<TriMesh>,
    /// What the operator should know of it, where it was read from an output folder.
    pub warnings: Vec<String>,
}

impl FusedScan {
    /// The part that is refined: what lies in a box, or what a crop takes. Where neither says anything it is what was delivered when
    /// the scan was made.
    ///
    /// # Errors
    /// Says for the operator why nothing is left.
    pub fn object(&self, roi: Option<&Roi>, crop: Crop) -> Result<TriMesh, String> {
        match (roi, crop, &self.delivered) {
            (None, Crop::Auto, Some(part)) => Ok(part.clone()),
            _ => choose_object(&self.base, &self.world_from_cameras, roi, crop),
        }
    }
}

/// The part of a surface that is refined: what lies in a box, or, without one, what a crop takes.
///
/// # Errors
/// Says for the operator why nothing is left.
pub fn choose_object(
    base: &TriMesh,
    world_from_cameras: &[Pose],
    roi: Option<&Roi>,
    crop: Crop,
) -> Result<TriMesh, String> {
    // Of a model without surface the crop says so, whichever part of it is asked for.
    let Some(roi) = roi.filter(|_| !base.faces.is_empty()) else {
        return crop.object(base, world_from_cameras);
    };
    let object = select_roi(base, roi);
    match object.faces.is_empty() {
        true => Err("no surface lies in the box given by --roi".to_owned()),
        false => Ok(object),
    }
}

/// What became of the frames.
#[derive(Clone, Debug, Default)]
pub struct FusionSummary {
    /// Frames that were fused, those that were taken back later, too.
    pub n_fused: u64,
    /// Frames during which tracking was lost.
    pub n_lost: u64,
    /// How often a lost camera was found in another place than it was lost at.
    pub n_relocalised: u64,
    /// Frames fused at their given pose although it was to be polished.
    pub n_unpolished: u64,
    /// Frames without depth.
    pub n_without_depth: u64,
    /// Frames that were in the model until the operator took them back.
    pub n_taken_back: u64,
    /// When tracking was lost.
    pub losses: Losses,
    /// What of the scene found no place in the model.
    pub refusal: Option<String>,
    /// Why the model has no surface; `None` if it has one, or nothing was fused.
    pub no_surface_reason: Option<String>,
    /// Why the scan was not improved at its end; `None` if it was tried in full.
    pub unimproved_reason: Option<String>,
    /// What was wrong with the depth of all frames alike, and was put right, in sentences for the operator.
    pub put_right: Vec<String>,
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
                Ok(frame) => stage.take(frame, &frames),
                Err(_) => break,
            },
            default(LOOK_AROUND) => stage.look_around(),
            recv(commands) -> command => {
                // The other end lives as long as anybody may ask.
                let Ok(command) = command else { break };
                stage.obey(command);
            }
        }
        stage.check_accounts(&frames);
    }
    stage.obey_last(commands);
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
    let is_empty = scan.base.faces.is_empty();
    // A refinement that is gone is told of where its thread is joined.
    let _ = scans.send(scan.clone());
    FusionSummary {
        n_fused: scan.world_from_cameras.len() as u64,
        path_length_m: path_length_m(&scan.world_from_cameras),
        no_surface_reason: is_empty.then(|| "the base mesh of the scan has no faces".to_owned()),
        scan: Some(scan),
        ..FusionSummary::default()
    }
}

/// What the fusion thread has in hand.
struct FusionStage {
    fusion: Fusion,
    correction: DepthCorrection,
    self_calibration: Option<SelfCalibration>,
    lamp: Option<InfraredOptics>,
    selector: Option<SnapshotSelector>,
    conditions: Conditions,
    /// What the frames say of the state, and what the operator was told last.
    of_frames: State,
    told: State,
    operator: Operator,
    showing: Showing,
    pulse: Pulse,
    /// How often the device was away before the last frame.
    n_device_gaps: u64,
    /// The working range, metres.
    range: [f32; 2],
    poses: Option<GivenPoses>,
    /// Whether given poses are polished.
    polish: bool,
    pool: ThreadPool,
    loops: LoopsUnderWay,
    status: StatusSlot,
    stop: StopToken,
    tracked: TrackedSender,
    summary: FusionSummary,
    /// Times (s) and poses of all fused frames.
    trajectory: Vec<(f64, Pose)>,
    /// As of [`FusedScan::intrinsics`].
    intrinsics: Intrinsics,
    last_depth: Option<Image<f32>>,
    last_frame_id: u64,
    had_depth: bool,
    /// Of the frame that was tracked last: see [`Fit::fitness`](crate::fusion::Fit::fitness).
    fitness: Option<f64>,
    correction_clock: StageClock,
    revision_clock: StageClock,
    fusion_clock: StageClock,
    selection_clock: StageClock,
    closing_clock: StageClock,
}

impl FusionStage {
    fn new(setup: FusionSetup, tracked: TrackedSender) -> Self {
        let camera = CameraModel::new(setup.info.intrinsics);
        let noise = DepthNoise::of_sensor(setup.info.sensor);
        let conditions = Conditions::new(&setup.fusion, &setup.snapshot);
        let wanted = setup.snapshot.max_snapshots;
        let selector = SnapshotSelector::new(&setup.info, setup.snapshot);
        let range = [setup.fusion.depth_min_m, setup.fusion.depth_max_m].map(|z| z as f32);
        setup.status.update(|status| {
            status.snapshots.wanted = selector.as_ref().map_or(0, |_| wanted);
        });
        FusionStage {
            polish: setup.fusion.polish.enabled,
            fusion: setup.pool.install(|| {
                let fusion = Fusion::new(camera, noise, setup.fusion).by_turns();
                match setup.infrared {
                    Some(optics) => fusion.with_infrared(camera, optics),
                    None => fusion,
                }
            }),
            selector,
            conditions,
            of_frames: State::default(),
            told: State::default(),
            operator: Operator::new(setup.info.clone(), setup.folder, setup.shading),
            showing: Showing::new(setup.live, setup.surfaces, range, setup.info.ir_full_scale),
            pulse: Pulse::default(),
            n_device_gaps: 0,
            range,
            correction: setup.correction,
            self_calibration: setup.self_calibration,
            lamp: setup.lamp,
            poses: setup.poses,
            pool: setup.pool,
            loops: LoopsUnderWay::new(setup.loops),
            status: setup.status,
            stop: setup.stop,
            tracked,
            summary: FusionSummary::default(),
            trajectory: Vec::new(),
            intrinsics: setup.info.intrinsics,
            last_depth: None,
            last_frame_id: 0,
            had_depth: true,
            fitness: None,
            correction_clock: StageClock::new("depth correction"),
            revision_clock: StageClock::new("fusing again with corrected depth"),
            fusion_clock: StageClock::new("tracking and fusion"),
            selection_clock: StageClock::new("selection of shading images"),
            closing_clock: StageClock::new("loop closing"),
        }
    }

    /// A frame that was taken out of its edge. A lost camera is looked for in the newest frame but one, which the newest may
    /// confirm: later ones, after the search, may show another place again.
    fn take(&mut self, frame: Arc<Frame>, frames: &FrameReceiver) {
        // Nothing is looked for while there is no depth, which is so, too, while a Kinect I takes a shading image.
        let is_sought =
            self.had_depth && matches!(self.of_frames, State::Lost(_)) && !self.operator.is_paused;
        if !is_sought {
            return self.handle(&frame);
        }
        for frame in frames.newest_two(frame) {
            self.handle(&frame);
        }
    }

    /// One frame: track and fuse it, tell what became of it, and consider it for shading. One that is still on its way when the
    /// scan is stopped is dropped: to look for a lost camera takes its time.
    fn handle(&mut self, frame: &Arc<Frame>) {
        self.note_gaps();
        self.last_frame_id = frame.frame_id;
        let saturated_share = self.saturated_share(frame);
        let place = if self.stop.is_stopped() {
            Place::Dropped
        } else if self.operator.is_paused {
            Place::Paused
        } else {
            self.use_up(frame, saturated_share)
        };
        self.publish(frame, place, saturated_share);
        self.show(Some(frame));
    }

    fn use_up(&mut self, frame: &Arc<Frame>, saturated_share: Option<f64>) -> Place {
        let frame = &self.corrected(frame);
        let outcome = self.fuse(frame);
        self.of_frames = self.conditions.observe(&Observed {
            time_secs: frame.device_time_secs,
            outcome: outcome.as_ref(),
            depth: DepthStatistics::of(frame.depth.as_ref(), self.range[0], self.range[1]),
            saturated_share,
        });
        let place = self.account(frame, outcome.as_ref());
        if let Some(outcome) = &outcome {
            self.consider(frame, outcome);
        }
        self.note_refusal();
        if place == Place::Fused {
            self.close_loops_on_the_way();
        }
        place
    }

    /// Whether the device was away: then the next frame may show another place.
    fn note_gaps(&mut self) {
        let n_gaps = self.status.get().n_device_gaps;
        if std::mem::replace(&mut self.n_device_gaps, n_gaps) != n_gaps {
            self.interrupt();
        }
    }

    fn interrupt(&mut self) {
        self.fusion.interrupt();
        self.conditions.interrupt();
    }

    /// The frame without the errors of its depth, as far as they are known now.
    fn corrected(&mut self, frame: &Arc<Frame>) -> Arc<Frame> {
        let (correction, pool) = (&mut self.correction, &self.pool);
        correction.thin_out(&self.fusion);
        let corrected = self
            .correction_clock
            .time(|| pool.install(|| correction.correct(frame)));
        corrected.map_or_else(|| frame.clone(), Arc::new)
    }
}

#[cfg(test)]
mod ending_tests;
#[cfg(test)]
mod loops_tests;
