//! From packets to the frames of a depth camera.

use std::time::Instant;

use depth_camera::{CameraInfo, Frame, ImagePool, Light, Sensor};

use crate::{
    HEIGHT, WIDTH,
    decoder::{Decoded, Decoder, DecoderError},
    ir_parameters::IrParameters,
    options::DecoderOptions,
    p0_tables::P0Tables,
    packet::RawPacket,
};

/// Threads that decode: one keeps up with the sensor, two leave it time for fusion.
const N_THREADS: usize = 2;

/// Images on their way through the pipeline whose buffers are used again.
const POOL_CAPACITY: usize = 16;

/// The sensor's own processing, as a part of a camera: decoder, memory and threads.
///
/// Frames are never mirrored, whatever the options say: a [`Frame`]'s columns go to the camera's right.
#[derive(Debug)]
pub(crate) struct FrameDecoder {
    decoder: Decoder,
    decoded: Decoded,
    threads: rayon::ThreadPool,
    depth: ImagePool<f32>,
    ir: ImagePool<u16>,
}

/// Why frames cannot be decoded.
#[derive(Debug, thiserror::Error)]
pub(crate) enum FrameDecoderError {
    #[error(transparent)]
    Decoder(#[from] DecoderError),
    #[error("no threads to decode with: {0}")]
    Threads(#[from] rayon::ThreadPoolBuildError),
}

impl FrameDecoder {
    pub(crate) fn new(
        tables: &P0Tables,
        camera: &IrParameters,
        options: DecoderOptions,
    ) -> Result<Self, FrameDecoderError> {
        let options = DecoderOptions {
            unmirrored: true,
            ..options
        };
        let threads = rayon::ThreadPoolBuilder::new()
            .num_threads(N_THREADS)
            .thread_name(|index| format!("k2-decode-{index}"))
            .build()?;
        let decoder = threads.install(|| Decoder::new(tables, camera, options))?;
        Ok(FrameDecoder {
            decoder,
            decoded: Decoded::default(),
            threads,
            depth: ImagePool::new(POOL_CAPACITY),
            ir: ImagePool::new(POOL_CAPACITY),
        })
    }

    /// The frame that a packet holds; the buffers of its images come back when it is dropped.
    pub(crate) fn frame(
        &mut self,
        packet: RawPacket<'_>,
        frame_id: u64,
        device_time_secs: f64,
        host_time: Instant,
    ) -> Frame {
        let (decoder, decoded) = (&self.decoder, &mut self.decoded);
        self.threads.install(|| decoder.decode(packet, decoded));
        let n_pixels = WIDTH * HEIGHT;
        let next_depth = self.depth.image(WIDTH, HEIGHT, self.depth.take(n_pixels));
        let next_ir = self.ir.image(WIDTH, HEIGHT, self.ir.take(n_pixels));
        let (depth, ir) = decoded.exchange(next_depth, next_ir);
        Frame {
            frame_id,
            device_time_secs,
            host_time,
            depth: Some(depth),
            ir: Some(ir),
        }
    }
}

/// A Kinect II as a camera that is not mirrored.
///
/// The light is where ranging takes the emitter to be; how far above or before the lens it is nobody has said.
pub(crate) fn camera_info(
    serial: &str,
    camera: &IrParameters,
    n_frames: Option<usize>,
) -> CameraInfo {
    CameraInfo {
        sensor: Sensor::Kinect2,
        serial: serial.to_owned(),
        driver: Some("libfreenect2".to_owned()),
        intrinsics: camera.intrinsics(),
        ir_full_scale: Some(f64::from(u16::MAX)),
        ir_gain: None,
        light: Some(Light::kinect2_emitter()),
        n_frames,
    }
}
