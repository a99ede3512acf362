//! The ROS 2 messages of a recording, field by field as their definitions in [`crate::streams`] give them.

mod compressed;
mod image_error;

use depth_camera::Intrinsics;

use crate::cdr::{CdrError, Decoder, Encoder};
use image_error::check_size;

pub use compressed::CompressedMessage;
pub use image_error::ImageError;

/// A larger image is no depth image: limits what a damaged or hostile file can ask for.
pub const MAX_SIDE_PX: u32 = 4096;

const NANOS_PER_SEC: i64 = 1_000_000_000;

/// A time in whole nanoseconds, as `builtin_interfaces/Time` carries it.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub struct Stamp(pub i64);

impl Stamp {
    /// The nearest nanosecond, or the microsecond that was meant; `None` beyond what 32 bits of seconds hold.
    pub fn from_secs(secs: f64) -> Option<Self> {
        let whole = secs.floor();
        if !(f64::from(i32::MIN)..f64::from(i32::MAX)).contains(&whole) {
            return None;
        }
        // Seconds since 1970 are finer than a microsecond, and coarser than a nanosecond.
        let micros = (secs * 1e6).round();
        if micros / 1e6 == secs {
            return Some(Stamp(1000 * micros as i64));
        }
        let nanos = ((secs - whole) * NANOS_PER_SEC as f64).round() as i64;
        Some(Stamp(whole as i64 * NANOS_PER_SEC + nanos))
    }

    /// Seconds: for a time of at most six decimals (of nine, within 104 days of zero) the number that its text gives.
    pub fn secs(self) -> f64 {
        // Both operands are exact, so that the quotient is the number nearest to the decimal fraction.
        match self.0 % 1000 {
            0 => (self.0 / 1000) as f64 / 1e6,
            _ => self.0 as f64 / 1e9,
        }
    }

    fn encode(self, out: &mut Encoder) {
        out.i32(self.0.div_euclid(NANOS_PER_SEC) as i32);
        out.u32(self.0.rem_euclid(NANOS_PER_SEC) as u32);
    }

    fn decode(message: &mut Decoder) -> Result<Self, CdrError> {
        let secs = message.i32("header.stamp.sec")?;
        let nanos = message.u32("header.stamp.nanosec")?;
        Ok(Stamp(i64::from(secs) * NANOS_PER_SEC + i64::from(nanos)))
    }
}

/// `std_msgs/Header`: when, and in which frame of reference.
#[derive(Clone, Debug, PartialEq)]
pub struct Header {
    /// The device's clock for images of Relief, whatever the node took for others.
    pub stamp: Stamp,
    /// The frame of reference.
    pub frame_id: String,
}

impl Header {
    fn encode(&self, out: &mut Encoder) {
        self.stamp.encode(out);
        out.string(&self.frame_id);
    }

    fn decode(message: &mut Decoder) -> Result<Self, CdrError> {
        Ok(Header {
            stamp: Stamp::decode(message)?,
            frame_id: message.string("header.frame_id")?.to_owned(),
        })
    }
}

/// The stamp of a message that begins with a header.
///
/// # Errors
/// [`CdrError`] for a message too short to hold one.
pub fn stamp_of(message: &[u8]) -> Result<Stamp, CdrError> {
    Stamp::decode(&mut Decoder::new(message)?)
}

/// How the pixels of an image are stored, by their names in ROS.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Encoding {
    /// `16UC1`: 16-bit values, depth by convention.
    U16,
    /// `mono16`: 16-bit brightness.
    Mono16,
    /// `32FC1`: depth in metres.
    F32,
}

impl Encoding {
    const ALL: [Encoding; 3] = [Encoding::U16, Encoding::Mono16, Encoding::F32];

    /// The name in ROS.
    pub fn name(self) -> &'static str {
        match self {
            Encoding::U16 => "16UC1",
            Encoding::Mono16 => "mono16",
            Encoding::F32 => "32FC1",
        }
    }

    /// The encoding of that name, if it is one of those.
    pub fn from_name(name: &str) -> Option<Self> {
        Self::ALL
            .into_iter()
            .find(|encoding| encoding.name() == name)
    }

    fn bytes_per_pixel(self) -> usize {
        match self {
            Encoding::U16 | Encoding::Mono16 => 2,
            Encoding::F32 => 4,
        }
    }
}

/// `sensor_msgs/Image` of one channel, checked: rows and pixels are there.
#[derive(Clone, Debug, PartialEq)]
pub struct ImageMessage<'a> {
    /// When and where.
    pub header: Header,
    /// Columns.
    pub width: usize,
    /// Rows.
    pub height: usize,
    /// How pixels are stored.
    pub encoding: Encoding,
    is_big_endian: bool,
    step: usize,
    data: &'a [u8],
}

impl<'a> ImageMessage<'a> {
    /// Reads and checks a message.
    ///
    /// # Errors
    /// [`ImageError`] with the value and its bound.
    pub fn decode(message: &'a [u8]) -> Result<Self, ImageError> {
        let mut message = Decoder::new(message)?;
        let header = Header::decode(&mut message)?;
        let height = message.u32("height")?;
        let width = message.u32("width")?;
        let encoding = message.string("encoding")?;
        let encoding =
            Encoding::from_name(encoding).ok_or_else(|| ImageError::Encoding(encoding.into()))?;
        let is_big_endian = message.u8("is_bigendian")? != 0;
        let step = message.u32("step")?;
        let data = message.bytes("data")?;
        check_size(width, height)?;
        let pixel = encoding.bytes_per_pixel();
        let row = width as usize * pixel;
        let needed = (height as usize - 1).saturating_mul(step as usize) + row;
        if (step as usize) < row || data.len() < needed {
            return Err(ImageError::Data {
                n_bytes: data.len(),
                step,
                width,
                height,
                pixel,
            });
        }
        Ok(ImageMessage {
            header,
            width: width as usize,
            height: height as usize,
            encoding,
            is_big_endian,
            step: step as usize,
            data,
        })
    }

    /// The pixels of a 16-bit image, row by row; none of another.
    pub fn u16_pixels(&self) -> Vec<u16> {
        match (self.encoding, self.is_big_endian) {
            (Encoding::F32, _) => Vec::new(),
            (Encoding::U16 | Encoding::Mono16, false) => self.pixels(u16::from_le_bytes),
            (Encoding::U16 | Encoding::Mono16, true) => self.pixels(u16::from_be_bytes),
        }
    }

    /// The pixels of a `32FC1` image, row by row; none of another.
    pub fn f32_pixels(&self) -> Vec<f32> {
        match (self.encoding, self.is_big_endian) {
            (Encoding::F32, false) => self.pixels(f32::from_le_bytes),
            (Encoding::F32, true) => self.pixels(f32::from_be_bytes),
            (Encoding::U16 | Encoding::Mono16, _) => Vec::new(),
        }
    }

    fn pixels<T, const N: usize>(&self, of_bytes: impl Fn([u8; N]) -> T) -> Vec<T> {
        let mut pixels = Vec::with_capacity(self.width * self.height);
        for row in self.data.chunks(self.step).take(self.height) {
            let bytes = row[..self.width * N].chunks_exact(N);
            pixels.extend(bytes.map(|b| of_bytes(std::array::from_fn(|index| b[index]))));
        }
        pixels
    }
}

/// A `sensor_msgs/Image` of 16-bit values.
pub fn encode_image(
    header: &Header,
    encoding: Encoding,
    width: usize,
    pixels: impl ExactSizeIterator<Item = u16>,
) -> Vec<u8> {
    let mut out = Encoder::with_capacity(2 * pixels.len() + 128);
    header.encode(&mut out);
    out.u32((pixels.len() / width) as u32);
    out.u32(width as u32);
    out.string(encoding.name());
    out.u8(0);
    out.u32(2 * width as u32);
    out.u16_bytes(pixels);
    out.finish()
}

/// `sensor_msgs/CameraInfo`, without binning and region of interest.
#[derive(Clone, Debug, PartialEq)]
pub struct CameraInfoMessage {
    /// When and where.
    pub header: Header,
    /// Rows.
    pub height: u32,
    /// Columns.
    pub width: u32,
    /// `plumb_bob` is Brown–Conrady with five coefficients.
    pub distortion_model: String,
    /// Coefficients in the model's order: k1 k2 p1 p2 k3.
    pub d: Vec<f64>,
    /// fx 0 cx, 0 fy cy, 0 0 1, of the image as taken.
    pub k: [f64; 9],
    /// The rectifying rotation.
    pub r: [f64; 9],
    /// fx' 0 cx' Tx, 0 fy' cy' Ty, 0 0 1 0, of the rectified image.
    pub p: [f64; 12],
}

/// The model that [`Intrinsics`] hold.
pub const PLUMB_BOB: &str = "plumb_bob";

impl CameraInfoMessage {
    /// The message of a camera.
    pub fn of_intrinsics(header: Header, i: &Intrinsics) -> Self {
        CameraInfoMessage {
            header,
            height: i.height as u32,
            width: i.width as u32,
            distortion_model: PLUMB_BOB.to_owned(),
            d: vec![i.k1, i.k2, i.p1, i.p2, i.k3],
            k: [i.fx, 0.0, i.cx, 0.0, i.fy, i.cy, 0.0, 0.0, 1.0],
            r: [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0],
            p: [
                i.fx, 0.0, i.cx, 0.0, 0.0, i.fy, i.cy, 0.0, 0.0, 0.0, 1.0, 0.0,
            ],
        }
    }

    /// The bytes of the message.
    pub fn encode(&self) -> Vec<u8> {
        let mut out = Encoder::with_capacity(512);
        self.header.encode(&mut out);
        out.u32(self.height);
        out.u32(self.width);
        out.string(&self.distortion_model);
        out.f64_sequence(&self.d);
        out.f64s(&self.k);
        out.f64s(&self.r);
        out.f64s(&self.p);
        // Binning in x and y, then the region of interest: offsets and size, all 0 for the whole image, and no rectification.
        for _ in 0..6 {
            out.u32(0);
        }
        out.u8(0);
        out.finish()
    }

    /// Reads a message.
    ///
    /// # Errors
    /// [`CdrError`] for bytes that are none.
    pub fn decode(message: &[u8]) -> Result<Self, CdrError> {
        let mut message = Decoder::new(message)?;
        Ok(CameraInfoMessage {
            header: Header::decode(&mut message)?,
            height: message.u32("height")?,
            width: message.u32("width")?,
            distortion_model: message.string("distortion_model")?.to_owned(),
            d: message.f64_sequence("d")?,
            k: message.f64s("k")?,
            r: message.f64s("r")?,
            p: message.f64s("p")?,
        })
    }
}

/// `geometry_msgs/PoseStamped`: a pose in the frame that the header names.
#[derive(Clone, Debug, PartialEq)]
pub struct PoseMessage {
    /// When, and in which frame.
    pub header: Header,
    /// Metres.
    pub position_m: [f64; 3],
    /// Unit quaternion x y z w.
    pub orientation: [f64; 4],
}

impl PoseMessage {
    /// The bytes of the message.
    pub fn encode(&self) -> Vec<u8> {
        let mut out = Encoder::with_capacity(96);
        self.header.encode(&mut out);
        out.f64s(&self.position_m);
        out.f64s(&self.orientation);
        out.finish()
    }

    /// Reads a message.
    ///
    /// # Errors
    /// [`CdrError`] for bytes that are none.
    pub fn decode(message: &[u8]) -> Result<Self, CdrError> {
        let mut message = Decoder::new(message)?;
        Ok(PoseMessage {
            header: Header::decode(&mut message)?,
            position_m: message.f64s("pose.position")?,
            orientation: message.f64s("pose.orientation")?,
        })
    }
}

/// The bytes of a `std_msgs/String`.
pub fn encode_string(text: &str) -> Vec<u8> {
    let mut out = Encoder::with_capacity(text.len() + 5);
    out.string(text);
    out.finish()
}

/// The text of a `std_msgs/String`.
///
/// # Errors
/// [`CdrError`] for bytes that are none.
pub fn decode_string(message: &[u8]) -> Result<&str, CdrError> {
    Decoder::new(message)?.string("data")
}

#[cfg(test)]
mod tests;
