//! That memory which is let go goes back. In a process of its own: limits hold for the whole process.

#![allow(clippy::unwrap_used, reason = "a test may fail anywhere")]
#![cfg(all(target_os = "linux", target_env = "gnu"))]

use std::{fs, hint::black_box};

const MIB: usize = 1 << 20;
const N_PIECES: usize = 64;

/// Resident memory of this process, bytes.
fn resident_bytes() -> usize {
    let status = fs::read_to_string("/proc/self/status").unwrap();
    let line = status.lines().find_map(|line| line.strip_prefix("VmRSS:"));
    let kibibytes = line.unwrap().trim().strip_suffix("kB").unwrap();
    1024 * kibibytes.trim().parse::<usize>().unwrap()
}

/// How much less memory is resident once large pieces, with small ones between them that stay, are let go.
fn given_back() -> usize {
    // With this one let go the allocator would take pieces like it into its heap.
    drop(black_box(vec![1u8; 2 * MIB]));
    let pairs = (0..N_PIECES).map(|_| (vec![1u8; MIB], vec![1u8; 64]));
    let (large, small): (Vec<_>, Vec<_>) = black_box(pairs.unzip());
    let before = resident_bytes();
    drop(large);
    let after = resident_bytes();
    drop(black_box(small));
    before.saturating_sub(after)
}

#[test]
fn what_is_let_go_goes_back_once_there_are_limits() {
    let kept = N_PIECES * MIB - given_back();
    assert!(kept > N_PIECES * MIB / 2, "without limits: {kept} bytes");
    let error = heap_limits::limit(4096 * MIB, MIB).unwrap_err();
    assert!(error.to_string().contains("4294967296 as M_MMAP_THRESHOLD"));
    heap_limits::limit(MIB / 8, MIB).unwrap();
    let back = given_back();
    assert!(back > N_PIECES * MIB * 9 / 10, "{back} bytes");
}
