//! Once it runs, nothing asks for memory: neither the decoder nor a packet's way from the library to the frame.

mod support;

use std::{collections::VecDeque, time::Duration};

use counting_allocator::{CountingAllocator, n_of_process, n_of_thread};
use depth_camera::{DepthCamera, Frame};
use freenect2::{
    Decoded, Decoder, DecoderOptions, Freenect2Camera, LiveOptions, P0_RESPONSE_BYTES, P0Tables,
    PACKET_BYTES, RawPacket,
};
use freenect2_stand_in::{Packet, Unit};
use support::{answers, encoder, parameters, plane_and_sphere};

#[global_allocator]
static ALLOCATOR: CountingAllocator = CountingAllocator;

#[test]
fn a_warm_decoder_allocates_nothing() {
    let tables = P0Tables::from_response(&vec![7; P0_RESPONSE_BYTES]).unwrap();
    let options = DecoderOptions::default().with_filters();
    let decoder = Decoder::new(&tables, &parameters(), options).unwrap();
    let bytes = vec![0x5a; PACKET_BYTES];
    let packet = RawPacket::new(&bytes).unwrap();
    let mut decoded = Decoded::default();
    // The pool's own queues are not counted: the work begins and ends on its one thread.
    let pool = rayon::ThreadPoolBuilder::new().num_threads(1);
    let (n_cold, n_warm) = pool.build().unwrap().install(|| {
        let start = n_of_thread();
        decoder.decode(packet, &mut decoded);
        let warm = n_of_thread();
        for _ in 0..50 {
            decoder.decode(packet, &mut decoded);
        }
        (warm - start, n_of_thread() - warm)
    });
    assert!(n_cold > 0, "the counter counts");
    assert_eq!(n_warm, 0);
}

/// The other test's few requests may fall in between; a frame that asked for its images' memory would ask a hundred times.
#[test]
fn a_packet_on_its_way_to_a_frame_allocates_nothing() {
    const N_FRAMES: u32 = 60;
    let unit = Unit::plug("allocation", answers());
    let options = LiveOptions {
        serial: Some("allocation".to_owned()),
        max_silence: Duration::from_secs(60),
        first_packet_timeout: Duration::from_secs(60),
        ..LiveOptions::default()
    };
    let mut camera = Freenect2Camera::open(freenect2_stand_in::library(), options).unwrap();
    let truth = plane_and_sphere();
    let bytes = encoder().packet(truth.scene());
    let mut held: VecDeque<Frame> = VecDeque::with_capacity(8);
    let mut first = None;
    let mut sequence = 0;
    let mut count = |n_frames| {
        let before = n_of_process();
        for _ in 0..n_frames {
            sequence += 1;
            assert!(unit.send(Packet {
                bytes: &bytes,
                timestamp: 266 * sequence,
                sequence,
                status: 0,
            }));
            // As a pipeline does: a few frames are in use at any time.
            if held.len() == 4 {
                held.pop_front();
            }
            held.push_back(camera.grab(Duration::from_secs(10)).unwrap().unwrap());
        }
        let n_allocations = n_of_process() - before;
        let newest = held.back().unwrap();
        let first = first.get_or_insert_with(|| newest.clone());
        // Whatever a buffer held before.
        assert!(newest.depth == first.depth && newest.ir == first.ir);
        n_allocations
    };
    let warming_up = count(30);
    let steady = count(N_FRAMES);
    eprintln!("allocations: {warming_up} in 30 frames, then {steady} in {N_FRAMES}");
    assert!(warming_up > 8, "the counter counts");
    // The queue of the decoder's threads asks for a block of memory now and then.
    assert!(steady <= u64::from(N_FRAMES) / 8, "{steady}");
}
