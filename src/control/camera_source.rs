//! The daemon's one camera: opened anew for every scan.

use depth_camera::{CameraError, CameraInfo, DepthCamera};
use replay::{Pacing, ReplayCamera};
use serde::{Deserialize, Serialize};
use std::path::{Path, PathBuf};
use utoipa::ToSchema;

/// Where frames come from.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum CameraSource {
    /// A recording, played at its own pace as if it were a device.
    Replay {
        /// The session.
        session: PathBuf,
        /// Whether it begins anew when it ends.
        repeat: bool,
    },
}

/// A camera by name.
#[derive(Clone, Debug, PartialEq, Eq, Deserialize, Serialize, ToSchema)]
pub struct DeviceName {
    /// The device's serial number.
    pub serial: String,
    /// `kinect1` or `kinect2`.
    pub sensor: String,
}

impl DeviceName {
    /// The name of a camera that was opened.
    pub fn of(info: &CameraInfo) -> Self {
        DeviceName {
            serial: info.serial.clone(),
            sensor: info.sensor.name().to_owned(),
        }
    }
}

impl CameraSource {
    /// Opens the camera; may wait for it.
    ///
    /// # Errors
    /// If it is not there, in use, or makes no sense.
    pub fn open(&self) -> Result<Box<dyn DepthCamera>, CameraError> {
        match self {
            CameraSource::Replay { session, repeat } => {
                let camera = ReplayCamera::open(session)?.with_pacing(Pacing::Recorded);
                Ok(match repeat {
                    true => Box::new(camera.repeating()),
                    false => Box::new(camera),
                })
            }
        }
    }

    /// The cameras that this daemon may scan with, those that answer.
    pub fn list(&self) -> Vec<DeviceName> {
        match self {
            CameraSource::Replay { session, .. } => ReplayCamera::open(session)
                .map(|camera| DeviceName::of(camera.info()))
                .into_iter()
                .collect(),
        }
    }

    /// The recording, if it is one; it may carry its calibration.
    pub fn session(&self) -> Option<&Path> {
        match self {
            CameraSource::Replay { session, .. } => Some(session),
        }
    }
}
