//! Why an image cannot be used.

use super::MAX_SIDE_PX;
use crate::cdr::CdrError;

/// Why an image cannot be used.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum ImageError {
    /// It is no image message.
    #[error(transparent)]
    Cdr(#[from] CdrError),
    /// Its pixels are stored in a way that is not read here.
    #[error("encoding \"{0}\", must be 16UC1, mono16 or 32FC1")]
    Encoding(String),
    /// It is compressed in a way that is not read here.
    #[error(
        "format \"{0}\", must be 16UC1 or 32FC1 with compressedDepth png, or mono16 or 16UC1 with png compressed"
    )]
    Format(String),
    /// What it was compressed to cannot be read.
    #[error("{0}")]
    Compressed(String),
    /// It is empty or larger than any depth image.
    #[error("{width}×{height} pixels, must be 1 to {MAX_SIDE_PX} each")]
    Size {
        /// Columns.
        width: u32,
        /// Rows.
        height: u32,
    },
    /// Its rows do not fit their length or the image's.
    #[error(
        "{n_bytes} bytes in rows of {step}, too few for {width}×{height} pixels of {pixel} bytes"
    )]
    Data {
        /// Bytes of pixels.
        n_bytes: usize,
        /// Bytes from row to row.
        step: u32,
        /// Columns.
        width: u32,
        /// Rows.
        height: u32,
        /// Bytes of one pixel.
        pixel: usize,
    },
}

/// Refuses the size of an image that is empty, or larger than any depth image.
///
/// # Errors
/// [`ImageError::Size`].
pub(super) fn check_size(width: u32, height: u32) -> Result<(), ImageError> {
    let sides = 1..=MAX_SIDE_PX;
    match sides.contains(&width) && sides.contains(&height) {
        true => Ok(()),
        false => Err(ImageError::Size { width, height }),
    }
}
