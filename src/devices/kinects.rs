//! The Kinects among the USB devices, each with what speaks for and against opening it.

use super::{
    machine::Machine,
    products::{Model, Part, VENDOR},
    usb::{self, UsbDevice},
};
use depth_camera::Sensor;
use std::{fmt, io};

/// A Kinect that is plugged in.
#[derive(Clone, Debug, PartialEq)]
pub struct Kinect {
    /// Its serial number, if it says one.
    pub serial: Option<String>,
    /// Which model it is.
    pub model: Model,
    /// Its camera.
    pub camera: UsbDevice,
    /// What keeps its driver from opening it, if anything is known to.
    pub obstacle: Option<Obstacle>,
}

/// What keeps a driver from opening a Kinect.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Obstacle {
    /// The program was built without the driver.
    NotBuilt(Sensor),
    /// The device's file is not ours to write, or is not there.
    Node(String),
    /// A program has opened it.
    InUse,
}

impl fmt::Display for Obstacle {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Obstacle::NotBuilt(sensor) => {
                write!(f, "built without the feature {}", sensor.name())
            }
            Obstacle::Node(what) => f.write_str(what),
            Obstacle::InUse => f.write_str("in use by a program"),
        }
    }
}

/// The library by which a sensor is read.
pub(crate) fn library(sensor: Sensor) -> &'static str {
    match sensor {
        Sensor::Kinect1 => "libfreenect",
        Sensor::Kinect2 => "libfreenect2",
    }
}

/// Whether the program was built with the driver of a sensor.
pub(crate) fn is_built(sensor: Sensor) -> bool {
    match sensor {
        Sensor::Kinect1 => cfg!(feature = "kinect1"),
        Sensor::Kinect2 => cfg!(feature = "kinect2"),
    }
}

/// All Kinects that are plugged in, in order of their ports.
pub fn list(machine: &Machine) -> Vec<Kinect> {
    Parts::of(machine).kinects(machine)
}

/// The USB devices that belong to Kinects.
pub(crate) struct Parts(pub(crate) Vec<(Part, UsbDevice)>);

impl Parts {
    pub(crate) fn of(machine: &Machine) -> Self {
        let devices = usb::devices(machine).into_iter();
        let devices = devices.filter(|device| device.vendor == VENDOR);
        let parts = devices.filter_map(|device| {
            let part = Part::of_product(device.product, device.release)?;
            Some((part, device))
        });
        Parts(parts.collect())
    }

    pub(crate) fn kinects(&self, machine: &Machine) -> Vec<Kinect> {
        let cameras = self.0.iter().filter_map(|(part, device)| match part {
            Part::Camera(model) => Some((*model, device)),
            _ => None,
        });
        let kinects = cameras.map(|(model, camera)| Kinect {
            serial: self.serial(model, camera),
            model,
            camera: camera.clone(),
            obstacle: obstacle(machine, model.sensor(), camera),
        });
        kinects.collect()
    }

    /// The serial number by which libfreenect knows the Kinect: for later models that of the audio part on the same hub.
    fn serial(&self, model: Model, camera: &UsbDevice) -> Option<String> {
        if model.has_own_serial() {
            return camera.serial.clone();
        }
        let mut others = self.0.iter();
        let audio = others
            .find(|(part, device)| *part == Part::Audio && device.hub() == camera.hub())
            .map(|(_, device)| device);
        audio.and_then(|audio| audio.serial.clone())
    }
}

fn obstacle(machine: &Machine, sensor: Sensor, camera: &UsbDevice) -> Option<Obstacle> {
    if !is_built(sensor) {
        return Some(Obstacle::NotBuilt(sensor));
    }
    if let Err(error) = may_use(machine, camera) {
        return Some(Obstacle::Node(format!("{}: {error}", camera.node())));
    }
    let is_in_use = camera.held_by.iter().any(|holder| holder == "usbfs");
    is_in_use.then_some(Obstacle::InUse)
}

/// Whether this user may read and write the device's file.
pub(crate) fn may_use(machine: &Machine, device: &UsbDevice) -> io::Result<()> {
    use rustix::fs::{Access, access};
    access(
        machine.path(&device.node()),
        Access::READ_OK | Access::WRITE_OK,
    )?;
    Ok(())
}
