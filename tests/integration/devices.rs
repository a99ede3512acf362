//! What is plugged in and what keeps it from working, on machines whose files a test writes.

use crate::support::{PROGRAM, assert_says};
use relief::devices::{
    Kinect, Machine, Model, Obstacle,
    doctor::{self, Check, Finding, Level, UDEV_RULES},
    list,
};
use serde_json::Value;
use std::{
    fs,
    io::{BufRead, BufReader},
    os::unix::fs::symlink,
    path::Path,
    process::{Command, Output, Stdio},
};

const INTEL: u16 = 0x8086;
const ASMEDIA: u16 = 0x1b21;

/// A machine's /sys, /dev and /etc in a folder.
struct Tree {
    root: tempfile::TempDir,
}

/// A device to plug in.
#[derive(Clone, Copy)]
struct Plug<'a> {
    bus: u32,
    /// Ports behind the bus: "1.2" is port 2 of the hub at port 1.
    ports: &'a str,
    address: u32,
    product: u16,
    release: u16,
    serial: Option<&'a str>,
    speed: &'a str,
}

const CAMERA_1414: Plug = Plug {
    bus: 1,
    ports: "1.1",
    address: 4,
    product: 0x02ae,
    release: 0x010b,
    serial: Some("A00361A00000001A"),
    speed: "480",
};

const SENSOR_2: Plug = Plug {
    bus: 2,
    ports: "1.1",
    address: 3,
    product: 0x02d8,
    release: 0x0100,
    serial: Some("018000000047"),
    speed: "5000",
};

impl Tree {
    /// A machine with an Intel controller for buses 1 and 2, our rules and their group, and 256 MiB for USB.
    fn healthy() -> Self {
        let tree = Tree {
            root: tempfile::tempdir().unwrap(),
        };
        fs::create_dir_all(tree.path("sys/bus/usb/devices")).unwrap();
        for bus in [1, 2] {
            tree.controller(bus, "0000:00:14.0", INTEL);
        }
        tree.write("etc/udev/rules.d/70-relief-kinect.rules", UDEV_RULES);
        tree.write("etc/group", "root:x:0:\nrelief:x:990:\n");
        tree.memory(256);
        tree
    }

    fn path(&self, name: &str) -> std::path::PathBuf {
        self.root.path().join(name)
    }

    fn write(&self, name: &str, text: &str) {
        let path = self.path(name);
        fs::create_dir_all(path.parent().unwrap()).unwrap();
        fs::write(path, text).unwrap();
    }

    fn memory(&self, mib: u32) {
        let file = "sys/module/usbcore/parameters/usbfs_memory_mb";
        self.write(file, &format!("{mib}\n"));
    }

    fn controller(&self, bus: u32, address: &str, vendor: u16) {
        let folder = format!("sys/devices/pci0000:00/{address}");
        self.write(&format!("{folder}/vendor"), &format!("0x{vendor:04x}\n"));
        self.write(&format!("{folder}/usb{bus}/busnum"), &format!("{bus}\n"));
        let _ = symlink(
            "../../../bus/pci/drivers/xhci_hcd",
            self.path(&format!("{folder}/driver")),
        );
        let link = self.path(&format!("sys/bus/usb/devices/usb{bus}"));
        let _ = fs::remove_file(&link);
        symlink(
            format!("../../../devices/pci0000:00/{address}/usb{bus}"),
            link,
        )
        .unwrap();
    }

    fn plug(&self, plug: Plug) -> &Self {
        let port = format!("{}-{}", plug.bus, plug.ports);
        let folder = format!("sys/bus/usb/devices/{port}");
        let mut files = vec![
            ("idVendor", "045e".to_owned()),
            ("idProduct", format!("{:04x}", plug.product)),
            ("bcdDevice", format!("{:04x}", plug.release)),
            ("busnum", plug.bus.to_string()),
            ("devnum", plug.address.to_string()),
            ("speed", plug.speed.to_owned()),
        ];
        files.extend(plug.serial.map(|serial| ("serial", serial.to_owned())));
        for (name, value) in files {
            self.write(&format!("{folder}/{name}"), &format!("{value}\n"));
        }
        let node = format!("dev/bus/usb/{:03}/{:03}", plug.bus, plug.address);
        self.write(&node, "");
        self
    }

    /// A driver of the kernel takes the first interface of a device.
    fn hold(&self, port: &str, driver: &str) -> &Self {
        let interface = self.path(&format!("sys/bus/usb/devices/{port}:1.0"));
        fs::create_dir_all(&interface).unwrap();
        let target = format!("../../../bus/usb/drivers/{driver}");
        symlink(target, interface.join("driver")).unwrap();
        self
    }

    fn machine(&self) -> Machine {
        Machine::under(self.root.path())
    }

    fn kinects(&self) -> Vec<Kinect> {
        list(&self.machine())
    }

    fn findings(&self) -> Vec<Finding> {
        doctor::examine(&self.machine(), self.root.path())
    }

    /// Findings of a check that are not fine.
    fn complaints(&self, check: Check) -> Vec<Finding> {
        let mut findings = self.findings();
        findings.retain(|finding| finding.check == check && finding.level != Level::Ok);
        findings
    }

    fn relief(&self, arguments: &[&str]) -> Output {
        Command::new(PROGRAM)
            .args(arguments)
            .args(["--root", self.root.path().to_str().unwrap()])
            .output()
            .unwrap()
    }
}

/// The one complaint of a check, with its level and what its text and its command must hold.
fn assert_complaint(tree: &Tree, check: Check, level: Level, says: &str, mend: &str) {
    let complaints = tree.complaints(check);
    let [complaint] = &complaints[..] else {
        panic!("one complaint: {complaints:?}");
    };
    assert_eq!(complaint.level, level, "{complaint:?}");
    assert!(complaint.says.contains(says), "{complaint:?}");
    let command = complaint.mend.as_deref().unwrap();
    assert!(command.contains(mend), "{complaint:?}");
}

#[test]
fn models_and_serial_numbers_are_those_that_the_libraries_know() {
    let tree = Tree::healthy();
    assert_eq!(tree.kinects(), []);
    let zeros = Some("0000000000000000");
    tree.plug(CAMERA_1414);
    // Two 1473 on hubs of their own, each with its audio part, in an order that could mislead.
    for (ports, address, product, serial) in [
        ("2.1", 11, 0x02ae, zeros),
        ("2.2", 12, 0x02ad, Some("B1")),
        ("3.3", 13, 0x02ad, Some("B2")),
        ("3.4", 14, 0x02ae, zeros),
        // Kinect for Windows, its audio part in each of its states elsewhere.
        ("4.1", 15, 0x02bf, zeros),
        ("4.2", 16, 0x02be, Some("W1")),
        ("4.3", 17, 0x02c2, None),
        // A mouse of the same maker.
        ("5", 18, 0x00cb, Some("M1")),
    ] {
        tree.plug(Plug {
            ports,
            address,
            product,
            serial,
            release: 0x010e,
            ..CAMERA_1414
        });
    }
    tree.plug(SENSOR_2).plug(Plug {
        ports: "2.1",
        address: 5,
        product: 0x02c4,
        serial: Some("501"),
        ..SENSOR_2
    });
    let kinects = tree.kinects();
    let found: Vec<_> = kinects
        .iter()
        .map(|k| {
            (
                k.model,
                k.serial.as_deref().unwrap(),
                k.camera.port.as_str(),
            )
        })
        .collect();
    assert_eq!(
        found,
        [
            (Model::Xbox1414, "A00361A00000001A", "1-1.1"),
            (Model::Xbox1473, "B1", "1-2.1"),
            (Model::Xbox1473, "B2", "1-3.4"),
            (Model::Windows1517, "W1", "1-4.1"),
            (Model::Kinect2Retail, "018000000047", "2-1.1"),
            (Model::Kinect2Early, "501", "2-2.1"),
        ]
    );
    let camera = &kinects[0].camera;
    assert_eq!(camera.node(), "/dev/bus/usb/001/004");
    assert_eq!(camera.speed_mbps, Some(480.0));
    let controller = camera.controller.as_ref().unwrap();
    assert_eq!(controller.address, "0000:00:14.0");
    assert_eq!(controller.driver.as_deref(), Some("xhci_hcd"));
    assert_eq!(controller.vendor, Some(INTEL));
}

#[test]
fn a_healthy_machine_has_nothing_to_complain_of() {
    let tree = Tree::healthy();
    tree.plug(CAMERA_1414).plug(SENSOR_2);
    let complaints: Vec<_> = tree
        .findings()
        .into_iter()
        .filter(|f| f.level != Level::Ok && f.check != Check::Disk)
        .collect();
    let missing = [cfg!(feature = "kinect1"), cfg!(feature = "kinect2")];
    let n_missing = missing.iter().filter(|built| !**built).count();
    assert_eq!(complaints.len(), n_missing, "{complaints:?}");
    for complaint in complaints {
        assert_eq!(complaint.check, Check::Driver);
        assert!(complaint.mend.unwrap().contains("--features kinect"));
    }
}

#[test]
fn each_thing_in_the_way_is_found_with_what_mends_it() {
    use Level::{Error, Warning};

    assert_complaint(
        &Tree::healthy(),
        Check::Devices,
        Warning,
        "no Kinect is plugged in",
        "power supply",
    );

    let tree = Tree::healthy();
    tree.plug(CAMERA_1414);
    fs::remove_file(tree.path("dev/bus/usb/001/004")).unwrap();
    let node = "/dev/bus/usb/001/004 is not there";
    assert_complaint(&tree, Check::Permissions, Error, node, "plug it in again");

    let tree = Tree::healthy();
    tree.plug(CAMERA_1414);
    let rules = tree.path("etc/udev/rules.d/70-relief-kinect.rules");
    fs::write(&rules, "# mine").unwrap();
    let altered = "is not the one shipped";
    assert_complaint(&tree, Check::UdevRules, Warning, altered, "--print-rules");
    fs::remove_file(&rules).unwrap();
    let missing = "is not installed";
    assert_complaint(&tree, Check::UdevRules, Warning, missing, "sudo tee");
    tree.write("usr/lib/udev/rules.d/70-relief-kinect.rules", UDEV_RULES);
    assert_eq!(tree.complaints(Check::UdevRules), []);
    tree.write("etc/group", "root:x:0:\n");
    let group = "which does not exist";
    assert_complaint(&tree, Check::UdevRules, Error, group, "systemd-sysusers");

    let tree = Tree::healthy();
    tree.plug(CAMERA_1414).hold("1-1.1", "gspca_kinect");
    let driver = "the kernel's gspca_kinect holds the camera";
    let blacklist = "sudo modprobe -r gspca_kinect";
    assert_complaint(&tree, Check::KernelDriver, Warning, driver, blacklist);

    let tree = Tree::healthy();
    tree.plug(CAMERA_1414).hold("1-1.1", "usbfs");
    let program = "a program has opened the device";
    let which = "fuser -v /dev/bus/usb/001/004";
    assert_complaint(&tree, Check::KernelDriver, Warning, program, which);
    if cfg!(feature = "kinect1") {
        assert_eq!(tree.kinects()[0].obstacle, Some(Obstacle::InUse));
    }
}

#[test]
fn parts_without_their_camera_lack_power() {
    let tree = Tree::healthy();
    tree.plug(Plug {
        product: 0x02b0,
        serial: None,
        ..CAMERA_1414
    });
    let what = "without its camera";
    assert_complaint(&tree, Check::Devices, Level::Error, what, "power supply");

    let tree = Tree::healthy();
    tree.plug(Plug {
        product: 0x02d9,
        ports: "1",
        serial: None,
        ..SENSOR_2
    });
    let what = "without its sensor";
    assert_complaint(&tree, Check::Devices, Level::Error, what, "power supply");
}

#[test]
fn ports_that_cannot_carry_a_kinect_are_told_of() {
    use Level::{Error, Warning};

    let tree = Tree::healthy();
    tree.plug(Plug {
        speed: "480",
        bus: 1,
        ..SENSOR_2
    });
    let slow = "runs at 480 Mbit/s and needs 5000";
    assert_complaint(&tree, Check::UsbPort, Error, slow, "USB 3 port");

    let tree = Tree::healthy();
    tree.plug(Plug {
        speed: "12",
        ..CAMERA_1414
    });
    let slow = "runs at 12 Mbit/s and needs 480";
    assert_complaint(&tree, Check::UsbPort, Error, slow, "USB 2 or 3");

    let tree = Tree::healthy();
    tree.controller(2, "0000:03:00.0", ASMEDIA);
    tree.plug(SENSOR_2);
    let maker = "0000:03:00.0 is of ASMedia";
    assert_complaint(&tree, Check::UsbPort, Warning, maker, "Intel or Renesas");

    let second = Plug {
        ports: "2.1",
        address: 9,
        serial: Some("2"),
        ..SENSOR_2
    };
    let tree = Tree::healthy();
    tree.plug(SENSOR_2).plug(second);
    let shared = "shares its controller";
    assert_complaint(&tree, Check::UsbPort, Warning, shared, "another controller");
    let tree = Tree::healthy();
    tree.controller(4, "0000:05:00.0", INTEL);
    tree.plug(SENSOR_2).plug(Plug { bus: 4, ..second });
    assert_eq!(tree.complaints(Check::UsbPort), []);

    let tree = Tree::healthy();
    tree.plug(CAMERA_1414).plug(Plug {
        ports: "4.1",
        address: 8,
        serial: Some("A2"),
        ..CAMERA_1414
    });
    let shared = "shares its bus";
    assert_complaint(&tree, Check::UsbPort, Warning, shared, "another controller");
}

/// libfreenect2 keeps 60 · 8 · 33 792 bytes in flight for a device, 15.5 MiB, libfreenect 0.9 MiB; and a tenth.
#[test]
fn memory_for_transfers_is_reckoned_from_what_is_plugged_in() {
    let tree = Tree::healthy();
    tree.plug(CAMERA_1414);
    tree.memory(16);
    assert_eq!(tree.complaints(Check::UsbMemory), []);
    tree.plug(SENSOR_2);
    let need = "is 16, 19 MiB are needed";
    assert_complaint(&tree, Check::UsbMemory, Level::Error, need, "echo 64 |");
    tree.plug(Plug {
        ports: "2.1",
        address: 9,
        serial: Some("2"),
        ..SENSOR_2
    });
    let need = "is 16, 36 MiB are needed";
    assert_complaint(&tree, Check::UsbMemory, Level::Error, need, "echo 128 |");
    tree.memory(64);
    let need = "leaves little for other devices";
    assert_complaint(&tree, Check::UsbMemory, Level::Warning, need, "echo 128 |");
    for enough in [128, 0] {
        tree.memory(enough);
        assert_eq!(tree.complaints(Check::UsbMemory), []);
    }
}

fn object(output: &Output) -> Value {
    serde_json::from_slice(&output.stdout).unwrap()
}

#[test]
fn the_program_lists_and_examines_and_its_exit_code_tells() {
    let tree = Tree::healthy();
    tree.plug(CAMERA_1414);
    let listed = tree.relief(&["devices", "--json"]);
    assert_says(&listed, 0, &[]);
    let device = &object(&listed)["devices"][0];
    assert_eq!(device["serial"], "A00361A00000001A");
    assert_eq!(device["model"], "1414");
    assert_eq!(device["release"], "1.0b");
    assert_eq!(device["node"], "/dev/bus/usb/001/004");
    assert_eq!(device["usable"], cfg!(feature = "kinect1"));
    let text = String::from_utf8(tree.relief(&["devices"]).stdout).unwrap();
    assert!(
        text.contains("A00361A00000001A  Kinect for Xbox 360, 1414"),
        "{text}"
    );

    // Without its driver the device is an error by itself.
    let code = if cfg!(feature = "kinect1") { 0 } else { 1 };
    let calibrations = tree.path("calibration");
    let calibration = calibrations.join("A00361A00000001A.toml");
    let doctor = ["doctor", "--json", "--calibration-dir"];
    let doctor = [doctor.as_slice(), &[calibrations.to_str().unwrap()]].concat();
    let missing = tree.relief(&doctor);
    assert_says(&missing, 2, &["--calibration-dir: ", "is no folder"]);
    fs::create_dir(&calibrations).unwrap();
    let examined = tree.relief(&doctor);
    assert_eq!(examined.status.code(), Some(code));
    let of_calibration = |output: &Output| {
        let findings = object(output)["findings"].as_array().unwrap().clone();
        let found = findings.into_iter().find(|f| f["check"] == "calibration");
        found.unwrap()["level"].clone()
    };
    assert_eq!(of_calibration(&examined), "warning");
    tree.write("calibration/A00361A00000001A.toml", "version = 1");
    assert!(calibration.exists());
    assert_eq!(of_calibration(&tree.relief(&doctor)), "ok");

    tree.plug(Plug {
        speed: "480",
        bus: 1,
        address: 9,
        ..SENSOR_2
    });
    let examined = tree.relief(&["doctor"]);
    assert_eq!(examined.status.code(), Some(1));
    let text = String::from_utf8(examined.stdout).unwrap();
    assert!(
        text.contains("ERROR    018000000047: it runs at 480 Mbit/s"),
        "{text}"
    );
    assert!(text.contains("→ plug it into a USB 3 port"), "{text}");
    let rules = Command::new(PROGRAM)
        .args(["doctor", "--print-rules"])
        .output();
    assert_eq!(rules.unwrap().stdout, UDEV_RULES.as_bytes());
}

#[test]
fn the_disk_is_looked_at_where_scans_are_written() {
    let tree = Tree::healthy();
    let examined = Command::new(PROGRAM)
        .args(["doctor", "--json", "--root"])
        .arg(tree.root.path())
        .env_remove("STATE_DIRECTORY")
        .env("XDG_STATE_HOME", tree.path("state"))
        .output()
        .unwrap();
    let findings = object(&examined)["findings"].clone();
    let mut findings = findings.as_array().unwrap().iter();
    let disk = findings.find(|f| f["check"] == "disk").unwrap();
    let says = disk["says"].as_str().unwrap();
    let expected = tree.path("state/relief").display().to_string();
    assert!(says.ends_with(&expected), "{says}");
}

/// The program as a user who is nobody, where this one may become him.
#[test]
fn a_device_that_may_not_be_opened_is_an_error() {
    let tree = Tree::healthy();
    tree.plug(CAMERA_1414);
    use std::os::unix::fs::PermissionsExt;
    let close = |name: &str, mode: u32| {
        fs::set_permissions(tree.path(name), fs::Permissions::from_mode(mode)).unwrap();
    };
    close("", 0o755);
    close("dev/bus/usb/001/004", 0o600);
    let nobody = ["--reuid=65534", "--regid=65534", "--clear-groups"];
    let can_run = Command::new("setpriv")
        .args(nobody)
        .args([PROGRAM, "--version"])
        .output();
    if !can_run.is_ok_and(|output| output.status.success()) {
        eprintln!("skipped: needs setpriv, and the right to become another user");
        return;
    }
    let root = tree.root.path().to_str().unwrap();
    let examined = Command::new("setpriv")
        .args(nobody)
        .args([PROGRAM, "doctor", "--json", "--root", root])
        .output()
        .unwrap();
    assert_eq!(examined.status.code(), Some(1));
    let findings = object(&examined)["findings"].clone();
    let findings = findings.as_array().unwrap();
    let denied = findings.iter().find(|f| f["check"] == "permissions");
    let denied = denied.unwrap();
    assert_eq!(denied["level"], "error", "{denied}");
    assert!(
        denied["mend"]
            .as_str()
            .unwrap()
            .contains("usermod -aG relief")
    );
}

/// A device that comes, is used, and goes, as whoever watches is told.
#[test]
fn devices_that_come_and_go_are_told_of() {
    let tree = Tree::healthy();
    tree.plug(CAMERA_1414);
    let root = tree.root.path().to_str().unwrap();
    let mut watching = Command::new(PROGRAM)
        .args(["devices", "--watch", "--json", "--root", root])
        .stdout(Stdio::piped())
        .spawn()
        .unwrap();
    let told = BufReader::new(watching.stdout.take().unwrap());
    let mut told = told.lines().map(|line| -> (String, String) {
        let change: Value = serde_json::from_str(&line.unwrap()).unwrap();
        let text = |value: &Value| value.as_str().unwrap_or_default().to_owned();
        (text(&change["event"]), text(&change["device"]["serial"]))
    });
    // A device whose files are being written may be told of more than once.
    let mut expect = |event: &str, serial: Option<&str>| {
        let change = (event.to_owned(), serial.unwrap().to_owned());
        assert!(told.any(|other| other == change), "{change:?}");
    };
    expect("added", CAMERA_1414.serial);
    tree.plug(SENSOR_2);
    expect("added", SENSOR_2.serial);
    tree.hold("1-1.1", "usbfs");
    if cfg!(feature = "kinect1") {
        expect("changed", CAMERA_1414.serial);
    }
    fs::remove_dir_all(tree.path("sys/bus/usb/devices/1-1.1")).unwrap();
    expect("removed", CAMERA_1414.serial);
    let id = watching.id().to_string();
    assert!(
        Command::new("kill")
            .args(["-INT", &id])
            .status()
            .unwrap()
            .success()
    );
    assert!(watching.wait().unwrap().success());
    assert_eq!(told.next(), None);
}

/// The real program on devices that umockdev puts into the real `/sys`.
#[test]
fn mocked_devices_are_listed() {
    let mocked = Command::new("umockdev-run").arg("--version").output();
    if !mocked.is_ok_and(|output| output.status.success()) {
        eprintln!("skipped: needs umockdev");
        return;
    }
    let folder = tempfile::tempdir().unwrap();
    let devices = [
        ("1-1", 2, "045e", "02ae", "A7", "480"),
        ("2-1", 2, "045e", "02c4", "K7", "5000"),
        ("3-1", 2, "1234", "02ae", "X7", "480"),
    ];
    let describe = |(port, address, vendor, product, serial, speed): (&str, u32, _, _, _, _)| {
        let bus = &port[..1];
        format!(
            "P: /devices/pci0000:00/0000:00:14.0/usb{bus}/{port}\nN: bus/usb/00{bus}/00{address}\nE: DEVTYPE=usb_device\n\
             E: SUBSYSTEM=usb\nA: idVendor={vendor}\\n\nA: idProduct={product}\\n\nA: bcdDevice=010b\\n\n\
             A: serial={serial}\\n\nA: busnum={bus}\\n\nA: devnum={address}\\n\nA: speed={speed}\\n\n\n"
        )
    };
    let description: String = devices.map(describe).concat();
    let path = folder.path().join("kinects.umockdev");
    fs::write(&path, description).unwrap();
    let output = Command::new("umockdev-run")
        .args([Path::new("--device"), &path])
        .args(["--", PROGRAM, "devices", "--json"])
        .output()
        .unwrap();
    assert_says(&output, 0, &[]);
    let devices = object(&output)["devices"].clone();
    let serials: Vec<_> = devices
        .as_array()
        .unwrap()
        .iter()
        .map(|device| device["serial"].as_str().unwrap())
        .collect();
    assert_eq!(serials, ["A7", "K7"], "{devices}");
}
