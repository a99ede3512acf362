//! Models, and several devices at once.

use std::thread;

use freenect1::{Freenect1Camera, Settings, attached, disparity::ZeroPlane};

use depth_camera::DepthCamera;

use crate::support::{assert_bit_exact, next_whole, on_stand_in, trace};

fn run_model(test: &str, model: &str) {
    let device = format!(
        "model = {model}\nserial = {model}X\nemitter_distance_cm = 7.625\nconst_shift = 201\n\
         reference_distance_mm = 118.5\nreference_pixel_size_mm = 0.125"
    );
    on_stand_in(test, &[&device], |root| {
        let serial = format!("{model}X");
        assert_eq!(attached().unwrap(), [serial.as_str()]);
        let mut camera = Freenect1Camera::open(Some(&serial), Settings::default()).unwrap();
        assert_eq!(camera.info().serial, serial);
        let expected = ZeroPlane {
            emitter_distance_cm: 7.625,
            reference_distance_mm: 118.5,
            reference_pixel_size_mm: 0.125,
            const_shift: 201.0,
        };
        assert_eq!(*camera.zero_plane(), expected);
        for _ in 0..5 {
            assert_bit_exact(&next_whole(&mut camera));
        }
        let trace = trace(root);
        // What keeps the later models alive is the library's own doing.
        assert_eq!(trace.iter().any(|line| line == "led"), model != "1414");
        let is_windows = trace.iter().any(|line| line == "alternate setting 1");
        assert_eq!(is_windows, model == "k4w");
    });
}

#[test]
fn model_1414_reports_its_own_serial() {
    run_model("devices::model_1414_reports_its_own_serial", "1414");
}

#[test]
fn model_1473_reports_the_serial_of_its_audio_part() {
    run_model(
        "devices::model_1473_reports_the_serial_of_its_audio_part",
        "1473",
    );
}

#[test]
fn kinect_for_windows_reports_the_serial_of_its_audio_part() {
    run_model(
        "devices::kinect_for_windows_reports_the_serial_of_its_audio_part",
        "k4w",
    );
}

#[test]
fn two_devices_stream_at_once() {
    let devices = [
        "serial = D1\nframe_rate_hz = 15",
        "serial = D2\nframe_rate_hz = 15",
    ];
    on_stand_in("devices::two_devices_stream_at_once", &devices, |_| {
        assert_eq!(attached().unwrap(), ["D1", "D2"]);
        thread::scope(|scope| {
            for serial in ["D1", "D2"] {
                scope.spawn(move || {
                    let mut camera =
                        Freenect1Camera::open(Some(serial), Settings::default()).unwrap();
                    assert_eq!(camera.info().serial, serial);
                    for _ in 0..20 {
                        assert_bit_exact(&next_whole(&mut camera));
                    }
                });
            }
        });
    });
}
