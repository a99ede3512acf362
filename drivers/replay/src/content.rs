//! What a session holds, as one number.

use std::path::Path;

use depth_camera::CameraError;
use sha2::{Digest, Sha256};

use crate::{
    files::read_ordinary_file,
    lists,
    session::{self, invalid},
};

/// The hash of a session's description, lists and images, `sha256:` and 64 digits: the same for the same recording wherever
/// it lies. Other files in the folder do not count, nor does an image that is listed but missing.
///
/// # Errors
/// [`CameraError::Invalid`] for a description or list that cannot be read.
pub fn content_hash(folder: &Path) -> Result<String, CameraError> {
    let lists: &[&str] = match folder.join("ir.txt").exists() {
        true => &["depth.txt", "ir.txt"],
        false => &["depth.txt"],
    };
    hash_of_files(folder, &[session::FILE_NAME], lists)
}

/// As [`content_hash`], of a recording with other descriptions and lists.
///
/// # Errors
/// As [`content_hash`].
pub fn hash_of_files(
    folder: &Path,
    descriptions: &[&str],
    lists: &[&str],
) -> Result<String, CameraError> {
    let mut hash = Sha256::new();
    let mut add = |name: &str, bytes: &[u8]| {
        // Lengths keep the end of one file from being taken for the start of the next.
        for part in [name.as_bytes(), bytes] {
            hash.update((part.len() as u64).to_le_bytes());
            hash.update(part);
        }
    };
    let read = |path: &Path| read_ordinary_file(path).map_err(|error| invalid(path, error));
    for name in descriptions {
        add(name, &read(&folder.join(name))?);
    }
    for name in lists {
        let path = folder.join(name);
        add(name, &read(&path)?);
        for entry in lists::read_list(&path)? {
            if let Ok(bytes) = read_ordinary_file(&folder.join(&entry.file_name)) {
                add(&entry.file_name, &bytes);
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
