//! How long stages take. Clocks run here and nowhere in the stages.

use crate::export::StageTiming;
use std::{fs, time::Instant};

/// Times that are kept for the median at most: 32 KiB, however long a scan goes on.
const MAX_KEPT: usize = 4096;

/// Measures one stage.
#[derive(Clone, Debug)]
pub struct StageClock {
    name: &'static str,
    n: u64,
    total_secs: f64,
    /// Of one run in `stride`, evenly spread over all.
    kept_secs: Vec<f64>,
    stride: u64,
}

impl StageClock {
    /// A clock that has measured nothing yet.
    pub fn new(name: &'static str) -> Self {
        StageClock {
            name,
            n: 0,
            total_secs: 0.0,
            kept_secs: Vec::new(),
            stride: 1,
        }
    }

    /// Does some work and measures it.
    pub fn time<T>(&mut self, work: impl FnOnce() -> T) -> T {
        let start = Instant::now();
        let result = work();
        self.note(start.elapsed().as_secs_f64());
        result
    }

    fn note(&mut self, secs: f64) {
        if self.n.is_multiple_of(self.stride) {
            self.kept_secs.push(secs);
        }
        self.n += 1;
        self.total_secs += secs;
        if self.kept_secs.len() > MAX_KEPT {
            let mut index = 0;
            self.kept_secs.retain(|_| {
                index += 1;
                index % 2 == 1
            });
            self.stride *= 2;
        }
    }

    /// What was measured, the median from the runs that are kept; `None` if the stage never ran.
    pub fn timing(&self) -> Option<StageTiming> {
        let mut sorted = self.kept_secs.clone();
        sorted.sort_unstable_by(f64::total_cmp);
        let median_secs = sorted.get(sorted.len() / 2)?;
        Some(StageTiming {
            name: self.name.to_owned(),
            total_secs: self.total_secs,
            n: self.n,
            median_ms: 1e3 * median_secs,
        })
    }
}

/// Largest resident memory of this process so far, bytes; `None` where the system does not tell.
pub fn peak_memory_bytes() -> Option<u64> {
    memory_bytes("VmHWM:")
}

/// Resident memory of this process, bytes; `None` where the system does not tell.
pub fn resident_memory_bytes() -> Option<u64> {
    memory_bytes("VmRSS:")
}

fn memory_bytes(key: &str) -> Option<u64> {
    let status = fs::read_to_string("/proc/self/status").ok()?;
    let line = status.lines().find_map(|line| line.strip_prefix(key))?;
    let kibibytes: u64 = line.trim().strip_suffix("kB")?.trim().parse().ok()?;
    Some(1024 * kibibytes)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_median_is_that_of_the_runs() {
        let mut clock = StageClock::new("stage");
        assert_eq!(clock.timing(), None);
        [0.3, 0.1, 0.2].iter().for_each(|&secs| clock.note(secs));
        let timing = clock.timing().unwrap();
        assert_eq!((timing.n, timing.median_ms), (3, 200.0));
        assert!((timing.total_secs - 0.6).abs() < 1e-12);
    }

    #[test]
    fn memory_stays_bounded_over_hours_and_all_runs_are_counted() {
        let mut clock = StageClock::new("stage");
        let n = 100_000u32;
        for run in 0..n {
            clock.note(f64::from(run));
            assert!(clock.kept_secs.len() <= MAX_KEPT);
        }
        let timing = clock.timing().unwrap();
        let all = f64::from(n);
        assert_eq!(timing.n, u64::from(n));
        assert_eq!(timing.total_secs, 0.5 * all * (all - 1.0));
        let off = timing.median_ms / (1e3 * 0.5 * all) - 1.0;
        assert!(off.abs() < 1e-3, "{off}");
    }
}
