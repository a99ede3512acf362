//! Kinects that are plain files, and processes that find them where libusb should be.

use crate::{raw_kinect1::stamp_secs, support::PROGRAM};
use depth_camera::Image;
use freenect1::assembly::RawFrame;
use std::{
    env, fs,
    os::unix::fs::symlink,
    path::{Path, PathBuf},
    process::{Child, Command, Stdio},
    thread,
    time::{Duration, Instant},
};

/// Longest wait for what another process does; the machine may be busy.
const PATIENCE: Duration = Duration::from_secs(60);

/// A bus with Kinects on it.
pub struct Bus {
    root: tempfile::TempDir,
}

impl Bus {
    /// A bus with nothing on it.
    pub fn new() -> Self {
        let root = tempfile::tempdir().unwrap();
        let libraries = root.path().join("lib");
        fs::create_dir(&libraries).unwrap();
        let stand_in = env::current_exe().unwrap();
        let stand_in = stand_in.with_file_name("libusb_stand_in.so");
        assert!(stand_in.exists(), "cargo builds it as a dependency");
        symlink(stand_in, libraries.join("libusb-1.0.so.0")).unwrap();
        Bus { root }
    }

    /// Plugs in a Kinect described by the lines of `device`, which plays `frames`.
    pub fn plug(&self, name: &str, device: &str, frames: &[RawFrame]) {
        let folder = self.path(name);
        fs::create_dir(&folder).unwrap();
        let disparity = frames.iter().map(|frame| frame.disparity.as_ref());
        let ir = frames.iter().map(|frame| frame.ir.as_ref());
        fs::write(folder.join("depth11.u16"), bytes(disparity)).unwrap();
        fs::write(folder.join("ir10.u16"), bytes(ir)).unwrap();
        fs::write(folder.join("device.txt"), device).unwrap();
    }

    pub fn path(&self, name: &str) -> PathBuf {
        self.root.path().join(name)
    }

    /// Lets a file of a Kinect appear, which the stand-in notices.
    pub fn raise(&self, kinect: &str, flag: &str) {
        fs::write(self.path(kinect).join(flag), []).unwrap();
    }

    /// Lets it vanish.
    pub fn lower(&self, kinect: &str, flag: &str) {
        fs::remove_file(self.path(kinect).join(flag)).unwrap();
    }

    /// A process that takes the stand-in for libusb.
    fn process(&self, program: &Path) -> Command {
        let mut command = Command::new(program);
        command
            .env("LD_LIBRARY_PATH", self.path("lib"))
            .env("USB_STAND_IN", self.root.path());
        command
    }

    /// The program.
    pub fn relief(&self, arguments: &[&str]) -> Command {
        let mut command = self.process(Path::new(PROGRAM));
        // However full the disk is on which the tests run.
        command.env("RELIEF_CAPTURE__MIN_FREE_DISK_MB", "0");
        command.args(arguments);
        command
    }

    /// Runs `body` in a process of its own on this bus: the test of that name again.
    pub fn run_inside(&self, test: &str) {
        let status = self
            .process(&env::current_exe().unwrap())
            .args(["--exact", test, "--nocapture", "--test-threads=1"])
            .status()
            .unwrap();
        assert!(status.success(), "{test} ended with {status}");
    }
}

/// The folder of the bus that this process is on, if a test has started it there.
pub fn inside() -> Option<PathBuf> {
    env::var_os("USB_STAND_IN").map(PathBuf::from)
}

fn bytes<'a>(images: impl Iterator<Item = Option<&'a Image<u16>>>) -> Vec<u8> {
    let values = images.flat_map(|image| image.unwrap().data());
    values.flat_map(|value| value.to_le_bytes()).collect()
}

/// A program in the background, whose messages are kept.
pub struct Running {
    child: Child,
    log: PathBuf,
}

impl Running {
    /// Starts it; what it writes to standard error goes into a file of that name.
    pub fn start(bus: &Bus, log: &str, mut command: Command) -> Self {
        let log = bus.path(log);
        let child = command
            .stdout(Stdio::piped())
            .stderr(fs::File::create(&log).unwrap())
            .spawn()
            .unwrap();
        Running { child, log }
    }

    /// What it has said so far.
    pub fn said(&self) -> String {
        fs::read_to_string(&self.log).unwrap()
    }

    /// Waits until something holds.
    pub fn wait_until(&mut self, what: &str, mut holds: impl FnMut(&Running) -> bool) {
        let start = Instant::now();
        while !holds(self) {
            let ended = self.child.try_wait().unwrap();
            assert!(
                ended.is_none(),
                "{what}: ended with {ended:?}: {}",
                self.said()
            );
            assert!(start.elapsed() < PATIENCE, "{what}: {}", self.said());
            thread::sleep(Duration::from_millis(5));
        }
    }

    /// Asks it to end by a signal, and returns what it printed.
    pub fn interrupt(self) -> String {
        let id = self.child.id().to_string();
        let sent = Command::new("kill").args(["-INT", &id]).status().unwrap();
        assert!(sent.success());
        self.finish()
    }

    /// Waits for its end, and returns what it printed.
    pub fn finish(self) -> String {
        self.end_with(0)
    }

    /// Waits for its end with that exit code, and returns what it printed.
    pub fn end_with(self, code: i32) -> String {
        let Running { child, log } = self;
        let output = child.wait_with_output().unwrap();
        let said = fs::read_to_string(log).unwrap();
        assert_eq!(output.status.code(), Some(code), "{said}");
        String::from_utf8(output.stdout).unwrap()
    }
}

/// The lines of a list of images.
pub fn n_listed(list: &Path) -> usize {
    let text = fs::read_to_string(list).unwrap_or_default();
    text.lines().filter(|line| !line.starts_with('#')).count()
}

/// The line of `device.txt` that says so.
pub const ZERO_PLANE_LINE: &str = "reference_pixel_size_mm = 0.10344828";

/// Frames without a scene, each unlike the others.
pub fn noise_frames(n_frames: usize, seed: usize) -> Vec<RawFrame> {
    let image = |number: usize, height: usize, range: usize| {
        let value = |index: usize| (index * 2_654_435_761 + (number + 100 * seed) * 40_503) >> 7;
        let values = (0..640 * height).map(|index| (value(index) % range) as u16);
        Image::from_vec(640, height, values.collect())
    };
    (0..n_frames)
        .map(|number| RawFrame {
            frame_id: number as u64,
            device_time_secs: stamp_secs(number),
            host_time: Instant::now(),
            disparity: Some(image(number, 480, 2048)),
            ir: Some(image(number, 488, 1024)),
        })
        .collect()
}
