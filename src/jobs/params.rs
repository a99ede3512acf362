//! What the worker needs to know, and the bounds of it.

use serde::{Deserialize, Serialize};

/// For which turns of the processor the child waits.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Deserialize, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Turns {
    /// For those that nobody else wants: capture never waits for it.
    Idle,
    /// For its share, as of its niceness.
    Shared,
}

/// How refinement is run beside capture.
#[derive(Clone, Debug, PartialEq, Deserialize, Serialize)]
#[serde(default, deny_unknown_fields)]
pub struct WorkerParams {
    /// Turns of the child process at processor and disk.
    pub turns: Turns,
    /// Niceness of the child process; 19 gives it a seventieth of what capture gets on a busy core, 10 a tenth.
    pub nice: i32,
    /// Address space of the child process, MiB; beyond it the attempt fails.
    pub max_memory_mb: u64,
    /// Processor time of one attempt, seconds; beyond it the attempt fails.
    pub max_cpu_secs: u64,
    /// An attempt that does nothing for so long, seconds, has failed.
    pub max_idle_secs: f64,
    /// How often a failed attempt is repeated.
    pub max_retries: u32,
    /// How long a child that was told to end may take before it is killed, seconds.
    pub grace_secs: f64,
}

impl Default for WorkerParams {
    fn default() -> Self {
        WorkerParams {
            turns: Turns::Idle,
            nice: 19,
            max_memory_mb: 8192,
            max_cpu_secs: 14_400,
            max_idle_secs: 120.0,
            max_retries: 3,
            grace_secs: 5.0,
        }
    }
}

impl WorkerParams {
    /// Checks every value against its bound.
    ///
    /// # Errors
    /// Names the key, its value and the bound.
    pub fn validate(&self) -> Result<(), String> {
        for (key, value, low, high) in [
            ("nice", f64::from(self.nice), 0.0, 19.0),
            (
                "max_memory_mb",
                self.max_memory_mb as f64,
                64.0,
                1_048_576.0,
            ),
            ("max_cpu_secs", self.max_cpu_secs as f64, 1.0, 1e6),
            ("max_idle_secs", self.max_idle_secs, 0.1, 86_400.0),
            ("max_retries", f64::from(self.max_retries), 0.0, 3.0),
            ("grace_secs", self.grace_secs, 0.0, 600.0),
        ] {
            if !(value >= low && value <= high) {
                return Err(format!("worker.{key} is {value}, must be {low} to {high}"));
            }
        }
        Ok(())
    }
}
