//! A session of a few pixels, whole until a test breaks it.

use std::{
    path::Path,
    time::{Duration, Instant},
};

use depth_camera::{
    CameraError, CameraInfo, DepthCamera, Frame, Image, Intrinsics, Light, LightKind, Sensor,
};
use replay::{ReplayCamera, SessionWriter};

pub fn tiny_camera() -> CameraInfo {
    CameraInfo {
        sensor: Sensor::Kinect2,
        serial: "0042".to_owned(),
        driver: None,
        intrinsics: Intrinsics {
            width: 7,
            height: 5,
            fx: 5.25,
            fy: 5.5,
            cx: 3.1,
            cy: 2.2,
            k1: 0.0905,
            k2: -0.2675,
            p1: -0.001,
            p2: 0.002,
            k3: 0.0949,
        },
        ir_full_scale: Some(65535.0),
        ir_gain: None,
        light: Some(Light {
            position_m: [0.052, 0.0, 0.004],
            kind: LightKind::Emitter,
        }),
        n_frames: None,
    }
}

/// Depth 0.6 m with a slope and one hole, IR up to full scale.
pub fn tiny_frame(frame_id: u64) -> Frame {
    let metres = |i: usize| match i {
        3 => 0.0,
        _ => 0.6 + 0.001 * i as f32,
    };
    Frame {
        frame_id,
        device_time_secs: 100.0 + frame_id as f64 / 30.0,
        host_time: Instant::now(),
        depth: Some(Image::from_vec(7, 5, (0..35).map(metres).collect())),
        ir: Some(Image::from_vec(
            7,
            5,
            (0..35).map(|i| 65535 - 257 * i).collect(),
        )),
    }
}

/// Three frames of depth and IR.
pub fn write_tiny_session(folder: &Path) {
    let mut writer =
        SessionWriter::create(folder, &tiny_camera(), 1000.0).expect("an empty folder");
    for frame_id in 0..3 {
        writer.write(&tiny_frame(frame_id)).expect("a whole frame");
    }
    assert_eq!(writer.finish().expect("a whole recording"), 3);
}

/// Everything that a recording delivers, until its end or the end of its stream.
pub fn play(camera: &mut ReplayCamera) -> Vec<Result<Frame, CameraError>> {
    std::iter::from_fn(|| camera.grab(Duration::ZERO).transpose()).collect()
}
