//! The bus: what is plugged in where, how fast, at which controller, and the memory that transfers may take.

use super::{Check, Finding};
use crate::devices::{
    Kinect, Machine,
    kinects::Parts,
    products::{Model, Part},
};
use depth_camera::Sensor;

/// USB 3, Mbit/s.
const SUPER_SPEED_MBPS: f64 = 5000.0;

/// USB 2, Mbit/s.
const HIGH_SPEED_MBPS: f64 = 480.0;

/// Makers of controllers that users of libfreenect2 tell of, by their PCI ids; none was tried by us.
const CONTROLLERS: [(u16, &str, bool); 6] = [
    (0x8086, "Intel", true),
    (0x1912, "Renesas", true),
    (0x1033, "NEC", true),
    (0x1b21, "ASMedia", false),
    (0x1b36, "a virtual machine", false),
    (0x15ad, "a virtual machine", false),
];

/// Where the kernel says what it lends to all USB transfers, MiB; 0 is no limit.
const MEMORY_LIMIT: &str = "/sys/module/usbcore/parameters/usbfs_memory_mb";

/// What the kernel lends where nobody has said otherwise, MiB.
const USUAL_LIMIT_MIB: u64 = 16;

/// What is there, and what of it is no whole Kinect.
pub(super) fn plugged_in(parts: &Parts, kinects: &[Kinect]) -> Vec<Finding> {
    let check = Check::Devices;
    let mut findings: Vec<Finding> = kinects.iter().map(whole).collect();
    let has_sensor = |sensor| kinects.iter().any(|kinect| kinect.model.sensor() == sensor);
    let has = |wanted: &[Part]| parts.0.iter().any(|(part, _)| wanted.contains(part));
    if has(&[Part::Audio, Part::Motor]) && !has_sensor(Sensor::Kinect1) {
        findings.push(Finding::error(
            check,
            "there is a Kinect I without its camera: it has no power but that of the USB cable",
            "connect its power supply, then plug it in again",
        ));
    }
    if has(&[Part::Adaptor]) && !has_sensor(Sensor::Kinect2) {
        findings.push(Finding::error(
            check,
            "there is the hub of a Kinect II without its sensor",
            "connect the adaptor's power supply and its cable to the sensor, then plug it in again",
        ));
    }
    if findings.is_empty() {
        findings.push(Finding::warning(
            check,
            "no Kinect is plugged in",
            "plug one in, with its power supply; `lsusb -d 045e:` shows what the system sees",
        ));
    }
    findings
}

fn whole(kinect: &Kinect) -> Finding {
    let (model, port) = (kinect.model, &kinect.camera.port);
    let finding = match &kinect.serial {
        Some(_) => Finding::ok(Check::Devices, format!("{model} at port {port}")),
        None => Finding::error(
            Check::Devices,
            format!("{model} at port {port} tells no serial number"),
            "unplug it, wait ten seconds, and plug it in again",
        ),
    };
    finding.about(kinect)
}

/// Speed and controller of a device.
pub(super) fn port(kinect: &Kinect) -> Vec<Finding> {
    let mut findings = vec![speed(kinect).about(kinect)];
    if kinect.model.sensor() == Sensor::Kinect2 {
        findings.extend(controller(kinect).map(|finding| finding.about(kinect)));
    }
    findings
}

fn speed(kinect: &Kinect) -> Finding {
    let check = Check::UsbPort;
    let needed = match kinect.model.sensor() {
        Sensor::Kinect1 => HIGH_SPEED_MBPS,
        Sensor::Kinect2 => SUPER_SPEED_MBPS,
    };
    match kinect.camera.speed_mbps {
        Some(speed) if speed < needed => Finding::error(
            check,
            format!("it runs at {speed} Mbit/s and needs {needed}"),
            match kinect.model.sensor() {
                Sensor::Kinect1 => "plug it into a USB 2 or 3 port of the machine itself",
                Sensor::Kinect2 => {
                    "plug it into a USB 3 port (blue, or marked SS); `lsusb -t` must say 5000M"
                }
            },
        ),
        Some(speed) => Finding::ok(check, format!("it runs at {speed} Mbit/s")),
        None => Finding::ok(check, "the system does not say how fast it runs"),
    }
}

fn controller(kinect: &Kinect) -> Option<Finding> {
    let controller = kinect.camera.controller.as_ref()?;
    let vendor = controller.vendor?;
    let address = &controller.address;
    let known = CONTROLLERS.iter().find(|(id, ..)| *id == vendor);
    Some(match known {
        Some((_, maker, true)) => Finding::ok(
            Check::UsbPort,
            format!("the controller at {address} is of {maker}, which users find to work"),
        ),
        Some((_, maker, false)) => Finding::warning(
            Check::UsbPort,
            format!("the controller at {address} is of {maker}, which users find not to work"),
            "use a port of an Intel or Renesas controller; `lspci` lists them",
        ),
        None => Finding::ok(
            Check::UsbPort,
            format!("nothing is known of the controller at {address}, maker {vendor:04x}"),
        ),
    })
}

/// Devices that share what carries one of them: a Kinect II takes most of a controller, a Kinect I half of a bus.
pub(super) fn shared_buses(kinects: &[Kinect]) -> Vec<Finding> {
    let mut findings = Vec::new();
    for (index, kinect) in kinects.iter().enumerate() {
        if !kinects[..index].iter().any(|other| shares(kinect, other)) {
            continue;
        }
        let what = match kinect.model.sensor() {
            Sensor::Kinect1 => "bus with another Kinect I; each takes half of it",
            Sensor::Kinect2 => "controller with another Kinect II; one takes most of it",
        };
        let finding = Finding::warning(
            Check::UsbPort,
            format!("it shares its {what}"),
            "plug it into a port of another controller; `lsusb -t` shows which port is whose",
        );
        findings.push(finding.about(kinect));
    }
    findings
}

fn shares(kinect: &Kinect, other: &Kinect) -> bool {
    let (camera, other_camera) = (&kinect.camera, &other.camera);
    match (kinect.model.sensor(), other.model.sensor()) {
        (Sensor::Kinect1, Sensor::Kinect1) => camera.bus == other_camera.bus,
        (Sensor::Kinect2, Sensor::Kinect2) => {
            camera.controller.is_some() && camera.controller == other_camera.controller
        }
        _ => false,
    }
}

/// Whether the kernel lends enough memory for all devices at once.
pub(super) fn memory(machine: &Machine, kinects: &[Kinect]) -> Finding {
    let check = Check::UsbMemory;
    let need_mib = needed_mib(kinects.iter().map(|kinect| kinect.model));
    let limit = machine
        .line(MEMORY_LIMIT)
        .and_then(|line| line.parse().ok());
    let Some(limit_mib) = limit else {
        return match need_mib >= USUAL_LIMIT_MIB {
            true => Finding::warning(
                check,
                format!("{need_mib} MiB are needed; {MEMORY_LIMIT} cannot be read"),
                "load the kernel's USB support: sudo modprobe usbcore",
            ),
            false => Finding::ok(
                check,
                format!("{need_mib} MiB are needed, which every kernel lends"),
            ),
        };
    };
    match (limit_mib, need_mib) {
        (0, _) => Finding::ok(check, "the kernel sets no limit to USB memory"),
        (limit, need) if limit < need => Finding::error(
            check,
            format!("usbfs_memory_mb is {limit}, {need} MiB are needed for what is plugged in"),
            raise_limit(need),
        ),
        (limit, need) if 2 * need > limit && has_kinect2(kinects) => Finding::warning(
            check,
            format!(
                "usbfs_memory_mb is {limit}, {need} MiB are needed, which leaves little for other devices"
            ),
            raise_limit(need),
        ),
        (limit, need) => Finding::ok(
            check,
            format!("usbfs_memory_mb is {limit}, {need} MiB are needed for what is plugged in"),
        ),
    }
}

fn has_kinect2(kinects: &[Kinect]) -> bool {
    kinects
        .iter()
        .any(|kinect| kinect.model.sensor() == Sensor::Kinect2)
}

/// What all transfers in flight take, with a tenth for the kernel's own records of them, MiB.
fn needed_mib(models: impl Iterator<Item = Model>) -> u64 {
    let bytes: u64 = models.map(Model::bytes_in_flight).sum();
    (bytes + bytes / 10).div_ceil(1024 * 1024)
}

/// Sets the limit to twice the need, 64 MiB at least, until the next boot.
fn raise_limit(need_mib: u64) -> String {
    let limit = (2 * need_mib).next_power_of_two().max(64);
    format!(
        "echo {limit} | sudo tee {MEMORY_LIMIT}; for good: usbcore.usbfs_memory_mb={limit} on the kernel's command line"
    )
}
