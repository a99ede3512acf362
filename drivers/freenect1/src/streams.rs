//! What the device is asked to deliver.

use serde::{Deserialize, Serialize};

use crate::packets::PacketLayout;

/// The sets of streams that the device can deliver; the colour camera shares its endpoint with IR and is not among them.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Streams {
    /// Depth and IR at 640×480, 30 Hz.
    #[default]
    DepthAndIr,
    /// Depth alone.
    Depth,
    /// IR alone at 640×480, 30 Hz, with depth stopped.
    Ir,
    /// IR alone at 1280×1024, 10 Hz; the device refuses it while depth runs.
    IrHigh,
}

impl Streams {
    /// IR of that size, with depth stopped.
    pub fn ir_alone(size: IrSize) -> Self {
        match size {
            IrSize::Medium => Streams::Ir,
            IrSize::High => Streams::IrHigh,
        }
    }

    /// Whether depth is among them.
    pub fn depth(self) -> bool {
        matches!(self, Streams::DepthAndIr | Streams::Depth)
    }

    /// At which size IR is among them, if it is.
    pub fn ir(self) -> Option<IrSize> {
        match self {
            Streams::DepthAndIr | Streams::Ir => Some(IrSize::Medium),
            Streams::IrHigh => Some(IrSize::High),
            Streams::Depth => None,
        }
    }
}

/// Sizes of the IR image as the device delivers it.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub enum IrSize {
    /// 640×488: the depth image's rows, and eight more at the bottom.
    #[default]
    #[serde(rename = "640x488")]
    Medium,
    /// 1280×1024: every pixel of the sensor.
    #[serde(rename = "1280x1024")]
    High,
}

/// Width and height of the depth image, pixels.
pub const DEPTH_SIZE: (usize, usize) = (640, 480);

impl IrSize {
    /// Width and height, pixels.
    pub fn pixels(self) -> (usize, usize) {
        match self {
            IrSize::Medium => (640, 488),
            IrSize::High => (1280, 1024),
        }
    }

    /// How frames travel.
    pub fn layout(self) -> PacketLayout {
        match self {
            IrSize::Medium => PacketLayout::IR,
            IrSize::High => PacketLayout::IR_HIGH,
        }
    }
}

/// What is known of the speckle projector. No register tells, and what is told of the firmware does not agree.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ProjectorState {
    /// Depth runs, which needs the speckle.
    Lit,
    /// Depth is stopped: the projector may be dark. Only the IR image can say, by the speckle that it shows or does not show.
    Unknown,
}
