//! A scan that is steered and looked at while it goes on: a camera that delivers when the test says so.

use crate::support::{poll, small_camera};
use crossbeam::channel::{Receiver, RecvTimeoutError, Sender, bounded};
use depth_camera::{CameraError, CameraInfo, DepthCamera, Frame};
use relief::{
    capture::CaptureParams,
    fusion::FusionParams,
    multipath::MultipathParams,
    pipeline::{
        Command, CommandRefused, Degradation, Ending, EventKind, Fault, Handle, OutputFolder,
        Pipeline, PipelineParams, RecordedScan, State, Status, Watch, WhenFull,
    },
    refine::{ObjectParams, RefineParams},
    shading::Calibration,
    snapshot::SnapshotParams,
};
use std::{
    ffi::OsStr,
    fs,
    num::NonZeroUsize,
    os::unix::ffi::OsStrExt,
    path::{Path, PathBuf},
    time::Duration,
};

/// A device that stops delivering for twice as long stalls, seconds: the test that has no device stall gives it time.
const PATIENT_SECS: f64 = 1.0;
const HASTY_SECS: f64 = 0.02;

/// What `grab` gives next.
type Answer = Result<Frame, CameraError>;

/// A live camera in the hands of a test; it ends when the test lets go of it.
struct FedCamera {
    info: CameraInfo,
    answers: Receiver<Answer>,
}

impl DepthCamera for FedCamera {
    fn info(&self) -> &CameraInfo {
        &self.info
    }

    fn grab(&mut self, timeout: Duration) -> Result<Option<Frame>, CameraError> {
        match self.answers.recv_timeout(timeout) {
            Ok(answer) => answer.map(Some),
            Err(RecvTimeoutError::Timeout) => Err(CameraError::Timeout { waited: timeout }),
            Err(RecvTimeoutError::Disconnected) => Ok(None),
        }
    }
}

/// A scan that goes on.
struct Scan {
    root: tempfile::TempDir,
    frames: std::vec::IntoIter<Frame>,
    feed: Option<Sender<Answer>>,
    handle: Handle,
    watch: Watch,
}

impl Scan {
    /// A scan of at most so many frames of 256×212.
    fn begin(n_frames: usize, grab_timeout_secs: f64) -> Self {
        let root = tempfile::tempdir().unwrap();
        let mut simulated = small_camera(n_frames, 2);
        let mut frames = Vec::new();
        while let Some(frame) = simulated.grab(Duration::ZERO).unwrap() {
            frames.push(frame);
        }
        let (feed, answers) = bounded(64);
        let info = CameraInfo {
            n_frames: None,
            ..simulated.info().clone()
        };
        let camera = Box::new(FedCamera { info, answers });
        let folder = OutputFolder::claim(&scan_folder(root.path())).unwrap();
        let handle = Pipeline::spawn(camera, params(grab_timeout_secs), folder).unwrap();
        Scan {
            root,
            frames: frames.into_iter(),
            feed: Some(feed),
            watch: handle.watch(),
            handle,
        }
    }

    fn folder(&self) -> PathBuf {
        scan_folder(self.root.path())
    }

    fn answer(&self, answer: Answer) {
        self.feed.as_ref().unwrap().send(answer).unwrap();
    }

    /// Delivers so many more frames and waits until none is on its way.
    fn feed(&mut self, n: usize) -> Status {
        let before = self.watch.status().frames.handled();
        for frame in self.frames.by_ref().take(n) {
            self.feed.as_ref().unwrap().send(Ok(frame)).unwrap();
        }
        self.until("frames", |status| {
            status.frames.handled() == before + n as u64
        })
    }

    /// Asks for something and waits until it is told as done by an event.
    fn ask(&self, command: Command, is_done: impl Fn(&EventKind) -> bool) -> EventKind {
        let seen = self
            .watch
            .events()
            .since(0)
            .last()
            .map_or(0, |(n, _)| n + 1);
        self.watch.command(command).unwrap();
        poll("an event", || {
            let events = self.watch.events().since(seen);
            let mut kinds = events.into_iter().map(|(_, event)| event.kind.clone());
            kinds.find(&is_done)
        })
    }

    fn until(&self, what: &str, is_so: impl Fn(&Status) -> bool) -> Status {
        poll(what, || {
            let status = self.watch.status();
            // At every moment, whatever is going on.
            assert_eq!(status.frames.unaccounted(), 0, "{:?}", status.frames);
            is_so(&status).then_some(status)
        })
    }
}

/// A folder whose name is no UTF-8: that is no matter to a scan.
fn scan_folder(root: &Path) -> PathBuf {
    root.join(OsStr::from_bytes(b"scan-\xff"))
}

fn params(grab_timeout_secs: f64) -> PipelineParams {
    PipelineParams {
        session: "live".to_owned(),
        capture: CaptureParams {
            grab_timeout_secs,
            ..CaptureParams::default()
        },
        multipath: MultipathParams { enabled: false },
        fusion: FusionParams {
            voxel_size_m: 0.004,
            ..FusionParams::default()
        },
        snapshot: SnapshotParams::default(),
        object: ObjectParams::default(),
        refine: RefineParams::default(),
        is_refined: false,
        calibration: Calibration::shipped(depth_camera::Sensor::Kinect2).unwrap(),
        calibration_source: "shipped".to_owned(),
        roi: None,
        poses: None,
        n_threads: NonZeroUsize::new(2).unwrap(),
        when_full: WhenFull::Block,
        record: false,
        warnings: Vec::new(),
    }
}

fn n_poses(folder: &Path) -> usize {
    let text = fs::read_to_string(folder.join("trajectory.txt")).unwrap();
    text.lines().filter(|line| !line.starts_with('#')).count()
}

#[test]
fn a_scan_is_paused_undone_written_down_begun_anew_and_finished() {
    let mut scan = Scan::begin(40, PATIENT_SECS);
    let watch = scan.watch.clone();
    assert_eq!(watch.status().state, State::Warming);
    let undo = Command::Undo { secs: 0.1 };
    assert_eq!(watch.command(undo), Err(CommandRefused::NothingFused));
    assert_eq!(
        watch.command(Command::Resume),
        Err(CommandRefused::NotPaused)
    );
    let status = scan.feed(8);
    assert_eq!((status.frames.fused, status.state), (8, State::Tracking));

    // Two commands in a row need not wait for each other.
    watch.command(Command::Pause).unwrap();
    assert_eq!(
        watch.command(Command::Pause),
        Err(CommandRefused::AlreadyPaused)
    );
    assert_eq!(
        watch.command(Command::Snapshot),
        Err(CommandRefused::Paused)
    );
    scan.until("a pause", |status| status.state == State::Paused);
    let status = scan.feed(2);
    assert_eq!((status.frames.fused, status.frames.paused), (8, 2));
    scan.ask(Command::Resume, |kind| *kind == EventKind::Resumed);
    let status = scan.feed(4);
    assert_eq!(status.frames.fused, 12, "in the same model");

    // Frames are 1/30 s apart.
    let undone = scan.ask(Command::Undo { secs: 0.05 }, |kind| {
        matches!(kind, EventKind::Undone { .. })
    });
    assert_eq!(undone, EventKind::Undone { n_frames: 2 });
    let status = scan.feed(1);
    assert_eq!((status.frames.fused, status.frames.lost), (13, 0));

    let written = scan.ask(Command::Refine, |kind| {
        matches!(kind, EventKind::Interim { .. } | EventKind::Refused { .. })
    });
    assert_eq!(written, EventKind::Interim { number: 1 });
    let interim = watch.live().interim().unwrap();
    assert_eq!(interim.number, 1);
    let interim = RecordedScan::read(&interim.folder).unwrap();
    assert_eq!(interim.scan.world_from_cameras.len(), 11);
    assert!(!interim.scan.snapshots.unwrap().accepted.is_empty());

    scan.ask(Command::Reset, |kind| *kind == EventKind::Reset);
    for command in [undo, Command::Refine] {
        let refused = watch.command(command);
        assert_eq!(refused, Err(CommandRefused::NothingFused), "{command:?}");
    }
    let status = scan.feed(3);
    assert_eq!(status.frames.fused, 16);
    watch.command(Command::Finish).unwrap();
    assert_eq!(watch.command(Command::Pause), Err(CommandRefused::Ending));

    let folder = scan.folder();
    let outcome = scan.handle.join();
    assert_eq!(outcome.failures, Vec::<String>::new());
    let frames = outcome.report.frames;
    assert_eq!((frames.total, frames.fused, frames.paused), (18, 16, 2));
    assert_eq!(frames.in_model, 3, "the others were taken back");
    assert_eq!(frames.unaccounted, 0);
    assert_eq!(n_poses(&folder), 3, "since the scan was begun anew");
    assert!(outcome.report.base_mesh.faces > 0);
    drop(scan.feed);
}

#[test]
fn a_scan_whose_frames_were_all_taken_back_says_so() {
    let mut scan = Scan::begin(40, PATIENT_SECS);
    scan.feed(3);
    scan.ask(Command::Reset, |kind| *kind == EventKind::Reset);
    scan.watch.command(Command::Finish).unwrap();
    let outcome = scan.handle.join();
    let [failure] = &outcome.failures[..] else {
        panic!("one failure: {:?}", outcome.failures);
    };
    assert!(failure.ends_with("0 dropped, 3 taken back"), "{failure}");
    drop(scan.feed);
}

#[test]
fn a_shading_image_is_taken_on_request_or_refused_with_the_reason() {
    let mut scan = Scan::begin(130, PATIENT_SECS);
    scan.feed(3);
    scan.watch.command(Command::Snapshot).unwrap();
    let again = || scan.watch.command(Command::Snapshot);
    poll("the request", || {
        (again() == Err(CommandRefused::AlreadySnapshotting)).then_some(())
    });
    let before = scan.watch.status().snapshots.accepted;
    let status = scan.feed(1);
    assert_eq!(
        (status.snapshots.accepted, status.is_snapshotting),
        (before + 1, false)
    );

    // With all of the images overexposed none comes.
    scan.watch.command(Command::Snapshot).unwrap();
    scan.until("the request", |status| status.is_snapshotting);
    let n = scan.watch.status().frames.handled();
    for mut frame in scan.frames.by_ref().take(95) {
        if let Some(ir) = &mut frame.ir {
            ir.data_mut().fill(u16::MAX);
        }
        scan.feed.as_ref().unwrap().send(Ok(frame)).unwrap();
    }
    let status = scan.until("frames", |status| status.frames.handled() == n + 95);
    assert!(!status.is_snapshotting);
    assert_eq!(
        status.state,
        State::Degraded(Degradation::SaturatedInfrared)
    );
    assert_eq!(status.ir_saturated_share, Some(1.0));
    let refused = scan
        .watch
        .events()
        .since(0)
        .into_iter()
        .find_map(|(_, event)| match &event.kind {
            EventKind::Refused { command, reason } => Some((*command, reason.clone())),
            _ => None,
        });
    let (command, reason) = refused.unwrap();
    assert_eq!(command, "snapshot");
    assert!(
        reason.contains("100.0 % of the pixels are saturated"),
        "{reason}"
    );

    let strip = poll("the strip", || {
        scan.watch
            .live()
            .snapshots()
            .filter(|strip| !strip.is_empty())
    });
    assert!(
        strip
            .iter()
            .any(|snapshot| snapshot.accepted && snapshot.thumbnail.is_some())
    );
    let saturated = strip
        .iter()
        .find(|snapshot| snapshot.code == Some("saturated"));
    assert!(saturated.unwrap().advice.is_some());
    scan.watch.command(Command::Abandon).unwrap();
    let outcome = scan.handle.join();
    assert_eq!(outcome.ending, Ending::Stopped);
    assert_eq!(outcome.report.frames.unaccounted, 0);
    drop(scan.feed);
}

#[test]
fn who_looks_sees_the_scan_grow() {
    let mut scan = Scan::begin(60, PATIENT_SECS);
    let live = scan.watch.live().clone();
    scan.feed(5);
    assert!(
        live.depth().is_none() && live.surface().is_none(),
        "nobody has looked"
    );
    scan.feed(10);
    let (depth, infrared) = poll("previews", || {
        scan.feed(1);
        Some((live.depth()?, live.infrared()?))
    });
    assert_eq!((depth.width, depth.height), (256, 212));
    assert!(depth.pixels.iter().any(|pixel| (2..254).contains(pixel)));
    assert!(infrared.pixels.iter().any(|pixel| *pixel > 1));
    // Fusion fills the slots between frames too.
    let (pose, path) = poll("the path", || Some((live.pose()?, live.path()?)));
    assert!(!pose.is_lost);
    assert_eq!(pose.world_from_camera, pose.last_good);
    assert_eq!(path.len() as u64, scan.watch.status().frames.fused);
    let surface = poll("the surface", || live.surface());
    assert_eq!(surface.coverage.len(), surface.positions.len());
    assert_eq!(surface.normals.len(), surface.positions.len());
    let n_vertices = surface.positions.len() as u32;
    assert!(!surface.faces.is_empty());
    assert!(
        surface
            .faces
            .iter()
            .flatten()
            .all(|vertex| *vertex < n_vertices)
    );
    assert!(surface.coverage.iter().any(|covered| *covered > 0));
    assert!(surface.coverage.iter().any(|covered| *covered < 255));
    let mesh = scan
        .until("the mesh's size", |status| status.mesh.is_some())
        .mesh
        .unwrap();
    assert!(mesh.revision >= surface.revision && mesh.faces > 0);
    let next = poll("the next view", || live.next_view());
    assert!(next.why.ends_with('.'), "{}", next.why);

    scan.feed = None;
    let outcome = scan.handle.join();
    assert_eq!(outcome.report.frames.unaccounted, 0);
    assert_eq!(outcome.ending, Ending::Complete);
}

#[test]
fn a_device_that_is_unplugged_comes_back_into_the_same_model() {
    let mut scan = Scan::begin(12, HASTY_SECS);
    scan.feed(6);
    let stalled = State::Lost(relief::pipeline::Loss::DeviceStalled);
    scan.until("silence", |status| status.state == stalled);
    scan.answer(Err(CameraError::Disconnected));
    let gone = State::Fault(Fault::DeviceGone);
    scan.until("the loss", |status| status.state == gone);
    let status = scan.feed(6);
    assert_eq!(status.frames.fused, 12);
    scan.feed = None;
    let folder = scan.folder();
    let outcome = scan.handle.join();
    assert_eq!(outcome.failures, Vec::<String>::new());
    let events = fs::read_to_string(folder.join("events.jsonl")).unwrap();
    for line in [
        r#""event":"device","health":"gone""#,
        r#""event":"device","health":"streaming""#,
        r#""event":"state","state":"fault","reason":"device_gone""#,
        r#""event":"state","state":"tracking","reason":null"#,
    ] {
        assert!(events.contains(line), "no {line} in {events}");
    }
}
