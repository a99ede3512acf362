//! Recordings of raw packets: written, played, refused.

mod support;

use std::{fs, path::Path, time::Duration};

use depth_camera::{CameraError, DepthCamera};
use freenect2::{
    DecoderOptions, DeviceRecord, P0_RESPONSE_BYTES, RawPacket, RawPacketCamera, RawPacketWriter,
};
use freenect2_synth::PhaseTables;
use support::{decode, decoder, encoder, parameters, plane_and_sphere};

fn device() -> DeviceRecord {
    DeviceRecord {
        serial: "012345678947".to_owned(),
        firmware: "4.3.3912.0".to_owned(),
        ir_parameters: parameters(),
        p0_response: PhaseTables::varied().response(),
    }
}

fn record(folder: &Path, packets: &[&[u8]]) {
    let mut writer = RawPacketWriter::create(folder, &device()).expect("the folder is empty");
    for (i, packet) in packets.iter().enumerate() {
        let packet = RawPacket::new(packet).expect("the packet is whole");
        let time_secs = 5.0 + i as f64 / 30.0;
        writer.write(packet, time_secs).expect("there is space");
    }
    assert_eq!(writer.finish().ok(), Some(packets.len()));
}

fn open_error(folder: &Path) -> String {
    let error = RawPacketCamera::open(folder, DecoderOptions::default());
    error.expect_err("it must be refused").to_string()
}

#[test]
fn a_recording_plays_as_its_packets_decode() {
    let folder = tempfile::tempdir().unwrap();
    let folder = folder.path().join("raw");
    let truth = plane_and_sphere();
    let packet = encoder().packet(truth.scene());
    record(&folder, &[&packet, &packet]);

    let options = DecoderOptions::default().with_filters();
    let mut camera = RawPacketCamera::open(&folder, options).unwrap();
    assert_eq!(camera.info().serial, "012345678947");
    assert_eq!(camera.info().driver.as_deref(), Some("libfreenect2"));
    assert_eq!(camera.info().n_frames, Some(2));
    assert_eq!(camera.info().intrinsics, parameters().intrinsics());
    let unmirrored = DecoderOptions {
        unmirrored: true,
        ..options
    };
    let expected = decode(&decoder(unmirrored), &packet);
    for frame_id in 0..2 {
        let frame = camera.grab(Duration::ZERO).unwrap().unwrap();
        assert_eq!(frame.frame_id, frame_id);
        assert!((frame.device_time_secs - 5.0 - frame_id as f64 / 30.0).abs() < 1e-6);
        assert_eq!(frame.depth.as_ref(), Some(expected.depth()));
        assert_eq!(frame.ir.as_ref(), Some(expected.ir()));
    }
    assert!(camera.grab(Duration::ZERO).unwrap().is_none());
}

#[test]
fn a_damaged_packet_costs_its_own_frame() {
    let folder = tempfile::tempdir().unwrap();
    let packet = vec![0; freenect2::PACKET_BYTES];
    record(folder.path(), &[&packet, &packet, &packet]);
    fs::write(folder.path().join("packets/000000.k2"), &packet[..1000]).unwrap();
    fs::remove_file(folder.path().join("packets/000001.k2")).unwrap();
    let mut camera = RawPacketCamera::open(folder.path(), DecoderOptions::default()).unwrap();
    for (id, what) in [
        (0, "000000.k2: raw packet has 1000 bytes"),
        (1, "000001.k2: No such file"),
    ] {
        match camera.grab(Duration::ZERO) {
            Err(CameraError::DamagedFrame { frame_id, reason }) => {
                assert_eq!(frame_id, id);
                assert!(reason.contains(what), "{reason}");
            }
            other => panic!("{other:?}"),
        }
    }
    let frame = camera.grab(Duration::ZERO).unwrap().unwrap();
    assert_eq!(frame.frame_id, 2);
}

#[test]
fn nothing_is_overwritten() {
    let folder = tempfile::tempdir().unwrap();
    fs::write(folder.path().join("notes.txt"), "mine").unwrap();
    let error = RawPacketWriter::create(folder.path(), &device()).unwrap_err();
    assert!(error.to_string().contains("is not empty"), "{error}");
}

#[test]
fn times_must_increase() {
    let folder = tempfile::tempdir().unwrap();
    let packet = vec![0; freenect2::PACKET_BYTES];
    let packet = RawPacket::new(&packet).unwrap();
    let mut writer = RawPacketWriter::create(folder.path(), &device()).unwrap();
    writer.write(packet, 1.0).unwrap();
    for time_secs in [1.0, 0.5, f64::NAN] {
        let error = writer.write(packet, time_secs).unwrap_err().to_string();
        assert!(error.contains("must be finite and follow 1.0 s"), "{error}");
    }
    writer.write(packet, 1.1).unwrap();
    assert_eq!(writer.finish().unwrap(), 2);
}

#[test]
fn what_makes_no_sense_is_named() {
    let folder = tempfile::tempdir().unwrap();
    let packet = vec![0; freenect2::PACKET_BYTES];
    record(folder.path(), &[&packet]);
    let device_path = folder.path().join("ir_parameters.toml");
    let good = fs::read_to_string(&device_path).unwrap();

    fs::write(&device_path, good.replace("fx = 365.4", "fx = -1.0")).unwrap();
    let error = open_error(folder.path());
    assert!(
        error.ends_with("ir_parameters.toml: IR parameter fx is -1, must be positive and finite"),
        "{error}"
    );
    fs::write(&device_path, good.replace("k3 = ", "k9 = ")).unwrap();
    assert!(open_error(folder.path()).contains("k9"));
    fs::write(&device_path, &good).unwrap();

    fs::write(folder.path().join("p0.bin"), [0; 40]).unwrap();
    let error = open_error(folder.path());
    assert!(
        error.contains("p0.bin: P0 response has 40 bytes, must have 1302572: p0_table_0"),
        "{error}"
    );
    fs::write(folder.path().join("p0.bin"), [0; P0_RESPONSE_BYTES]).unwrap();

    fs::write(folder.path().join("packets.txt"), "# none\n").unwrap();
    let error = open_error(folder.path());
    assert!(error.ends_with("packets.txt: holds no packet"), "{error}");
    fs::write(folder.path().join("packets.txt"), "1.0 ../secret\n").unwrap();
    let error = open_error(folder.path());
    assert!(error.contains("line 1: file name"), "{error}");
}
