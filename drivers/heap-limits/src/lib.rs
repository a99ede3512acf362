//! What the system's allocator keeps of the memory that a program lets go.
//!
//! The allocator of glibc serves large pieces straight from the system, to which they then go back, but takes pieces of up to
//! 32 MiB into its heaps as soon as the first such one has been let go. It has a heap for every thread or so: a program in
//! whose threads pieces of very different sizes come and go for hours keeps much more than it uses, and ever more. With fixed
//! limits it does not; in exchange the system hands out large pieces anew each time.

use std::io;

/// From now on pieces of at least `large_bytes` are never kept once they are let go, and a heap keeps `spare_bytes` beyond what is
/// in use at most. Nothing is done where the allocator is another one.
///
/// # Errors
/// If the allocator refuses a limit, naming it: it counts to 2 GiB.
pub fn limit(large_bytes: usize, spare_bytes: usize) -> io::Result<()> {
    system::limit(large_bytes, spare_bytes)
}

#[cfg(all(target_os = "linux", target_env = "gnu"))]
mod system {
    use std::io;

    pub fn limit(large_bytes: usize, spare_bytes: usize) -> io::Result<()> {
        set("M_MMAP_THRESHOLD", libc::M_MMAP_THRESHOLD, large_bytes)?;
        set("M_TRIM_THRESHOLD", libc::M_TRIM_THRESHOLD, spare_bytes)
    }

    fn set(name: &str, parameter: libc::c_int, bytes: usize) -> io::Result<()> {
        let refused = || {
            io::Error::new(
                io::ErrorKind::InvalidInput,
                format!("the allocator does not take {bytes} as {name}"),
            )
        };
        let value = libc::c_int::try_from(bytes).map_err(|_| refused())?;
        // SAFETY: `mallopt` takes two numbers, refuses those that make no sense, and may be called at any time by any thread.
        match unsafe { libc::mallopt(parameter, value) } {
            1 => Ok(()),
            _ => Err(refused()),
        }
    }
}

#[cfg(not(all(target_os = "linux", target_env = "gnu")))]
mod system {
    use std::io;

    pub fn limit(_large_bytes: usize, _spare_bytes: usize) -> io::Result<()> {
        Ok(())
    }
}
