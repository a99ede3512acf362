//! Packets and phase tables of a Kinect II with any bytes, of any length: nothing breaks, and depth is in its range or none.
#![no_main]

use std::sync::OnceLock;

use freenect2::{
    Decoded, Decoder, DecoderOptions, IrParameters, P0_RESPONSE_BYTES, P0Tables, PACKET_BYTES,
    RawPacket,
};
use libfuzzer_sys::fuzz_target;

const CAMERA: IrParameters = IrParameters {
    fx: 365.4,
    fy: 365.4,
    cx: 258.3,
    cy: 204.9,
    k1: 0.092,
    k2: -0.271,
    k3: 0.096,
    p1: 0.001,
    p2: -0.0007,
};

/// Decoders that differ in their options and their tables.
fn decoders() -> &'static [Decoder; 4] {
    static DECODERS: OnceLock<[Decoder; 4]> = OnceLock::new();
    DECODERS.get_or_init(|| {
        let tables = |step: usize| {
            let response: Vec<u8> = (0..P0_RESPONSE_BYTES).map(|i| (i * step >> 5) as u8).collect();
            P0Tables::from_response(&response).expect("the answer is whole")
        };
        let plain = DecoderOptions::default();
        let legacy = DecoderOptions {
            legacy_row_order: true,
            unmirrored: true,
            ..plain
        };
        [
            (0, plain),
            (7, plain.with_filters()),
            (13, legacy),
            (1, legacy.with_filters()),
        ]
        .map(|(step, options)| {
            Decoder::new(&tables(step), &CAMERA, options).expect("camera and options are good")
        })
    })
}

fuzz_target!(|bytes: &[u8]| {
    assert_eq!(RawPacket::new(bytes).is_ok(), bytes.len() == PACKET_BYTES);
    assert_eq!(P0Tables::from_response(bytes).is_ok(), bytes.len() == P0_RESPONSE_BYTES);
    let Some((first, pattern)) = bytes.split_first().filter(|(_, pattern)| !pattern.is_empty())
    else {
        return;
    };
    // The pattern all over a packet: of eleven bytes, it gives every pixel the same codes.
    let packet: Vec<u8> = pattern.iter().copied().cycle().take(PACKET_BYTES).collect();
    let packet = RawPacket::new(&packet).expect("it is whole");
    let mut decoded = Decoded::default();
    decoders()[usize::from(first % 4)].decode(packet, &mut decoded);
    let options = DecoderOptions::default();
    let range = options.near_m..=options.far_m;
    let sigma = decoded.depth_sigma().data();
    for (z, sigma) in decoded.depth().data().iter().zip(sigma) {
        assert!(*z == 0.0 || range.contains(z), "{z} m");
        assert!((*sigma > 0.0 && sigma.is_finite()) == (*z > 0.0), "{sigma} at {z}");
    }
});
