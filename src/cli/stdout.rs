//! Standard output, behind which may be a full disk, or a reader that has gone.

use std::io::{self, ErrorKind, Write};

/// Standard output. What nobody reads any more, as behind `head`, is dropped; what cannot be written is an error that says so.
pub struct Stdout;

impl Write for Stdout {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        printed(io::stdout().write(bytes), bytes.len())
    }

    fn flush(&mut self) -> io::Result<()> {
        printed(io::stdout().flush(), ())
    }
}

fn printed<T>(result: io::Result<T>, all: T) -> io::Result<T> {
    match result {
        Err(error) if error.kind() == ErrorKind::BrokenPipe => Ok(all),
        result => {
            result.map_err(|error| io::Error::new(error.kind(), format!("cannot print: {error}")))
        }
    }
}
