//! Shading images with depth stopped, on the unmodified libfreenect.

use super::stand_in::{Bus, inside};
use crate::raw_kinect1::raw_frames;
use depth_camera::DepthCamera;
use relief::{
    devices::{DeviceParams, open},
    pipeline::{ShadingOutcome, ShadingRefusal, ShadingRequest, StopDepthCamera},
};
use simulated::SimulatedCamera;
use std::{fs, path::Path, time::Duration};

/// A device that shows speckle while depth runs, and without depth what `alone` holds, if it is dark then.
fn plug(bus: &Bus, alone: Option<&[u16]>) {
    let frames = raw_frames(SimulatedCamera::kinect1_plaque(8, 5));
    // Frame 6 is of the projector, those after it of the lamp, with nothing for depth.
    let speckled = &frames[6..7];
    let device = "serial = P1\nframe_rate_hz = 10\nfreeze_ir_clock = true";
    bus.plug("kinect0", device, speckled);
    if let Some(alone) = alone {
        let bytes: Vec<u8> = alone.iter().flat_map(|count| count.to_le_bytes()).collect();
        fs::write(bus.path("kinect0/ir10-alone.u16"), bytes).unwrap();
    }
}

/// Asks for a shading image; how it ended, and how many frames came without depth.
fn ask(camera: &mut StopDepthCamera, request: &ShadingRequest) -> (ShadingOutcome, usize) {
    request.ask();
    let mut n_without_depth = 0;
    loop {
        match camera.grab(Duration::from_secs(10)) {
            Ok(frame) => n_without_depth += usize::from(frame.unwrap().depth.is_none()),
            Err(error) => assert!(error.is_recoverable(), "{error}"),
        }
        if let Some(outcome) = request.take_outcome() {
            return (outcome, n_without_depth);
        }
    }
}

fn camera() -> (StopDepthCamera, ShadingRequest) {
    let request = ShadingRequest::default();
    let camera = open("P1", &DeviceParams::default()).unwrap();
    let camera = StopDepthCamera::new(camera, request.clone(), 4);
    (camera.unwrap_or_else(|_| panic!("it delivers IR")), request)
}

fn wait_for_depth(camera: &mut StopDepthCamera) {
    for _ in 0..30 {
        match camera.grab(Duration::from_secs(10)) {
            Ok(frame) if frame.as_ref().unwrap().depth.is_some() => return,
            Ok(_) => {}
            Err(error) => assert!(error.is_recoverable(), "{error}"),
        }
    }
    panic!("no depth among 30 frames");
}

/// What the library has told the device.
fn written(root: &Path) -> Vec<String> {
    let trace = fs::read_to_string(root.join("kinect0/trace.txt")).unwrap();
    trace.lines().map(str::to_owned).collect()
}

#[test]
fn a_projector_that_goes_dark_gives_exposures() {
    let test = "live_devices::shading::a_projector_that_goes_dark_gives_exposures";
    let Some(root) = inside() else {
        let bus = Bus::new();
        let lamp = raw_frames(SimulatedCamera::kinect1_plaque(8, 5));
        plug(&bus, Some(lamp[8].ir.as_ref().unwrap().data()));
        return bus.run_inside(test);
    };
    let (mut camera, request) = camera();
    wait_for_depth(&mut camera);
    for _ in 0..2 {
        let (outcome, n_frames) = ask(&mut camera, &request);
        assert_eq!(outcome, ShadingOutcome::Taken { n_exposures: 4 });
        assert!(n_frames >= 4);
        wait_for_depth(&mut camera);
    }
    let written = written(&root);
    let n_starts = written.iter().filter(|line| *line == "write 06 2").count();
    assert_eq!(n_starts, 3, "again after each image: {written:?}");
    assert!(
        !written.iter().any(|line| line == "write 05 0"),
        "IR went on"
    );
    assert!(!written.iter().any(|line| line.contains("Motor")));
}

#[test]
fn a_projector_that_stays_lit_is_refused() {
    let test = "live_devices::shading::a_projector_that_stays_lit_is_refused";
    if inside().is_none() {
        let bus = Bus::new();
        plug(&bus, None);
        return bus.run_inside(test);
    }
    let (mut camera, request) = camera();
    wait_for_depth(&mut camera);
    let (outcome, _) = ask(&mut camera, &request);
    let ShadingOutcome::Refused(ShadingRefusal::Speckle { energy }) = outcome else {
        panic!("{outcome:?}");
    };
    assert!(energy > 0.12, "{energy}");
    wait_for_depth(&mut camera);
}
