//! Kinect II: its raw packets, decoded, recorded and replayed.
//!
//! A Kinect II sends *raw packets*: ten exposures of a time-of-flight sensor, see [`RawPacket`]. [`Decoder`] turns one into
//! depth, IR, the depth's standard deviation and the ambient light, with the device's [`P0Tables`] and [`IrParameters`].
//!
//! [`RawPacketWriter`] records packets, [`RawPacketCamera`] plays such a recording through the decoder.
//! [`Freenect2Camera`] is a live device, reached through a [`Library`]: libfreenect2 itself with the feature `kinect2`.
//!
//! The ranging is that of the sensor's own processing as libfreenect2 has laid it open: three phase measurements, unwrapped
//! together. Images come *mirrored*, left and right exchanged, as libfreenect2 and the sensor's own SDK deliver them, unless
//! [`DecoderOptions::unmirrored`] is set. Not handled: a normalisation of IR by emitter lobe and lens, several surfaces in one
//! pixel, and motion between the exposures.

mod decoder;
mod live;
mod recording;

mod frames;
mod ir_parameters;
mod options;
mod p0_tables;
mod packet;

mod arctangent;
mod bilateral;
mod edges;
mod phasors;
mod unwrap;

pub use decoder::{Decoded, Decoder, DecoderError};
pub use ir_parameters::{IrParameterError, IrParameters};
pub use live::{Freenect2Camera, Library, LiveOptions, PacketCounts};
pub use options::{BilateralOptions, DecoderOptions, EdgeAwareOptions, OptionError};
pub use p0_tables::{P0_RESPONSE_BYTES, P0LengthError, P0Tables};
pub use packet::{
    N_SUB_IMAGES, PACKET_BYTES, PacketLengthError, ROW_BYTES, RawPacket, SUB_IMAGE_BYTES,
};
pub use recording::{
    DeviceRecord, RAW_DEVICE_FILE, RawPacketCamera, RawPacketWriter, content_hash,
};

/// Columns of every image.
pub const WIDTH: usize = 512;
/// Rows of every image.
pub const HEIGHT: usize = 424;
