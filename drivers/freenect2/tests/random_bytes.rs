//! No bytes break the decoder: random packets, tables, cameras and options.
//!
//! There are `RELIEF_FUZZ_CASES` of them, 64 by default; a failure names its seed.

mod support;

use freenect2::{
    BilateralOptions, Decoder, DecoderOptions, EdgeAwareOptions, IrParameters, P0_RESPONSE_BYTES,
    P0Tables, PACKET_BYTES,
};
use support::{decode, parameters};

#[test]
fn no_bytes_break_the_decoder() {
    let n_cases = std::env::var("RELIEF_FUZZ_CASES").map_or(64_u64, |n| n.parse().unwrap());
    let n_depths: usize = (0..n_cases).map(decode_random).sum();
    assert!(n_depths > 0);
}

/// Decodes one random packet and checks what comes out; gives the number of pixels with depth.
fn decode_random(seed: u64) -> usize {
    let mut random = fastrand::Rng::with_seed(seed);
    let response = random_bytes(&mut random, P0_RESPONSE_BYTES);
    let tables = P0Tables::from_response(&response).expect("the answer is whole");
    let camera = random_camera(&mut random);
    let options = random_options(&mut random);
    if options.validate().is_err() || camera.validate().is_err() {
        assert!(Decoder::new(&tables, &camera, options).is_err());
        return 0;
    }
    let decoder = Decoder::new(&tables, &camera, options).expect("both are valid");
    let decoded = decode(&decoder, &random_bytes(&mut random, PACKET_BYTES));
    let depths = decoded.depth().data();
    for (&z, &sigma) in depths.iter().zip(decoded.depth_sigma().data()) {
        let range = options.near_m..=options.far_m;
        assert!(z == 0.0 || range.contains(&z), "seed {seed}: depth {z}");
        let there = sigma > 0.0 && sigma.is_finite();
        assert!(
            there == (z > 0.0) && !sigma.is_nan(),
            "seed {seed}: {sigma} at {z}"
        );
    }
    depths.iter().filter(|&&z| z > 0.0).count()
}

/// Noise, one byte all over, or a short pattern that repeats: a pattern of eleven bytes has every code in every pixel.
fn random_bytes(random: &mut fastrand::Rng, n: usize) -> Vec<u8> {
    let period = [1, 11, 88, 704, n][random.usize(..5)];
    let pattern: Vec<u8> = (0..period).map(|_| random.u8(..)).collect();
    pattern.iter().copied().cycle().take(n).collect()
}

/// A camera like a real one, of which one number may be anything.
fn random_camera(random: &mut fastrand::Rng) -> IrParameters {
    let mut camera = parameters();
    let anything = f64::from_bits(random.u64(..));
    let large = 10.0 * random.f64() - 5.0;
    let value = [anything, large][random.usize(..2)];
    let fields = [
        &mut camera.fx,
        &mut camera.cy,
        &mut camera.k1,
        &mut camera.k2,
        &mut camera.k3,
        &mut camera.p1,
        &mut camera.p2,
    ];
    if let Some(field) = fields.into_iter().nth(random.usize(..14)) {
        *field = value;
    }
    camera
}

/// Any mix of filters and flags, of which one number may be anything.
fn random_options(random: &mut fastrand::Rng) -> DecoderOptions {
    let mut options = DecoderOptions {
        legacy_row_order: random.bool(),
        unmirrored: random.bool(),
        bilateral: random.bool().then(BilateralOptions::default),
        edge_aware: random.bool().then(EdgeAwareOptions::default),
        ..DecoderOptions::default()
    };
    let value = f32::from_bits(random.u32(..));
    let fields = [
        &mut options.far_m,
        &mut options.min_amplitude,
        &mut options.read_noise,
        &mut options.depth_offset_m,
    ];
    if let Some(field) = fields.into_iter().nth(random.usize(..12)) {
        *field = value;
    }
    options
}
