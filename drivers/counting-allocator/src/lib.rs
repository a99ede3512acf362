//! Of the tests: the system's allocator, counting what is asked of it.
//!
//! A test program takes it for its own with `#[global_allocator]`; what libraries of other languages ask for is not among its
//! counts.

use std::{
    alloc::{GlobalAlloc, Layout, System},
    cell::Cell,
    sync::atomic::{AtomicU64, Ordering},
};

static OF_PROCESS: AtomicU64 = AtomicU64::new(0);

thread_local! {
    static OF_THREAD: Cell<u64> = const { Cell::new(0) };
}

/// The allocator.
#[derive(Clone, Copy, Debug)]
pub struct CountingAllocator;

// SAFETY: every call is handed on to the system's allocator unchanged; counting asks for no memory.
unsafe impl GlobalAlloc for CountingAllocator {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        OF_PROCESS.fetch_add(1, Ordering::Relaxed);
        OF_THREAD.with(|count| count.set(count.get() + 1));
        // SAFETY: the caller keeps to the contract of `alloc`.
        unsafe { System.alloc(layout) }
    }

    unsafe fn dealloc(&self, pointer: *mut u8, layout: Layout) {
        // SAFETY: the caller keeps to the contract of `dealloc`.
        unsafe { System.dealloc(pointer, layout) }
    }
}

/// How often the process has asked for memory.
pub fn n_of_process() -> u64 {
    OF_PROCESS.load(Ordering::Relaxed)
}

/// How often this thread has.
pub fn n_of_thread() -> u64 {
    OF_THREAD.with(Cell::get)
}
