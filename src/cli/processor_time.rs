//! Processor time, which other work on the machine disturbs less than wall time.

use rustix::time::{ClockId, clock_gettime};

/// Processor time of this process so far, all threads together, seconds.
pub fn process_cpu_secs() -> f64 {
    let time = clock_gettime(ClockId::ProcessCPUTime);
    time.tv_sec as f64 + 1e-9 * time.tv_nsec as f64
}
