//! Scenarios, and the process that plays them.

use std::{
    env, fs,
    os::unix::fs::symlink,
    path::{Path, PathBuf},
    process::Command,
    sync::{Mutex, PoisonError},
    time::{Duration, Instant},
};

use depth_camera::{CameraError, DepthCamera, Frame};
use freenect1::{
    Freenect1Camera,
    assembly::{RawFrame, Statistics},
};

/// Frames that a scenario plays over and over.
pub const N_FRAMES: usize = 8;

pub const SECOND: Duration = Duration::from_secs(1);

/// Runs `body` in a process that takes the stand-in for libusb, with a Kinect described by each of `devices`.
pub fn on_stand_in(test: &str, devices: &[&str], body: impl FnOnce(&Path)) {
    on_stand_in_under(&[], test, devices, body);
}

/// As [`on_stand_in`], the process started by another program.
pub fn on_stand_in_under(wrapper: &[&str], test: &str, devices: &[&str], body: impl FnOnce(&Path)) {
    if let Some(root) = env::var_os("USB_STAND_IN") {
        return body(&PathBuf::from(root));
    }
    // One at a time: they keep time, and the machine may have few cores.
    static TURN: Mutex<()> = Mutex::new(());
    let _turn = TURN.lock().unwrap_or_else(PoisonError::into_inner);
    let folder = tempfile::tempdir().unwrap();
    let test_binary = env::current_exe().unwrap();
    let stand_in = test_binary.with_file_name("libusb_stand_in.so");
    assert!(stand_in.exists(), "cargo builds it as a dependency");
    let libraries = folder.path().join("lib");
    fs::create_dir(&libraries).unwrap();
    symlink(stand_in, libraries.join("libusb-1.0.so.0")).unwrap();
    for (index, device) in devices.iter().enumerate() {
        let kinect = folder.path().join(format!("kinect{index}"));
        fs::create_dir(&kinect).unwrap();
        fs::write(kinect.join("device.txt"), device).unwrap();
        write_frames(&kinect);
    }
    let mut words = wrapper.iter().map(PathBuf::from).chain([test_binary]);
    let status = Command::new(words.next().unwrap())
        .args(words)
        .args(["--exact", test, "--nocapture", "--test-threads=1"])
        .env("LD_LIBRARY_PATH", &libraries)
        .env("USB_STAND_IN", folder.path())
        .status()
        .unwrap();
    assert!(status.success(), "{test} ended with {status}");
}

/// Value `index` of frame `frame`; the first one is the frame's number.
fn value(frame: usize, index: usize, range: usize) -> u16 {
    match index {
        0 => frame as u16,
        _ => ((index * 2_654_435_761 + frame * 40_503) >> 7) as u16 % range as u16,
    }
}

fn values(frame: usize, n_values: usize, range: usize) -> impl Iterator<Item = u16> {
    (0..n_values).map(move |index| value(frame, index, range))
}

fn write_frames(folder: &Path) {
    for (file, n_values, range) in [
        ("depth11.u16", 640 * 480, 2048),
        ("ir10.u16", 640 * 488, 1024),
        ("ir10-high.u16", 1280 * 1024, 1024),
    ] {
        let frames = (0..N_FRAMES).flat_map(|frame| values(frame, n_values, range));
        let bytes: Vec<u8> = frames.flat_map(u16::to_le_bytes).collect();
        fs::write(folder.join(file), bytes).unwrap();
    }
}

/// Checks every value of a frame against what was sent; returns which frame it is.
pub fn assert_bit_exact(frame: &RawFrame) -> usize {
    let disparity = frame.disparity.as_ref().map(|image| {
        assert_eq!((image.width(), image.height()), (640, 480));
        let number = usize::from(*image.at(0, 0));
        assert!(
            image
                .data()
                .iter()
                .copied()
                .eq(values(number, 640 * 480, 2048))
        );
        number
    });
    let ir = frame.ir.as_ref().map(|image| {
        assert_eq!(image.width() * image.height(), image.data().len());
        let number = usize::from(*image.at(0, 0));
        let n_values = image.data().len();
        assert!(
            image
                .data()
                .iter()
                .copied()
                .eq(values(number, n_values, 1024))
        );
        number
    });
    if let (Some(disparity), Some(ir)) = (disparity, ir) {
        assert_eq!(disparity, ir, "depth and IR are not of one frame");
    }
    disparity.or(ir).expect("a frame holds something")
}

/// The next frame that is whole: a busy machine leaves packets without a transfer. It may hold depth or IR alone: when a
/// stream begins they need not begin together, and damaged IR costs itself alone.
pub fn next_whole(camera: &mut Freenect1Camera) -> RawFrame {
    next_that(camera, |_| true)
}

/// The next whole frame that satisfies a condition.
pub fn next_that(camera: &mut Freenect1Camera, satisfies: impl Fn(&RawFrame) -> bool) -> RawFrame {
    first_that(|| camera.grab_raw(5 * SECOND), satisfies, 30)
}

/// The next frame that holds depth and IR.
pub fn next_pair(camera: &mut Freenect1Camera) -> RawFrame {
    let is_pair = |frame: &RawFrame| frame.disparity.is_some() && frame.ir.is_some();
    first_that(|| camera.grab_raw(5 * SECOND), is_pair, N_ALONE)
}

/// The same, decoded.
pub fn next_decoded_pair(camera: &mut Freenect1Camera) -> Frame {
    let grab = || {
        let frame = camera.grab(5 * SECOND)?;
        Ok(frame.expect("a device does not end"))
    };
    let is_pair = |frame: &Frame| frame.depth.is_some() && frame.ir.is_some();
    first_that(grab, is_pair, N_ALONE)
}

/// Whole frames that may come one after the other without their counterpart: while streams begin, three.
const N_ALONE: usize = 5;

/// The first whole frame that satisfies, after so many at most that do not.
fn first_that<T>(
    mut grab: impl FnMut() -> Result<T, CameraError>,
    satisfies: impl Fn(&T) -> bool,
    n_others: usize,
) -> T {
    let mut n_seen = 0;
    while n_seen <= n_others {
        match grab() {
            Ok(frame) if satisfies(&frame) => return frame,
            Ok(_) => n_seen += 1,
            Err(error) => assert!(matches!(error, CameraError::DamagedFrame { .. }), "{error}"),
        }
    }
    panic!("no such frame after {n_others} others");
}

/// Whether anything was lost for want of time, as is right on a machine that is too busy: the stand-in writes down the packets for
/// which no transfer waited, and the camera counts the frames that nobody fetched.
pub fn is_too_busy(root: &Path, statistics: &Statistics) -> bool {
    let n_packets = trace(root)
        .iter()
        .filter(|line| line.starts_with("overrun"))
        .count();
    let is_too_busy = n_packets > 0 || statistics.n_overrun > 0;
    if is_too_busy {
        eprintln!("{n_packets} packets found no transfer: the machine is too busy");
    }
    is_too_busy
}

/// Longer than any failure takes to come, on a busy machine too.
const PATIENCE: Duration = Duration::from_secs(60);

/// The first error that is not about a single frame, and how long it took to come.
pub fn next_failure(camera: &mut Freenect1Camera) -> (CameraError, Duration) {
    let start = Instant::now();
    while start.elapsed() < PATIENCE {
        match camera.grab_raw(SECOND / 10) {
            Ok(_) => {}
            Err(error) if error.is_recoverable() => {}
            Err(error) => return (error, start.elapsed()),
        }
    }
    panic!("no failure within {PATIENCE:?}");
}

/// A file of the first Kinect.
pub fn file(root: &Path, name: &str) -> PathBuf {
    root.join("kinect0").join(name)
}

/// Lets a file appear, which the stand-in notices.
pub fn raise(root: &Path, flag: &str) {
    fs::write(file(root, flag), []).unwrap();
}

/// Lets it vanish.
pub fn lower(root: &Path, flag: &str) {
    fs::remove_file(file(root, flag)).unwrap();
}

pub fn trace(root: &Path) -> Vec<String> {
    let text = fs::read_to_string(file(root, "trace.txt")).unwrap();
    text.lines().map(str::to_owned).collect()
}
