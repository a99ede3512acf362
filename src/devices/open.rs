//! Opening a device by its serial number.

use super::{DeviceParams, Kinect, Machine, list};
use depth_camera::{CameraError, CameraInfo, DepthCamera, Frame, Sensor};
use freenect2::Freenect2Camera;
use std::time::Duration;

/// Why a device could not be opened.
#[derive(Debug, thiserror::Error)]
pub enum OpenError {
    /// No device has that serial number.
    #[error("no Kinect with the serial number {serial} is plugged in; {}", what_is_there(.plugged_in))]
    NotFound {
        /// What was asked for.
        serial: String,
        /// What is there instead.
        plugged_in: Vec<String>,
    },
    /// The program has no driver for it.
    #[error("{serial} is a {model}, and this program was built without its driver: {}", super::doctor::how_to_build(*.sensor))]
    NotBuilt {
        /// What was asked for.
        serial: String,
        /// Its model.
        model: String,
        /// The sensor that a driver is missing for.
        sensor: Sensor,
    },
    /// The driver could not open it.
    #[error("the Kinect {serial} cannot be opened: {source}; `relief doctor` tells what to do")]
    Camera {
        /// What was asked for.
        serial: String,
        /// What the driver says.
        source: CameraError,
    },
}

fn what_is_there(plugged_in: &[String]) -> String {
    match plugged_in {
        [] => "there is none at all".to_owned(),
        serials => format!("there are: {}", serials.join(", ")),
    }
}

/// A live device with its driver.
#[derive(Debug)]
pub enum LiveCamera {
    /// A Kinect I.
    #[cfg(feature = "kinect1")]
    Kinect1(Box<freenect1::Freenect1Camera>),
    /// A Kinect II.
    Kinect2(Box<Freenect2Camera>),
}

impl LiveCamera {
    fn as_camera(&self) -> &dyn DepthCamera {
        match self {
            #[cfg(feature = "kinect1")]
            LiveCamera::Kinect1(camera) => camera.as_ref(),
            LiveCamera::Kinect2(camera) => camera.as_ref(),
        }
    }

    fn as_camera_mut(&mut self) -> &mut dyn DepthCamera {
        match self {
            #[cfg(feature = "kinect1")]
            LiveCamera::Kinect1(camera) => camera.as_mut(),
            LiveCamera::Kinect2(camera) => camera.as_mut(),
        }
    }
}

impl DepthCamera for LiveCamera {
    fn info(&self) -> &CameraInfo {
        self.as_camera().info()
    }

    fn grab(&mut self, timeout: Duration) -> Result<Option<Frame>, CameraError> {
        self.as_camera_mut().grab(timeout)
    }

    fn n_missed(&self) -> u64 {
        self.as_camera().n_missed()
    }

    fn pause_depth(&mut self) -> Result<(), CameraError> {
        self.as_camera_mut().pause_depth()
    }

    fn resume_depth(&mut self) -> Result<(), CameraError> {
        self.as_camera_mut().resume_depth()
    }
}

/// Opens the device of that serial number and starts its streams.
///
/// # Errors
/// [`OpenError`], with what is there instead, or with what the driver says.
pub fn open(serial: &str, params: &DeviceParams) -> Result<Box<dyn DepthCamera>, OpenError> {
    Ok(Box::new(connect(serial, params)?))
}

/// As [`open`], with the driver known, as recording raw data asks for.
///
/// # Errors
/// As [`open`].
pub fn connect(serial: &str, params: &DeviceParams) -> Result<LiveCamera, OpenError> {
    let kinects = list(&Machine::this());
    let known = kinects
        .iter()
        .find(|kinect| kinect.serial.as_deref() == Some(serial));
    // The libraries may see what /sys does not show; then whichever has the device opens it.
    let sensors = match known {
        Some(kinect) => vec![kinect.model.sensor()],
        None => vec![Sensor::Kinect1, Sensor::Kinect2],
    };
    for sensor in sensors {
        match connect_to(sensor, serial, params) {
            Some(Err(CameraError::Disconnected)) | None => {}
            Some(Ok(camera)) => return Ok(camera),
            Some(Err(source)) => {
                let serial = serial.to_owned();
                return Err(OpenError::Camera { serial, source });
            }
        }
    }
    Err(not_opened(serial, known, &kinects))
}

fn not_opened(serial: &str, known: Option<&Kinect>, kinects: &[Kinect]) -> OpenError {
    let serial = serial.to_owned();
    match known {
        Some(kinect) if super::kinects::is_built(kinect.model.sensor()) => OpenError::Camera {
            serial,
            source: CameraError::Disconnected,
        },
        Some(kinect) => OpenError::NotBuilt {
            serial,
            model: kinect.model.to_string(),
            sensor: kinect.model.sensor(),
        },
        None => OpenError::NotFound {
            serial,
            plugged_in: plugged_in(kinects),
        },
    }
}

/// Serial numbers of all that is there, by the system and by the libraries.
fn plugged_in(kinects: &[Kinect]) -> Vec<String> {
    let mut serials: Vec<String> = kinects.iter().filter_map(|k| k.serial.clone()).collect();
    // What cannot be asked lists nothing.
    #[cfg(feature = "kinect1")]
    serials.extend(freenect1::attached().unwrap_or_default());
    serials.sort();
    serials.dedup();
    serials
}

/// Opens a device with the driver of a sensor; `None` if the program has none.
fn connect_to(
    sensor: Sensor,
    serial: &str,
    params: &DeviceParams,
) -> Option<Result<LiveCamera, CameraError>> {
    match sensor {
        #[cfg(feature = "kinect1")]
        Sensor::Kinect1 => {
            let camera = freenect1::Freenect1Camera::open(Some(serial), params.kinect1.settings());
            Some(camera.map(|camera| {
                // Without udev, a look at the bus now and then tells that the device is back.
                let camera = match udev_monitor::UsbMonitor::open() {
                    Ok(monitor) => camera.with_monitor(monitor),
                    Err(_) => camera,
                };
                LiveCamera::Kinect1(Box::new(camera))
            }))
        }
        #[cfg(feature = "kinect2")]
        Sensor::Kinect2 => {
            let options = freenect2::LiveOptions {
                serial: Some(serial.to_owned()),
                decoder: params.kinect2.decoder_options(),
                ..freenect2::LiveOptions::default()
            };
            let camera = Freenect2Camera::open(freenect2::Library::libfreenect2(), options);
            Some(camera.map(|camera| {
                // Without udev, silence tells of unplugging.
                let camera = match udev_monitor::UsbMonitor::open() {
                    Ok(monitor) => camera.with_monitor(monitor),
                    Err(_) => camera,
                };
                LiveCamera::Kinect2(Box::new(camera))
            }))
        }
        #[allow(unreachable_patterns, reason = "reached without a driver's feature")]
        _ => {
            let _ = (serial, params);
            None
        }
    }
}
