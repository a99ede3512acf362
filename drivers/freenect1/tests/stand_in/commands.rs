//! What the camera is told while it streams: other streams, another gain, to stop.

use std::time::Instant;

use depth_camera::{CameraError, DepthCamera};
use freenect1::{
    Freenect1Camera, Settings,
    streams::{ProjectorState, Streams},
};

use crate::support::{
    SECOND, assert_bit_exact, next_pair, next_that, next_whole, on_stand_in, trace,
};

/// The sequence of a shading image without a shutter: depth stops, IR goes on with its clock standing still, depth comes back.
#[test]
fn depth_stops_while_infrared_goes_on() {
    let device = "freeze_ir_clock = true";
    on_stand_in(
        "commands::depth_stops_while_infrared_goes_on",
        &[device],
        |root| {
            let mut camera = Freenect1Camera::open(None, Settings::default()).unwrap();
            let control = camera.control();
            let before = next_whole(&mut camera);
            assert_eq!(control.projector(), ProjectorState::Lit);
            control.set_streams(Streams::Ir).unwrap();
            assert_eq!(control.projector(), ProjectorState::Unknown);
            let mut newest = next_that(&mut camera, |frame| frame.disparity.is_none());
            assert!(newest.device_time_secs > before.device_time_secs);
            for _ in 0..20 {
                let frame = next_whole(&mut camera);
                assert_bit_exact(&frame);
                assert!(frame.disparity.is_none() && frame.ir.is_some());
                let by_device = frame.device_time_secs - newest.device_time_secs;
                let by_host = (frame.host_time - newest.host_time).as_secs_f64();
                assert!(
                    (by_device - by_host).abs() < 2e-6,
                    "the host's clock tells the time, in whole microseconds"
                );
                newest = frame;
            }
            control.set_streams(Streams::DepthAndIr).unwrap();
            // IR goes on with the same frames, so that pairs must still be of one frame: `assert_bit_exact` looks.
            let back = next_pair(&mut camera);
            assert_bit_exact(&back);
            assert!(back.device_time_secs > newest.device_time_secs);
            for _ in 0..20 {
                assert_bit_exact(&next_whole(&mut camera));
            }
            assert_eq!(control.projector(), ProjectorState::Lit);
            // IR was never stopped for it.
            assert!(!trace(root).iter().any(|line| line == "write 05 0"));
        },
    );
}

#[test]
fn infrared_at_full_size_and_back() {
    on_stand_in("commands::infrared_at_full_size_and_back", &[""], |_| {
        let mut camera = Freenect1Camera::open(None, Settings::default()).unwrap();
        let control = camera.control();
        next_whole(&mut camera);
        for _ in 0..2 {
            control.set_streams(Streams::IrHigh).unwrap();
            let is_high = |frame: &freenect1::assembly::RawFrame| {
                frame.ir.as_ref().is_some_and(|ir| ir.width() == 1280)
            };
            let begun = next_that(&mut camera, is_high).host_time;
            let mut newest = begun;
            for _ in 0..5 {
                let frame = next_whole(&mut camera);
                assert_bit_exact(&frame);
                assert!(is_high(&frame) && frame.disparity.is_none());
                newest = frame.host_time;
            }
            // However late the first came: the library's transfers hold less than a third of a frame.
            assert!(newest - begun > SECOND / 3, "it has 10 frames a second");
            control.set_streams(Streams::DepthAndIr).unwrap();
            let both = next_pair(&mut camera);
            assert_bit_exact(&both);
        }
        control.set_streams(Streams::Depth).unwrap();
        next_that(&mut camera, |frame| frame.ir.is_none());
        assert!(next_whole(&mut camera).ir.is_none());
    });
}

#[test]
fn the_gain_is_what_the_device_says_it_is() {
    on_stand_in(
        "commands::the_gain_is_what_the_device_says_it_is",
        &[""],
        |root| {
            let settings = Settings {
                ir_gain: 21,
                ..Settings::default()
            };
            let camera = Freenect1Camera::open(None, settings).unwrap();
            let control = camera.control();
            assert_eq!(control.ir_gain(), 21);
            assert_eq!(control.set_ir_gain(50), Ok(50));
            assert_eq!(control.ir_gain(), 50);
            for gain in [0, 51] {
                let error = control.set_ir_gain(gain).unwrap_err();
                assert_eq!(
                    error.to_string(),
                    format!("ir_gain is {gain}, must be 1 to 50")
                );
            }
            let written: Vec<_> = trace(root)
                .into_iter()
                .filter(|line| line.starts_with("write 15"))
                .collect();
            assert_eq!(written, ["write 15 15", "write 15 32"]);
            let settings = Settings {
                ir_gain: 0,
                ..Settings::default()
            };
            let refused = Freenect1Camera::open(None, settings).unwrap_err();
            assert!(matches!(refused, CameraError::Invalid(_)));
        },
    );
}

/// The library crashes over a device that is closed while both streams run, and moves what it opens.
#[test]
fn streams_stop_in_order_and_the_motor_is_left_alone() {
    let test = "commands::streams_stop_in_order_and_the_motor_is_left_alone";
    on_stand_in(test, &[""], |root| {
        let mut camera = Freenect1Camera::open(None, Settings::default()).unwrap();
        next_whole(&mut camera);
        drop(camera);
        let trace = trace(root);
        let place = |what: &str| trace.iter().rposition(|line| line == what);
        let order = [
            "write 05 3",
            "write 05 0",
            "write 06 0",
            "attach kernel driver",
            "close Camera",
        ];
        let places =
            order.map(|what| place(what).unwrap_or_else(|| panic!("no {what} in {trace:?}")));
        assert!(places.is_sorted(), "{places:?} in {trace:?}");
        assert!(
            !trace.iter().any(|line| line.contains("Motor")),
            "{trace:?}"
        );
    });
}

/// Frames that nobody fetches make room for newer ones, and the camera goes on.
#[test]
fn a_slow_reader_gets_the_newest_frames() {
    on_stand_in(
        "commands::a_slow_reader_gets_the_newest_frames",
        &[""],
        |_| {
            let mut camera = Freenect1Camera::open(None, Settings::default()).unwrap();
            let control = camera.control();
            let n_overrun = || control.statistics().n_overrun;
            let first = next_whole(&mut camera);
            let enough = n_overrun() + 15;
            let deadline = Instant::now() + 60 * SECOND;
            while n_overrun() < enough {
                assert!(Instant::now() < deadline, "frames wait for the reader");
                std::thread::sleep(SECOND / 100);
            }
            let next = next_whole(&mut camera);
            // Those that made room came after the first and before all that are left.
            assert!(next.frame_id > first.frame_id + 15);
            assert!(camera.n_missed() >= enough);
            assert_bit_exact(&next);
        },
    );
}
