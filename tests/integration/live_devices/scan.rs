//! The whole pipeline on a device: it ends in the meshes of its replay.

use super::stand_in::{Bus, ZERO_PLANE_LINE, inside};
use crate::{
    end_to_end::params,
    raw_kinect1::{raw_frames, zero_plane},
};
use depth_camera::{CameraError, CameraInfo, DepthCamera, Frame, Sensor};
use freenect1::{DeviceRecord, RawDisparityWriter};
use relief::{
    capture::DeviceHealth,
    devices::{DeviceParams, RecordedCamera, connect, open, open_recording},
    export::read_trajectory,
    pipeline::{Ending, OutputFolder, Pipeline, PipelineParams, Status},
    shading::Calibration,
};
use replay::Pacing;
use simulated::SimulatedCamera;
use std::{
    fs,
    path::{Path, PathBuf},
    thread,
    time::{Duration, Instant},
};

pub const SERIAL: &str = "A00362A00000007A";

/// Longest wait for what the pipeline does; the machine may be busy.
const PATIENCE: Duration = Duration::from_secs(120);

/// A camera whose stream ends after some frames.
struct FirstFrames {
    camera: RecordedCamera,
    n_left: usize,
    n_grabbed: usize,
    frame_limit: PathBuf,
}

impl DepthCamera for FirstFrames {
    fn info(&self) -> &CameraInfo {
        self.camera.info()
    }

    fn grab(&mut self, timeout: Duration) -> Result<Option<Frame>, CameraError> {
        if self.n_left == 0 {
            return Ok(None);
        }
        // As many frames as the driver keeps, however slow fusion is.
        let limit = self.n_grabbed + 3;
        fs::write(&self.frame_limit, limit.to_string()).unwrap();
        let frame = self.camera.grab(timeout)?;
        self.n_left -= 1;
        self.n_grabbed += 1;
        Ok(frame)
    }
}

pub fn device_params() -> DeviceParams {
    let mut params = DeviceParams::default();
    params.kinect1.ir_gain = 12;
    params.kinect1.ir_offset_px = Some([0.0, 0.0]);
    params.kinect1.lamp_position_m = Some([0.12, -0.07, 0.02]);
    params
}

/// The simulated camera's two images lie on one grid, and it shines evenly.
pub fn scan_params() -> PipelineParams {
    let calibration = Calibration::shipped(Sensor::Kinect1).unwrap();
    PipelineParams {
        record: false,
        ..params(2, calibration)
    }
}

fn scan(camera: Box<dyn DepthCamera>, out: &Path) -> u64 {
    let folder = OutputFolder::claim(out).unwrap();
    let outcome = Pipeline::spawn(camera, scan_params(), folder)
        .unwrap()
        .join();
    assert_eq!(outcome.failures, Vec::<String>::new());
    assert_eq!(outcome.ending, Ending::Complete);
    let frames = outcome.report.frames;
    eprintln!("{}: {frames:?}", out.display());
    frames.fused
}

#[test]
fn a_session_streamed_as_packets_ends_in_the_meshes_of_its_replay() {
    let test = "live_devices::scan::a_session_streamed_as_packets_ends_in_the_meshes_of_its_replay";
    let Some(root) = inside() else {
        let bus = Bus::new();
        let frames = raw_frames(SimulatedCamera::kinect1_plaque(18, 5));
        // The recording that the device's stream is made from.
        let device = DeviceRecord {
            serial: SERIAL.to_owned(),
            zero_plane: zero_plane(),
            ir_gain: 12,
            ir_offset_px: [0.0, 0.0],
            lamp_position_m: device_params().kinect1.lamp_position_m,
        };
        let mut writer = RawDisparityWriter::create(&bus.path("session"), &device).unwrap();
        for frame in &frames {
            writer.write(frame).unwrap();
        }
        writer.finish().unwrap();
        // Device time goes on only as packets are taken, and waits for fusion: nothing is lost, however busy the machine is.
        let device = format!(
            "serial = {SERIAL}\nframe_rate_hz = 0\nfree_step_us = 200\nplay_once = true\n{ZERO_PLANE_LINE}"
        );
        bus.plug("kinect0", &device, &frames);
        fs::write(bus.path("kinect0/frame-limit"), "3").unwrap();
        return bus.run_inside(test);
    };
    let n_frames = fs::read_to_string(root.join("session/disparity.txt"))
        .unwrap()
        .lines()
        .count()
        - 1;
    let camera = connect(SERIAL, &device_params()).unwrap();
    let camera = RecordedCamera::create(camera, &root.join("recorded")).unwrap();
    let n_fused = scan(
        Box::new(FirstFrames {
            camera,
            n_left: n_frames,
            n_grabbed: 0,
            frame_limit: root.join("kinect0/frame-limit"),
        }),
        &root.join("live"),
    );
    // Four exposures under the lamp at two poses.
    assert_eq!(n_fused, n_frames as u64 - 8);
    for (name, session) in [("replayed", "session"), ("again", "recorded")] {
        let replayed = open_recording(
            &root.join(session),
            &device_params(),
            Pacing::AsFastAsPossible,
        );
        assert_eq!(scan(replayed.unwrap(), &root.join(name)), n_fused);
        for file in [
            "base.ply",
            "refined.ply",
            "trajectory.txt",
            "events.jsonl",
            "snapshots/000/meta.json",
            "snapshots/000/ir.png",
        ] {
            let [live, replayed] =
                ["live", name].map(|run| fs::read(root.join(run).join(file)).unwrap());
            assert!(live == replayed, "{file} of {session} differs");
        }
    }
    // The gain that was set is the one that the device says it has, and is kept with the image.
    let meta = fs::read_to_string(root.join("live/snapshots/000/meta.json")).unwrap();
    let meta: serde_json::Value = serde_json::from_str(&meta).unwrap();
    assert_eq!(meta["ir_gain"], 12);
}

/// A camera that stands still before the plaque, unplugged three times: the frames after each time are of the same model.
#[test]
fn a_scan_goes_on_in_the_same_map_after_each_of_three_unpluggings() {
    let test = "live_devices::scan::a_scan_goes_on_in_the_same_map_after_each_of_three_unpluggings";
    let Some(root) = inside() else {
        let bus = Bus::new();
        let frames = raw_frames(SimulatedCamera::kinect1_plaque(1, 5));
        let device = format!("serial = {SERIAL}\nframe_rate_hz = 5\n{ZERO_PLANE_LINE}");
        bus.plug("kinect0", &device, &frames);
        return bus.run_inside(test);
    };
    let camera = open(SERIAL, &device_params()).unwrap();
    let folder = OutputFolder::claim(&root.join("out")).unwrap();
    let params = PipelineParams {
        is_refined: false,
        ..scan_params()
    };
    let handle = Pipeline::spawn(camera, params, folder).unwrap();
    let watch = handle.watch();
    let wait_until = |what: &str, holds: &dyn Fn(&Status) -> bool| {
        let start = Instant::now();
        while !holds(&watch.status()) {
            assert!(start.elapsed() < PATIENCE, "{what}: {:?}", watch.status());
            thread::sleep(Duration::from_millis(5));
        }
    };
    let unplugged = root.join("kinect0/unplugged");
    let mut n_fused = 0;
    for cycle in 1..=3 {
        wait_until("frames are fused", &|status| {
            status.frames.fused >= n_fused + 3
        });
        fs::write(&unplugged, []).unwrap();
        wait_until("it is missed", &|status| {
            status.device == DeviceHealth::Gone
        });
        n_fused = watch.status().frames.fused;
        fs::remove_file(&unplugged).unwrap();
        wait_until("it is back", &|status| {
            status.n_device_gaps >= cycle && status.device == DeviceHealth::Streaming
        });
    }
    wait_until("frames are fused", &|status| {
        status.frames.fused >= n_fused + 3
    });
    watch.command(relief::pipeline::Command::Finish).unwrap();
    let outcome = handle.join();
    assert_eq!(outcome.failures, Vec::<String>::new());
    assert_eq!(outcome.ending, Ending::Complete);
    // Where the camera is must be seen before it is believed.
    assert!(outcome.report.frames.lost <= 3);
    let trajectory = read_trajectory(&root.join("out/trajectory.txt")).unwrap();
    let times = trajectory.iter().map(|(time_secs, _)| *time_secs);
    assert!(times.is_sorted_by(|a, b| a < b), "device time goes on");
    // It is one picture over and over: whatever moves is the tracker's noise.
    for (_, world_from_camera) in &trajectory {
        let moved_m = world_from_camera.translation.vector.norm();
        assert!(moved_m < 1e-3, "{moved_m} m");
    }
}
