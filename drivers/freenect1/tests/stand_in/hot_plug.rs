//! Plugging in as udev tells of it, long before the next look at the bus.

use std::time::{Duration, Instant};

use depth_camera::CameraError;
use freenect1::{Freenect1Camera, Settings};
use udev_monitor::UsbMonitor;

use crate::{
    support::{SECOND, assert_bit_exact, lower, next_failure, next_whole, on_stand_in, raise},
    testbed::{Testbed, run_mocked},
};

#[test]
fn udev_tells_of_plugging_in() {
    let test = "hot_plug::udev_tells_of_plugging_in";
    run_mocked(test, || {
        on_stand_in(test, &["serial = B7"], |root| {
            let testbed = Testbed::with_camera(0x02ae, "B7");
            let settings = Settings {
                // Longer than the test waits for anything.
                search_interval: 600 * SECOND,
                ..Settings::default()
            };
            let camera = Freenect1Camera::open(Some("B7"), settings).unwrap();
            let mut camera = camera.with_monitor(UsbMonitor::open().unwrap());
            let mut last = next_whole(&mut camera);
            for _ in 0..5 {
                raise(root, "unplugged");
                testbed.tell("remove");
                let (error, _) = next_failure(&mut camera);
                assert_eq!(error, CameraError::Disconnected);
                // It is looked for at once, in vain, and then not before udev has said something.
                let away = camera.grab_raw(Duration::from_millis(200));
                assert!(matches!(away, Err(CameraError::Timeout { .. })), "{away:?}");
                lower(root, "unplugged");
                testbed.tell("change");
                let unsaid = camera.grab_raw(Duration::from_millis(200));
                assert!(
                    matches!(unsaid, Err(CameraError::Timeout { .. })),
                    "{unsaid:?}"
                );
                testbed.tell("add");
                let told = Instant::now();
                let frame = next_whole(&mut camera);
                let millis = told.elapsed().as_secs_f64() * 1e3;
                eprintln!("plugged in: a frame after {millis:.1} ms");
                assert_bit_exact(&frame);
                assert!(frame.frame_id > last.frame_id);
                last = frame;
            }
        });
    });
}
