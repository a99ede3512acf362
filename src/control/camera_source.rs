//! The daemon's one camera: opened anew for every scan.

use crate::{
    config::ConfigError,
    devices::{self, DeviceParams, Machine, OpenError, open_recording},
};
use depth_camera::{CameraError, CameraInfo, DepthCamera};
use replay::{Pacing, RepeatingCamera};
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
    /// A live device.
    Live {
        /// Its serial number; the only Kinect that can be used without one.
        serial: Option<String>,
    },
}

/// Why there is no camera.
#[derive(Debug, thiserror::Error)]
pub enum SourceError {
    /// The recording, or the camera that plays it, makes no sense.
    #[error("the camera cannot be used: {0}")]
    Camera(#[from] CameraError),
    /// The device cannot be opened.
    #[error(transparent)]
    Open(#[from] OpenError),
    /// What is known of the device cannot be read.
    #[error(transparent)]
    Config(#[from] ConfigError),
    /// No device was named, and it is not clear which is meant.
    #[error("{}", which(.0))]
    Unclear(Vec<String>),
}

fn which(usable: &[String]) -> String {
    match usable {
        [] => "no Kinect can be used; `relief doctor` tells why".to_owned(),
        serials => format!("--device must name one of {}", serials.join(", ")),
    }
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
    /// Opens the camera; may wait for it. `params_of` tells what a driver has to know of the device with that serial number.
    ///
    /// # Errors
    /// If it is not there, in use, or makes no sense.
    pub fn open(
        &self,
        params_of: impl FnOnce(&str) -> Result<DeviceParams, ConfigError>,
    ) -> Result<Box<dyn DepthCamera>, SourceError> {
        match self {
            CameraSource::Replay { session, repeat } => {
                // A recording of packets is decoded as the configuration says; no calibration has a say in that.
                let params = params_of("")?;
                Ok(play(session, *repeat, &params)?)
            }
            CameraSource::Live { serial } => {
                let serial = match serial {
                    Some(serial) => serial.clone(),
                    None => only(usable())?,
                };
                Ok(devices::open(&serial, &params_of(&serial)?)?)
            }
        }
    }

    /// Looks whether the camera makes sense, without opening a device: one that is not there yet may come.
    ///
    /// # Errors
    /// For a recording that cannot be played.
    pub fn check(&self) -> Result<(), CameraError> {
        match self {
            CameraSource::Replay { session, .. } => {
                play(session, false, &DeviceParams::default()).map(drop)
            }
            CameraSource::Live { .. } => Ok(()),
        }
    }

    /// The cameras that this daemon may scan with, those that answer.
    pub fn list(&self) -> Vec<DeviceName> {
        match self {
            CameraSource::Replay { session, .. } => play(session, false, &DeviceParams::default())
                .map(|camera| DeviceName::of(camera.info()))
                .into_iter()
                .collect(),
            CameraSource::Live { serial } => {
                let mut devices = usable();
                if let Some(serial) = serial {
                    devices.retain(|device| device.serial == *serial);
                }
                devices
            }
        }
    }

    /// The recording, if it is one; it may carry its calibration.
    pub fn session(&self) -> Option<&Path> {
        match self {
            CameraSource::Replay { session, .. } => Some(session),
            CameraSource::Live { .. } => None,
        }
    }
}

/// A recording at its own pace.
fn play(
    session: &Path,
    repeat: bool,
    params: &DeviceParams,
) -> Result<Box<dyn DepthCamera>, CameraError> {
    let (session, params) = (session.to_owned(), params.clone());
    let open = move || open_recording(&session, &params, Pacing::Recorded);
    match repeat {
        true => Ok(Box::new(RepeatingCamera::new(Box::new(open))?)),
        false => open(),
    }
}

/// The Kinects that nothing is known to keep from working.
fn usable() -> Vec<DeviceName> {
    let kinects = devices::list(&Machine::this()).into_iter();
    kinects
        .filter(|kinect| kinect.obstacle.is_none())
        .filter_map(|kinect| {
            Some(DeviceName {
                sensor: kinect.model.sensor().name().to_owned(),
                serial: kinect.serial?,
            })
        })
        .collect()
}

fn only(usable: Vec<DeviceName>) -> Result<String, SourceError> {
    let serials: Vec<String> = usable.into_iter().map(|device| device.serial).collect();
    match <[String; 1]>::try_from(serials) {
        Ok([serial]) => Ok(serial),
        Err(serials) => Err(SourceError::Unclear(serials)),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_device_that_is_not_named_must_be_the_only_one() {
        let named = |serial: &str| DeviceName {
            serial: serial.to_owned(),
            sensor: "kinect1".to_owned(),
        };
        assert_eq!(only(vec![named("A")]).unwrap(), "A");
        let error = only(vec![named("A"), named("B")]).unwrap_err();
        assert_eq!(error.to_string(), "--device must name one of A, B");
        let error = only(Vec::new()).unwrap_err().to_string();
        assert!(error.starts_with("no Kinect can be used"), "{error}");
    }
}
