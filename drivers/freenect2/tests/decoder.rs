//! The decoder against packets made by its closed-form inverse.

mod support;

use std::path::{Path, PathBuf};

use depth_camera::DepthCamera;
use freenect2::{DecoderOptions, HEIGHT, WIDTH};
use freenect2_synth::{Encoder, PhaseTables, RayRows, Scene, saturate};
use support::{CAMERA, Figures, Truth, decode, decoder, encoder, plane_and_sphere};

/// What the decoder must hold on noise-free packets, whose errors are those of the 11-bit code: libfreenect2's own depth has
/// 0.53 mm of them in such a scene.
fn assert_good(figures: &Figures) {
    println!("{figures:?}");
    assert!(figures.depth_rms_m <= 0.6e-3, "{figures:?}");
    assert!(figures.depth_p99_m <= 2.5e-3, "{figures:?}");
    assert!(figures.ir_relative_p50 <= 0.0015, "{figures:?}");
    assert!(figures.valid >= 0.995, "{figures:?}");
}

#[test]
fn depth_and_ir_come_back() {
    let truth = plane_and_sphere();
    let packet = encoder().packet(truth.scene());
    let decoded = decode(&decoder(DecoderOptions::default()), &packet);
    assert_good(&Figures::of(&decoded, &truth));
}

#[test]
fn filters_keep_surfaces_and_ir() {
    let truth = plane_and_sphere();
    let packet = encoder().packet(truth.scene());
    let plain = decode(&decoder(DecoderOptions::default()), &packet);
    let filtered = decode(&decoder(DecoderOptions::default().with_filters()), &packet);
    let figures = Figures::of(&filtered, &truth);
    println!("{figures:?}");
    assert!(figures.depth_rms_m < 0.6 * Figures::of(&plain, &truth).depth_rms_m);
    // The rim of the sphere is steeper than the filter believes.
    assert!(figures.valid > 0.99);
    assert_eq!(filtered.ir(), plain.ir());
    assert_eq!(filtered.ambient(), plain.ambient());
}

#[test]
fn recorded_frames_come_back() {
    let bench = std::env::var_os("RELIEF_BENCH").map_or_else(
        || Path::new(env!("CARGO_MANIFEST_DIR")).join("../../../shared/bench"),
        PathBuf::from,
    );
    let session = bench.join("sessions/relief-k2");
    if !session.exists() {
        println!("skipped: {} is not there", session.display());
        return;
    }
    let mut camera = replay::ReplayCamera::open(&session).unwrap();
    for _ in 0..2 {
        let frame = camera.grab(std::time::Duration::ZERO).unwrap().unwrap();
        let truth = Truth {
            depth: frame
                .depth
                .unwrap()
                .data()
                .iter()
                .map(|&z| f64::from(z))
                .collect(),
            ir: frame
                .ir
                .unwrap()
                .data()
                .iter()
                .map(|&counts| f64::from(counts))
                .collect(),
        };
        let packet = encoder().packet(truth.scene());
        let decoded = decode(&decoder(DecoderOptions::default()), &packet);
        assert_good(&Figures::of(&decoded, &truth));
    }
}

#[test]
fn the_legacy_order_is_that_of_the_cpu_decoder() {
    let truth = plane_and_sphere();
    let upside_down = Encoder::new(PhaseTables::varied(), &CAMERA, RayRows::UpsideDown);
    let packet = upside_down.packet(truth.scene());
    let legacy = DecoderOptions {
        legacy_row_order: true,
        ..DecoderOptions::default()
    };
    assert_good(&Figures::of(&decode(&decoder(legacy), &packet), &truth));
    // Read in the other order the same packet is bent by centimetres.
    let wrong = decode(&decoder(DecoderOptions::default()), &packet);
    assert!(Figures::of(&wrong, &truth).depth_rms_m > 0.01);
}

#[test]
fn the_mirror_is_undone_in_every_image() {
    let truth = plane_and_sphere();
    let ambient: Vec<f64> = (0..WIDTH * HEIGHT).map(|i| (i % WIDTH) as f64).collect();
    let scene = Scene {
        ambient: &ambient,
        ..truth.scene()
    };
    let packet = encoder().packet(scene);
    let options = DecoderOptions::default().with_filters();
    let mirrored = decode(&decoder(options), &packet);
    let unmirrored = DecoderOptions {
        unmirrored: true,
        ..options
    };
    let natural = decode(&decoder(unmirrored), &packet);
    for v in 0..HEIGHT {
        for u in 1..WIDTH - 1 {
            let other = WIDTH - 1 - u;
            assert_eq!(mirrored.ir().at(u, v), natural.ir().at(other, v));
            assert_eq!(mirrored.ambient().at(u, v), natural.ambient().at(other, v));
            // Sums over a mirrored neighbourhood are taken in another order.
            let [z, other_z] = [mirrored.depth().at(u, v), natural.depth().at(other, v)];
            assert!((z - other_z).abs() < 1e-5, "{u}, {v}: {z} and {other_z}");
        }
    }
    assert_eq!(mirrored.ambient().at(200, 17), &200);
}

#[test]
fn saturation_costs_depth_and_shows_in_ir() {
    let truth = plane_and_sphere();
    let mut packet = encoder().packet(truth.scene());
    let pixels = [(10, 20), (300, 211), (301, 212), (510, 423)];
    for (sub_image, (u, v)) in [0, 4, 8, 9].into_iter().zip(pixels) {
        saturate(&mut packet, sub_image, u, v);
    }
    let decoded = decode(&decoder(DecoderOptions::default()), &packet);
    for (u, v) in &pixels[..3] {
        assert_eq!(decoded.depth().at(*u, *v), &0.0);
        assert_eq!(decoded.depth_sigma().at(*u, *v), &f32::INFINITY);
        assert_eq!(decoded.ir().at(*u, *v), &u16::MAX);
    }
    assert!(decoded.depth().at(510, 423) > &0.0);
    assert_eq!(decoded.ambient().at(510, 423), &i16::MAX);
}

#[test]
fn the_predicted_deviation_is_that_of_the_errors() {
    let truth = plane_and_sphere();
    let read_noise = 2.0;
    let mut random = fastrand::Rng::with_seed(7);
    // Three uniform numbers have a variance of 1 and are normal enough.
    let mut noise = || read_noise * (0..3).map(|_| 2.0 * random.f64() - 1.0).sum::<f64>();
    let packet = encoder().packet_with_noise(truth.scene(), &mut noise);
    let plain = DecoderOptions {
        read_noise: read_noise as f32,
        min_amplitude: 10.0,
        ..DecoderOptions::default()
    };
    let smoothed = DecoderOptions {
        bilateral: DecoderOptions::default().with_filters().bilateral,
        ..plain
    };
    // The filter's weights are chosen by the noise that they average, which leaves more of it than they tell.
    for (options, bounds) in [(plain, 0.95..1.05), (smoothed, 0.9..1.25)] {
        let decoded = decode(&decoder(options), &packet);
        let (mut sum, mut n) = (0.0, 0);
        for (i, &z) in decoded.depth().data().iter().enumerate() {
            // The filter rounds off the sphere's rim, which is no noise.
            let sigma = f64::from(decoded.depth_sigma().data()[i]);
            if z > 1.3 {
                sum += ((f64::from(z) - truth.depth[i]) / sigma).powi(2);
                n += 1;
            }
        }
        let ratio = (sum / f64::from(n)).sqrt();
        println!("{ratio} over {n} pixels");
        assert!(n > 100_000);
        assert!(bounds.contains(&ratio), "{ratio}");
    }
}

#[test]
fn threads_do_not_change_a_bit() {
    let truth = plane_and_sphere();
    let packet = encoder().packet(truth.scene());
    let decoder = decoder(DecoderOptions::default().with_filters());
    let on = |n_threads| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(n_threads);
        pool.build().unwrap().install(|| decode(&decoder, &packet))
    };
    let (one, three) = (on(1), on(3));
    assert_eq!(one.depth(), three.depth());
    assert_eq!(one.ir(), three.ir());
    assert_eq!(one.depth_sigma(), three.depth_sigma());
}
