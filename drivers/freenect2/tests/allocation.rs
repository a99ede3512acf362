//! The decoder allocates nothing once it is warm.

use std::{
    alloc::{GlobalAlloc, Layout, System},
    sync::atomic::{AtomicUsize, Ordering},
};

use freenect2::{
    Decoded, Decoder, DecoderOptions, IrParameters, P0_RESPONSE_BYTES, P0Tables, PACKET_BYTES,
    RawPacket,
};

/// The system's allocator, counting what is asked of it.
struct Counting;

static N_ALLOCATIONS: AtomicUsize = AtomicUsize::new(0);

// SAFETY: every call is handed on to the system's allocator unchanged.
unsafe impl GlobalAlloc for Counting {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        N_ALLOCATIONS.fetch_add(1, Ordering::Relaxed);
        // SAFETY: the caller keeps to the contract of `alloc`.
        unsafe { System.alloc(layout) }
    }

    unsafe fn dealloc(&self, pointer: *mut u8, layout: Layout) {
        // SAFETY: the caller keeps to the contract of `dealloc`.
        unsafe { System.dealloc(pointer, layout) }
    }
}

#[global_allocator]
static ALLOCATOR: Counting = Counting;

#[test]
fn a_warm_decoder_allocates_nothing() {
    let tables = P0Tables::from_response(&vec![7; P0_RESPONSE_BYTES]).unwrap();
    let camera = IrParameters {
        fx: 365.0,
        fy: 365.0,
        cx: 256.0,
        cy: 212.0,
        k1: 0.0,
        k2: 0.0,
        k3: 0.0,
        p1: 0.0,
        p2: 0.0,
    };
    let options = DecoderOptions::default().with_filters();
    let decoder = Decoder::new(&tables, &camera, options).unwrap();
    let bytes = vec![0x5a; PACKET_BYTES];
    let packet = RawPacket::new(&bytes).unwrap();
    let mut decoded = Decoded::default();
    // The pool's own queues are not counted: the work begins and ends on its one thread.
    let pool = rayon::ThreadPoolBuilder::new().num_threads(1);
    let n_allocations = pool.build().unwrap().install(|| {
        decoder.decode(packet, &mut decoded);
        let before = N_ALLOCATIONS.load(Ordering::Relaxed);
        for _ in 0..50 {
            decoder.decode(packet, &mut decoded);
        }
        N_ALLOCATIONS.load(Ordering::Relaxed) - before
    });
    assert_eq!(n_allocations, 0);
    let empty = N_ALLOCATIONS.load(Ordering::Relaxed);
    drop(Decoded::default());
    assert!(N_ALLOCATIONS.load(Ordering::Relaxed) > empty);
}
