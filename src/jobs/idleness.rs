//! Tells a child that hangs, without using the processor, from one that works, or would if it had a turn.

use std::{
    fs,
    time::{Duration, Instant},
};

/// Who uses less of a processor than this has come to a stand, if it does not wait for its turn. A process of niceness 19 gets
/// ten times as much beside a busy one; a timer that ticks five times a second, as that of a refinement's progress, takes less.
const MIN_SHARE: f64 = 0.001;

/// Watches the processor time of one process.
#[derive(Debug)]
pub struct Idleness {
    pid: u32,
    max_idle: Duration,
    /// When its processor time was read last, and what it was.
    since: Instant,
    used: Duration,
}

impl Idleness {
    /// Watches a process that may do nothing for `max_idle`.
    pub fn new(pid: u32, max_idle: Duration) -> Self {
        Idleness {
            pid,
            max_idle,
            since: Instant::now(),
            used: Duration::ZERO,
        }
    }

    /// Whether the process has done nothing for so long. One that the system tells nothing of counts as busy.
    pub fn is_over(&mut self) -> bool {
        let elapsed = self.since.elapsed();
        if elapsed < self.max_idle {
            return false;
        }
        let Some(used) = processor_time(self.pid) else {
            return false;
        };
        let share = used.saturating_sub(self.used).as_secs_f64() / elapsed.as_secs_f64();
        (self.since, self.used) = (Instant::now(), used);
        share < MIN_SHARE && !waits_for_its_turn(self.pid)
    }
}

/// Processor time of a process and of those of its children that have ended; `None` if it cannot be read.
fn processor_time(pid: u32) -> Option<Duration> {
    let stat = fs::read_to_string(format!("/proc/{pid}/stat")).ok()?;
    Some(Duration::from_secs_f64(
        ticks(&stat)? as f64 / rustix::param::clock_ticks_per_second() as f64,
    ))
}

/// Whether a thread of the process wants a turn at the processor or the disk, as one of the idle class may for long.
fn waits_for_its_turn(pid: u32) -> bool {
    let Ok(threads) = fs::read_dir(format!("/proc/{pid}/task")) else {
        return false;
    };
    threads
        .flatten()
        .filter_map(|thread| fs::read_to_string(thread.path().join("stat")).ok())
        .any(|stat| wants_a_turn(&stat))
}

/// Whether the state, proc_pid_stat(5), is one of waiting for processor or disk.
fn wants_a_turn(stat: &str) -> bool {
    let after_name = stat.rsplit_once(") ");
    after_name.is_some_and(|(_, state)| state.starts_with(['R', 'D']))
}

/// The sum of `utime`, `stime`, `cutime` and `cstime`, proc_pid_stat(5); the name before them may hold anything.
fn ticks(stat: &str) -> Option<u64> {
    let (_, after_name) = stat.rsplit_once(") ")?;
    let fields = after_name.split(' ').skip(11).take(4);
    let ticks: Vec<u64> = fields
        .map(|field| field.parse().ok())
        .collect::<Option<_>>()?;
    (ticks.len() == 4).then(|| ticks.iter().sum())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ticks_are_found_whatever_the_name() {
        let stat =
            "7 (a) b (c) S 1 7 7 0 -1 4194304 100 0 0 0 11 22 33 44 20 0 1 0 5 6 7 8 9 10 11";
        assert_eq!(ticks(stat), Some(110));
        assert_eq!(ticks("7 (a) S 1 7 7 0 -1 4194304 100 0 0 0 11 22"), None);
        assert_eq!(ticks(""), None);
    }

    #[test]
    fn who_sleeps_wants_no_turn() {
        assert!(wants_a_turn("7 (a) S) R 1 7 7 0"));
        assert!(wants_a_turn("7 (a) D 1 7 7 0"));
        assert!(!wants_a_turn("7 (R) S 1 7 7 0"));
        assert!(waits_for_its_turn(std::process::id()), "who asks runs");
        assert!(!waits_for_its_turn(u32::MAX));
    }

    #[test]
    fn who_works_is_not_idle_and_who_is_gone_is_not_judged() {
        let mut own = Idleness::new(std::process::id(), Duration::ZERO);
        let start = processor_time(own.pid).unwrap();
        while processor_time(own.pid).unwrap() < start + Duration::from_millis(100) {
            std::hint::spin_loop();
        }
        own.used = start;
        own.since = Instant::now() - Duration::from_secs(1);
        assert!(!own.is_over());
        // No process has this number.
        assert!(!Idleness::new(u32::MAX, Duration::ZERO).is_over());
    }
}
