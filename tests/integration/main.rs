//! The stages together: recordings through the real pipeline and the real program, and the rules on who may know whom.
#![allow(clippy::unwrap_used, reason = "a test may fail anywhere")]

mod layering;

mod end_to_end;

mod bad_input;
mod bench;
mod calibrate;
mod commands;
mod delivery;
mod devices;
mod live;
#[cfg(feature = "kinect1")]
mod live_devices;
mod raw_kinect1;
mod raw_packets;
mod raw_recordings;
mod service;
mod sessions;
mod signals;
mod worker;

mod daemon;
mod daemon_disk;
mod daemon_limits;
mod daemon_refined;
mod daemon_tls;

mod daemon_process;
mod http_client;
#[path = "../../drivers/mcap-session/tests/recording/small_disk.rs"]
mod small_disk;
mod support;
