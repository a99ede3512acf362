//! Opens a recorded session of whatever kind.

use std::path::Path;

use depth_camera::{CameraError, DepthCamera};
use replay::{DepthScale, Pacing, ReplayCamera};

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
    let camera = ReplayCamera::open(path)?.with_pacing(pacing);
    Ok(Session {
        depth_scale: camera.depth_scale(),
        camera: Box::new(camera),
    })
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
