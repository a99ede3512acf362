//! `sensor_msgs/CompressedImage` as the plugins of image_transport write it, as far as it is depth or brightness of 16 bits in a PNG.
//!
//! `format` names how pixels are stored and how they are compressed: `16UC1; compressedDepth png`, `mono16; png compressed`. The
//! PNG of `compressedDepth` comes after twelve bytes, of which for `32FC1` the last eight are a and b: a value v stands for the
//! depth a / (v − b), and 0 for none. Not handled: RVL, JPEG, images of 8 bits, a and b in big endian.

use depth_camera::Image;

use super::{Encoding, Header, ImageError, check_size};
use crate::cdr::Decoder;

/// What comes before the PNG of a depth image.
const DEPTH_HEAD_BYTES: usize = 12;

/// An image that is compressed, checked as far as its PNG's own header says what it is.
#[derive(Clone, Debug, PartialEq)]
pub struct CompressedMessage<'a> {
    /// Columns.
    pub width: usize,
    /// Rows.
    pub height: usize,
    /// How pixels are stored once they are decompressed.
    pub encoding: Encoding,
    /// What comes before the PNG.
    head: &'a [u8],
    png: &'a [u8],
}

impl<'a> CompressedMessage<'a> {
    /// Reads and checks a message.
    ///
    /// # Errors
    /// [`ImageError`] with the value and its bound.
    pub fn decode(message: &'a [u8]) -> Result<Self, ImageError> {
        let mut message = Decoder::new(message)?;
        Header::decode(&mut message)?;
        let format = message.string("format")?;
        let data = message.bytes("data")?;
        let (encoding, n_head) =
            understood(format).ok_or_else(|| ImageError::Format(format.to_owned()))?;
        let (head, png) = data.split_at_checked(n_head).unwrap_or((data, &[]));
        let (width, height) = png_size(png)
            .ok_or_else(|| ImageError::Compressed("it holds no PNG image".to_owned()))?;
        check_size(width, height)?;
        Ok(CompressedMessage {
            width: width as usize,
            height: height as usize,
            encoding,
            head,
            png,
        })
    }

    /// The values of a `16UC1` or `mono16` image, or what stands for the depth of a `32FC1` image.
    ///
    /// # Errors
    /// [`ImageError::Compressed`] for a PNG that is damaged, or not grey in 16 bits.
    pub fn values(&self) -> Result<Image<u16>, ImageError> {
        replay::decode_png(self.png).map_err(ImageError::Compressed)
    }

    /// The depth that a value of a `32FC1` image stands for, metres; 0 for none.
    pub fn depth_m(&self, value: u16) -> f32 {
        let [a, b] = [4, 8].map(|at| {
            let bytes = self.head.get(at..).and_then(|rest| rest.first_chunk());
            bytes.map_or(0.0, |bytes| f32::from_le_bytes(*bytes))
        });
        match value {
            0 => 0.0,
            _ => a / (f32::from(value) - b),
        }
    }
}

/// How pixels of a format are stored, and how many bytes come before their PNG; `None` for a format that is not read here.
fn understood(format: &str) -> Option<(Encoding, usize)> {
    let (encoding, how) = format.split_once(';')?;
    let encoding = Encoding::from_name(encoding.trim())?;
    let how: Vec<&str> = how.split_whitespace().collect();
    match (encoding, how.as_slice()) {
        // At first there was nothing but PNG.
        (Encoding::U16 | Encoding::F32, ["compressedDepth"] | ["compressedDepth", "png"]) => {
            Some((encoding, DEPTH_HEAD_BYTES))
        }
        (Encoding::U16 | Encoding::Mono16, ["png", "compressed", ..]) => Some((encoding, 0)),
        _ => None,
    }
}

/// Columns and rows by the header of a PNG.
fn png_size(png: &[u8]) -> Option<(u32, u32)> {
    let chunk = png.strip_prefix(b"\x89PNG\r\n\x1a\n")?.get(4..)?;
    let (width, rest) = chunk.strip_prefix(b"IHDR")?.split_first_chunk()?;
    let height = rest.first_chunk()?;
    Some((u32::from_be_bytes(*width), u32::from_be_bytes(*height)))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::cdr::Encoder;

    #[test]
    fn formats_say_what_is_read() {
        for (format, expected) in [
            ("16UC1; compressedDepth", Some((Encoding::U16, 12))),
            ("16UC1; compressedDepth png", Some((Encoding::U16, 12))),
            ("32FC1;compressedDepth png", Some((Encoding::F32, 12))),
            ("mono16; png compressed ", Some((Encoding::Mono16, 0))),
            ("16UC1; png compressed mono16", Some((Encoding::U16, 0))),
            ("16UC1; compressedDepth rvl", None),
            ("mono16; compressedDepth png", None),
            ("bgr8; jpeg compressed bgr8", None),
            ("mono8; png compressed ", None),
            ("png", None),
        ] {
            assert_eq!(understood(format), expected, "{format}");
        }
    }

    #[test]
    fn a_png_that_promises_too_much_is_refused_before_it_is_decompressed() {
        let message = |format: &str, data: &[u8]| {
            let mut out = Encoder::with_capacity(0);
            out.i32(7);
            out.u32(0);
            out.string("x");
            out.string(format);
            out.u32(data.len() as u32);
            data.iter().for_each(|&byte| out.u8(byte));
            out.finish()
        };
        let large = b"\x89PNG\r\n\x1a\n\0\0\0\x0dIHDR\0\0\x10\x01\x7f\xff\xff\xff";
        let (width, height) = (4097, 0x7fff_ffff);
        assert_eq!(
            CompressedMessage::decode(&message("mono16; png compressed ", large)),
            Err(ImageError::Size { width, height })
        );
        // Too short for what comes before the PNG.
        let short = message("16UC1; compressedDepth png", &large[..11]);
        let error = CompressedMessage::decode(&short).unwrap_err();
        assert_eq!(error.to_string(), "it holds no PNG image");
        // As large as it may be, and nothing behind its header.
        let cut = b"\x89PNG\r\n\x1a\n\0\0\0\x0dIHDR\0\0\x10\0\0\0\x10\0\x10\0\0\0\0";
        let cut = message("mono16; png compressed ", cut);
        let cut = CompressedMessage::decode(&cut).unwrap();
        assert!(matches!(cut.values(), Err(ImageError::Compressed(_))));
    }

    #[test]
    fn a_png_tells_its_size() {
        let png = b"\x89PNG\r\n\x1a\n\0\0\0\x0dIHDR\0\0\x02\0\0\0\x01\xa8\x10";
        assert_eq!(png_size(png), Some((512, 424)));
        assert_eq!(png_size(&png[..23]), None);
        assert_eq!(png_size(b"JPEG"), None);
    }
}
