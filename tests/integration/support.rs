//! Small recordings, and the program as a process.

use depth_camera::{DepthCamera, Sensor};
use nalgebra::center;
use replay::SessionWriter;
use serde_json::Value;
use simulated::{Infrared, Scene, Setup, SimulatedCamera, Trajectory};
use std::{
    fs,
    path::{Path, PathBuf},
    process::{Command, Output},
    thread,
    time::{Duration, Instant},
};

/// A Kinect II with larger pixels, led round the plaque.
pub fn small_camera(n_frames: usize, reduction: usize) -> SimulatedCamera {
    let scene = Scene::plaque();
    let (low, high) = scene.object_bounds();
    SimulatedCamera::new(Setup {
        trajectory: Trajectory::hand_held(center(&low, &high), n_frames),
        scene,
        sensor: Sensor::Kinect2,
        infrared: Infrared::of_sensor(Sensor::Kinect2),
        n_moving_frames: n_frames,
        shading_frames: Vec::new(),
        reduction,
        seed: 1,
    })
    .unwrap()
}

/// Records all that a camera delivers.
pub fn record(mut camera: SimulatedCamera, folder: &Path) {
    let mut writer = SessionWriter::create(folder, camera.info(), 5000.0).unwrap();
    while let Some(frame) = camera.grab(Duration::ZERO).unwrap() {
        writer.write(&frame).unwrap();
    }
    writer.finish().unwrap();
}

/// A folder with a recording of a few small frames in it, which a test may spoil.
pub struct Workbench {
    root: tempfile::TempDir,
}

impl Workbench {
    /// A recording of so many frames of 128×106.
    pub fn with_frames(n_frames: usize) -> Self {
        let bench = Workbench {
            root: tempfile::tempdir().unwrap(),
        };
        record(small_camera(n_frames, 4), &bench.session());
        bench
    }

    /// The recording.
    pub fn session(&self) -> PathBuf {
        self.path("session")
    }

    /// A path in the folder.
    pub fn path(&self, name: &str) -> PathBuf {
        self.root.path().join(name)
    }

    /// Writes a file and returns its path.
    pub fn write(&self, name: &str, text: &str) -> PathBuf {
        let path = self.path(name);
        fs::write(&path, text).unwrap();
        path
    }

    /// Replaces a piece of a file of the recording.
    pub fn edit(&self, name: &str, old: &str, new: &str) {
        let path = self.session().join(name);
        let text = fs::read_to_string(&path).unwrap();
        assert!(text.contains(old), "{name} holds {old}");
        fs::write(path, text.replacen(old, new, 1)).unwrap();
    }

    /// `relief replay` of the recording into `out`, fusing only, with more arguments.
    pub fn replay(&self, arguments: &[&str]) -> Output {
        let session = self.session();
        let out = self.path("out");
        let fixed = [session.to_str().unwrap(), "--out", out.to_str().unwrap()];
        Command::new(PROGRAM)
            .arg("replay")
            .args(fixed)
            .args(["--no-refine", "--json"])
            .args(arguments)
            .output()
            .unwrap()
    }
}

/// Generous: a busy machine is no fault.
const GRACE: Duration = Duration::from_secs(30);

/// Looks again and again until there is an answer.
pub fn poll<T>(what: &str, mut look: impl FnMut() -> Option<T>) -> T {
    let deadline = Instant::now() + GRACE;
    loop {
        if let Some(answer) = look() {
            return answer;
        }
        assert!(Instant::now() < deadline, "{what} took more than {GRACE:?}");
        thread::sleep(Duration::from_millis(10));
    }
}

/// The program.
pub const PROGRAM: &str = env!("CARGO_BIN_EXE_relief");

/// The one object that a run printed.
pub fn summary(output: &Output) -> Value {
    let text = String::from_utf8_lossy(&output.stdout);
    assert_eq!(text.lines().count(), 1, "{text}");
    serde_json::from_str(&text).unwrap()
}

/// Asserts how a run ended and what it said.
pub fn assert_says(output: &Output, code: i32, pieces: &[&str]) {
    let said = String::from_utf8_lossy(&output.stderr);
    assert_eq!(output.status.code(), Some(code), "{said}");
    for piece in pieces {
        assert!(said.contains(piece), "no \"{piece}\" in: {said}");
    }
}
