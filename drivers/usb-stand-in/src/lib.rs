//! A `libusb-1.0.so.0` of the tests: loaded in front of the unmodified libfreenect, it lets the whole live path of a Kinect I run
//! without a device: enumeration, serial numbers, control transfers, isochronous streams, lost packets, unplugging.
//!
//! The environment variable `USB_STAND_IN` names a folder; each folder in it is one Kinect, in order of their names, described
//! by files (see [`scenario`]). What is set up before goes into `device.txt`, `depth11.u16` and `ir10.u16`; what happens meanwhile
//! is a file that appears or vanishes, such as `unplugged`. What the library did is written to `trace.txt`.
//!
//! It tells a driver what the driver expects, and so cannot reveal a wrong belief about real firmware; nor does it know limits
//! of the kernel or of the bus. Its isochronous transfers are as the kernel's in one respect that matters: packets that
//! find no transfer waiting are lost.

mod abi;
mod bus;
mod calls;
mod kinect;
pub mod scenario;
mod stream;
mod wire;
