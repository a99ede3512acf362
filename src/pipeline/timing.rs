//! How long stages take. Clocks run here and nowhere in the stages.

use crate::export::StageTiming;
use std::{fs, time::Instant};

/// Measures one stage.
#[derive(Clone, Debug)]
pub struct StageClock {
    name: &'static str,
    runs_secs: Vec<f64>,
}

impl StageClock {
    /// A clock that has measured nothing yet.
    pub fn new(name: &'static str) -> Self {
        StageClock {
            name,
            runs_secs: Vec::new(),
        }
    }

    /// Does some work and measures it.
    pub fn time<T>(&mut self, work: impl FnOnce() -> T) -> T {
        let start = Instant::now();
        let result = work();
        self.runs_secs.push(start.elapsed().as_secs_f64());
        result
    }

    /// What was measured; `None` if the stage never ran.
    pub fn timing(&self) -> Option<StageTiming> {
        let mut sorted = self.runs_secs.clone();
        sorted.sort_unstable_by(f64::total_cmp);
        let median_secs = sorted.get(sorted.len() / 2)?;
        Some(StageTiming {
            name: self.name.to_owned(),
            total_secs: sorted.iter().sum(),
            n: sorted.len() as u64,
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
        clock.runs_secs = vec![0.3, 0.1, 0.2];
        let timing = clock.timing().unwrap();
        assert_eq!((timing.n, timing.median_ms), (3, 200.0));
        assert!((timing.total_secs - 0.6).abs() < 1e-12);
    }
}
