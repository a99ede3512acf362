//! How frames travel: values packed most significant bit first, cut into packets with a header of twelve bytes.

/// Bytes of a packet's header.
pub(crate) const HEADER_BYTES: usize = 12;

/// Values of `bits` bits each, most significant first, without gaps.
pub(crate) fn pack(values: &[u16], bits: u32, packed: &mut Vec<u8>) {
    packed.clear();
    let mut held = 0_u32;
    let mut n_held = 0;
    for &value in values {
        held = held << bits | u32::from(value) & ((1 << bits) - 1);
        n_held += bits;
        while n_held >= 8 {
            n_held -= 8;
            packed.push((held >> n_held) as u8);
        }
    }
    if n_held > 0 {
        packed.push((held << (8 - n_held)) as u8);
    }
}

/// Where in its frame a packet is, as its header says.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Position {
    First,
    Middle,
    Last,
}

/// A packet's header; `stream` is 0x70 for depth and 0x80 for video.
pub(crate) fn header(
    stream: u8,
    position: Position,
    sequence: u8,
    bytes: usize,
    ticks: u32,
) -> [u8; HEADER_BYTES] {
    let flag = match position {
        Position::First => 1,
        Position::Middle => 2,
        Position::Last => 5,
    };
    let length = ((bytes + HEADER_BYTES) as u16).to_be_bytes();
    let t = ticks.to_le_bytes();
    [
        b'R',
        b'B',
        0,
        stream | flag,
        0,
        sequence,
        length[0],
        length[1],
        t[0],
        t[1],
        t[2],
        t[3],
    ]
}

#[cfg(test)]
mod tests {
    use super::*;

    fn unpack(packed: &[u8], bits: usize, n_values: usize) -> Vec<u16> {
        let bit = |i: usize| u16::from(packed[i / 8] >> (7 - i % 8) & 1);
        let value = |v: usize| (0..bits).fold(0, |acc, b| acc << 1 | bit(v * bits + b));
        (0..n_values).map(value).collect()
    }

    #[test]
    fn values_are_packed_bit_by_bit() {
        for bits in [10_usize, 11] {
            let values: Vec<u16> = (0..37).map(|i| (i * 677) % (1 << bits)).collect();
            let mut packed = Vec::new();
            pack(&values, bits as u32, &mut packed);
            assert_eq!(packed.len(), (37 * bits).div_ceil(8));
            assert_eq!(unpack(&packed, bits, 37), values);
        }
    }

    #[test]
    fn a_header_tells_stream_and_position() {
        let header = header(0x70, Position::Last, 9, 1132, 0x0403_0201);
        assert_eq!(header[..4], [b'R', b'B', 0, 0x75]);
        assert_eq!(header[5], 9);
        assert_eq!(header[8..], [1, 2, 3, 4]);
    }
}
