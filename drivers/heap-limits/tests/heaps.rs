//! That threads share heaps. In a process of its own: heaps that there are stay.

#![allow(clippy::unwrap_used, reason = "a test may fail anywhere")]
#![cfg(all(target_os = "linux", target_env = "gnu"))]

use std::{fs, hint::black_box, sync::Barrier, thread};

const N_THREADS: usize = 12;

/// Heaps other than the first: glibc reserves 64 MiB of addresses for each, of which next to nothing is in use.
fn n_reserved() -> usize {
    let maps = fs::read_to_string("/proc/self/maps").unwrap();
    let is_reserved = |line: &&str| {
        let mut words = line.split_whitespace();
        let (range, access) = (words.next().unwrap(), words.next().unwrap());
        let (start, end) = range.split_once('-').unwrap();
        let [start, end] = [start, end].map(|hex| u64::from_str_radix(hex, 16).unwrap());
        access == "---p" && (48 << 20..=64 << 20).contains(&(end - start))
    };
    maps.lines().filter(is_reserved).count()
}

#[test]
fn threads_share_as_many_heaps_as_they_may() {
    heap_limits::limit(128 << 10, 1 << 20, 3).unwrap();
    let all_have_one = Barrier::new(N_THREADS);
    thread::scope(|scope| {
        for _ in 0..N_THREADS {
            scope.spawn(|| {
                let piece = black_box(vec![1u8; 1000]);
                all_have_one.wait();
                drop(piece);
            });
        }
    });
    let n = n_reserved();
    assert!((1..=2).contains(&n), "{n} heaps beside the first");
}
