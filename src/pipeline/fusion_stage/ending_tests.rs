//! How fusion ends, whatever frames and commands are on their way to it when capture ends.

use super::*;
use crate::{
    capture::{EventKind, Tracked},
    geometry::motion_between,
    pipeline::{
        command::Command,
        edges::{self, WhenFull},
        event_log::EventLog,
        status::{Phase, Status},
        threads::pool,
        under_its_light,
    },
    refine::RefineParams,
    shading::Calibration,
    snapshot::ShadingSnapshot,
};
use crossbeam::channel::TryRecvError;
use depth_camera::{DepthCamera, Sensor};
use proptest::{collection::vec, prelude::*, sample::select};
use simulated::{Infrared, Scene, Setup, SimulatedCamera, Trajectory};
use std::{num::NonZeroUsize, sync::LazyLock, time::Instant};

static INFO: LazyLock<CameraInfo> =
    LazyLock::new(|| SimulatedCamera::kinect1_plaque(1, 0).info().clone());

/// Commands that are told of by an event of their own, whatever becomes of them.
const COMMANDS: [Command; 5] = [
    Command::Pause,
    Command::Resume,
    Command::Undo { secs: 2.0 },
    Command::Refine,
    Command::Reset,
];

/// Fusion that writes nothing, of a camera that nobody corrects, on one thread.
pub(super) fn setup(
    info: CameraInfo,
    fusion: FusionParams,
    surfaces: Sender<SurfaceUpdate>,
) -> FusionSetup {
    let calibration = Calibration::shipped_for(&info);
    FusionSetup {
        correction: DepthCorrection::new(&info, &calibration.unwrap(), false, &fusion),
        info,
        fusion,
        infrared: None,
        lamp: None,
        snapshot: SnapshotParams::default(),
        self_calibration: None,
        poses: None,
        pool: pool("track", NonZeroUsize::MIN).unwrap(),
        loops: LoopTiming::AtEnd,
        status: StatusSlot::default(),
        live: Live::default(),
        surfaces,
        folder: PathBuf::from("nothing is written here"),
        shading: None,
        stop: StopToken::default(),
    }
}

fn frame(frame_id: u64) -> Arc<Frame> {
    Arc::new(Frame {
        frame_id,
        device_time_secs: frame_id as f64,
        host_time: Instant::now(),
        depth: None,
        ir: None,
    })
}

/// The command that an event tells of.
fn command_of(kind: EventKind) -> Option<&'static str> {
    match kind {
        EventKind::Paused => Some("pause"),
        EventKind::Resumed => Some("resume"),
        EventKind::Reset => Some("reset"),
        EventKind::Refused { command, .. } => Some(command),
        _ => None,
    }
}

fn name(command: &Command) -> &'static str {
    match command {
        Command::Pause => "pause",
        Command::Resume => "resume",
        Command::Undo { .. } => "undo",
        Command::Refine => "refine",
        _ => "reset",
    }
}

/// Runs fusion on what is on its way while both ends of capture are gone: the status it leaves, and the commands it told of.
fn run_with(n_frames: u64, commands: &[Command], stop: &StopToken) -> (Status, Vec<&'static str>) {
    let status = StatusSlot::default();
    let (frames_in, frames_out) = edges::frames(WhenFull::Block, &status);
    let (commands_in, commands_out) = edges::commands();
    let (tracked_in, tracked_out) = edges::tracked(&EventLog::default());
    let (surfaces_in, _surfaces) = edges::surfaces();
    let (scans_in, scans_out) = edges::scans();
    for frame_id in 0..n_frames {
        assert!(frames_in.send(frame(frame_id)));
    }
    for command in commands {
        commands_in.try_send(*command).unwrap();
    }
    drop(frames_in);
    let setup = FusionSetup {
        status: status.clone(),
        stop: stop.clone(),
        ..setup(INFO.clone(), FusionParams::default(), surfaces_in)
    };
    run(setup, frames_out, &commands_out, tracked_in, scans_in);
    // Whoever waits for a scan learns that there is none.
    assert_eq!(
        scans_out.try_recv().unwrap_err(),
        TryRecvError::Disconnected
    );
    let told = tracked_out.iter().filter_map(|tracked| match tracked {
        Tracked::Event(event) => command_of(event.kind),
        _ => None,
    });
    (status.get(), told.collect())
}

#[test]
fn images_are_asked_for_the_calibration_where_there_are_some_and_the_scan_is_not_stopped() {
    let info = SimulatedCamera::kinect2_plaque(1, 0).info().clone();
    let self_calibration = SelfCalibration {
        info: info.clone(),
        calibration: Calibration::shipped_for(&info).unwrap(),
        // Nothing lies in it: that it was looked for is all that is asked.
        roi: Some(Roi::of_bounds([0.0, 0.0, 0.0, 1.0, 1.0, 1.0]).unwrap()),
        crop: Crop::None,
        refine: RefineParams::default(),
    };
    let (surfaces, _) = edges::surfaces();
    let setup = FusionSetup {
        self_calibration: Some(self_calibration),
        ..setup(info, FusionParams::default(), surfaces)
    };
    let (tracked, _) = edges::tracked(&EventLog::default());
    let mut stage = FusionStage::new(setup, tracked);
    let mut selection = SnapshotSelection::default();
    stage.recalibrate(Some(&selection));
    selection.accepted.push(ShadingSnapshot {
        frame_id: 0,
        device_time_secs: 0.0,
        n_exposures: 1,
        ir_counts: Image::filled(1, 1, 0.0),
        unlit_counts: None,
        depth_m: Image::filled(1, 1, 0.0),
        world_from_camera: Pose::identity(),
        moved: None,
    });
    stage.stop.stop();
    stage.recalibrate(Some(&selection));
    assert_eq!(stage.revision_clock.timing(), None);
    stage.stop = StopToken::default();
    stage.recalibrate(Some(&selection));
    assert!(stage.revision_clock.timing().is_some());
}

#[test]
fn a_shading_image_settles_as_its_depth_does_and_keeps_its_place_beside_it() {
    let mut camera = SimulatedCamera::kinect2_plaque(60, 3);
    let params = FusionParams {
        voxel_size_m: 0.004,
        depth_max_m: 1.5,
        ..FusionParams::default()
    };
    let (surfaces, _) = edges::surfaces();
    let setup = setup(camera.info().clone(), params, surfaces);
    let (tracked, _) = edges::tracked(&EventLog::default());
    let mut stage = FusionStage::new(setup, tracked);
    let frames = (0..10).map(|_| {
        let frame = camera.grab(Duration::ZERO).unwrap().unwrap();
        let outcome = stage.fuse(&frame);
        assert_eq!(stage.account(&frame, outcome.as_ref()), Place::Fused);
        frame
    });
    let frames: Vec<Frame> = frames.collect();
    let depth = frames[6].depth.as_ref().unwrap();
    let (time_secs, world_from_depth) = stage.trajectory[6];
    let settled = stage.fusion.settle(depth, &world_from_depth).unwrap();
    let depth_from_image = Pose::translation(0.002, 0.0, 0.0);
    let mut selection = SnapshotSelection::default();
    selection.accepted.push(ShadingSnapshot {
        frame_id: 7,
        device_time_secs: time_secs + 0.01,
        n_exposures: 1,
        ir_counts: Image::filled(1, 1, 0.0),
        unlit_counts: None,
        depth_m: depth.clone(),
        world_from_camera: world_from_depth * depth_from_image,
        moved: None,
    });
    stage.settle(Some(&mut selection));
    let off = motion_between(
        &(settled * depth_from_image),
        &selection.accepted[0].world_from_camera,
    );
    assert!(
        off.translation_m < 1e-9 && off.rotation_rad < 1e-6,
        "{off:?}"
    );
}

#[test]
fn a_shading_image_of_a_camera_that_moved_is_put_where_its_light_says() {
    /// The image is taken where this frame was, and told to lie between the ones two before and two after.
    const HELD: usize = 12;
    let scene = Scene::plaque();
    let (low, high) = scene.object_bounds();
    let mut camera = SimulatedCamera::new(Setup {
        scene,
        trajectory: Trajectory::hand_held(nalgebra::center(&low, &high), 40),
        sensor: Sensor::Kinect1,
        infrared: Infrared::of_sensor(Sensor::Kinect1),
        n_moving_frames: 20,
        shading_frames: vec![HELD],
        reduction: 2,
        seed: 9,
    })
    .unwrap();
    let info = camera.info().clone();
    let params = FusionParams {
        voxel_size_m: 0.004,
        depth_max_m: 1.5,
        ..FusionParams::default()
    };
    let (surfaces, _) = edges::surfaces();
    let setup = FusionSetup {
        lamp: under_its_light(&Calibration::shipped_for(&info).unwrap(), &info),
        ..setup(info, params, surfaces)
    };
    let (tracked, _) = edges::tracked(&EventLog::default());
    let mut stage = FusionStage::new(setup, tracked);
    let (mut depth_m, mut exposure) = (Vec::new(), None);
    while let Some(frame) = camera.grab(Duration::ZERO).unwrap() {
        if frame.depth_share() < 0.1 {
            exposure = frame.ir;
            continue;
        }
        let outcome = stage.fuse(&frame);
        assert_eq!(stage.account(&frame, outcome.as_ref()), Place::Fused);
        depth_m.push(frame.depth.unwrap());
    }
    let [before, held, after] = [HELD - 2, HELD, HELD + 2].map(|frame| stage.trajectory[frame].1);
    let mut selection = SnapshotSelection::default();
    selection.accepted.push(ShadingSnapshot {
        frame_id: 0,
        device_time_secs: 0.0,
        n_exposures: 1,
        ir_counts: exposure.unwrap().map(|&counts| f32::from(counts)),
        unlit_counts: None,
        depth_m: depth_m[HELD - 2].clone(),
        world_from_camera: before,
        moved: Some(before.inverse() * after),
    });
    stage.place_on_their_ways(Some(&mut selection));
    let placed = &selection.accepted[0].world_from_camera;
    let way_m = motion_between(&before, &after).translation_m;
    let off_m = motion_between(&held, placed).translation_m;
    assert!(off_m < 0.25 * way_m, "{off_m} m of {way_m}");
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(64))]

    #[test]
    fn frames_on_their_way_are_accounted_for_and_commands_are_obeyed_or_refused(
        n_frames in 0..=4u64,
        commands in vec(select(&COMMANDS[..]), 0..=8),
        is_stopped in any::<bool>(),
    ) {
        let stop = StopToken::default();
        if is_stopped {
            stop.stop();
        }
        let (status, told) = run_with(n_frames, &commands, &stop);
        prop_assert_eq!(told, commands.iter().map(name).collect::<Vec<_>>());
        let accounts = status.frames;
        let handled = if is_stopped { 0 } else { n_frames };
        prop_assert_eq!((accounts.handled(), accounts.dropped), (handled, n_frames - handled));
        prop_assert_eq!((accounts.in_flight, accounts.unaccounted()), (0, 0));
        prop_assert_eq!((status.phase, status.state), (Phase::Meshing, State::Draining));
    }
}
