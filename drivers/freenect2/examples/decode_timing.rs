//! How long a packet takes: `cargo run --release -p freenect2 --example decode_timing`.
//!
//! Prints the median over 200 packets for each number of threads, without filters, with each and with both.

use std::time::Instant;

use freenect2::{
    Decoded, Decoder, DecoderError, DecoderOptions, HEIGHT, IrParameters, P0Tables, PACKET_BYTES,
    RawPacket, WIDTH,
};
use freenect2_synth::{Camera, Encoder, PhaseTables, RayRows, Scene};

const N_PACKETS: usize = 200;

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let tables = PhaseTables::varied();
    let packet = wall(&tables);
    let tables = P0Tables::from_response(&tables.response())?;
    let both = DecoderOptions::default().with_filters();
    let rows = [
        ("no filter", DecoderOptions::default()),
        (
            "bilateral",
            DecoderOptions {
                edge_aware: None,
                ..both
            },
        ),
        (
            "edge-aware",
            DecoderOptions {
                bilateral: None,
                ..both
            },
        ),
        ("both", both),
    ];
    for n_threads in [1, 2] {
        let pool = rayon::ThreadPoolBuilder::new()
            .num_threads(n_threads)
            .build()?;
        for (name, options) in rows {
            let median_ms = pool.install(|| median_ms(&tables, options, &packet))?;
            println!("{n_threads} threads, {name}: {median_ms:.2} ms");
        }
    }
    Ok(())
}

fn median_ms(
    tables: &P0Tables,
    options: DecoderOptions,
    packet: &[u8],
) -> Result<f64, DecoderError> {
    let camera = IrParameters {
        fx: 365.4,
        fy: 365.4,
        cx: 258.3,
        cy: 204.9,
        k1: 0.09,
        k2: -0.27,
        k3: 0.096,
        p1: 0.0,
        p2: 0.0,
    };
    let decoder = Decoder::new(tables, &camera, options)?;
    let mut decoded = Decoded::default();
    let mut times: Vec<f64> = (0..N_PACKETS)
        .map(|_| {
            let start = Instant::now();
            let packet: &[u8; PACKET_BYTES] =
                packet.try_into().expect("the encoder makes whole packets");
            decoder.decode(RawPacket::from(packet), &mut decoded);
            start.elapsed().as_secs_f64() * 1e3
        })
        .collect();
    times.sort_by(f64::total_cmp);
    Ok(times[N_PACKETS / 2])
}

/// A wavy wall at about 1.2 m.
fn wall(tables: &PhaseTables) -> Vec<u8> {
    let camera = Camera {
        focal: [365.4, 365.4],
        centre: [258.3, 204.9],
        radial: [0.09, -0.27, 0.096],
        tangential: [0.0, 0.0],
    };
    let wave = |i: usize| ((i % WIDTH) as f64 * 0.05).sin() + ((i / WIDTH) as f64 * 0.07).cos();
    let depth: Vec<f64> = (0..WIDTH * HEIGHT).map(|i| 1.2 + 0.1 * wave(i)).collect();
    let ir: Vec<f64> = (0..WIDTH * HEIGHT)
        .map(|i| 6000.0 + 1500.0 * wave(i))
        .collect();
    let scene = Scene {
        depth: &depth,
        ir: &ir,
        ambient: &[],
    };
    Encoder::new(tables.clone(), &camera, RayRows::Own).packet(scene)
}
