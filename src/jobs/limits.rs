//! What the child process imposes on itself before it begins.
//!
//! The daemon could do so between fork and exec, but only by unsafe code; a flag says it as well.

use super::{WorkerParams, params::Turns};
use rustix::process::{self, Pid, Resource, Rlimit, Signal};
use std::{fs, io};

/// At the lower limit of processor time the system sends SIGXCPU, which says what was used up; so much later, at the upper, SIGKILL.
const CPU_GRACE_SECS: u64 = 5;
/// The most that a process can be worse than others when the system chooses which to kill, proc(5).
const OOM_FIRST: &str = "1000";

/// Priority and limits of a process. `None` leaves what it has.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Limits {
    /// Whether it takes the turns of processor and disk that nobody else wants.
    pub idle: bool,
    /// Niceness to add, which the system also derives the priority at the disk from.
    pub nice: Option<i32>,
    /// Address space, MiB.
    pub max_memory_mb: Option<u64>,
    /// Processor time, seconds.
    pub max_cpu_secs: Option<u64>,
    /// The process must not outlive this one, its parent, and is to be killed before it where memory runs out.
    pub parent: Option<u32>,
}

impl Limits {
    /// The limits of a child of this process.
    pub fn of_child(params: &WorkerParams) -> Self {
        Limits {
            idle: params.turns == Turns::Idle,
            nice: Some(params.nice),
            max_memory_mb: Some(params.max_memory_mb),
            max_cpu_secs: Some(params.max_cpu_secs),
            parent: Some(std::process::id()),
        }
    }

    /// As arguments of `relief refine`.
    pub fn arguments(&self) -> Vec<String> {
        let flag =
            |name: &str, value: Option<String>| value.map(|value| format!("--{name}={value}"));
        [
            self.idle.then(|| "--idle".to_owned()),
            flag("nice", self.nice.map(|nice| nice.to_string())),
            flag("max-memory-mb", self.max_memory_mb.map(|mb| mb.to_string())),
            flag(
                "max-cpu-secs",
                self.max_cpu_secs.map(|secs| secs.to_string()),
            ),
            flag("parent", self.parent.map(|pid| pid.to_string())),
        ]
        .into_iter()
        .flatten()
        .collect()
    }

    /// Imposes them on this process; to be called before it starts a thread, which would keep its own priority.
    ///
    /// # Errors
    /// If the system refuses, or the parent is gone.
    pub fn impose(&self) -> io::Result<()> {
        if let Some(parent) = self.parent {
            die_with(parent)?;
            die_first();
        }
        // Where the system knows no such class its niceness is left.
        if self.idle
            && let Err(error) = idle_class::enter()
        {
            tracing::warn!(%error, "not in the idle class");
        }
        if let Some(nice) = self.nice {
            process::nice(nice)?;
        }
        if let Some(mb) = self.max_memory_mb {
            let bytes = mb.saturating_mul(1 << 20);
            limit(Resource::As, bytes, bytes)?;
        }
        if let Some(secs) = self.max_cpu_secs {
            limit(Resource::Cpu, secs, secs.saturating_add(CPU_GRACE_SECS))?;
        }
        Ok(())
    }
}

fn die_with(parent: u32) -> io::Result<()> {
    process::set_parent_process_death_signal(Some(Signal::KILL))?;
    // It may have ended before the line above.
    let present = process::getppid().map(Pid::as_raw_pid);
    match present.and_then(|pid| u32::try_from(pid).ok()) == Some(parent) {
        true => Ok(()),
        false => Err(io::Error::other(
            "the process that started this one is gone",
        )),
    }
}

/// Where memory runs out the system is to take this process, which can be repeated, and not the scan. A system that knows no such
/// wish chooses by itself.
fn die_first() {
    if let Err(error) = fs::write("/proc/self/oom_score_adj", OOM_FIRST) {
        tracing::warn!(%error, "not the first to be killed where memory runs out");
    }
}

fn limit(resource: Resource, current: u64, maximum: u64) -> io::Result<()> {
    let limit = Rlimit {
        current: Some(current),
        maximum: Some(maximum),
    };
    Ok(process::setrlimit(resource, limit)?)
}
