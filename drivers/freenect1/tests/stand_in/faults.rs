//! Devices that are slow, silent, stuck, held by another, or not ours to open.

use std::thread;
use std::time::{Duration, Instant};

use depth_camera::CameraError;
use freenect1::{Freenect1Camera, Settings, attached, streams::Streams};

use crate::support::{
    SECOND, assert_bit_exact, lower, next_failure, next_pair, next_whole, on_stand_in, raise, trace,
};

fn open() -> Result<Freenect1Camera, CameraError> {
    Freenect1Camera::open(None, Settings::default())
}

#[test]
fn a_slow_first_frame_is_waited_for() {
    let device = "first_depth_after_ms = 1200\nfirst_ir_after_ms = 700";
    on_stand_in(
        "faults::a_slow_first_frame_is_waited_for",
        &[device],
        |_| {
            let start = Instant::now();
            let mut camera = open().unwrap();
            let frame = next_whole(&mut camera);
            assert!(frame.disparity.is_some());
            assert!(start.elapsed() > Duration::from_secs(1));
        },
    );
}

fn assert_silent(camera: &mut Freenect1Camera, stream: &str) {
    let (error, took) = next_failure(camera);
    eprintln!("after {:.2} s: {error}", took.as_secs_f64());
    let message = error.to_string();
    assert!(matches!(error, CameraError::Unresponsive(_)), "{message}");
    assert!(
        message.contains(&format!("no {stream} frame within ")),
        "{message}"
    );
    assert!(message.contains("its start"), "{message}");
    assert_eq!(
        camera.grab_raw(Duration::ZERO).unwrap_err(),
        error,
        "it stays over"
    );
}

#[test]
fn a_missing_first_frame_is_an_error_that_names_the_stream() {
    let test = "faults::a_missing_first_frame_is_an_error_that_names_the_stream";
    on_stand_in(test, &[""], |root| {
        for (flag, stream) in [("silent-depth", "depth"), ("silent-ir", "IR")] {
            raise(root, flag);
            let mut camera = open().unwrap();
            assert_silent(&mut camera, stream);
            drop(camera);
            lower(root, flag);
        }
    });
}

/// As after a stall of the bus; the file that silences depth is still there when the device is opened again.
#[test]
fn a_stream_that_stops_by_itself_is_opened_again_until_it_comes() {
    let test = "faults::a_stream_that_stops_by_itself_is_opened_again_until_it_comes";
    on_stand_in(test, &[""], |root| {
        let settings = Settings {
            search_interval: SECOND / 10,
            ..Settings::default()
        };
        let mut camera = Freenect1Camera::open(None, settings).unwrap();
        let before = next_pair(&mut camera);
        raise(root, "silent-depth");
        let (error, took) = next_failure(&mut camera);
        eprintln!("after {:.2} s: {error}", took.as_secs_f64());
        assert_eq!(error, CameraError::Disconnected);
        // Longer than a stream is given to come.
        let silent = camera.grab_raw(4 * SECOND);
        assert!(
            matches!(silent, Err(CameraError::Timeout { .. })),
            "{silent:?}"
        );
        lower(root, "silent-depth");
        let after = next_pair(&mut camera);
        assert_bit_exact(&after);
        assert!(after.frame_id > before.frame_id);
        assert!(after.device_time_secs > before.device_time_secs);
        let starts_depth = |line: &&String| *line == "write 06 2";
        assert!(trace(root).iter().filter(starts_depth).count() >= 2);
    });
}

/// libfreenect reports success for a stream of which no transfer could be submitted.
#[test]
fn transfers_that_the_kernel_has_no_memory_for_are_told_of() {
    let test = "faults::transfers_that_the_kernel_has_no_memory_for_are_told_of";
    on_stand_in(test, &[""], |root| {
        raise(root, "no-memory");
        let mut camera = open().unwrap();
        let (error, _) = next_failure(&mut camera);
        let message = error.to_string();
        eprintln!("{message}");
        assert!(message.contains("no depth frame"), "{message}");
        // LIBUSB_ERROR_NO_MEM.
        assert!(
            message.contains("Failed to submit isochronous transfer"),
            "{message}"
        );
        assert!(message.contains("-11"), "{message}");
        // Longer than a call to the device may take: it has none any more.
        thread::sleep(Duration::from_millis(2500));
        let error = camera.control().set_streams(Streams::Ir).unwrap_err();
        let expected = CameraError::Unresponsive("its thread has ended".to_owned());
        assert_eq!(error, expected);
        // Its streams never had a transfer: stopping and closing must not wait for one.
        drop(camera);
        lower(root, "no-memory");
        next_whole(&mut open().unwrap());
    });
}

#[test]
fn a_control_transfer_that_never_returns_is_noticed_from_outside() {
    let test = "faults::a_control_transfer_that_never_returns_is_noticed_from_outside";
    on_stand_in(test, &[""], |root| {
        let mut camera = open().unwrap();
        next_whole(&mut camera);
        raise(root, "wedged");
        let start = Instant::now();
        let error = camera.control().set_streams(Streams::Ir).unwrap_err();
        eprintln!("after {:.2} s: {error}", start.elapsed().as_secs_f64());
        assert!(
            error.to_string().contains("stopping depth has taken "),
            "{error}"
        );
        let (error, _) = next_failure(&mut camera);
        assert!(matches!(error, CameraError::Unresponsive(_)), "{error}");
        // Dropping does not wait for the transfer, which returns when the file is gone and not before.
        drop(camera);
        lower(root, "wedged");
    });
}

#[test]
fn devices_that_cannot_be_opened_say_why() {
    on_stand_in(
        "faults::devices_that_cannot_be_opened_say_why",
        &["serial = C3"],
        |root| {
            assert_eq!(attached().unwrap(), ["C3"]);
            let other = Freenect1Camera::open(Some("C4"), Settings::default());
            assert_eq!(other.unwrap_err(), CameraError::Disconnected);
            raise(root, "busy");
            assert_eq!(open().unwrap_err(), CameraError::Busy);
            lower(root, "busy");
            raise(root, "denied");
            assert_eq!(open().unwrap_err(), CameraError::PermissionDenied);
            let named = Freenect1Camera::open(Some("C3"), Settings::default());
            assert_eq!(named.unwrap_err(), CameraError::PermissionDenied);
            assert_eq!(attached().unwrap_err(), CameraError::PermissionDenied);
            lower(root, "denied");
            raise(root, "unplugged");
            assert_eq!(open().unwrap_err(), CameraError::Disconnected);
            assert!(attached().unwrap().is_empty());
            lower(root, "unplugged");
            next_whole(&mut open().unwrap());
        },
    );
}

#[test]
fn constants_that_make_no_sense_are_refused() {
    let device = "reference_pixel_size_mm = 0";
    on_stand_in(
        "faults::constants_that_make_no_sense_are_refused",
        &[device],
        |_| {
            let message = open().unwrap_err().to_string();
            assert!(
                message.contains("reference_pixel_size_mm is 0"),
                "{message}"
            );
        },
    );
}
