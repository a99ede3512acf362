//! `relief record`: what comes is on the disk, also over unplugging, and one program at a time.

use super::stand_in::{Bus, Running, n_listed, noise_frames};
use crate::support::assert_says;
use depth_camera::{DepthCamera, Frame, Image};
use freenect1::{
    RawDisparityCamera,
    assembly::RawFrame,
    disparity::{DisparityTable, ZeroPlane},
};
use replay::ReplayCamera;
use serde_json::Value;
use std::{fs, path::Path, time::Duration};

const N_FRAMES: usize = 8;

fn frames(mut camera: impl DepthCamera) -> Vec<Frame> {
    std::iter::from_fn(|| camera.grab(Duration::ZERO).unwrap()).collect()
}

/// Asserts that a frame is one of those that were sent; depth may be rounded.
fn assert_sent(frame: &Frame, sent: &[RawFrame], depth_step_m: f32) {
    let (depth, ir) = (frame.depth.as_ref().unwrap(), frame.ir.as_ref().unwrap());
    let shown = |raw: &RawFrame| raw.ir.as_ref().unwrap().data()[..640 * 480] == *ir.data();
    let raw = sent.iter().find(|raw| shown(raw));
    let disparity = raw.expect("IR that was sent").disparity.as_ref().unwrap();
    // As the device has it, in 32 bits.
    let plane = ZeroPlane {
        reference_pixel_size_mm: f64::from(0.1042_f32),
        ..ZeroPlane::TYPICAL
    };
    let table = DisparityTable::new(&plane).unwrap();
    let expected: Image<f32> = disparity.map(|disparity| table.metres(*disparity));
    for (metres, expected) in depth.data().iter().zip(expected.data()) {
        // A recording of decoded frames has 16 bits for depth.
        let is_beyond = depth_step_m > 0.0 && *expected > 65535.0 * depth_step_m;
        let expected = if is_beyond { 0.0 } else { *expected };
        assert!(
            (metres - expected).abs() <= 0.51 * depth_step_m,
            "{metres} m for {expected} m"
        );
    }
}

fn record(bus: &Bus, out: &str, more: &[&str]) -> std::process::Output {
    let out = bus.path(out);
    let arguments = ["record", "--json", "--device", "R1", "--out"];
    let arguments = [&arguments, [out.to_str().unwrap()].as_slice(), more].concat();
    bus.relief(&arguments).output().unwrap()
}

#[test]
fn frames_and_raw_disparity_are_recorded_as_they_were_sent() {
    let bus = Bus::new();
    let sent = noise_frames(N_FRAMES, 1);
    bus.plug("kinect0", "serial = R1\nframe_rate_hz = 10", &sent);
    for (out, more, step_m) in [
        ("frames", ["--seconds", "2"].as_slice(), 1.0 / 5000.0),
        ("raw", ["--seconds", "2", "--raw"].as_slice(), 0.0),
    ] {
        let output = record(&bus, out, more);
        assert_says(&output, 0, &[]);
        let summary: Value = serde_json::from_slice(&output.stdout).unwrap();
        eprintln!("{out}: {summary}");
        let folder = bus.path(out);
        let recorded = match step_m > 0.0 {
            true => frames(ReplayCamera::open(&folder).unwrap()),
            false => frames(RawDisparityCamera::open(&folder).unwrap()),
        };
        assert_eq!(summary["recorded"], recorded.len());
        assert!(recorded.len() >= 3, "{summary}");
        for frame in recorded
            .iter()
            .filter(|f| f.depth.is_some() && f.ir.is_some())
        {
            assert_sent(frame, &sent, step_m);
        }
    }
}

#[test]
fn a_device_that_is_not_there_or_makes_no_sense_is_refused() {
    let bus = Bus::new();
    bus.plug("kinect0", "serial = R1", &noise_frames(1, 1));
    let out = bus.path("out");
    let to = ["--out", out.to_str().unwrap()];
    let elsewhere = ["record", "--device", "R9"];
    let output = bus.relief(&[&elsewhere, to.as_slice()].concat()).output();
    let what = "no Kinect with the serial number R9 is plugged in; there are: R1";
    assert_says(&output.unwrap(), 1, &[what]);
    assert!(!out.exists());
    let forever = ["record", "--device", "R1", "--seconds", "0"];
    let output = bus.relief(&[&forever, to.as_slice()].concat()).output();
    assert_says(&output.unwrap(), 2, &["0 s, must be 0.1 to 1000000"]);
    bus.raise("kinect0", "denied");
    let output = record(&bus, "out", &["--seconds", "1"]);
    assert_says(&output, 1, &["R1 cannot be opened: no permission"]);
}

fn start(bus: &Bus, out: &str) -> Running {
    let folder = bus.path(out);
    let arguments = ["record", "--raw", "--json", "--device", "R1", "--out"];
    let arguments = [&arguments, [folder.to_str().unwrap()].as_slice()].concat();
    Running::start(bus, &format!("{out}.log"), bus.relief(&arguments))
}

fn wait_for_frames(running: &mut Running, folder: &Path, n_frames: usize) {
    let list = folder.join("disparity.txt");
    running.wait_until(&format!("{n_frames} frames"), |_| {
        n_listed(&list) >= n_frames
    });
}

#[test]
fn a_recording_goes_on_after_each_of_three_unpluggings() {
    let bus = Bus::new();
    let sent = noise_frames(N_FRAMES, 2);
    bus.plug("kinect0", "serial = R1\nframe_rate_hz = 15", &sent);
    let mut running = start(&bus, "out");
    let folder = bus.path("out");
    let mut n_frames = 0;
    for cycle in 1..=3 {
        wait_for_frames(&mut running, &folder, n_frames + 4);
        bus.raise("kinect0", "unplugged");
        running.wait_until("unplugged", |running| {
            running
                .said()
                .matches("unplugged, or silent: plug it in again")
                .count()
                == cycle
        });
        n_frames = n_listed(&folder.join("disparity.txt"));
        bus.lower("kinect0", "unplugged");
    }
    wait_for_frames(&mut running, &folder, n_frames + 4);
    let summary: Value = serde_json::from_str(&running.interrupt()).unwrap();
    eprintln!("{summary}");
    assert_eq!(summary["unplugged"], 3);
    let recorded = frames(RawDisparityCamera::open(&folder).unwrap());
    assert_eq!(summary["recorded"], recorded.len());
    let times: Vec<f64> = recorded
        .iter()
        .map(|frame| frame.device_time_secs)
        .collect();
    assert!(times.is_sorted_by(|a, b| a < b), "{times:?}");
    for frame in recorded
        .iter()
        .filter(|f| f.depth.is_some() && f.ir.is_some())
    {
        assert_sent(frame, &sent, 0.0);
    }
}

#[test]
fn a_recording_that_cannot_be_written_any_more_is_whole_and_summed_up() {
    let bus = Bus::new();
    let sent = noise_frames(N_FRAMES, 4);
    bus.plug("kinect0", "serial = R1\nframe_rate_hz = 15", &sent);
    let mut running = start(&bus, "out");
    let (folder, elsewhere) = (bus.path("out"), bus.path("elsewhere"));
    wait_for_frames(&mut running, &folder, 4);
    fs::rename(folder.join("disparity"), &elsewhere).unwrap();
    let summary: Value = serde_json::from_str(&running.end_with(1)).unwrap();
    assert_eq!(summary["status"], "failed");
    let failure = summary["failures"][0].as_str().unwrap();
    assert!(failure.contains("disparity/"), "{failure}");
    fs::rename(&elsewhere, folder.join("disparity")).unwrap();
    let recorded = frames(RawDisparityCamera::open(&folder).unwrap());
    assert_eq!(summary["recorded"], recorded.len());
}

#[test]
fn a_device_serves_one_program_at_a_time() {
    let bus = Bus::new();
    bus.plug(
        "kinect0",
        "serial = R1\nframe_rate_hz = 10",
        &noise_frames(2, 3),
    );
    let mut first = start(&bus, "first");
    wait_for_frames(&mut first, &bus.path("first"), 1);
    let second = record(&bus, "second", &["--seconds", "1"]);
    let busy = "R1 cannot be opened: the device is held by another process";
    assert_says(&second, 1, &[busy, "relief doctor"]);
    // The first one has not noticed.
    let n_frames = n_listed(&bus.path("first/disparity.txt"));
    wait_for_frames(&mut first, &bus.path("first"), n_frames + 2);
    first.interrupt();
    let third = record(&bus, "third", &["--raw", "--seconds", "1"]);
    assert_says(&third, 0, &[]);
}
