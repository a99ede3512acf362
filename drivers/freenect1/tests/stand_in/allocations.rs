//! Once it runs, a frame's way from the library to its reader allocates nothing.

use counting_allocator::{CountingAllocator, n_of_process};
use depth_camera::{DepthCamera, Frame};
use freenect1::{Freenect1Camera, Settings};

use crate::support::{SECOND, on_stand_in};

#[global_allocator]
static ALLOCATOR: CountingAllocator = CountingAllocator;

/// The next frame of which every packet came.
fn next_frame(camera: &mut Freenect1Camera) -> Option<Frame> {
    loop {
        match camera.grab(5 * SECOND) {
            Ok(frame) => return frame,
            Err(error) => assert!(error.is_recoverable(), "{error}"),
        }
    }
}

/// Counts this program's allocations; the library's and the stand-in's are not among them.
#[test]
fn the_steady_state_allocates_nothing() {
    on_stand_in(
        "allocations::the_steady_state_allocates_nothing",
        &[""],
        |_| {
            let mut camera = Freenect1Camera::open(None, Settings::default()).unwrap();
            let mut held = std::collections::VecDeque::with_capacity(8);
            let mut count = |camera: &mut Freenect1Camera, n_frames| {
                let before = n_of_process();
                for _ in 0..n_frames {
                    // As a pipeline does: a few frames are in use at any time.
                    if held.len() == 4 {
                        held.pop_front();
                    }
                    held.push_back(next_frame(camera));
                }
                n_of_process() - before
            };
            let warming_up = count(&mut camera, 30);
            let steady = count(&mut camera, 60);
            let statistics = camera.control().statistics();
            eprintln!(
                "allocations: {warming_up} in 30 frames, then {steady} in 60: {statistics:?}"
            );
            assert!(warming_up > 0, "the counter counts");
            // A reader that was kept from running lets more frames wait than ever before, each in a buffer of its own; a library that
            // was loses packets, which is told of.
            assert!(
                steady <= 2 * statistics.n_overrun + 8 * statistics.depth.n_damaged,
                "{steady} allocations"
            );
        },
    );
}
