//! Opens a recorded session of whatever kind.

use std::{fs, path::Path};

use depth_camera::{CameraError, DepthCamera};
use replay::{DepthScale, Pacing, ReplayCamera, SESSION_FILE_NAME};

use crate::{camera::McapCamera, content, folder::is_recording};

/// A recorded session that is being played.
pub struct Session {
    /// Its camera.
    pub camera: Box<dyn DepthCamera>,
    /// How its depth is stored, for another recording of the same.
    pub depth_scale: DepthScale,
}

/// Opens a folder of images with their lists, a folder of MCAP segments, or an MCAP file.
///
/// # Errors
/// [`CameraError`] naming the file and what is wrong with it.
pub fn open_session(path: &Path, pacing: Pacing) -> Result<Session, CameraError> {
    if is_recording(path) {
        let camera = McapCamera::open(path)?.with_pacing(pacing);
        return Ok(Session {
            depth_scale: camera.depth_scale(),
            camera: Box::new(camera),
        });
    }
    check_session(path)?;
    let camera = ReplayCamera::open(path)?.with_pacing(pacing);
    Ok(Session {
        depth_scale: camera.depth_scale(),
        camera: Box::new(camera),
    })
}

/// Looks whether a path is that of a session at all.
fn check_session(path: &Path) -> Result<(), CameraError> {
    let refuse = |what: String| CameraError::Invalid(format!("{} {what}", path.display()));
    let metadata =
        fs::metadata(path).map_err(|error| refuse(format!("cannot be read: {error}")))?;
    let described = path.join(SESSION_FILE_NAME).try_exists();
    match metadata.is_dir() && described.unwrap_or(true) {
        true => Ok(()),
        false => Err(refuse(format!(
            "is neither a session's folder (no {SESSION_FILE_NAME}, no .mcap) nor an .mcap file"
        ))),
    }
}

/// The hash of what a session holds, `sha256:` and 64 digits: the same wherever it lies.
///
/// # Errors
/// [`CameraError`] for a file that cannot be read.
pub fn content_hash(path: &Path) -> Result<String, CameraError> {
    match is_recording(path) {
        true => Ok(content::content_hash(path)?),
        false => replay::content_hash(path),
    }
}
