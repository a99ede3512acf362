//! From packets to the frames of a depth camera.

use std::time::Instant;

use depth_camera::{CameraInfo, Frame, Light, Sensor};

use crate::{
    decoder::{Decoded, Decoder, DecoderError},
    ir_parameters::IrParameters,
    options::DecoderOptions,
    p0_tables::P0Tables,
    packet::RawPacket,
};

/// Threads that decode: one keeps up with the sensor, two leave it time for fusion.
const N_THREADS: usize = 2;

/// The sensor's own processing, as a part of a camera: decoder, memory and threads.
///
/// Frames are never mirrored, whatever the options say: a [`Frame`]'s columns go to the camera's right.
#[derive(Debug)]
pub(crate) struct FrameDecoder {
    decoder: Decoder,
    decoded: Decoded,
    pool: rayon::ThreadPool,
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
        let pool = rayon::ThreadPoolBuilder::new()
            .num_threads(N_THREADS)
            .thread_name(|index| format!("k2-decode-{index}"))
            .build()?;
        let decoder = pool.install(|| Decoder::new(tables, camera, options))?;
        Ok(FrameDecoder {
            decoder,
            decoded: Decoded::default(),
            pool,
        })
    }

    /// The frame that a packet holds; its images are the only memory that is asked for.
    pub(crate) fn frame(
        &mut self,
        packet: RawPacket<'_>,
        frame_id: u64,
        device_time_secs: f64,
        host_time: Instant,
    ) -> Frame {
        let (decoder, decoded) = (&self.decoder, &mut self.decoded);
        self.pool.install(|| decoder.decode(packet, decoded));
        let (depth, ir) = decoded.take_depth_and_ir();
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
        intrinsics: camera.intrinsics(true),
        ir_full_scale: Some(f64::from(u16::MAX)),
        ir_gain: None,
        light: Some(Light::kinect2_emitter()),
        n_frames,
    }
}
