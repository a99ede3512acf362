//! No invalid read, no invalid write, no leak between the camera and the other side of the shim, under valgrind.

#![allow(clippy::unwrap_used, reason = "a test may fail anywhere")]

mod support;

use std::{
    env,
    process::{Command, Stdio},
    time::Duration,
};

use depth_camera::{CameraError, DepthCamera};
use freenect2::{Freenect2Camera, LiveOptions, PACKET_BYTES};
use freenect2_stand_in::{AnsweredCamera, Answers, Packet, Unit};
use freenect2_synth::PhaseTables;
use support::parameters;

const TEST: &str = "valgrind_finds_nothing";
const INSIDE: &str = "RELIEF_UNDER_VALGRIND";
/// Programs run some thirty times slower there.
const PATIENCE: Duration = Duration::from_secs(60);

#[test]
fn valgrind_finds_nothing() {
    if env::var_os(INSIDE).is_some() {
        return use_a_camera();
    }
    let here = Command::new("valgrind")
        .arg("--version")
        .stdout(Stdio::null())
        .status();
    if !here.is_ok_and(|status| status.success()) {
        eprintln!("skipped: no valgrind here");
        return;
    }
    let status = Command::new("valgrind")
        .args(["--quiet", "--leak-check=full", "--error-exitcode=99"])
        // What is merely reachable or possibly lost belongs to the test harness and to rayon's threads.
        .args([
            "--show-leak-kinds=definite",
            "--errors-for-leak-kinds=definite",
        ])
        .arg(env::current_exe().unwrap())
        .args(["--exact", TEST, "--nocapture", "--test-threads=1"])
        .env(INSIDE, "1")
        .status()
        .unwrap();
    assert!(status.success(), "{status}");
}

/// Opens, streams whole and cut packets, loses the device, finds it again, closes.
fn use_a_camera() {
    let p = parameters();
    let answers = Answers {
        firmware: "4.3.3912.0".to_owned(),
        p0_response: PhaseTables::varied().response(),
        ir_parameters: AnsweredCamera {
            fx: p.fx as f32,
            fy: p.fy as f32,
            cx: p.cx as f32,
            cy: p.cy as f32,
            ..AnsweredCamera::default()
        },
        open_error: String::new(),
        list_error: String::new(),
    };
    let unit = Unit::plug("memcheck", answers);
    let options = LiveOptions {
        serial: Some("memcheck".to_owned()),
        open_timeout: PATIENCE,
        first_packet_timeout: PATIENCE,
        max_silence: Duration::from_secs(2),
        reopen_interval: Duration::from_millis(20),
        close_timeout: PATIENCE,
        ..LiveOptions::default()
    };
    let mut camera = Freenect2Camera::open(freenect2_stand_in::library(), options).unwrap();
    let bytes: Vec<u8> = (0..PACKET_BYTES).map(|i| ((i * 7919) >> 4) as u8).collect();
    let send = |sequence: u32, bytes: &[u8]| {
        unit.send(Packet {
            bytes,
            timestamp: 266 * sequence,
            sequence,
            status: 0,
        })
    };
    for sequence in 1..3 {
        assert!(send(sequence, &bytes));
        assert!(camera.grab(PATIENCE).unwrap().is_some());
    }
    assert!(send(3, &bytes[..1000]) && send(4, &[]));
    unit.unplug();
    assert_eq!(
        camera.grab(PATIENCE).unwrap_err(),
        CameraError::Disconnected
    );
    unit.replug();
    loop {
        send(1, &bytes);
        match camera.grab(Duration::from_millis(50)) {
            Ok(frame) => break assert!(frame.is_some()),
            Err(error) => assert!(matches!(error, CameraError::Timeout { .. }), "{error}"),
        }
    }
    drop(camera);
    assert_eq!(unit.n_open(), 0);
}
