//! The Kinect I as a [`depth_camera::DepthCamera`], through libfreenect.
//!
//! The library wants one thread for all its calls, hides lost packets, waits without limit for a device that does not answer, and
//! crashes if a device is closed while both of its streams run. So one named thread owns its context and makes every
//! call; commands reach it by channel and frames leave it by channel; every packet is counted; what the thread is inside
//! of can be seen from outside; and streams are stopped in one order, always.
//!
//! What needs neither library nor device is in modules of its own and builds without the feature `kinect1`: [`disparity`],
//! [`packets`], [`pairing`], [`clock`] and [`assembly`], which puts them together, and recordings of disparity
//! ([`RawDisparityWriter`], [`RawDisparityCamera`]). The camera itself, `Freenect1Camera`, is there with the feature. Not handled: colour, sound, the motor (it is never moved) and near mode.

pub mod assembly;
pub mod clock;
pub mod disparity;
mod frames;
pub mod packets;
pub mod pairing;
mod recording;
mod reduction;
mod settings;
pub mod streams;
pub mod supervision;

#[cfg(feature = "kinect1")]
mod announcements;
#[cfg(feature = "kinect1")]
mod callbacks;
#[cfg(feature = "kinect1")]
mod camera;
#[cfg(feature = "kinect1")]
mod context;
#[cfg(feature = "kinect1")]
mod control;
#[cfg(feature = "kinect1")]
mod device;
#[cfg(feature = "kinect1")]
mod device_thread;
#[cfg(feature = "kinect1")]
mod exchange;

#[cfg(feature = "kinect1")]
pub use camera::{Freenect1Camera, attached};
#[cfg(feature = "kinect1")]
pub use control::Control;
pub use frames::{DeviceRecord, NOMINAL_IR_OFFSET_PX};
pub use recording::{RAW_DEVICE_FILE, RawDisparityCamera, RawDisparityWriter, content_hash};
pub use settings::Settings;
