//! The only place where the stages meet: one thread for each, one bounded channel for each edge.
//!
//! ```text
//! device ──frames──▶ fusion ──scan──▶ refine ──▶ outputs
//!    │                  │
//!    └─frames, events─▶ recorder ◀─events, poses
//! ```
//!
//! Capacities and what happens when an edge is full stand in [`edges`]. Results depend on the frames alone: with
//! [`WhenFull::Block`] they are the same for any number of threads. [`Handle::stop`] ends capture, ends fusion with
//! what it has, unimproved, and cancels refinement; base mesh and report are still written. A thread that panics takes down nothing but its
//! own outputs.

pub mod edges;
mod handle;
mod status;

mod accounts;
mod command;
mod event_log;
mod live;
mod state;

mod conditions;
mod depth_statistics;
mod standing;

mod device_stage;
mod fusion_stage;
mod given_poses;
mod losses;
mod recorded_scan;
mod recorder_stage;
mod refine_stage;
mod snapshot_meta;
mod stop_depth;

mod deliver;
mod output_folder;
mod patience;
mod pictures;
mod report;
mod self_calibration;
mod threads;
mod timing;

pub use crate::{
    capture::{DeviceHealth, EVENTS_FILE, Event, EventKind},
    export::SNAPSHOTS,
    fusion::{Improvement, Work},
    snapshot::SequenceStep,
};
pub use accounts::FrameAccounts;
pub use command::{Command, CommandRefused};
pub use deliver::{
    BASE_PLY, CALIBRATION, INTERIM, REFINED_GLB, REFINED_PLY, REPORT_HTML, REPORT_JSON, SCENE_PLY,
    TRAJECTORY,
};
pub use edges::WhenFull;
pub use event_log::EventLog;
pub use fusion_stage::FusedScan;
pub use given_poses::GivenPoses;
pub use handle::{Ending, Handle, Outcome, Watch};
pub use live::{InterimScan, Live, LivePose, LiveSnapshot, LiveSurface, NextView, Preview};
pub use output_folder::{OutputFolder, OutputFolderError};
pub use recorded_scan::{RecordedScan, RecordedScanError};
pub use state::{Degradation, Fault, Loss, State};
pub use status::{
    MeshStatus, Phase, RecordingStatus, RefinementProgress, SequenceStatus, SnapshotCounts, Status,
};
pub use stop_depth::{ShadingOutcome, ShadingRefusal, ShadingRequest, StopDepthCamera};
pub use threads::idle_pool;
pub use timing::{peak_memory_bytes, resident_memory_bytes};

use crate::{
    capture::{CaptureParams, IrOffset, Recorder},
    depth_correction::DepthCorrection,
    fusion::{FusionParams, InfraredOptics},
    multipath::MultipathParams,
    refine::{ObjectParams, RefineParams, Roi},
    shading::Calibration,
    snapshot::SnapshotParams,
};
use command::CommandDesk;
use crossbeam::channel::Sender;
use deliver::Outbox;
use depth_camera::{CameraInfo, DepthCamera, Sensor};
use device_stage::DeviceSetup;
use edges::DropCounts;
use fusion_stage::{FusionSetup, LoopTiming};
use handle::Threads;
use live::surface::{self, SurfaceUpdate};
use mcap_session::RecordingError;
use rayon::ThreadPoolBuildError;
use recorder_stage::Telling;
use refine_stage::RefineSetup;
use report::Subject;
use self_calibration::SelfCalibration;
use std::{io, num::NonZeroUsize, sync::Arc};
use threads::{pool, spawn};

/// Everything that a run needs to know; all parameters must have been validated.
pub struct PipelineParams {
    /// Name of the recording or scan.
    pub session: String,
    /// The device thread and the recorder.
    pub capture: CaptureParams,
    /// Multipath of a Kinect II.
    pub multipath: MultipathParams,
    /// Tracking and fusion.
    pub fusion: FusionParams,
    /// Selection of shading images.
    pub snapshot: SnapshotParams,
    /// Which part of the scan becomes meshes.
    pub object: ObjectParams,
    /// Refinement; and how far the images are asked for the calibration by which depth is corrected.
    pub refine: RefineParams,
    /// Whether this run refines, or fuses only.
    pub is_refined: bool,
    /// Response, flat field and noise of the camera's IR.
    pub calibration: Calibration,
    /// Where the calibration comes from, for the report.
    pub calibration_source: String,
    /// The object's box in the world frame; without one the object is found.
    pub roi: Option<Roi>,
    /// Poses to fuse at, or to polish, instead of tracking.
    pub poses: Option<GivenPoses>,
    /// Threads of each of the two pools.
    pub n_threads: NonZeroUsize,
    /// What happens when the program is slower than the camera.
    pub when_full: WhenFull,
    /// Whether the frames are recorded.
    pub record: bool,
    /// What the operator should know from the start.
    pub warnings: Vec<String>,
}

/// Why a pipeline could not be started.
#[derive(Debug, thiserror::Error)]
pub enum SpawnError {
    /// The recorder cannot write.
    #[error("cannot record: {0}")]
    Recorder(#[from] RecordingError),
    /// The calibration cannot be recorded.
    #[error("cannot record the calibration: {0}")]
    Calibration(String),
    /// The system gives no thread.
    #[error("cannot start a thread: {0}")]
    Thread(#[from] io::Error),
    /// The system gives no threads for a pool.
    #[error("cannot start a pool of threads: {0}")]
    Pool(#[from] ThreadPoolBuildError),
}

/// The pipeline as a whole.
pub struct Pipeline;

impl Pipeline {
    /// Starts all threads; the folder is held until [`Handle::join`] returns.
    ///
    /// # Errors
    /// If the recorder cannot write into the folder, or the system gives no threads.
    pub fn spawn(
        camera: Box<dyn DepthCamera>,
        params: PipelineParams,
        folder: OutputFolder,
    ) -> Result<Handle, SpawnError> {
        let (camera, shading) =
            stop_depth::by_strategy(camera, params.capture.shading, &params.snapshot);
        let subject = subject(&params, camera.info(), &folder);
        let (commands_in, commands_out) = edges::commands();
        let watch = Watch {
            desk: Some(CommandDesk::new(commands_in)),
            ..watch(camera.info())
        };
        let drops = Arc::new(DropCounts::default());
        let outbox = Arc::new(Outbox::new(&folder, &watch));
        if camera.info().ir_full_scale.is_some() {
            outbox.calibration(&params.calibration);
        }
        let (outbox_of_recorder, outbox_of_refine) = (outbox.clone(), outbox.clone());
        let recorder = recorder(&params, camera.info(), &folder)?;
        let (surfaces_in, surfaces_out) = edges::surfaces();
        let fusion = FusionSetup {
            shading,
            ..fusion_setup(&params, camera.info(), &watch, surfaces_in, &folder)?
        };
        let refine = refine_setup(&params, camera.info(), &watch)?;
        let device = device_setup(&params, camera, &watch);

        let (frames_in, frames_out) = edges::frames(params.when_full, &watch.status);
        let (recording_in, recording_out) = edges::recording(params.when_full, &drops);
        let (tracked_in, tracked_out) = edges::tracked(&watch.events);
        let (scans_in, scans_out) = edges::scans();
        let events_in = tracked_in.clone();
        let live = watch.live.clone();
        let (status, status_of_sewing) = (&watch.status, watch.status.clone());
        let end = watch.end.clone();
        let telling = Telling {
            status: watch.status.clone(),
            events: watch.events.clone(),
            drops: drops.clone(),
        };

        let threads = Threads {
            device: Some(spawn("device", status, move || {
                device_stage::run(device, &frames_in, &recording_in, &events_in)
            })?),
            fusion: spawn("fusion", status, move || {
                fusion_stage::run(fusion, frames_out, &commands_out, tracked_in, scans_in)
            })?,
            recorder: Some(spawn("recorder", status, move || {
                recorder_stage::run(
                    recorder,
                    recording_out,
                    tracked_out,
                    &outbox_of_recorder,
                    &telling,
                )
            })?),
            sewing: Some(spawn("sewing", status, move || {
                surface::run(&surfaces_out, &live.surface, &status_of_sewing, &end)
            })?),
            refine: spawn("refine", status, move || {
                refine_stage::run(&refine, &scans_out, &outbox_of_refine)
            })?,
        };
        Ok(Handle {
            subject,
            watch,
            threads,
            drops,
            outbox,
            folder,
        })
    }
}

impl Pipeline {
    /// Starts refinement alone, of a scan that was fused before; of `params` only what refinement needs is read.
    ///
    /// # Errors
    /// If the system gives no threads.
    pub fn spawn_refinement(
        recorded: RecordedScan,
        mut params: PipelineParams,
        folder: OutputFolder,
    ) -> Result<Handle, SpawnError> {
        let RecordedScan { info, scan } = recorded;
        params.warnings.extend_from_slice(&scan.warnings);
        let watch = watch(&info);
        // Frames that were fused before this run are told of as its own.
        let n_fused = scan.world_from_cameras.len() as u64;
        watch.status.update(|status| {
            (status.frames.produced, status.frames.fused) = (n_fused, n_fused);
            status.phase = Phase::Refining;
        });
        let refine = RefineSetup {
            keeps_scene: false,
            ..refine_setup(&params, &info, &watch)?
        };
        let outbox = Arc::new(Outbox::new(&folder, &watch));
        let outbox_of_refine = outbox.clone();
        let (scans_in, scans_out) = edges::scans();
        let status = &watch.status;
        let threads = Threads {
            device: None,
            fusion: spawn("fusion", status, move || {
                fusion_stage::send(scan, &scans_in)
            })?,
            recorder: None,
            sewing: None,
            refine: spawn("refine", status, move || {
                refine_stage::run(&refine, &scans_out, &outbox_of_refine)
            })?,
        };
        Ok(Handle {
            subject: subject(&params, &info, &folder),
            watch,
            threads,
            drops: Arc::new(DropCounts::default()),
            outbox,
            folder,
        })
    }
}

fn subject(params: &PipelineParams, info: &CameraInfo, folder: &OutputFolder) -> Subject {
    Subject {
        session: params.session.clone(),
        info: info.clone(),
        calibration: params.calibration_source.clone(),
        warnings: params.warnings.clone(),
        folder: folder.name().to_owned(),
    }
}

fn watch(info: &CameraInfo) -> Watch {
    let watch = Watch::default();
    watch
        .status
        .update(|status| status.n_announced = info.n_frames);
    watch
}

fn recorder(
    params: &PipelineParams,
    info: &CameraInfo,
    folder: &OutputFolder,
) -> Result<Recorder, SpawnError> {
    let recorder = Recorder::new(folder.path()).map_err(RecordingError::from)?;
    if !params.record {
        return Ok(recorder);
    }
    // With the calibration beside it a recording replays as it was taken.
    let calibration = params
        .calibration
        .to_toml()
        .map_err(SpawnError::Calibration)?;
    let max_covered = params.snapshot.max_covered_depth_share;
    let recorder = recorder.with_frames(info, &params.capture, max_covered)?;
    Ok(recorder
        .with_text(Calibration::FILE_NAME, &calibration)
        .map_err(RecordingError::from)?)
}

fn device_setup(
    params: &PipelineParams,
    camera: Box<dyn DepthCamera>,
    watch: &Watch,
) -> DeviceSetup {
    DeviceSetup {
        camera,
        capture: params.capture.clone(),
        record: params.record,
        ir_offset: IrOffset::nearest(params.calibration.ir_offset_px),
        end: watch.end.clone(),
        status: watch.status.clone(),
    }
}

fn fusion_setup(
    params: &PipelineParams,
    info: &CameraInfo,
    watch: &Watch,
    surfaces: Sender<SurfaceUpdate>,
    folder: &OutputFolder,
) -> Result<FusionSetup, ThreadPoolBuildError> {
    Ok(FusionSetup {
        info: info.clone(),
        fusion: params.fusion.clone(),
        infrared: infrared_optics(&params.fusion, &params.calibration, info),
        lamp: (info.sensor == Sensor::Kinect1)
            .then(|| under_its_light(&params.calibration, info))
            .flatten(),
        snapshot: params.snapshot.clone(),
        correction: DepthCorrection::new(
            info,
            &params.calibration,
            params.multipath.enabled,
            &params.fusion,
        ),
        self_calibration: self_calibration(params, info),
        poses: params.poses.clone(),
        pool: pool("track", params.n_threads)?,
        loops: loop_timing(params)?,
        status: watch.status.clone(),
        live: watch.live.clone(),
        surfaces,
        folder: folder.path().to_owned(),
        shading: None,
        stop: watch.stop.clone(),
    })
}

/// Frames of a recording wait while loops are closed, those of a live camera cannot.
fn loop_timing(params: &PipelineParams) -> Result<LoopTiming, ThreadPoolBuildError> {
    match params.when_full {
        _ if !params.fusion.loop_closing.while_scanning => Ok(LoopTiming::AtEnd),
        WhenFull::Block => Ok(LoopTiming::BetweenFrames),
        WhenFull::Drop => LoopTiming::aside(params.n_threads),
    }
}

/// What asks the images for the calibration by which depth is corrected; `None` where it does not depend on it.
fn self_calibration(params: &PipelineParams, info: &CameraInfo) -> Option<SelfCalibration> {
    let has_multipath = info.sensor == Sensor::Kinect2 && params.multipath.enabled;
    (has_multipath && params.refine.self_calibration.enabled).then(|| SelfCalibration {
        info: info.clone(),
        calibration: params.calibration.clone(),
        roi: params.roi,
        crop: params.object.crop,
        refine: params.refine.clone(),
    })
}

/// What tracking has to know of the infrared images; `None` where those that come with depth show the projector's speckle.
pub fn infrared_optics(
    fusion: &FusionParams,
    calibration: &Calibration,
    info: &CameraInfo,
) -> Option<InfraredOptics> {
    let is_used = info.sensor == Sensor::Kinect2 && fusion.use_infrared;
    is_used
        .then(|| under_its_light(calibration, info))
        .flatten()
}

/// What has to be known of images under a camera's light; `None` if it does not say where that is, or what full scale is.
fn under_its_light(calibration: &Calibration, info: &CameraInfo) -> Option<InfraredOptics> {
    Some(InfraredOptics {
        light: calibration.light.near_light(info.light?.position_m),
        calibration: calibration.clone(),
        full_scale: info.ir_full_scale?,
    })
}

fn refine_setup(
    params: &PipelineParams,
    info: &CameraInfo,
    watch: &Watch,
) -> Result<RefineSetup, ThreadPoolBuildError> {
    Ok(RefineSetup {
        info: info.clone(),
        object: params.object.clone(),
        refine: params.is_refined.then(|| params.refine.clone()),
        calibration: params.calibration.clone(),
        roi: params.roi,
        keeps_scene: true,
        pool: pool("refine", params.n_threads)?,
        status: watch.status.clone(),
        stop: watch.stop.clone(),
    })
}
