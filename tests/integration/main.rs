//! The stages together: recordings through the real pipeline and the real program, and the rules on who may know whom.
#![allow(clippy::unwrap_used, reason = "a test may fail anywhere")]

mod layering;

mod end_to_end;

mod bad_input;
mod bench;
mod calibrate;
mod delivery;
mod live;
mod sessions;
mod signals;

mod support;
