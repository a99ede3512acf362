//! From disparity to the frames of a depth camera, the same for a live device and for a recording of one.

use depth_camera::{
    CameraError, CameraInfo, Frame, Image, ImagePool, Intrinsics, Light, LightKind, Sensor,
};

use crate::{
    assembly::RawFrame,
    disparity::{DisparityTable, ZeroPlane},
    reduction::reduce,
    streams::{DEPTH_SIZE, IrSize},
};

/// How far right of and below its place in the depth image a point lies in the IR image, pixels, where the device has not been
/// calibrated: what the correlation window of 9×7 pixels does. Units differ; calibration's `ir_offset_px` is the measured value.
pub const NOMINAL_IR_OFFSET_PX: [f64; 2] = [5.0, 4.0];

/// Principal point of the IR image where the device has not been calibrated, pixels.
const NOMINAL_IR_CENTRE_PX: [f64; 2] = [319.5, 239.5];

/// IR counts at full scale: 10 bits.
pub(crate) const IR_FULL_SCALE: u16 = 1023;

/// Images on their way through the pipeline whose buffers are used again.
const POOL_CAPACITY: usize = 16;

/// What has to be known of a device to make frames of what it sends.
#[derive(Clone, Debug, PartialEq)]
pub struct DeviceRecord {
    /// The device's serial number.
    pub serial: String,
    /// Its constants of triangulation.
    pub zero_plane: ZeroPlane,
    /// The gain of the IR image, as the device reported it.
    pub ir_gain: u16,
    /// How far right of and below its place in the depth image a point lies in the IR image, pixels.
    pub ir_offset_px: [f64; 2],
    /// Where the lamp of the shading images is, IR camera's frame, metres; `None` if there is none.
    pub lamp_position_m: Option<[f64; 3]>,
}

impl DeviceRecord {
    /// The device as a camera with nominal lens: a focal length by its own constants, no distortion.
    pub(crate) fn camera_info(&self, n_frames: Option<usize>) -> CameraInfo {
        let (width, height) = DEPTH_SIZE;
        let focal_px = self.zero_plane.focal_px();
        CameraInfo {
            sensor: Sensor::Kinect1,
            serial: self.serial.clone(),
            driver: Some("libfreenect".to_owned()),
            intrinsics: Intrinsics {
                width,
                height,
                fx: focal_px,
                fy: focal_px,
                cx: NOMINAL_IR_CENTRE_PX[0] - self.ir_offset_px[0],
                cy: NOMINAL_IR_CENTRE_PX[1] - self.ir_offset_px[1],
                k1: 0.0,
                k2: 0.0,
                p1: 0.0,
                p2: 0.0,
                k3: 0.0,
            },
            ir_full_scale: Some(IR_FULL_SCALE.into()),
            ir_gain: Some(self.ir_gain),
            light: self.lamp_position_m.map(|position_m| Light {
                position_m,
                kind: LightKind::Lamp,
            }),
            n_frames,
        }
    }
}

/// Turns disparity into metres, and puts IR of either size onto the depth image's grid.
#[derive(Debug)]
pub(crate) struct FrameDecoder {
    table: DisparityTable,
    metres: ImagePool<f32>,
    /// Of IR images that are reduced.
    counts: ImagePool<u16>,
}

impl FrameDecoder {
    /// # Errors
    /// [`CameraError::Invalid`] for constants that make no sense.
    pub(crate) fn new(zero_plane: &ZeroPlane) -> Result<Self, CameraError> {
        Ok(FrameDecoder {
            table: DisparityTable::new(zero_plane)?,
            metres: ImagePool::new(POOL_CAPACITY),
            counts: ImagePool::new(POOL_CAPACITY),
        })
    }

    /// Depth in metres and IR, both at 640×480.
    pub(crate) fn frame(&self, raw: RawFrame) -> Frame {
        let depth = raw.disparity.map(|disparity| {
            let (width, height) = (disparity.width(), disparity.height());
            let mut metres = self.metres.take(width * height);
            self.table.convert(&disparity, &mut metres);
            self.metres.image(width, height, metres)
        });
        Frame {
            frame_id: raw.frame_id,
            device_time_secs: raw.device_time_secs,
            host_time: raw.host_time,
            depth,
            ir: raw.ir.map(|ir| self.on_depth_grid(ir)),
        }
    }

    fn on_depth_grid(&self, ir: Image<u16>) -> Image<u16> {
        let (width, height) = DEPTH_SIZE;
        if ir.width() == IrSize::Medium.pixels().0 {
            // Row 0 is the depth image's; what is more lies at the bottom.
            return ir.top_rows(height);
        }
        let mut counts = self.counts.take(width * height);
        reduce(&ir, &mut counts);
        self.counts.image(width, height, counts)
    }
}
