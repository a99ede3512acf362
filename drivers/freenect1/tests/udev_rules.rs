//! What the shipped udev rules make of a Kinect, by the system's own `udevadm test` over mocked devices.
//!
//! Rules, group file and devices are put in place in a mount namespace of its own: nothing of the machine is changed.
//! `udevadm test` succeeds for a broken rule as well, so its output is read.
#![allow(clippy::unwrap_used, reason = "a test may fail anywhere")]

use std::{fs, path::Path, process::Command};

/// Every product of Microsoft's that is part of a Kinect.
const KINECT_IDS: [&str; 11] = [
    "02ae", "02b0", "02ad", "02bf", "02be", "02bb", "02c3", "02c2", "02c4", "02d8", "02d9",
];

const KINECT_2_IDS: [&str; 3] = ["02c4", "02d8", "02d9"];

/// Needs root in a namespace: an empty `/run` with our rules, and the groups that our sysusers file makes.
const IN_NAMESPACE: &str = r#"
set -e
mkdir -p "$WORK/etc"
systemd-sysusers --root="$WORK" - <"$UDEV/relief.sysusers"
mount --bind "$WORK/etc/group" /etc/group
mount -t tmpfs none /run
mkdir -p /run/udev/rules.d
cp "$UDEV/70-relief-kinect.rules" /run/udev/rules.d/
for id in $IDS; do
    # Tags stick to a device, and all of these are one device to udev.
    rm -rf /run/udev/data /run/udev/tags
    echo "@@ begins: $id"
    umockdev-run --device "$WORK/$id.umockdev" -- udevadm test --action=add /sys/devices/usb1/1-1 2>&1
done
"#;

fn describe(vendor: &str, product: &str) -> String {
    format!(
        "P: /devices/usb1/1-1\nN: bus/usb/001/002\nE: DEVNAME=/dev/bus/usb/001/002\nE: DEVTYPE=usb_device\n\
         E: SUBSYSTEM=usb\nA: idVendor={vendor}\\n\nA: idProduct={product}\\n\nA: power/control=auto\\n\n"
    )
}

fn is_here(program: &str, arguments: &[&str]) -> bool {
    let output = Command::new(program).args(arguments).output();
    output.is_ok_and(|output| output.status.success())
}

#[test]
fn every_kinect_belongs_to_the_group_and_to_whoever_sits_there() {
    let can_run = is_here("unshare", &["-rm", "mount", "-t", "tmpfs", "none", "/run"])
        && is_here("umockdev-run", &["--version"])
        && is_here("udevadm", &["--version"])
        && is_here("systemd-sysusers", &["--version"]);
    if !can_run {
        eprintln!(
            "skipped: needs umockdev, udev, systemd-sysusers and the right to a mount namespace"
        );
        return;
    }
    let work = tempfile::tempdir().unwrap();
    for product in KINECT_IDS {
        let path = work.path().join(format!("{product}.umockdev"));
        fs::write(path, describe("045e", product)).unwrap();
    }
    // A keyboard of Microsoft's, and another maker's device with a Kinect's number.
    for (name, vendor, product) in [("keyboard", "045e", "00db"), ("stranger", "1234", "02ae")] {
        let path = work.path().join(format!("{name}.umockdev"));
        fs::write(path, describe(vendor, product)).unwrap();
    }
    let ids = [KINECT_IDS.as_slice(), &["keyboard", "stranger"]].concat();
    let output = Command::new("unshare")
        .args(["-rm", "sh", "-c", IN_NAMESPACE])
        .env("WORK", work.path())
        .env(
            "UDEV",
            Path::new(env!("CARGO_MANIFEST_DIR")).join("../../udev"),
        )
        .env("IDS", ids.join(" "))
        .output()
        .unwrap();
    let text = String::from_utf8_lossy(&output.stdout).into_owned();
    assert!(
        output.status.success(),
        "{text}{}",
        String::from_utf8_lossy(&output.stderr)
    );
    let groups = fs::read_to_string(work.path().join("etc/group")).unwrap();
    let group = groups
        .lines()
        .find(|line| line.starts_with("relief:"))
        .unwrap();
    let gid = group.split(':').nth(2).unwrap();

    let sections: Vec<&str> = text.split("@@ begins: ").skip(1).collect();
    assert_eq!(sections.len(), ids.len());
    for (section, id) in sections.into_iter().zip(ids) {
        let ours: Vec<&str> = section
            .lines()
            .filter(|line| line.contains("70-relief-kinect.rules:"))
            .collect();
        let is_kinect = KINECT_IDS.contains(&id);
        let says = |what: &str| ours.iter().filter(|line| line.ends_with(what)).count();
        assert_eq!(says("MODE 0660"), usize::from(is_kinect), "{id}: {section}");
        assert_eq!(
            says(&format!("GROUP {gid}")),
            usize::from(is_kinect),
            "{id}: {section}"
        );
        let n_awake = ours
            .iter()
            .filter(|line| line.contains("power/control"))
            .count();
        assert_eq!(
            n_awake,
            usize::from(KINECT_2_IDS.contains(&id)),
            "{id}: {section}"
        );
        // Whatever else is said of the file is a complaint.
        let n_expected = if is_kinect { 2 + n_awake } else { 0 };
        assert_eq!(ours.len(), n_expected, "{id}: {ours:?}");
        let tags = section.lines().find(|line| line.starts_with("TAGS="));
        let for_the_seat = tags.is_some_and(|tags| tags.contains(":uaccess:"));
        assert_eq!(for_the_seat, is_kinect, "{id}: {section}");
    }
}
