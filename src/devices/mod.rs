//! Live devices: what is plugged in, whether it can be used, and opening it by its serial number.
//!
//! A *Kinect* is several USB devices to the system: camera, motor and audio of a Kinect I, sensor and hub of a Kinect II. What
//! is plugged in is read from `/sys` alone ([`list`]): no library, no permission and no device is touched for it.
//! [`doctor`] looks for what keeps a Kinect from working. [`open`] is where the driver crates come in; each is
//! there with its feature, `kinect1` or `kinect2`.

pub mod doctor;
mod kinects;
mod machine;
mod open;
mod params;
mod products;
mod record;
mod recording;
mod usb;

pub use kinects::{Kinect, Obstacle, list};
pub use machine::Machine;
pub use open::{LiveCamera, OpenError, connect, open};
pub use params::{DeviceParams, Kinect1Params, Kinect2Params};
pub use products::{Model, Part};
pub use record::{RawRecording, RecordedCamera};
pub use recording::{Recording, content_hash, open_recording};
pub use usb::{Controller, UsbDevice};
