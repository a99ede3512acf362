//! Work for which processors and disks have time that nobody else wants.
//!
//! Niceness is a share of the processor: a thread of another process that wakes up may have to wait for the turn of a nice one to
//! end. A thread of the idle class yields at once to any thread that is not of that class, and gets less than a nice one where
//! all processors are busy: sched(7), ioprio_set(2).

use std::io;

/// Puts the calling thread, and those it starts from now on, into the idle classes of processor and disk. There is no way back
/// for a process without privileges.
///
/// # Errors
/// If the system refuses, or knows no such class.
pub fn enter() -> io::Result<()> {
    system::yield_processor()?;
    system::yield_disk()
}

#[cfg(target_os = "linux")]
mod system {
    use std::io;

    /// The number of a thread or process by which the caller means itself.
    const ITSELF: libc::pid_t = 0;
    /// Of `ioprio_set`, which the C library does not declare: one thread is meant, and its class is the idle one.
    const IOPRIO_WHO_PROCESS: libc::c_int = 1;
    const IOPRIO_CLASS_IDLE: libc::c_int = 3 << 13;

    pub fn yield_processor() -> io::Result<()> {
        let no_priority = libc::sched_param { sched_priority: 0 };
        // SAFETY: the parameter is alive, and read only.
        let code = unsafe { libc::sched_setscheduler(ITSELF, libc::SCHED_IDLE, &no_priority) };
        checked(code.into())
    }

    pub fn yield_disk() -> io::Result<()> {
        // SAFETY: this call takes three numbers and touches no memory.
        let code = unsafe {
            libc::syscall(
                libc::SYS_ioprio_set,
                IOPRIO_WHO_PROCESS,
                ITSELF,
                IOPRIO_CLASS_IDLE,
            )
        };
        checked(code)
    }

    fn checked(code: libc::c_long) -> io::Result<()> {
        match code {
            -1 => Err(io::Error::last_os_error()),
            _ => Ok(()),
        }
    }
}

#[cfg(not(target_os = "linux"))]
mod system {
    use std::io;

    pub fn yield_processor() -> io::Result<()> {
        Err(io::ErrorKind::Unsupported.into())
    }

    pub fn yield_disk() -> io::Result<()> {
        Err(io::ErrorKind::Unsupported.into())
    }
}
