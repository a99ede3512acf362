//! PNG in memory, encoded for speed: pictures leave while the operator waits.

use depth_camera::Image;
use png::{BitDepth, ColorType, Compression, Encoder};
use std::io;

/// Encodes an sRGB picture.
///
/// # Errors
/// If the image has no pixels.
pub fn encode_png_rgb(image: &Image<[u8; 3]>) -> io::Result<Vec<u8>> {
    let bytes = image.data().as_flattened();
    encode(
        image.width(),
        image.height(),
        (ColorType::Rgb, BitDepth::Eight),
        bytes,
    )
}

/// Encodes an sRGB picture with opacity (255 is opaque).
///
/// # Errors
/// If the image has no pixels.
pub fn encode_png_rgba(image: &Image<[u8; 4]>) -> io::Result<Vec<u8>> {
    let bytes = image.data().as_flattened();
    let format = (ColorType::Rgba, BitDepth::Eight);
    encode(image.width(), image.height(), format, bytes)
}

/// Encodes an 8-bit grey image.
///
/// # Errors
/// If the image has no pixels.
pub fn encode_png_grey8(image: &Image<u8>) -> io::Result<Vec<u8>> {
    let format = (ColorType::Grayscale, BitDepth::Eight);
    encode(image.width(), image.height(), format, image.data())
}

/// Encodes a 16-bit grey image, such as raw IR counts, without loss.
///
/// # Errors
/// If the image has no pixels.
pub fn encode_png_grey16(image: &Image<u16>) -> io::Result<Vec<u8>> {
    let format = (ColorType::Grayscale, BitDepth::Sixteen);
    let bytes: Vec<u8> = image.data().iter().flat_map(|x| x.to_be_bytes()).collect();
    encode(image.width(), image.height(), format, &bytes)
}

fn encode(
    width: usize,
    height: usize,
    (color, depth): (ColorType, BitDepth),
    bytes: &[u8],
) -> io::Result<Vec<u8>> {
    let side = |n: usize| u32::try_from(n).map_err(io::Error::other);
    let mut file = Vec::new();
    let mut encoder = Encoder::new(&mut file, side(width)?, side(height)?);
    encoder.set_color(color);
    encoder.set_depth(depth);
    encoder.set_compression(Compression::Fast);
    encoder.write_header()?.write_image_data(bytes)?;
    Ok(file)
}

#[cfg(test)]
mod tests {
    use super::*;
    use replay::decode_png;
    use std::io::Cursor;

    fn decode(file: Vec<u8>) -> (ColorType, BitDepth, Vec<u8>) {
        let mut reader = png::Decoder::new(Cursor::new(file)).read_info().unwrap();
        let mut bytes = vec![0; reader.output_buffer_size().unwrap()];
        let info = reader.next_frame(&mut bytes).unwrap();
        (info.color_type, info.bit_depth, bytes)
    }

    #[test]
    fn pixels_survive_in_all_formats() {
        let grey16 = Image::from_vec(3, 2, vec![0u16, 1, 256, 4095, 65534, 65535]);
        let file = encode_png_grey16(&grey16).unwrap();
        assert_eq!(decode_png(&file).unwrap(), grey16);
        let refused = decode_png(&file[..file.len() / 2]).unwrap_err();
        assert!(refused.contains("PNG image"), "{refused}");

        let grey8 = Image::from_vec(2, 2, vec![0u8, 7, 128, 255]);
        let file = encode_png_grey8(&grey8).unwrap();
        assert!(decode_png(&file).unwrap_err().starts_with("8-bit"));
        assert_eq!(decode(file).2, grey8.data());
        let rgb = Image::from_vec(1, 2, vec![[1u8, 2, 3], [250, 251, 252]]);
        assert_eq!(
            decode(encode_png_rgb(&rgb).unwrap()).2,
            [1, 2, 3, 250, 251, 252]
        );
        let rgba = Image::from_vec(1, 2, vec![[1u8, 2, 3, 0], [4, 5, 6, 255]]);
        assert_eq!(
            decode(encode_png_rgba(&rgba).unwrap()).2,
            [1, 2, 3, 0, 4, 5, 6, 255]
        );
        assert!(encode_png_grey8(&Image::from_vec(0, 0, vec![])).is_err());
    }
}
