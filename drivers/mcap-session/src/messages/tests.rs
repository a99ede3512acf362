//! Messages there and back, and what is refused.

use super::*;
use proptest::prelude::*;

fn header() -> impl Strategy<Value = Header> {
    (any::<i32>(), 0..NANOS_PER_SEC, "[a-z_/]{0,20}").prop_map(|(secs, nanos, frame_id)| Header {
        stamp: Stamp(i64::from(secs) * NANOS_PER_SEC + nanos),
        frame_id,
    })
}

fn numbers<const N: usize>() -> impl Strategy<Value = [f64; N]> {
    prop::array::uniform::<_, N>(-1e6..1e6)
}

proptest! {
    #[test]
    fn images_come_back(header in header(), width in 1usize..40, height in 1usize..30, seed in any::<u16>()) {
        let pixels: Vec<u16> = (0..width * height).map(|k| (k as u16).wrapping_mul(seed)).collect();
        let message = encode_image(&header, Encoding::Mono16, width, pixels.iter().copied());
        let image = ImageMessage::decode(&message).unwrap();
        prop_assert_eq!((image.width, image.height, image.encoding), (width, height, Encoding::Mono16));
        prop_assert_eq!(image.u16_pixels(), pixels);
        prop_assert_eq!(stamp_of(&message).unwrap(), header.stamp);
        prop_assert_eq!(image.header, header);
    }

    #[test]
    fn camera_infos_come_back(header in header(), size in (1u32..5000, 1u32..5000), d in prop::collection::vec(-1.0..1.0, 0..9), k in numbers(), r in numbers(), p in numbers()) {
        let info = CameraInfoMessage { header, height: size.0, width: size.1, distortion_model: PLUMB_BOB.into(), d, k, r, p };
        prop_assert_eq!(CameraInfoMessage::decode(&info.encode()).unwrap(), info);
    }

    #[test]
    fn poses_and_strings_come_back(header in header(), position_m in numbers(), orientation in numbers(), text in "[^\0]{0,80}") {
        let pose = PoseMessage { header, position_m, orientation };
        prop_assert_eq!(PoseMessage::decode(&pose.encode()).unwrap(), pose);
        let message = encode_string(&text);
        prop_assert_eq!(decode_string(&message).unwrap(), text);
    }

    #[test]
    fn times_of_six_decimals_come_back_to_the_bit(micros in -2_000_000_000_000_000i64..2_000_000_000_000_000) {
        let secs: f64 = format!("{}{}.{:06}", if micros < 0 { "-" } else { "" }, micros.abs() / 1_000_000, micros.abs() % 1_000_000).parse().unwrap();
        prop_assert_eq!(Stamp::from_secs(secs).unwrap().secs().to_bits(), secs.to_bits());
    }

    #[test]
    fn any_bytes_are_an_image_or_an_error(bytes in prop::collection::vec(any::<u8>(), 0..200)) {
        let mut message = vec![0, 1, 0, 0];
        message.extend(bytes);
        if let Ok(image) = ImageMessage::decode(&message) {
            prop_assert!(image.width * image.height <= 200);
        }
    }
}

/// A `32FC1` image whose rows are `step` bytes long.
fn float_image(width: u32, height: u32, step: u32, data: &[u8]) -> Vec<u8> {
    packed_image(("32FC1", 0), (width, height), step, data)
}

/// An image of an encoding, with `is_bigendian`, whose rows are `step` bytes long.
fn packed_image(
    (encoding, is_bigendian): (&str, u8),
    (width, height): (u32, u32),
    step: u32,
    data: &[u8],
) -> Vec<u8> {
    let mut out = Encoder::with_capacity(0);
    out.i32(7);
    out.u32(500_000_000);
    out.string("x");
    out.u32(height);
    out.u32(width);
    out.string(encoding);
    out.u8(is_bigendian);
    out.u32(step);
    out.u32(data.len() as u32);
    for &byte in data {
        out.u8(byte);
    }
    out.finish()
}

#[test]
fn rows_may_be_longer_than_their_pixels() {
    let rows = [1.0f32, 2.0, 99.0, 3.0, 4.0];
    let data: Vec<u8> = rows.iter().flat_map(|x| x.to_le_bytes()).collect();
    let message = float_image(2, 2, 12, &data);
    let image = ImageMessage::decode(&message).unwrap();
    assert_eq!(image.f32_pixels(), [1.0, 2.0, 3.0, 4.0]);
    assert_eq!(image.header.stamp.secs(), 7.5);
    assert!(image.u16_pixels().is_empty());
}

#[test]
fn big_endian_pixels_are_read() {
    let metres = [1.5f32, -2.0].map(f32::to_be_bytes).concat();
    let message = packed_image(("32FC1", 1), (2, 1), 8, &metres);
    let image = ImageMessage::decode(&message).unwrap();
    assert_eq!(image.f32_pixels(), [1.5, -2.0]);
    // The second row behind two bytes of nothing.
    let message = packed_image(("mono16", 1), (1, 2), 4, &[1, 2, 9, 9, 3, 4]);
    let image = ImageMessage::decode(&message).unwrap();
    assert_eq!(image.u16_pixels(), [0x0102, 0x0304]);
}

#[test]
fn sizes_that_lie_are_refused() {
    for (message, expected) in [
        (
            float_image(5000, 1, 20_000, &[]),
            "5000×1 pixels, must be 1 to 4096 each",
        ),
        (
            float_image(0, 4, 0, &[]),
            "0×4 pixels, must be 1 to 4096 each",
        ),
        (
            float_image(2, 2, 4, &[0; 32]),
            "32 bytes in rows of 4, too few for 2×2 pixels of 4 bytes",
        ),
        (
            float_image(2, 4096, u32::MAX, &[0; 32]),
            "32 bytes in rows of 4294967295, too few for 2×4096 pixels of 4 bytes",
        ),
    ] {
        let error = ImageMessage::decode(&message).unwrap_err();
        assert_eq!(error.to_string(), expected);
    }
}

#[test]
fn times_beyond_the_format_are_refused() {
    assert_eq!(Stamp::from_secs(3e9), None);
    assert_eq!(Stamp::from_secs(f64::NAN), None);
    assert_eq!(Stamp::from_secs(-0.25), Some(Stamp(-250_000_000)));
}
