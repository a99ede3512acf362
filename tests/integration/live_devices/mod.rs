//! Live devices: the program and the pipeline on the unmodified libfreenect, with a stand-in for libusb beneath it.

mod daemon;
mod recording;
mod scan;
mod several;
mod shading;
mod snapshots;
mod stand_in;
