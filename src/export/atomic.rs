//! Whole files, with the errors of this module.

use super::ExportError;
use crate::atomic_file;
use std::{
    fs::File,
    io::{self, BufWriter},
    path::Path,
};

/// [`atomic_file::write_atomically`] of an output.
///
/// # Errors
/// [`ExportError::Write`], which names the path.
pub fn write_atomically(
    path: &Path,
    write: impl FnOnce(&mut BufWriter<File>) -> io::Result<()>,
) -> Result<(), ExportError> {
    atomic_file::write_atomically(path, write).map_err(|cause| ExportError::write(path, cause))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_error_names_the_file() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("mesh.ply");
        let full = |_: &mut BufWriter<File>| Err(io::Error::other("the disk is full"));
        let text = write_atomically(&path, full).unwrap_err().to_string();
        assert!(text.contains("mesh.ply") && text.contains("the disk is full"));
    }
}
