//! Loops that are closed while the scan goes on: a camera swings round a sphere with bumps, out of sight of where it began, and back.

use super::{ending_tests::setup, *};
use crate::{
    capture::{EventKind, Tracked},
    fusion::LoopClosingParams,
    geometry::motion_between,
    pipeline::{command::Command, edges, event_log::EventLog},
};
use depth_camera::{DepthCamera, Sensor};
use nalgebra::center;
use simulated::{Infrared, Orbit, Scene, Setup, SimulatedCamera, Trajectory};
use std::{
    num::NonZeroUsize,
    thread,
    time::{Duration, Instant},
};

/// There and back.
const N_FRAMES: usize = 215;

fn camera() -> SimulatedCamera {
    let scene = Scene::bumpy_sphere();
    let (low, high) = scene.object_bounds();
    SimulatedCamera::new(Setup {
        trajectory: Trajectory::Orbit(Orbit {
            target: center(&low, &high),
            distance_m: 0.6,
            azimuth_rad: 60_f64.to_radians(),
            elevation_rad: 40_f64.to_radians(),
            elevation_swing_rad: 5_f64.to_radians(),
            frames_per_swing: 90.0,
            tremor_rad: 0.1_f64.to_radians(),
        }),
        scene,
        sensor: Sensor::Kinect2,
        infrared: Infrared::of_sensor(Sensor::Kinect2),
        n_moving_frames: N_FRAMES,
        shading_frames: Vec::new(),
        reduction: 2,
        seed: 5,
    })
    .expect("half the size")
}

/// A scan under way.
struct Scan {
    camera: SimulatedCamera,
    stage: FusionStage,
    told: Receiver<Tracked>,
    last: Option<Arc<Frame>>,
    n_closed: usize,
}

impl Scan {
    fn new(loops: LoopTiming) -> Scan {
        let camera = camera();
        let info = camera.info().clone();
        let fusion = FusionParams {
            voxel_size_m: 0.004,
            depth_max_m: 1.5,
            loop_closing: LoopClosingParams {
                fragment_frames: 10,
                ..LoopClosingParams::default()
            },
            ..FusionParams::default()
        };
        let (surfaces, _) = edges::surfaces();
        let setup = FusionSetup {
            loops,
            ..setup(info, fusion, surfaces)
        };
        let (tracked, told) = edges::tracked(&EventLog::default());
        Scan {
            camera,
            stage: FusionStage::new(setup, tracked),
            told,
            last: None,
            n_closed: 0,
        }
    }

    fn take_next(&mut self) {
        let frame = self.camera.grab(Duration::ZERO).expect("no errors");
        self.take(Arc::new(frame.expect("not the last")));
    }

    fn take(&mut self, frame: Arc<Frame>) {
        self.stage.handle(&frame);
        self.last = Some(frame);
        let closed = |told: &Tracked| matches!(told, Tracked::Event(event) if matches!(event.kind, EventKind::LoopsClosed { .. }));
        self.n_closed += self.told.try_iter().filter(closed).count();
    }

    /// The camera rests: what it saw last comes once more.
    fn rest(&mut self) {
        let last = self.last.as_deref().expect("a frame");
        let again = Frame {
            frame_id: last.frame_id + 1,
            device_time_secs: last.device_time_secs + 1.0 / 30.0,
            host_time: last.host_time,
            depth: last.depth.clone(),
            ir: last.ir.clone(),
        };
        self.take(Arc::new(again));
    }

    /// Checks that loops were closed once, that path and shading images have moved together, and that the path is true while the
    /// camera moves, however long it rests then: within 4 mm in the mean, a voxel.
    fn check(&self) {
        assert_eq!(self.n_closed, 1);
        let path = &self.stage.trajectory;
        assert_eq!(self.stage.summary.n_fused, path.len() as u64);
        let selector = self.stage.selector.as_ref().expect("a Kinect II");
        let held = selector.held();
        assert!(held.len() > 5);
        for (snapshot, _) in held {
            let same = |(time_secs, _): &&(f64, Pose)| *time_secs == snapshot.device_time_secs;
            let (_, pose) = path.iter().find(same).expect("it was fused");
            let apart = motion_between(pose, &snapshot.world_from_camera);
            assert!(apart.translation_m < 1e-9 && apart.rotation_rad < 1e-7);
        }
        let first_from_table = self.camera.true_world_from_camera(0).inverse();
        let off_m = path.iter().take(N_FRAMES).enumerate();
        let off_m = off_m.map(|(frame, (_, pose))| {
            let truth = first_from_table * self.camera.true_world_from_camera(frame);
            motion_between(&truth, pose).translation_m
        });
        let mean_m = off_m.sum::<f64>() / N_FRAMES as f64;
        assert!(mean_m < 0.004, "{mean_m}");
    }
}

#[test]
fn a_recording_closes_them_once_between_two_frames_and_tracking_goes_on() {
    let mut scan = Scan::new(LoopTiming::BetweenFrames);
    for _ in 0..N_FRAMES {
        scan.take_next();
    }
    assert_eq!(scan.stage.trajectory.len(), N_FRAMES);
    scan.check();
}

#[test]
fn a_live_scan_closes_them_beside_tracking() {
    let mut scan = Scan::new(LoopTiming::aside(NonZeroUsize::MIN).expect("a thread"));
    for _ in 0..N_FRAMES {
        scan.take_next();
    }
    // An idle thread takes as long as others let it.
    let deadline = Instant::now() + Duration::from_secs(300);
    while scan.n_closed == 0 && Instant::now() < deadline {
        scan.rest();
        thread::sleep(Duration::from_millis(20));
    }
    let n_frames = scan.stage.trajectory.len();
    scan.rest();
    assert_eq!(
        scan.stage.trajectory.len(),
        n_frames + 1,
        "tracking goes on"
    );
    scan.check();
}

#[test]
fn taking_frames_back_gives_up_what_goes_on_beside() {
    let mut scan = Scan::new(LoopTiming::aside(NonZeroUsize::MIN).expect("a thread"));
    while !scan.stage.loops.is_under_way() {
        scan.take_next();
    }
    scan.stage.obey(Command::Reset);
    assert!(!scan.stage.loops.is_under_way());
    assert!(scan.stage.trajectory.is_empty());
    for _ in 0..3 {
        scan.rest();
    }
    assert_eq!(scan.stage.trajectory.len(), 3);
    assert_eq!(scan.n_closed, 0);
}
