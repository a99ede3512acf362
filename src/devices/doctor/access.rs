//! Whether a device may be opened: its file, the udev rules, and who holds it already.

use super::{Check, Finding};
use crate::devices::{Kinect, Machine, kinects::may_use};
use depth_camera::Sensor;
use std::{fs, io};

/// The rules that give a Kinect to its users, as they are shipped.
pub const UDEV_RULES: &str = include_str!("../../../udev/70-relief-kinect.rules");

/// The name under which they must be installed: udev reads rules in the order of their names.
const RULES_FILE: &str = "70-relief-kinect.rules";

/// Where udev looks for rules, the most binding place first.
const RULES_FOLDERS: [&str; 4] = [
    "/etc/udev/rules.d",
    "/run/udev/rules.d",
    "/usr/lib/udev/rules.d",
    "/lib/udev/rules.d",
];

/// The group that the rules give a Kinect to.
const GROUP: &str = "relief";

/// Installs the rules and their group, and applies them to what is plugged in.
const INSTALL: &str = "echo 'g relief - -' | sudo systemd-sysusers - && \
    relief doctor --print-rules | sudo tee /etc/udev/rules.d/70-relief-kinect.rules >/dev/null && \
    sudo udevadm control --reload && sudo udevadm trigger --action=add --subsystem-match=usb";

/// Whether the device's file may be read and written.
pub(super) fn node(machine: &Machine, kinect: &Kinect) -> Finding {
    let node = kinect.camera.node();
    let finding = match may_use(machine, &kinect.camera) {
        Ok(()) => Finding::ok(
            Check::Permissions,
            format!("{node} may be read and written"),
        ),
        Err(error) if error.kind() == io::ErrorKind::NotFound => Finding::error(
            Check::Permissions,
            format!("{node} is not there"),
            "unplug the device and plug it in again; in a container, pass /dev/bus/usb on",
        ),
        Err(error) => Finding::error(
            Check::Permissions,
            format!("{node} may not be read and written: {error}"),
            match installed_rules(machine) {
                Some(_) => format!("sudo usermod -aG {GROUP} \"$USER\", then log in again"),
                None => INSTALL.to_owned(),
            },
        ),
    };
    finding.about(kinect)
}

/// Whether the rules are installed as shipped, and their group exists.
pub(super) fn rules(machine: &Machine, kinects: &[Kinect]) -> Vec<Finding> {
    let check = Check::UdevRules;
    let Some((place, text)) = installed_rules(machine) else {
        let says = format!("{RULES_FILE} is not installed: only root may open a Kinect");
        // Whoever may open the device all the same, root above all, needs no rules.
        let is_needed = kinects.iter().any(|k| may_use(machine, &k.camera).is_err());
        return vec![match is_needed {
            true => Finding::error(check, says, INSTALL),
            false => Finding::warning(check, says, INSTALL),
        }];
    };
    let mut findings = vec![match text == UDEV_RULES {
        true => Finding::ok(check, format!("{place} is installed")),
        false => Finding::warning(check, format!("{place} is not the one shipped"), INSTALL),
    }];
    if !has_group(machine) {
        findings.push(Finding::error(
            check,
            format!("the rules name the group {GROUP}, which does not exist"),
            "echo 'g relief - -' | sudo systemd-sysusers - && sudo udevadm control --reload",
        ));
    }
    findings
}

fn installed_rules(machine: &Machine) -> Option<(String, String)> {
    let places = RULES_FOLDERS.map(|folder| format!("{folder}/{RULES_FILE}"));
    places.into_iter().find_map(|place| {
        let text = fs::read_to_string(machine.path(&place)).ok()?;
        Some((place, text))
    })
}

fn has_group(machine: &Machine) -> bool {
    let groups = fs::read_to_string(machine.path("/etc/group")).unwrap_or_default();
    groups
        .lines()
        .any(|line| line.split(':').next() == Some(GROUP))
}

/// Who holds the device's interfaces.
pub(super) fn holders(kinect: &Kinect) -> Vec<Finding> {
    let check = Check::KernelDriver;
    let camera = &kinect.camera;
    let holders = camera.held_by.iter().map(|holder| match holder.as_str() {
        "usbfs" => Finding::warning(
            check,
            "a program has opened the device",
            format!("fuser -v {} tells which; end it", camera.node()),
        ),
        // libfreenect takes the device from it and gives it back; a camera program may get in between.
        driver if kinect.model.sensor() == Sensor::Kinect1 => Finding::warning(
            check,
            format!("the kernel's {driver} holds the camera: libfreenect has to take it away"),
            format!(
                "echo 'blacklist {driver}' | sudo tee /etc/modprobe.d/relief-kinect.conf && sudo modprobe -r {driver}"
            ),
        ),
        driver => Finding::error(
            check,
            format!("the kernel's {driver} holds the device"),
            format!("sudo modprobe -r {driver}"),
        ),
    });
    let findings: Vec<_> = holders.map(|finding| finding.about(kinect)).collect();
    match findings.is_empty() {
        true => vec![Finding::ok(check, "nobody holds the device").about(kinect)],
        false => findings,
    }
}
