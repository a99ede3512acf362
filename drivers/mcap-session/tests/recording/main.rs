//! Recordings written, killed, cut, flipped, mended and replayed.
#![allow(clippy::unwrap_used, reason = "a test may fail anywhere")]

mod support;

mod damage;
mod foreign;
mod kill;
mod round_trip;
mod storage;
