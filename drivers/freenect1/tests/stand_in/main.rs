//! The camera on the unmodified libfreenect, with a stand-in for libusb beneath it (`drivers/usb-stand-in`).
//!
//! Every test runs itself again in a process of its own, into which the stand-in is loaded in libusb's place.

#![allow(
    clippy::unwrap_used,
    reason = "helpers of tests are outside of test functions"
)]

mod allocations;
mod commands;
mod devices;
mod faults;
mod hot_plug;
mod memcheck;
mod scene;
mod streaming;
mod support;
#[path = "../../../udev-monitor/tests/testbed/mod.rs"]
mod testbed;
mod unplugging;
