//! 16-bit greyscale PNG, checked against the size that the camera promises.

use std::{
    io::{Cursor, Write},
    path::Path,
};

use depth_camera::Image;
use png::{BitDepth, ColorType, Compression, Decoder, Encoder, EncodingError, Filter};

use crate::files::read_ordinary_file;

/// Reads a 16-bit greyscale PNG of exactly `width` × `height`.
///
/// # Errors
/// Says what was found instead.
pub fn read(path: &Path, width: usize, height: usize) -> Result<Image<u16>, String> {
    read_one_of(path, &[(width, height)])
}

/// Reads a 16-bit greyscale PNG of one of these sizes (columns, rows).
///
/// # Errors
/// Says what was found instead.
pub fn read_one_of(path: &Path, sizes: &[(usize, usize)]) -> Result<Image<u16>, String> {
    let file = read_ordinary_file(path).map_err(|error| error.to_string())?;
    decode_checked(&file, |size| match sizes.contains(&size) {
        true => Ok(()),
        false => Err(format!(
            "{}×{} pixels, expected {}",
            size.0,
            size.1,
            any_of(sizes)
        )),
    })
}

/// Sizes in words: `640×488 or 1280×1024`.
pub fn any_of(sizes: &[(usize, usize)]) -> String {
    let sizes = sizes
        .iter()
        .map(|(width, height)| format!("{width}×{height}"));
    sizes.collect::<Vec<_>>().join(" or ")
}

/// Decodes a 16-bit greyscale PNG of any size.
///
/// # Errors
/// Says what was found instead.
pub fn decode(file: &[u8]) -> Result<Image<u16>, String> {
    decode_checked(file, |_| Ok(()))
}

/// Decodes an image whose size (columns, rows) is `expected`, which is asked before memory is.
fn decode_checked(
    file: &[u8],
    expected: impl FnOnce((usize, usize)) -> Result<(), String>,
) -> Result<Image<u16>, String> {
    let mut reader = Decoder::new(Cursor::new(file))
        .read_info()
        .map_err(|error| format!("not a PNG image: {error}"))?;
    let header = reader.info();
    let (width, height) = (header.width as usize, header.height as usize);
    expected((width, height))?;
    if (header.color_type, header.bit_depth) != (ColorType::Grayscale, BitDepth::Sixteen) {
        return Err(format!(
            "{}-bit {:?}, expected 16-bit Grayscale",
            header.bit_depth as u8, header.color_type
        ));
    }
    let mut bytes = vec![0; 2 * width * height];
    reader
        .next_frame(&mut bytes)
        .map_err(|error| format!("damaged PNG image: {error}"))?;
    let values = bytes.chunks_exact(2);
    let values = values.map(|pair| u16::from_be_bytes([pair[0], pair[1]]));
    Ok(Image::from_vec(width, height, values.collect()))
}

/// How hard an image is compressed.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum PngEffort {
    /// As small as is sensible.
    Archive,
    /// So fast that a live stream waits for it.
    Live,
}

/// Writes an image as a complete PNG file to `out`.
pub(crate) fn write(
    out: impl Write,
    image: &Image<u16>,
    effort: PngEffort,
) -> Result<(), EncodingError> {
    let (width, height) = (image.width() as u32, image.height() as u32);
    let mut encoder = Encoder::new(out, width, height);
    encoder.set_color(ColorType::Grayscale);
    encoder.set_depth(BitDepth::Sixteen);
    match effort {
        PngEffort::Archive => {
            encoder.set_compression(Compression::Balanced);
            encoder.set_filter(Filter::Adaptive);
        }
        PngEffort::Live => {
            encoder.set_compression(Compression::Fastest);
            encoder.set_filter(Filter::Sub);
        }
    }
    let bytes: Vec<u8> = image
        .data()
        .iter()
        .flat_map(|value| value.to_be_bytes())
        .collect();
    let mut writer = encoder.write_header()?;
    writer.write_image_data(&bytes)?;
    writer.finish()
}
