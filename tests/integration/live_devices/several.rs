//! Several devices in one process: each its own thread and library context.

use super::stand_in::{Bus, inside, noise_frames};
use depth_camera::{CameraError, DepthCamera};
use relief::devices::{DeviceParams, OpenError, open};
use std::{fs, thread, time::Duration};

const PATIENCE: Duration = Duration::from_secs(10);

/// What the first pixels of a device's IR images are, in the order in which it sends them.
fn first_pixels(seed: usize) -> Vec<u16> {
    let frames = noise_frames(6, seed);
    let pixels = frames
        .iter()
        .map(|frame| *frame.ir.as_ref().unwrap().at(1, 0));
    pixels.collect()
}

fn grab_ten(camera: &mut dyn DepthCamera, seed: usize) {
    let known = first_pixels(seed);
    let mut n_whole = 0;
    while n_whole < 10 {
        match camera.grab(PATIENCE) {
            Ok(frame) => {
                if let Some(ir) = frame.unwrap().ir {
                    assert!(known.contains(ir.at(1, 0)), "of the other device");
                    n_whole += 1;
                }
            }
            Err(error) => assert!(error.is_recoverable(), "{error}"),
        }
    }
}

#[test]
fn two_devices_stream_beside_each_other_and_one_may_go() {
    let test = "live_devices::several::two_devices_stream_beside_each_other_and_one_may_go";
    let Some(root) = inside() else {
        let bus = Bus::new();
        for (name, serial, seed) in [("kinect0", "S1", 1), ("kinect1", "S2", 2)] {
            let device = format!("serial = {serial}\nframe_rate_hz = 8");
            bus.plug(name, &device, &noise_frames(6, seed));
        }
        return bus.run_inside(test);
    };
    assert_ne!(first_pixels(1), first_pixels(2));
    let params = DeviceParams::default();
    let mut cameras = [("S1", 1), ("S2", 2)].map(|(serial, seed)| {
        let camera = open(serial, &params).unwrap();
        assert_eq!(camera.info().serial, serial);
        (camera, seed)
    });
    thread::scope(|scope| {
        for (camera, seed) in &mut cameras {
            thread::Builder::new()
                .name(format!("grab-{seed}"))
                .spawn_scoped(scope, || grab_ten(camera.as_mut(), *seed))
                .unwrap();
        }
    });
    // A device that is open here already.
    let again = open("S1", &params).map(drop).unwrap_err();
    let busy = matches!(
        again,
        OpenError::Camera {
            source: CameraError::Busy,
            ..
        }
    );
    assert!(busy, "{again}");
    let [(first, _), (second, seed)] = &mut cameras;
    fs::write(root.join("kinect0/unplugged"), []).unwrap();
    let gone = loop {
        match first.grab(PATIENCE) {
            Ok(_) => {}
            Err(error) if error.is_recoverable() => {}
            Err(error) => break error,
        }
    };
    assert_eq!(gone, CameraError::Disconnected);
    grab_ten(second.as_mut(), *seed);
}
