//! Small recordings in closed form: every pixel of every frame is known from its number.

use std::{
    path::{Path, PathBuf},
    time::{Duration, Instant},
};

use depth_camera::{CameraError, CameraInfo, DepthCamera, Frame, Image, Intrinsics, Light, Sensor};
use mcap_session::{McapCamera, RecordingParams, SegmentWriter};

/// Steps of depth in a metre.
pub const UNITS_PER_METRE: f64 = 5000.0;

/// A small Kinect II.
pub fn camera_info(width: usize, height: usize) -> CameraInfo {
    CameraInfo {
        sensor: Sensor::Kinect2,
        serial: "012-test".to_owned(),
        driver: Some("libfreenect2".to_owned()),
        intrinsics: Intrinsics {
            width,
            height,
            fx: 365.6 / 3.0,
            fy: 365.7,
            cx: width as f64 / 2.0 - 0.1,
            cy: height as f64 / 2.0 + 0.3,
            k1: 0.0905,
            k2: -0.2675,
            p1: 1e-17,
            p2: 0.0,
            k3: 0.0949,
        },
        ir_full_scale: Some(65_535.0),
        light: Some(Light::kinect2_emitter()),
        n_frames: None,
        ir_gain: None,
    }
}

/// The frame of that number: smooth depth, noise as IR.
pub fn frame(info: &CameraInfo, frame_id: u64) -> Frame {
    let i = &info.intrinsics;
    let (width, height) = (i.width, i.height);
    let mut noise = fastrand::Rng::with_seed(frame_id);
    let pixels = 0..width * height;
    let depth = pixels
        .clone()
        .map(|k| (4000 + (k as u64 + 7 * frame_id) % 900) as u16)
        .map(|units| (f64::from(units) / UNITS_PER_METRE) as f32)
        .collect();
    let ir = pixels.map(|_| noise.u16(1000..1400)).collect();
    Frame {
        frame_id,
        // Of six decimals, as devices and lists give it.
        device_time_secs: (1_000_000_000 + 33_333 * frame_id) as f64 / 1e6,
        host_time: Instant::now(),
        depth: Some(Image::from_vec(width, height, depth)),
        ir: Some(Image::from_vec(width, height, ir)),
    }
}

/// Parameters that flush after every frame, and leave the disk alone.
pub fn params() -> RecordingParams {
    RecordingParams {
        depth_units_per_metre: UNITS_PER_METRE,
        min_free_bytes: 0,
        flush_every: Duration::ZERO,
        ..RecordingParams::default()
    }
}

/// A closed recording of so many frames, flushed after every `frames_per_chunk`.
pub fn record(folder: &Path, info: &CameraInfo, n_frames: u64, frames_per_chunk: u64) {
    let hold = RecordingParams {
        flush_every: Duration::from_secs(3600),
        ..params()
    };
    let mut writer = SegmentWriter::create(folder, info, hold).unwrap();
    for frame_id in 0..n_frames {
        writer.write(&frame(info, frame_id)).unwrap();
        if (frame_id + 1) % frames_per_chunk == 0 {
            writer.flush().unwrap();
        }
    }
    writer.finish().unwrap();
}

/// What a recording gives: frames, and what it says of damage.
pub struct Played {
    pub frames: Vec<Frame>,
    pub damages: Vec<String>,
}

/// Plays a recording to its end.
pub fn play(path: &Path) -> Result<Played, CameraError> {
    let mut camera = McapCamera::open(path)?;
    let (mut frames, mut damages) = (Vec::new(), Vec::new());
    loop {
        match camera.grab(Duration::ZERO) {
            Ok(Some(frame)) => frames.push(frame),
            Ok(None) => return Ok(Played { frames, damages }),
            Err(CameraError::DamagedFrame { reason, .. }) => damages.push(reason),
            Err(error) => return Err(error),
        }
    }
}

/// Panics unless two frames are the same to the bit.
pub fn assert_same(found: &Frame, expected: &Frame) {
    assert_eq!(found.frame_id, expected.frame_id);
    let times = [found, expected].map(|frame| frame.device_time_secs.to_bits());
    assert_eq!(times[0], times[1], "frame {}", found.frame_id);
    assert!(found.depth == expected.depth, "depth of {}", found.frame_id);
    assert!(found.ir == expected.ir, "IR of {}", found.frame_id);
}

/// Panics unless every frame is as it was recorded.
pub fn assert_as_recorded(info: &CameraInfo, frames: &[Frame]) {
    for found in frames {
        assert_same(found, &frame(info, found.frame_id));
    }
}

/// The first segment of a recording.
pub fn first_segment(folder: &Path) -> PathBuf {
    folder.join("segment-0000.mcap")
}
