//! Live devices, through the shim over libfreenect2.

mod camera;
mod device_thread;
mod listening;
mod shim;
mod slot;
mod sync;

pub use camera::{Freenect2Camera, LiveOptions};
pub use shim::Library;
pub use slot::PacketCounts;
