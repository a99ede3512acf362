//! Recordings written, killed, cut, flipped, mended and replayed.
#![allow(clippy::unwrap_used, reason = "a test may fail anywhere")]

mod small_disk;
mod support;

mod damage;
mod flip;
mod foreign;
mod kill;
mod original;
mod round_trip;
mod storage;
