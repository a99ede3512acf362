//! What a recording holds, as one number.

use std::{fs::File, io::Read, path::Path};

use sha2::{Digest, Sha256};

use crate::{
    error::{RecordingError, io_error},
    folder,
};

/// The hash of a recording's MCAP files, `sha256:` and 64 digits: the same for the same files wherever they lie.
///
/// # Errors
/// If there is no file, or one cannot be read.
pub fn content_hash(path: &Path) -> Result<String, RecordingError> {
    let mut hash = Sha256::new();
    let mut buffer = vec![0; 1 << 18];
    for path in folder::files(path)? {
        let mut file = File::open(&path).map_err(io_error(&path))?;
        let n_bytes = file.metadata().map_err(io_error(&path))?.len();
        // Lengths keep the end of one file from being taken for the start of the next.
        hash.update(n_bytes.to_le_bytes());
        loop {
            match file.read(&mut buffer).map_err(io_error(&path))? {
                0 => break,
                n => hash.update(&buffer[..n]),
            }
        }
    }
    let digits: String = hash
        .finalize()
        .iter()
        .map(|byte| format!("{byte:02x}"))
        .collect();
    Ok(format!("sha256:{digits}"))
}
