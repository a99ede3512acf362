//! The live camera against the stand-in of the shim: silence, replugging, packets out of order, cut and damaged.

mod support;

use std::time::{Duration, Instant};

use depth_camera::{CameraError, DepthCamera, Frame};
use freenect2::{
    DecoderOptions, Freenect2Camera, LiveOptions, PACKET_BYTES, PacketCounts, RawPacketCamera,
    RawPacketWriter,
};
use freenect2_stand_in::{Answers, Packet, Unit};
use support::{answers, decode, decoder, encoder, plane_and_sphere};

const PATIENCE: Duration = Duration::from_secs(10);
/// Ticks of 0.125 ms between frames.
const FRAME_TICKS: u32 = 266;

fn options(serial: &str) -> LiveOptions {
    LiveOptions {
        serial: Some(serial.to_owned()),
        first_packet_timeout: Duration::from_millis(300),
        max_silence: Duration::from_millis(100),
        reopen_interval: Duration::from_millis(5),
        ..LiveOptions::default()
    }
}

fn open(options: LiveOptions) -> Result<Freenect2Camera, CameraError> {
    Freenect2Camera::open(freenect2_stand_in::library(), options)
}

/// Sends packet `sequence`.
fn send(unit: &Unit, bytes: &[u8], sequence: u32) -> bool {
    unit.send(Packet {
        bytes,
        timestamp: sequence * FRAME_TICKS,
        sequence,
        status: 0,
    })
}

fn grab(camera: &mut Freenect2Camera) -> Frame {
    let frame = camera.grab(PATIENCE).expect("a packet was sent");
    frame.expect("a device has no end")
}

/// Grabs until something else than a timeout comes, for a device that is being looked for.
fn grab_patiently(camera: &mut Freenect2Camera, unit: &Unit, bytes: &[u8]) -> Frame {
    let start = Instant::now();
    loop {
        send(unit, bytes, 1);
        match camera.grab(Duration::from_millis(5)) {
            Ok(frame) => return frame.expect("a device has no end"),
            Err(CameraError::Timeout { .. }) if start.elapsed() < PATIENCE => {}
            Err(error) => panic!("{error}"),
        }
    }
}

#[test]
fn packets_become_frames_as_a_recording_of_them_does() {
    let unit = Unit::plug("live-frames", answers());
    let mut camera = open(options("live-frames")).unwrap();
    assert_eq!(camera.info().serial, "live-frames");
    assert_eq!(camera.info().driver.as_deref(), Some("libfreenect2"));
    assert_eq!(camera.device().firmware, "4.3.3912.0");
    let truth = plane_and_sphere();
    let packet = encoder().packet(truth.scene());

    let folder = tempfile::tempdir().unwrap();
    let mut writer = RawPacketWriter::create(folder.path(), camera.device()).unwrap();
    let mut live = Vec::new();
    for sequence in 10..13 {
        assert!(send(&unit, &packet, sequence));
        let frame = grab(&mut camera);
        let time_secs = frame.device_time_secs;
        writer.write(camera.last_packet(), time_secs).unwrap();
        live.push(frame);
    }
    assert_eq!(writer.finish().unwrap(), 3);

    let mut replay = RawPacketCamera::open(folder.path(), DecoderOptions::default()).unwrap();
    assert_eq!(replay.info().intrinsics, camera.info().intrinsics);
    for frame in &live {
        let again = replay.grab(Duration::ZERO).unwrap().unwrap();
        assert_eq!(again.frame_id, frame.frame_id);
        assert_eq!(
            again.device_time_secs.to_bits(),
            frame.device_time_secs.to_bits()
        );
        assert_eq!((&again.depth, &again.ir), (&frame.depth, &frame.ir));
    }
    // The device's parameters are single precision, the encoder's are not: half a millimetre is far more than that makes.
    let unmirrored = DecoderOptions {
        unmirrored: true,
        ..DecoderOptions::default()
    };
    let expected = decode(&decoder(unmirrored), &packet);
    assert_eq!(live[0].ir.as_ref(), Some(expected.ir()));
    let depth = live[0].depth.as_ref().unwrap();
    for (z, expected) in depth.data().iter().zip(expected.depth().data()) {
        assert!((z - expected).abs() < 5e-4);
    }
}

#[test]
fn bad_packets_are_dropped_and_counted() {
    let unit = Unit::plug("live-bad", answers());
    let mut camera = open(options("live-bad")).unwrap();
    let whole = vec![0; PACKET_BYTES];
    assert!(send(&unit, &whole, 5));
    assert_eq!(grab(&mut camera).frame_id, 0);
    // Cut, too long, empty, out of order, twice the same, damaged.
    assert!(send(&unit, &whole[..1000], 6));
    assert!(send(&unit, &vec![0; PACKET_BYTES + 1], 6));
    assert!(send(&unit, &[], 6));
    assert!(send(&unit, &whole, 4));
    assert!(send(&unit, &whole, 5));
    assert!(unit.send(Packet {
        bytes: &whole,
        timestamp: 6 * FRAME_TICKS,
        sequence: 6,
        status: 1,
    }));
    assert!(matches!(
        camera.grab(Duration::ZERO),
        Err(CameraError::Timeout { .. })
    ));
    // Packets 6 and 7 are missing; of 8 and 9 the newer one is taken.
    assert!(send(&unit, &whole, 8));
    assert!(send(&unit, &whole, 9));
    let frame = grab(&mut camera);
    assert_eq!(frame.frame_id, 4);
    assert!((frame.device_time_secs - 9.0 * 0.03325).abs() < 1e-9);
    let expected = PacketCounts {
        good: 3,
        superseded: 1,
        truncated: 3,
        damaged: 1,
        out_of_order: 2,
        lost: 2,
    };
    assert_eq!(camera.counts(), expected);
    assert_eq!(camera.n_missed(), 3);
}

#[test]
fn bad_packets_alone_are_a_device_that_is_gone() {
    let unit = Unit::plug("live-useless", answers());
    let options = LiveOptions {
        max_without_good: Duration::from_millis(200),
        ..options("live-useless")
    };
    let mut camera = open(options).unwrap();
    let whole = vec![0; PACKET_BYTES];
    assert!(send(&unit, &whole, 1));
    grab(&mut camera);
    let start = Instant::now();
    let error = loop {
        send(&unit, &whole[..1000], 2);
        match camera.grab(Duration::from_millis(5)) {
            Err(CameraError::Timeout { .. }) if start.elapsed() < PATIENCE => {}
            other => break other.unwrap_err(),
        }
    };
    assert_eq!(error, CameraError::Disconnected);
}

#[test]
fn silence_is_unplugging_and_the_device_comes_back_by_serial() {
    let unit = Unit::plug("live-replug", answers());
    let mut camera = open(options("live-replug")).unwrap();
    let bytes = vec![0; PACKET_BYTES];
    assert!(send(&unit, &bytes, 1));
    let mut last = grab(&mut camera);
    for _ in 0..20 {
        unit.unplug();
        assert!(!send(&unit, &bytes, 2));
        let start = Instant::now();
        assert_eq!(
            camera.grab(PATIENCE).unwrap_err(),
            CameraError::Disconnected
        );
        assert!(start.elapsed() < PATIENCE / 2);
        assert!(matches!(
            camera.grab(Duration::from_millis(1)),
            Err(CameraError::Timeout { .. })
        ));
        unit.replug();
        // The first packet is cut, which makes the gap no shorter.
        while !send(&unit, &bytes[..1000], 0) {
            let away = camera.grab(Duration::from_millis(1)).unwrap_err();
            assert!(away.is_recoverable() && start.elapsed() < PATIENCE);
        }
        let frame = grab_patiently(&mut camera, &unit, &bytes);
        assert!(frame.frame_id > last.frame_id);
        let by_device = frame.device_time_secs - last.device_time_secs;
        let by_host = (frame.host_time - last.host_time).as_secs_f64();
        assert!(
            (by_device - by_host).abs() < 1e-5,
            "{by_device} s, {by_host} s"
        );
        assert_eq!(unit.n_open(), 1);
        last = frame;
    }
    drop(camera);
    assert_eq!(unit.n_open(), 0);
    assert!(!unit.streams());
}

#[test]
fn a_device_that_sends_nothing_is_given_up() {
    let _unit = Unit::plug("live-silent", answers());
    let mut camera = open(options("live-silent")).unwrap();
    let start = Instant::now();
    assert_eq!(
        camera.grab(PATIENCE).unwrap_err(),
        CameraError::Unresponsive("no packet within 0.3 s of the start".to_owned())
    );
    assert!(start.elapsed() >= Duration::from_millis(250));
    assert!(start.elapsed() < PATIENCE / 2);
}

#[test]
fn an_opening_that_does_not_end_is_told() {
    let unit = Unit::plug("live-stuck", answers());
    let options = LiveOptions {
        open_timeout: Duration::from_millis(20),
        ..options("live-stuck")
    };
    let error = unit.while_stuck(|| open(options).unwrap_err());
    let expected = CameraError::Unresponsive("opening has taken 0.02 s".to_owned());
    assert_eq!(error, expected);
}

#[test]
fn what_keeps_a_device_from_opening_is_told() {
    assert_eq!(
        open(options("live-nobody")).unwrap_err(),
        CameraError::Disconnected
    );
    let _cut = Unit::plug(
        "live-cut",
        Answers {
            p0_response: vec![0; 40],
            ..answers()
        },
    );
    let error = open(options("live-cut")).unwrap_err().to_string();
    assert!(
        error.starts_with("live-cut: P0 response has 40 bytes"),
        "{error}"
    );
    let mut wrong = answers();
    wrong.ir_parameters.fy = f32::NAN;
    let _wrong = Unit::plug("live-wrong", wrong);
    let error = open(options("live-wrong")).unwrap_err().to_string();
    assert!(error.contains("IR parameter fy is NaN"), "{error}");

    let denied = Unit::plug(
        "live-denied",
        Answers {
            list_error: "failed to open Kinect v2: @2:5 LIBUSB_ERROR_ACCESS Access denied"
                .to_owned(),
            ..answers()
        },
    );
    let error = open(options("live-denied")).unwrap_err();
    // It is on the bus of the other tests, too.
    denied.unplug();
    assert_eq!(error, CameraError::PermissionDenied);
    for (text, expected) in [
        (
            "failed to open Kinect v2: LIBUSB_ERROR_ACCESS",
            CameraError::PermissionDenied,
        ),
        (
            "failed to claim interface with index 0! LIBUSB_ERROR_BUSY Resource busy; failed to open Kinect v2: @2:5",
            CameraError::Busy,
        ),
        (
            "failed to reset",
            CameraError::Invalid("the device cannot be opened: failed to reset".to_owned()),
        ),
    ] {
        let _locked = Unit::plug(
            "live-locked",
            Answers {
                open_error: text.to_owned(),
                ..answers()
            },
        );
        assert_eq!(open(options("live-locked")).unwrap_err(), expected);
    }
}
