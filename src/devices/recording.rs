//! Recordings of every kind as cameras.

use super::DeviceParams;
use depth_camera::{CameraError, DepthCamera};
use freenect1::RawDisparityCamera;
use freenect2::RawPacketCamera;
use mcap_session::open_session;
use replay::Pacing;
use std::path::Path;

/// What a folder holds.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Recording {
    /// Decoded frames.
    Session,
    /// Disparity and IR of a Kinect I.
    RawDisparity,
    /// Packets of a Kinect II.
    RawPackets,
}

impl Recording {
    /// What the folder looks like; a session if nothing says otherwise.
    pub fn of_folder(folder: &Path) -> Self {
        if folder.join(freenect1::RAW_DEVICE_FILE).exists() {
            Recording::RawDisparity
        } else if folder.join(freenect2::RAW_DEVICE_FILE).exists() {
            Recording::RawPackets
        } else {
            Recording::Session
        }
    }
}

/// The hash of what a recording of any kind holds, `sha256:` and 64 digits: the same wherever it lies.
///
/// # Errors
/// [`CameraError`] for a file that cannot be read.
pub fn content_hash(folder: &Path) -> Result<String, CameraError> {
    match Recording::of_folder(folder) {
        Recording::Session => mcap_session::content_hash(folder),
        Recording::RawDisparity => freenect1::content_hash(folder),
        Recording::RawPackets => freenect2::content_hash(folder),
    }
}

/// Opens a recording of any kind; raw ones are decoded as the live device's data would be.
///
/// # Errors
/// [`CameraError::Invalid`] naming file, key or line, value and bound.
pub fn open_recording(
    folder: &Path,
    params: &DeviceParams,
    pacing: Pacing,
) -> Result<Box<dyn DepthCamera>, CameraError> {
    let camera: Box<dyn DepthCamera> = match Recording::of_folder(folder) {
        Recording::Session => open_session(folder, pacing)?.camera,
        Recording::RawDisparity => Box::new(RawDisparityCamera::open(folder)?.with_pacing(pacing)),
        Recording::RawPackets => {
            let camera = RawPacketCamera::open(folder, params.kinect2.decoder_options())?;
            Box::new(camera.with_pacing(pacing))
        }
    };
    let size = camera.info().intrinsics.check_size();
    size.map_err(|what| CameraError::Invalid(format!("{}: {what}", folder.display())))?;
    Ok(camera)
}
