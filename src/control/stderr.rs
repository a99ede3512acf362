//! Standard error, behind which may be a full disk, a terminal that was closed, or a reader that has gone.

use std::{
    fmt,
    io::{self, Write},
};

/// Standard error. What cannot be written is dropped: there is nobody left to tell, and no scan ends for it.
#[derive(Clone, Copy, Debug)]
pub struct Stderr;

impl Write for Stderr {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        Ok(io::stderr().write(bytes).unwrap_or(bytes.len()))
    }

    /// As one piece, so that lines of several threads do not mix.
    fn write_fmt(&mut self, line: fmt::Arguments<'_>) -> io::Result<()> {
        let _ = io::stderr().write_fmt(line);
        Ok(())
    }

    fn flush(&mut self) -> io::Result<()> {
        let _ = io::stderr().flush();
        Ok(())
    }
}
