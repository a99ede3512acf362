//! What is decided before the device is opened.

use std::time::Duration;

use crate::{
    frames::NOMINAL_IR_OFFSET_PX,
    streams::{IrSize, Streams},
};

/// What is decided before the device is opened.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Settings {
    /// What to deliver at first.
    pub streams: Streams,
    /// Gain of the IR image, 1 to 50. Light strength and albedo scale with it: keep it for a whole scan.
    pub ir_gain: u16,
    /// How far right of and below its place in the depth image a point lies in the IR image, pixels. It moves the principal
    /// point alone: the images stay as they are.
    pub ir_offset_px: [f64; 2],
    /// Where the lamp of the shading images is, IR camera's frame, metres; `None` if there is none.
    pub lamp_position_m: Option<[f64; 3]>,
    /// The size of IR while depth is paused; its frames are of 640×480 pixels all the same.
    pub paused_ir_size: IrSize,
    /// How often a device that has gone is looked for, where nobody tells that it is back.
    pub search_interval: Duration,
}

impl Default for Settings {
    fn default() -> Self {
        Settings {
            streams: Streams::default(),
            // What the device starts with.
            ir_gain: 30,
            ir_offset_px: NOMINAL_IR_OFFSET_PX,
            lamp_position_m: None,
            paused_ir_size: IrSize::default(),
            search_interval: Duration::from_secs(1),
        }
    }
}
