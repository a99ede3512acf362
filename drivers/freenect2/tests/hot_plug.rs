//! Unplugging and plugging in as udev tells of them, long before silence or a look at the bus would.
#![allow(clippy::unwrap_used, reason = "a test may fail anywhere")]

mod support;
#[path = "../../udev-monitor/tests/testbed/mod.rs"]
mod testbed;

use std::time::{Duration, Instant};

use depth_camera::{CameraError, DepthCamera, Frame};
use freenect2::{Freenect2Camera, LiveOptions};
use freenect2_stand_in::{Packet, Unit};
use support::{answers, encoder, plane_and_sphere};
use testbed::{Testbed, run_mocked};
use udev_monitor::UsbMonitor;

/// Longer than the test waits for anything.
const NEVER: Duration = Duration::from_secs(600);
const PATIENCE: Duration = Duration::from_secs(60);

/// The next frame, of a packet that is sent over and over.
fn next_frame(camera: &mut Freenect2Camera, unit: &Unit, bytes: &[u8]) -> Frame {
    let start = Instant::now();
    loop {
        unit.send(Packet {
            bytes,
            timestamp: start.elapsed().as_millis() as u32 * 8,
            sequence: start.elapsed().as_millis() as u32,
            status: 0,
        });
        match camera.grab(Duration::from_millis(5)) {
            Ok(frame) => return frame.unwrap(),
            Err(CameraError::Timeout { .. }) if start.elapsed() < PATIENCE => {}
            Err(error) => panic!("{error}"),
        }
    }
}

#[test]
fn udev_tells_of_unplugging_and_plugging_in() {
    run_mocked("udev_tells_of_unplugging_and_plugging_in", || {
        let testbed = Testbed::with_camera(0x02c4, "K7");
        let unit = Unit::plug("K7", answers());
        let options = LiveOptions {
            serial: Some("K7".to_owned()),
            max_silence: NEVER,
            first_packet_timeout: NEVER,
            reopen_interval: NEVER,
            ..LiveOptions::default()
        };
        let camera = Freenect2Camera::open(freenect2_stand_in::library(), options).unwrap();
        let mut camera = camera.with_monitor(UsbMonitor::open().unwrap());
        let packet = encoder().packet(plane_and_sphere().scene());
        let mut last = next_frame(&mut camera, &unit, &packet);
        for _ in 0..3 {
            unit.unplug();
            testbed.tell("remove");
            let told = Instant::now();
            assert_eq!(
                camera.grab(PATIENCE).unwrap_err(),
                CameraError::Disconnected
            );
            eprintln!("unplugged: noticed after {:?}", told.elapsed());
            assert!(matches!(
                camera.grab(Duration::from_millis(50)),
                Err(CameraError::Timeout { .. })
            ));
            unit.replug();
            testbed.tell("add");
            let told = Instant::now();
            let frame = next_frame(&mut camera, &unit, &packet);
            eprintln!("plugged in: a frame after {:?}", told.elapsed());
            assert!(frame.frame_id > last.frame_id);
            assert!(frame.device_time_secs > last.device_time_secs);
            assert_eq!(frame.depth, last.depth);
            last = frame;
        }
    });
}
