//! The raw packet: ten sub-images of 11-bit codes, and where in it a pixel lies.
//!
//! A *sub-image* is one exposure: 0 to 2 at the first modulation frequency, 3 to 5 at the second, 6 to 8 at the third, each
//! at three phases of the reference a third of a period apart; 9 is said to be exposed without the emitters. Its rows are of
//! 704 bytes; the lower half of the image comes bottom up and last. Within a row, pixel x has slot x/4 + 128 (x mod 4), and
//! slot i the 11 bits from bit 11 i on, lowest bit first.

use crate::{HEIGHT, WIDTH};

/// Sub-images of a packet.
pub const N_SUB_IMAGES: usize = 10;
/// Bytes of one row of a sub-image.
pub const ROW_BYTES: usize = WIDTH * 11 / 8;
/// Bytes of one sub-image.
pub const SUB_IMAGE_BYTES: usize = HEIGHT * ROW_BYTES;
/// Bytes of a whole packet.
pub const PACKET_BYTES: usize = N_SUB_IMAGES * SUB_IMAGE_BYTES;
/// Pixels whose codes lie side by side; the pixels between them follow in three more such runs.
const RUN: usize = WIDTH / 4;
/// Eight codes fill eleven bytes.
const GROUP: usize = 8;
const GROUP_BYTES: usize = 11;

/// The code of a pixel that was flooded with light.
pub(crate) const SATURATED_CODE: u16 = 1024;

/// A packet of the wrong size, which was cut off or is none.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[error("raw packet has {length} bytes, must have {PACKET_BYTES}")]
pub struct PacketLengthError {
    /// Bytes that were there.
    pub length: usize,
}

/// The bytes of one whole raw packet; any content is a packet.
#[derive(Clone, Copy, Debug)]
pub struct RawPacket<'a>(&'a [u8]);

impl<'a> From<&'a [u8; PACKET_BYTES]> for RawPacket<'a> {
    fn from(bytes: &'a [u8; PACKET_BYTES]) -> Self {
        RawPacket(bytes)
    }
}

impl<'a> RawPacket<'a> {
    /// Takes bytes for a packet.
    ///
    /// # Errors
    /// [`PacketLengthError`] if there are not [`PACKET_BYTES`] of them.
    pub fn new(bytes: &'a [u8]) -> Result<Self, PacketLengthError> {
        match bytes.len() {
            PACKET_BYTES => Ok(RawPacket(bytes)),
            length => Err(PacketLengthError { length }),
        }
    }

    /// The packet's bytes, [`PACKET_BYTES`] of them.
    pub fn bytes(self) -> &'a [u8] {
        self.0
    }

    /// The bytes of row `v` of the image, from the top, in one sub-image.
    pub(crate) fn row(self, sub_image: usize, v: usize) -> &'a [u8] {
        let stored_row = if v < HEIGHT / 2 {
            v
        } else {
            HEIGHT / 2 + HEIGHT - 1 - v
        };
        let start = sub_image * SUB_IMAGE_BYTES + stored_row * ROW_BYTES;
        &self.0[start..start + ROW_BYTES]
    }
}

/// The codes of a row of [`ROW_BYTES`], in the order of its pixels.
#[inline(always)]
pub(crate) fn unpack_row(bytes: &[u8], codes: &mut [u16; WIDTH]) {
    for (phase, run) in bytes.chunks_exact(RUN * 11 / 8).enumerate() {
        let pixels = codes.chunks_exact_mut(4 * GROUP);
        let (groups, _) = run.as_chunks::<GROUP_BYTES>();
        for (group, pixels) in groups.iter().zip(pixels) {
            // Two overlapping words: codes 0 to 4 lie in the first, 5 to 7 in the second, which starts 24 bits later.
            let [b0, b1, b2, b3, b4, b5, b6, b7, b8, b9, b10] = *group;
            let first = u64::from_le_bytes([b0, b1, b2, b3, b4, b5, b6, b7]);
            let second = u64::from_le_bytes([b3, b4, b5, b6, b7, b8, b9, b10]);
            for i in 0..5 {
                pixels[4 * i + phase] = (first >> (11 * i)) as u16 & 0x7ff;
            }
            for i in 5..GROUP {
                pixels[4 * i + phase] = (second >> (11 * i - 24)) as u16 & 0x7ff;
            }
        }
    }
}

/// The linear value of a code, counts: bit 10 is the sign, bits 7 to 9 an exponent, the rest the mantissa. The steps are
/// 1 up to 256, then double with every 128 codes; the largest value is 16 320. [`SATURATED_CODE`] has none, it gives 0.
#[inline(always)]
pub(crate) fn linear(code: u16) -> f32 {
    let code = u32::from(code);
    let exponent = (code >> 7) & 7;
    let mantissa = code & 127;
    let magnitude = if exponent == 0 {
        mantissa
    } else {
        (mantissa + 128) << (exponent - 1)
    };
    let value = magnitude as f32;
    if code & 1024 == 0 { value } else { -value }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_whole_packets_are_packets() {
        let bytes = vec![0; PACKET_BYTES];
        assert!(RawPacket::new(&bytes).is_ok());
        let error = RawPacket::new(&bytes[1..]).unwrap_err();
        assert_eq!(
            error.to_string(),
            "raw packet has 2984959 bytes, must have 2984960"
        );
    }

    #[test]
    fn every_code_is_found_in_its_slot() {
        // Bit by bit, as the format is defined.
        let mut bytes = [0u8; ROW_BYTES];
        let code_of = |x: usize| ((x * 37 + 5) % 2048) as u16;
        for x in 0..WIDTH {
            let slot = (x >> 2) + ((x & 3) << 7);
            for bit in 0..11 {
                let place = 11 * slot + bit;
                bytes[place / 8] |= ((code_of(x) >> bit & 1) as u8) << (place % 8);
            }
        }
        let mut codes = [0; WIDTH];
        unpack_row(&bytes, &mut codes);
        for (x, &code) in codes.iter().enumerate() {
            assert_eq!(code, code_of(x), "pixel {x}");
        }
    }

    #[test]
    fn codes_grow_by_doubling_steps() {
        let mut value = 0.0;
        for code in 0..1024u16 {
            assert_eq!(linear(code), value, "code {code}");
            assert_eq!(linear(code + 1024), -value, "code {}", code + 1024);
            value += [1.0, 1.0, 2.0, 4.0, 8.0, 16.0, 32.0, 64.0][usize::from(code) / 128];
        }
        assert_eq!(linear(1023), 16_320.0);
    }

    #[test]
    fn rows_of_the_lower_half_come_bottom_up() {
        let bytes: Vec<u8> = (0..PACKET_BYTES)
            .map(|i| (i / ROW_BYTES % 256) as u8)
            .collect();
        let packet = RawPacket::new(&bytes).unwrap();
        for (sub_image, v, stored) in [(0, 0, 0), (0, 211, 211), (0, 212, 423), (3, 423, 212)] {
            let expected = ((sub_image * HEIGHT + stored) % 256) as u8;
            assert_eq!(packet.row(sub_image, v)[0], expected, "row {v}");
        }
    }
}
