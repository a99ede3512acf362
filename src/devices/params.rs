//! What can be set about live devices.

use depth_camera::Light;
use freenect1::{Settings, streams::IrSize};
use freenect2::{BilateralOptions, DecoderOptions, EdgeAwareOptions};
use serde::{Deserialize, Serialize};

/// What the drivers are told.
#[derive(Clone, Debug, Default, PartialEq, Deserialize, Serialize)]
#[serde(default, deny_unknown_fields)]
pub struct DeviceParams {
    /// Kinect I.
    pub kinect1: Kinect1Params,
    /// Kinect II, live and in recordings of raw packets.
    pub kinect2: Kinect2Params,
}

/// How a Kinect I is used.
#[derive(Clone, Debug, PartialEq, Deserialize, Serialize)]
#[serde(default, deny_unknown_fields)]
pub struct Kinect1Params {
    /// Gain of the IR image, 1 to 50; light strength and albedo scale with it.
    pub ir_gain: u16,
    /// Where the lamp of the shading images is in the IR camera's frame, metres; a position in the device's calibration goes
    /// before. Without either there are no shading images.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub lamp_position_m: Option<[f64; 3]>,
    /// The size at which the device takes IR while depth is stopped for a shading image; the image is of 640×480 pixels all the
    /// same.
    pub stop_depth_ir_size: IrSize,
    /// How far right of and below its place in the depth image a point lies in the IR image, pixels; it moves the
    /// principal point. Not a key of the configuration: the device's calibration has it.
    #[serde(skip)]
    pub ir_offset_px: Option<[f64; 2]>,
}

impl Default for Kinect1Params {
    fn default() -> Self {
        let settings = Settings::default();
        Kinect1Params {
            ir_gain: settings.ir_gain,
            lamp_position_m: settings.lamp_position_m,
            stop_depth_ir_size: settings.paused_ir_size,
            ir_offset_px: None,
        }
    }
}

/// How packets of a Kinect II are decoded.
#[derive(Clone, Debug, PartialEq, Deserialize, Serialize)]
#[serde(default, deny_unknown_fields)]
pub struct Kinect2Params {
    /// Added to every depth, metres.
    pub depth_offset_m: f64,
    /// Whether phasors are smoothed before unwrapping.
    pub bilateral: bool,
    /// Whether pixels that mix two surfaces are taken out.
    pub edge_aware: bool,
}

impl Default for Kinect2Params {
    fn default() -> Self {
        Kinect2Params {
            depth_offset_m: 0.0,
            bilateral: false,
            edge_aware: true,
        }
    }
}

impl DeviceParams {
    /// Checks every value against its bound.
    ///
    /// # Errors
    /// Names the key, its value and the bound.
    pub fn validate(&self) -> Result<(), String> {
        let gain = self.kinect1.ir_gain;
        if !(1..=50).contains(&gain) {
            return Err(format!(
                "devices.kinect1.ir_gain is {gain}, must be 1 to 50"
            ));
        }
        if let Some(position_m) = self.kinect1.lamp_position_m {
            Light::check_position("devices.kinect1.lamp_position_m", position_m)?;
        }
        let offset_m = self.kinect2.depth_offset_m;
        if !(-0.2..=0.2).contains(&offset_m) {
            return Err(format!(
                "devices.kinect2.depth_offset_m is {offset_m}, must be -0.2 to 0.2"
            ));
        }
        Ok(())
    }
}

impl Kinect1Params {
    /// What the driver is told.
    pub fn settings(&self) -> Settings {
        let default = Settings::default();
        Settings {
            ir_gain: self.ir_gain,
            lamp_position_m: self.lamp_position_m,
            paused_ir_size: self.stop_depth_ir_size,
            ir_offset_px: self.ir_offset_px.unwrap_or(default.ir_offset_px),
            ..default
        }
    }
}

impl Kinect2Params {
    /// What the decoder is told.
    pub fn decoder_options(&self) -> DecoderOptions {
        DecoderOptions {
            depth_offset_m: self.depth_offset_m as f32,
            bilateral: self.bilateral.then(BilateralOptions::default),
            edge_aware: self.edge_aware.then(EdgeAwareOptions::default),
            ..DecoderOptions::default()
        }
    }
}
