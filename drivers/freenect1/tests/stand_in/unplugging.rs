//! The device goes and comes back.

use std::{
    fs,
    time::{Duration, Instant},
};

use depth_camera::CameraError;
use freenect1::{Freenect1Camera, Settings};

use crate::support::{
    SECOND, assert_bit_exact, lower, next_failure, next_whole, on_stand_in, raise,
};

#[test]
fn unplugging_is_noticed_and_plugging_in_goes_on() {
    let test = "unplugging::unplugging_is_noticed_and_plugging_in_goes_on";
    on_stand_in(test, &["serial = B7"], |root| {
        let mut camera = Freenect1Camera::open(Some("B7"), Settings::default()).unwrap();
        let control = camera.control();
        control.set_ir_gain(12).unwrap();
        let before = next_whole(&mut camera);
        raise(root, "unplugged");
        let (error, noticed) = next_failure(&mut camera);
        eprintln!("noticed after {:.1} ms", noticed.as_secs_f64() * 1e3);
        assert_eq!(error, CameraError::Disconnected);
        assert_eq!(control.set_ir_gain(13), Err(CameraError::Disconnected));
        let away = camera.grab_raw(Duration::from_millis(50));
        assert!(matches!(away, Err(CameraError::Timeout { .. })), "{away:?}");
        lower(root, "unplugged");
        let plugged = Instant::now();
        let after = next_whole(&mut camera);
        eprintln!(
            "went on after {:.1} ms",
            plugged.elapsed().as_secs_f64() * 1e3
        );
        assert_bit_exact(&after);
        assert!(after.frame_id > before.frame_id);
        let by_device = after.device_time_secs - before.device_time_secs;
        let by_host = (after.host_time - before.host_time).as_secs_f64();
        // It may be more: the first frame was taken before it arrived, on a busy machine long before.
        assert!(by_device > by_host - 0.3, "{by_device} s, {by_host} s");
        assert_eq!(control.ir_gain(), 13);
    });
}

/// As the later models, whose audio part is reset.
#[test]
fn a_device_that_takes_long_to_open_when_it_is_back_is_waited_for() {
    let test = "unplugging::a_device_that_takes_long_to_open_when_it_is_back_is_waited_for";
    on_stand_in(test, &[""], |root| {
        let settings = Settings {
            search_interval: SECOND / 10,
            ..Settings::default()
        };
        let mut camera = Freenect1Camera::open(None, settings).unwrap();
        next_whole(&mut camera);
        raise(root, "unplugged");
        let (error, _) = next_failure(&mut camera);
        assert_eq!(error, CameraError::Disconnected);
        raise(root, "wedged");
        lower(root, "unplugged");
        // Longer than a call to a device that streams may take.
        let opening = camera.grab_raw(4 * SECOND);
        assert!(
            matches!(opening, Err(CameraError::Timeout { .. })),
            "{opening:?}"
        );
        lower(root, "wedged");
        assert_bit_exact(&next_whole(&mut camera));
    });
}

#[test]
fn fifty_times_leave_nothing_behind() {
    on_stand_in(
        "unplugging::fifty_times_leave_nothing_behind",
        &[""],
        |root| {
            let settings = Settings {
                search_interval: SECOND / 10,
                ..Settings::default()
            };
            let mut camera = Freenect1Camera::open(None, settings).unwrap();
            let mut after_warm_up = (0, 0);
            let mut slowest = Duration::ZERO;
            for cycle in 0..50 {
                assert_bit_exact(&next_whole(&mut camera));
                raise(root, "unplugged");
                let (error, noticed) = next_failure(&mut camera);
                assert_eq!(error, CameraError::Disconnected);
                slowest = slowest.max(noticed);
                lower(root, "unplugged");
                if cycle == 9 {
                    after_warm_up = (resident_kib(), open_files());
                }
            }
            assert_bit_exact(&next_whole(&mut camera));
            let (kib, files) = (resident_kib(), open_files());
            let slowest = slowest.as_secs_f64() * 1e3;
            eprintln!(
                "RSS {} -> {kib} KiB, files {} -> {files}, slowest notice {slowest:.1} ms",
                after_warm_up.0, after_warm_up.1
            );
            // A leak of one frame's buffers a cycle would be 48 MiB.
            assert!(kib < after_warm_up.0 + 8 * 1024, "{kib} KiB");
            assert!(files <= after_warm_up.1 + 1, "{files} files");
        },
    );
}

fn resident_kib() -> usize {
    let status = fs::read_to_string("/proc/self/status").unwrap();
    let line = status
        .lines()
        .find(|line| line.starts_with("VmRSS:"))
        .unwrap();
    line.split_whitespace().nth(1).unwrap().parse().unwrap()
}

fn open_files() -> usize {
    fs::read_dir("/proc/self/fd").unwrap().count()
}
