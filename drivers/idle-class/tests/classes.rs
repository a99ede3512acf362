//! That a thread is in the idle class afterwards, as the system says, and those it starts.

#![allow(clippy::unwrap_used, reason = "a test may fail anywhere")]
#![cfg(target_os = "linux")]

use std::{fs, thread};

/// `SCHED_OTHER` and `SCHED_IDLE`, sched(7).
const OTHER: u32 = 0;
const IDLE: u32 = 5;

/// The scheduling policy of the calling thread: the 41st field, proc_pid_stat(5), of which the name is the second.
fn policy() -> u32 {
    let stat = fs::read_to_string("/proc/thread-self/stat").unwrap();
    let after_name = stat.rsplit_once(") ").unwrap().1;
    after_name.split(' ').nth(38).unwrap().parse().unwrap()
}

#[test]
fn a_thread_and_those_it_starts_are_idle_and_the_others_are_not() {
    let started = || thread::scope(|scope| scope.spawn(policy).join().unwrap());
    let policies = thread::scope(|scope| {
        let entering = scope.spawn(|| {
            let before = policy();
            idle_class::enter().unwrap();
            [before, policy(), started()]
        });
        entering.join().unwrap()
    });
    assert_eq!(policies, [OTHER, IDLE, IDLE]);
    assert_eq!(policy(), OTHER);
}
