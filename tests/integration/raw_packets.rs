//! A Kinect II's packets from a stand-in of libfreenect2 through the pipeline, recorded meanwhile, and replayed by the program.

use crate::{
    end_to_end::params,
    support::{PROGRAM, small_camera, summary},
};
use depth_camera::{CameraError, CameraInfo, DepthCamera, Frame, Sensor};
use freenect2::{Freenect2Camera, LiveOptions};
use freenect2_stand_in::{AnsweredCamera, Answers, Packet, Unit};
use freenect2_synth::{Camera, Encoder, PhaseTables, RayRows, Scene};
use relief::{
    devices::{DeviceParams, LiveCamera, RecordedCamera, open_recording},
    pipeline::{Ending, OutputFolder, Pipeline, PipelineParams},
    shading::Calibration,
};
use replay::Pacing;
use std::{fs, path::Path, process::Command, time::Duration};

const N_FRAMES: usize = 5;
const SERIAL: &str = "raw-packets";

/// The simulated Kinect II's lens, as the device has it: of the mirrored image, pixel centres at halves.
const CAMERA: Camera = Camera {
    focal: [365.6, 365.6],
    centre: [511.0 - 256.8 + 0.5, 205.3 + 0.5],
    radial: [0.0905, -0.2675, 0.0949],
    tangential: [0.0, 0.0],
};

fn answers() -> Answers {
    Answers {
        firmware: "4.3.3912.0".to_owned(),
        p0_response: PhaseTables::varied().response(),
        ir_parameters: AnsweredCamera {
            fx: CAMERA.focal[0] as f32,
            fy: CAMERA.focal[1] as f32,
            cx: CAMERA.centre[0] as f32,
            cy: CAMERA.centre[1] as f32,
            k1: CAMERA.radial[0] as f32,
            k2: CAMERA.radial[1] as f32,
            k3: CAMERA.radial[2] as f32,
            p1: 0.0,
            p2: 0.0,
        },
        open_error: String::new(),
        list_error: String::new(),
    }
}

/// The plaque, as packets.
fn packets() -> Vec<Vec<u8>> {
    let encoder = Encoder::new(PhaseTables::varied(), &CAMERA, RayRows::Own);
    let mut camera = small_camera(N_FRAMES, 1);
    let frames = std::iter::from_fn(|| camera.grab(Duration::ZERO).unwrap());
    frames
        .map(|frame| {
            let (depth, ir) = (frame.depth.unwrap(), frame.ir.unwrap());
            let rows = 0..depth.height();
            let depth: Vec<f64> = rows
                .clone()
                .flat_map(|v| depth.row(v).iter().rev().map(|z| f64::from(*z)))
                .collect();
            let ir: Vec<f64> = rows
                .flat_map(|v| ir.row(v).iter().rev().map(|counts| f64::from(*counts)))
                .collect();
            encoder.packet(Scene {
                depth: &depth,
                ir: &ir,
                ambient: &[],
            })
        })
        .collect()
}

/// A live camera to which each packet is sent when the one before has been taken.
struct Sent {
    camera: RecordedCamera,
    unit: Unit,
    packets: Vec<Vec<u8>>,
    next: usize,
}

impl DepthCamera for Sent {
    fn info(&self) -> &CameraInfo {
        self.camera.info()
    }

    fn grab(&mut self, timeout: Duration) -> Result<Option<Frame>, CameraError> {
        let Some(bytes) = self.packets.get(self.next) else {
            return Ok(None);
        };
        let sequence = self.next as u32 + 7;
        assert!(self.unit.send(Packet {
            bytes,
            timestamp: 266 * sequence,
            sequence,
            status: 0,
        }));
        self.next += 1;
        self.camera.grab(timeout.max(Duration::from_secs(10)))
    }
}

fn scan(camera: Box<dyn DepthCamera>, out: &Path) {
    let calibration = Calibration::shipped(Sensor::Kinect2).unwrap();
    let params = PipelineParams {
        record: false,
        ..params(2, calibration)
    };
    let folder = OutputFolder::claim(out).unwrap();
    let outcome = Pipeline::spawn(camera, params, folder).unwrap().join();
    assert_eq!(outcome.failures, Vec::<String>::new());
    assert_eq!(outcome.ending, Ending::Complete);
    assert_eq!(outcome.report.frames.fused, N_FRAMES as u64);
    assert_eq!(outcome.report.not_refined_reason, None);
}

#[test]
fn a_scan_of_packets_is_the_scan_of_their_recording() {
    let root = tempfile::tempdir().unwrap();
    let raw = root.path().join("raw");
    let unit = Unit::plug(SERIAL, answers());
    let options = LiveOptions {
        serial: Some(SERIAL.to_owned()),
        // Encoding the scene comes first, and the machine may be busy.
        first_packet_timeout: Duration::from_secs(60),
        max_silence: Duration::from_secs(60),
        decoder: DeviceParams::default().kinect2.decoder_options(),
        ..LiveOptions::default()
    };
    let packets = packets();
    let camera = Freenect2Camera::open(freenect2_stand_in::library(), options).unwrap();
    let camera = LiveCamera::Kinect2(Box::new(camera));
    let camera = RecordedCamera::create(camera, &raw).unwrap();
    let live = root.path().join("live");
    scan(
        Box::new(Sent {
            camera,
            unit,
            packets,
            next: 0,
        }),
        &live,
    );

    let replayed = root.path().join("replayed");
    let camera = open_recording(&raw, &DeviceParams::default(), Pacing::AsFastAsPossible);
    scan(camera.unwrap(), &replayed);
    for name in ["base.ply", "refined.ply", "trajectory.txt", "events.jsonl"] {
        let [a, b] = [&live, &replayed].map(|out| fs::read(out.join(name)).unwrap());
        assert!(a == b, "{name} of the recording differs");
    }

    let by_program = Command::new(PROGRAM)
        .args(["replay", "--no-refine", "--json", "--voxel-size", "0.004"])
        .arg("--out")
        .arg(root.path().join("by-program"))
        .arg(&raw)
        .output()
        .unwrap();
    let told = summary(&by_program);
    assert_eq!(told["serial"], SERIAL);
    assert_eq!(told["frames"]["fused"], N_FRAMES, "{told}");
}
