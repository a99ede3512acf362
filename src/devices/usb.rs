//! USB devices as the kernel describes them in `/sys/bus/usb/devices`.

use super::machine::{Machine, line};
use serde::Serialize;
use std::{
    fs,
    path::{Path, PathBuf},
    str::FromStr,
};

/// One USB device.
#[derive(Clone, Debug, PartialEq)]
pub struct UsbDevice {
    /// Where it is plugged in: bus, then ports, as in `2-1.4`.
    pub port: String,
    /// Vendor id.
    pub vendor: u16,
    /// Product id.
    pub product: u16,
    /// The maker's number of this release, `bcdDevice`.
    pub release: u16,
    /// Its serial number, if it has one.
    pub serial: Option<String>,
    /// What bus and device have agreed on, Mbit/s: 480 is USB 2, 5000 USB 3.
    pub speed_mbps: Option<f64>,
    /// Number of the bus.
    pub bus: u32,
    /// Number on the bus; another one each time it is plugged in.
    pub address: u32,
    /// Drivers of the kernel that hold its interfaces; `usbfs` stands for a program.
    pub held_by: Vec<String>,
    /// What the bus hangs on.
    pub controller: Option<Controller>,
}

/// A USB host controller.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct Controller {
    /// Address on the PCI bus, or the kernel's name for it.
    pub address: String,
    /// Its driver in the kernel.
    pub driver: Option<String>,
    /// PCI id of its maker.
    pub vendor: Option<u16>,
}

impl UsbDevice {
    /// The file through which programs reach the device.
    pub fn node(&self) -> String {
        format!("/dev/bus/usb/{:03}/{:03}", self.bus, self.address)
    }

    /// The port of the hub that it hangs on; `usb2` for that of the bus itself.
    pub(crate) fn hub(&self) -> String {
        match self.port.rsplit_once('.') {
            Some((hub, _)) => hub.to_owned(),
            None => format!("usb{}", self.bus),
        }
    }
}

/// All devices but the buses' own hubs, in order of their ports. What cannot be read is left out: a device may go meanwhile.
pub(crate) fn devices(machine: &Machine) -> Vec<UsbDevice> {
    let folder = machine.path("/sys/bus/usb/devices");
    let entries = fs::read_dir(&folder).into_iter().flatten().flatten();
    let names = entries.filter_map(|entry| entry.file_name().into_string().ok());
    let mut devices: Vec<UsbDevice> = names
        .filter(|name| !name.contains(':') && !name.starts_with("usb"))
        .filter_map(|name| device(&folder, name))
        .collect();
    devices.sort_by(|a, b| a.port.cmp(&b.port));
    devices
}

fn device(folder: &Path, port: String) -> Option<UsbDevice> {
    let path = folder.join(&port);
    let bus = number(&path, "busnum")?;
    Some(UsbDevice {
        vendor: id(&path, "idVendor")?,
        product: id(&path, "idProduct")?,
        release: id(&path, "bcdDevice").unwrap_or(0),
        serial: line(&path.join("serial")),
        speed_mbps: number(&path, "speed"),
        bus,
        address: number(&path, "devnum")?,
        held_by: holders(folder, &port),
        controller: controller(&folder.join(format!("usb{bus}"))),
        port,
    })
}

/// Drivers of the interfaces, which lie beside their device as `PORT:CONFIGURATION.INTERFACE`.
fn holders(folder: &Path, port: &str) -> Vec<String> {
    let prefix = format!("{port}:");
    let entries = fs::read_dir(folder).into_iter().flatten().flatten();
    let interfaces = entries.filter(|e| e.file_name().to_string_lossy().starts_with(&prefix));
    let mut holders: Vec<String> = interfaces
        .filter_map(|interface| link_name(&interface.path().join("driver")))
        .collect();
    holders.sort();
    holders.dedup();
    holders
}

/// The controller is the folder in which that of the bus lies.
fn controller(bus: &Path) -> Option<Controller> {
    let bus = fs::canonicalize(bus).ok()?;
    let path = bus.parent()?;
    Some(Controller {
        address: path.file_name()?.to_str()?.to_owned(),
        driver: link_name(&path.join("driver")),
        vendor: id(path, "vendor"),
    })
}

/// The last part of what a link names.
fn link_name(link: &Path) -> Option<String> {
    let target: PathBuf = fs::read_link(link).ok()?;
    Some(target.file_name()?.to_str()?.to_owned())
}

fn number<T: FromStr>(folder: &Path, name: &str) -> Option<T> {
    line(&folder.join(name))?.parse().ok()
}

/// A number of four hexadecimal digits.
fn id(folder: &Path, name: &str) -> Option<u16> {
    let text = line(&folder.join(name))?;
    u16::from_str_radix(text.trim_start_matches("0x"), 16).ok()
}
