//! Recordings of raw disparity whose files hold any bytes: they are refused, or they play to their end.
#![no_main]

use std::{cell::OnceCell, fs, time::Duration};

use depth_camera::{CameraError, DepthCamera};
use freenect1::{RAW_DEVICE_FILE, RawDisparityCamera};
use libfuzzer_sys::fuzz_target;

thread_local! {
    static FOLDER: OnceCell<tempfile::TempDir> = const { OnceCell::new() };
}

const DEVICE: &str = "serial = \"A\"\nir_gain = 30\nir_offset_px = [5.0, 4.0]\n[zero_plane]\nemitter_distance_cm = 7.5\n\
    reference_distance_mm = 120.0\nreference_pixel_size_mm = 0.1042\nconst_shift = 200.0\n";

fuzz_target!(|bytes: &[u8]| {
    FOLDER.with(|folder| {
        let folder = folder.get_or_init(|| tempfile::tempdir().expect("a folder"));
        play(folder.path(), bytes);
    });
});

/// The first byte says which file the others are; what is left out is good.
fn play(folder: &std::path::Path, bytes: &[u8]) {
    let Some((which, content)) = bytes.split_first() else { return };
    let list = b"1.0 image.png\n2.0 image.png\n".as_slice();
    let file = |number: u8, good: &'static [u8]| match which % 4 == number {
        true => content.to_owned(),
        false => good.to_owned(),
    };
    for (name, content) in [
        (RAW_DEVICE_FILE, file(0, DEVICE.as_bytes())),
        ("disparity.txt", file(1, list)),
        ("ir.txt", file(2, b"")),
        ("image.png", file(3, b"\x89PNG\r\n\x1a\n")),
    ] {
        fs::write(folder.join(name), content).expect("a folder takes files");
    }
    let mut camera = match RawDisparityCamera::open(folder) {
        Ok(camera) => camera,
        Err(error) => {
            assert!(matches!(error, CameraError::Invalid(_)), "{error}");
            return;
        }
    };
    let announced = camera.info().n_frames.expect("a recording knows its length");
    for _ in 0..announced {
        match camera.grab(Duration::ZERO) {
            Ok(frame) => assert!(frame.is_some()),
            Err(error) => assert!(error.is_recoverable(), "{error}"),
        }
    }
    assert!(matches!(camera.grab(Duration::ZERO), Ok(None)));
}
