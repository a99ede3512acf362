//! What keeps a Kinect from working on a machine, each finding with the command that mends it.
//!
//! Everything is read from files; no device is opened. A finding is an error where a Kinect that is plugged in cannot work,
//! a warning where it may not. Not seen from here: a cable, the bus's bandwidth, and what a program does that
//! holds the device.

mod access;
mod software;
mod usb;

pub use access::UDEV_RULES;
pub(crate) use software::how_to_build;

use super::{Kinect, Machine, kinects::Parts};
use serde::Serialize;
use std::path::Path;

/// How bad a finding is.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Level {
    /// As it should be.
    Ok,
    /// May be in the way.
    Warning,
    /// Is in the way.
    Error,
}

/// What was looked at.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Check {
    /// What is plugged in.
    Devices,
    /// The permissions of a device's file.
    Permissions,
    /// The udev rules, and the group that they name.
    UdevRules,
    /// Drivers of the kernel, and programs, that hold the device.
    KernelDriver,
    /// What the kernel lends to USB transfers.
    UsbMemory,
    /// The bus and the controller.
    UsbPort,
    /// The driver and its library.
    Driver,
    /// The calibration of a device.
    Calibration,
    /// Space for recordings.
    Disk,
}

/// One finding.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct Finding {
    /// What was looked at.
    pub check: Check,
    /// How bad it is.
    pub level: Level,
    /// Serial number, or port, of the device that it is about.
    pub device: Option<String>,
    /// What was found.
    pub says: String,
    /// The command, or else the deed, that mends it.
    pub mend: Option<String>,
}

impl Finding {
    /// A finding about the machine that needs no mending.
    pub fn ok(check: Check, says: impl Into<String>) -> Self {
        Finding {
            check,
            level: Level::Ok,
            device: None,
            says: says.into(),
            mend: None,
        }
    }

    /// A finding about the machine that should be mended.
    pub fn warning(check: Check, says: impl Into<String>, mend: impl Into<String>) -> Self {
        Finding {
            level: Level::Warning,
            mend: Some(mend.into()),
            ..Finding::ok(check, says)
        }
    }

    /// A finding about the machine that must be mended.
    pub fn error(check: Check, says: impl Into<String>, mend: impl Into<String>) -> Self {
        Finding {
            level: Level::Error,
            ..Finding::warning(check, says, mend)
        }
    }

    /// The same finding, about a device.
    pub fn about(self, kinect: &Kinect) -> Self {
        let name = kinect.serial.clone();
        Finding {
            device: Some(name.unwrap_or_else(|| kinect.camera.port.clone())),
            ..self
        }
    }
}

/// Examines a machine; `data` is the folder that recordings go to.
pub fn examine(machine: &Machine, data: &Path) -> Vec<Finding> {
    let parts = Parts::of(machine);
    let kinects = parts.kinects(machine);
    let mut findings = usb::plugged_in(&parts, &kinects);
    for kinect in &kinects {
        findings.push(access::node(machine, kinect));
        findings.extend(access::holders(kinect));
        findings.extend(usb::port(kinect));
    }
    findings.extend(usb::shared_buses(&kinects));
    findings.extend(access::rules(machine, &kinects));
    findings.push(usb::memory(machine, &kinects));
    findings.extend(software::drivers(&kinects));
    findings.push(software::disk(data));
    findings
}

/// The worst of the levels; fine if there is none.
pub fn worst(findings: &[Finding]) -> Level {
    let levels = findings.iter().map(|finding| finding.level);
    levels.max().unwrap_or(Level::Ok)
}
