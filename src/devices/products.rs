//! The product ids of the parts of a Kinect.

use depth_camera::Sensor;
use serde::Serialize;
use std::fmt;

/// Microsoft, as a USB vendor.
pub(crate) const VENDOR: u16 = 0x045e;

/// `bcdDevice` of the camera of the first Kinect I; later models report others.
const RELEASE_OF_1414: u16 = 0x010b;

/// The models that differ to a driver.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
pub enum Model {
    /// Kinect for Xbox 360, model 1414: its camera has a serial number.
    #[serde(rename = "1414")]
    Xbox1414,
    /// Kinect for Xbox 360, model 1473: the serial number is that of its audio part.
    #[serde(rename = "1473")]
    Xbox1473,
    /// Kinect for Windows, model 1517: likewise, with product ids of its own.
    #[serde(rename = "1517")]
    Windows1517,
    /// Kinect II: preview, and much of what was sold.
    #[serde(rename = "02c4")]
    Kinect2Early,
    /// Kinect II as sold later.
    #[serde(rename = "02d8")]
    Kinect2Retail,
}

impl Model {
    /// Which sensor it is.
    pub fn sensor(self) -> Sensor {
        match self {
            Model::Xbox1414 | Model::Xbox1473 | Model::Windows1517 => Sensor::Kinect1,
            Model::Kinect2Early | Model::Kinect2Retail => Sensor::Kinect2,
        }
    }

    /// Whether its serial number is that of its camera.
    pub(crate) fn has_own_serial(self) -> bool {
        matches!(
            self,
            Model::Xbox1414 | Model::Kinect2Early | Model::Kinect2Retail
        )
    }

    /// USB memory that the driver's library keeps in flight, bytes.
    ///
    /// libfreenect: 16 transfers of 16 packets of each stream, 1760 and 1920 bytes. libfreenect2: 60 transfers of 8 packets
    /// of 33 792 bytes.
    pub(crate) fn bytes_in_flight(self) -> u64 {
        match self.sensor() {
            Sensor::Kinect1 => 16 * 16 * (1760 + 1920),
            Sensor::Kinect2 => 60 * 8 * 33_792,
        }
    }
}

impl fmt::Display for Model {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Model::Xbox1414 => "Kinect for Xbox 360, 1414",
            Model::Xbox1473 => "Kinect for Xbox 360, 1473",
            Model::Windows1517 => "Kinect for Windows, 1517",
            Model::Kinect2Early => "Kinect II, 02c4",
            Model::Kinect2Retail => "Kinect II, 02d8",
        })
    }
}

/// What a USB device is to a Kinect.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Part {
    /// The camera, or the whole sensor of a Kinect II.
    Camera(Model),
    /// The microphones of a Kinect I, in one of their states.
    Audio,
    /// The motor of a Kinect I; in Kinect for Windows it is on the hub.
    Motor,
    /// The hub in the adaptor of a Kinect II.
    Adaptor,
}

impl Part {
    /// The part that a product id of Microsoft's stands for, with its `bcdDevice`.
    pub(crate) fn of_product(product: u16, release: u16) -> Option<Self> {
        Some(match product {
            0x02ae if release == RELEASE_OF_1414 => Part::Camera(Model::Xbox1414),
            0x02ae => Part::Camera(Model::Xbox1473),
            0x02bf => Part::Camera(Model::Windows1517),
            0x02c4 => Part::Camera(Model::Kinect2Early),
            0x02d8 => Part::Camera(Model::Kinect2Retail),
            0x02ad | 0x02be | 0x02bb | 0x02c3 => Part::Audio,
            0x02b0 | 0x02c2 => Part::Motor,
            0x02d9 => Part::Adaptor,
            _ => return None,
        })
    }
}
