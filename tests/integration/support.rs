//! Small recordings, and the program as a process.

use depth_camera::{CameraInfo, DepthCamera, Sensor};
use nalgebra::center;
use replay::SessionWriter;
use serde_json::Value;
use simulated::{Infrared, Scene, Setup, SimulatedCamera, Trajectory};
use std::{
    fmt::Write,
    fs,
    path::{Path, PathBuf},
    process::{Command, Output},
    sync::OnceLock,
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
    let info = camera.info().clone();
    record_as(&info, &mut camera, folder);
}

/// The same as if of a camera that is said to be another.
pub fn record_as(said: &CameraInfo, camera: &mut SimulatedCamera, folder: &Path) {
    let mut writer = SessionWriter::create(folder, said, 5000.0).unwrap();
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
        let bench = Workbench::empty();
        record(small_camera(n_frames, 4), &bench.session());
        bench
    }

    /// A folder without a recording.
    pub fn empty() -> Self {
        Workbench {
            root: tempfile::tempdir().unwrap(),
        }
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

/// Lists the images of a recording over and over, a minute long.
pub fn prolong(session: &Path) {
    for kind in ["depth", "ir"] {
        let path = session.join(format!("{kind}.txt"));
        let list = fs::read_to_string(&path).unwrap();
        let image = list.lines().last().unwrap().split_once(' ').unwrap().1;
        let mut longer = String::new();
        for frame in 0..1800 {
            writeln!(longer, "{:.6} {image}", 100.0 + f64::from(frame) / 30.0).unwrap();
        }
        fs::write(path, longer).unwrap();
    }
}

/// The recording that comes with the source.
pub fn demo() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/data/demo")
}

/// A configuration by which the demo becomes a refined mesh within seconds, also where the processors are busy.
pub const COARSE: &str = "\
[multipath]
enabled = false
[fusion]
voxel_size_m = 0.006
[snapshot]
max_snapshots = 6
[refine]
edge_length_m = 0.006
n_rounds = 1
max_turns = 1
max_steps = 1
[worker]
turns = \"shared\"
nice = 0
";

/// A configuration by which a single frame makes a surface.
pub const EVERY_FRAME: &str = "[fusion]\nmin_surface_weight = 0.1\n";

/// Fuses a session into a folder and does not refine it. Multipath stays in, since most of the time would go into taking it off.
pub fn fuse(session: &Path, out: &Path, arguments: &[&str]) {
    let output = Command::new(PROGRAM)
        .arg("replay")
        .arg(session)
        .arg("--out")
        .arg(out)
        .args(["--no-refine", "--json"])
        .args(arguments)
        .env("RELIEF_MULTIPATH__ENABLED", "false")
        .output()
        .unwrap();
    assert_says(&output, 0, &[]);
}

/// Puts the fused demo into a folder: it is fused once for all tests, and each may spoil its own files.
pub fn fused_demo(scan: &Path) {
    static FUSED: OnceLock<Vec<(PathBuf, Vec<u8>)>> = OnceLock::new();
    let files = FUSED.get_or_init(|| {
        let root = tempfile::tempdir().unwrap();
        let out = root.path().join("demo");
        fuse(&demo(), &out, &[]);
        read_beneath(&out)
    });
    for (name, bytes) in files {
        let path = scan.join(name);
        fs::create_dir_all(path.parent().unwrap()).unwrap();
        fs::write(path, bytes).unwrap();
    }
}

/// The files of a folder and of those in it, by their paths there.
fn read_beneath(folder: &Path) -> Vec<(PathBuf, Vec<u8>)> {
    let mut files = Vec::new();
    let mut folders = vec![PathBuf::new()];
    while let Some(inner) = folders.pop() {
        for entry in fs::read_dir(folder.join(&inner)).unwrap() {
            let name = inner.join(entry.unwrap().file_name());
            let path = folder.join(&name);
            match path.is_dir() {
                true => folders.push(name),
                false => files.push((name, fs::read(path).unwrap())),
            }
        }
    }
    files
}

/// Generous: a busy machine is no fault.
const GRACE: Duration = Duration::from_secs(120);

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
