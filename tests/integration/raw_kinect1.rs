//! What a simulated Kinect I would send: disparity, and IR with all its rows.

use depth_camera::{DepthCamera, Image, Sensor};
use freenect1::{
    DeviceRecord, RawDisparityWriter,
    assembly::RawFrame,
    disparity::{NO_DISPARITY, ZeroPlane},
};
use nalgebra::center;
use simulated::{Infrared, Scene, Setup, SimulatedCamera, Trajectory};
use std::{path::Path, time::Duration};

/// A Kinect I whose IR lies as the device has it, led round the plaque with three shading poses.
pub fn offset_kinect1() -> SimulatedCamera {
    let scene = Scene::plaque();
    let (low, high) = scene.object_bounds();
    SimulatedCamera::new(Setup {
        trajectory: Trajectory::hand_held(center(&low, &high), 24),
        scene,
        sensor: Sensor::Kinect1,
        infrared: Infrared {
            offset_px: [5.0, 4.0],
            ..Infrared::of_sensor(Sensor::Kinect1)
        },
        n_moving_frames: 4,
        shading_frames: vec![0, 1, 2],
        reduction: 1,
        seed: 7,
    })
    .unwrap()
}

/// The constants of a device whose focal length is that of the simulated Kinect I, 580 px.
pub fn zero_plane() -> ZeroPlane {
    ZeroPlane {
        // As the device has it, in 32 bits.
        reference_pixel_size_mm: f64::from((120.0 / 1160.0) as f32),
        ..ZeroPlane::TYPICAL
    }
}

/// Records what a device of that serial number sent, which has its lamp where the simulated one has.
pub fn record_raw(frames: &[RawFrame], serial: &str, folder: &Path) {
    let light = SimulatedCamera::kinect1_plaque(1, 0).info().light;
    let device = DeviceRecord {
        serial: serial.to_owned(),
        zero_plane: zero_plane(),
        ir_gain: 12,
        ir_offset_px: [0.0, 0.0],
        lamp_position_m: light.map(|light| light.position_m),
    };
    let mut writer = RawDisparityWriter::create(folder, &device).unwrap();
    for frame in frames {
        writer.write(frame).unwrap();
    }
    writer.finish().unwrap();
}

/// Stamp of depth in frame `number` of a stream that is played once, seconds.
pub fn stamp_secs(number: usize) -> f64 {
    // The stand-in stamps depth 12 345 ticks after IR.
    depth_camera::whole_microseconds((number as f64 * 2e6 + 12_345.0) / 60e6)
}

/// A simulated Kinect I's frames as the device would send them: the nearest disparity, and IR with eight more rows.
pub fn raw_frames(camera: SimulatedCamera) -> Vec<RawFrame> {
    let plane = zero_plane();
    let mut camera = camera;
    let frames = std::iter::from_fn(|| camera.grab(Duration::ZERO).unwrap());
    frames
        .enumerate()
        .map(|(number, frame)| {
            let disparity = |metres: &f32| match *metres > 0.0 {
                true => plane.disparity(f64::from(*metres)),
                false => NO_DISPARITY,
            };
            let mut ir = Image::filled(640, 488, 0);
            if let Some(shown) = &frame.ir {
                ir.data_mut()[..640 * 480].copy_from_slice(shown.data());
            }
            RawFrame {
                frame_id: number as u64,
                device_time_secs: stamp_secs(number),
                host_time: frame.host_time,
                disparity: frame.depth.map(|depth| depth.map(disparity)),
                ir: Some(ir),
            }
        })
        .collect()
}
