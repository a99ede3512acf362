//! What the program itself brings along, and where it writes.

use super::{Check, Finding, Level};
use crate::devices::{
    Kinect,
    kinects::{is_built, library},
};
use depth_camera::Sensor;
use std::path::Path;

/// Raw packets of a Kinect II fill 90 MB a second: this is two minutes of them.
const SPACE_FOR_A_SCAN_BYTES: u64 = 10 << 30;

/// With less, meshes and reports may not fit.
const SPACE_FOR_MESHES_BYTES: u64 = 1 << 30;

/// Whether the program was built with the drivers; one that is missing is an error where its device is plugged in.
pub(super) fn drivers(kinects: &[Kinect]) -> Vec<Finding> {
    let of_sensor = |sensor: Sensor| {
        let (feature, library) = (sensor.name(), library(sensor));
        if is_built(sensor) {
            return Finding::ok(Check::Driver, format!("{feature}: built with {library}"));
        }
        let is_needed = kinects.iter().any(|kinect| kinect.model.sensor() == sensor);
        Finding {
            level: match is_needed {
                true => Level::Error,
                false => Level::Ok,
            },
            ..Finding::error(
                Check::Driver,
                format!("{feature}: this program was built without {library}"),
                how_to_build(sensor),
            )
        }
    };
    [Sensor::Kinect1, Sensor::Kinect2].map(of_sensor).into()
}

/// The commands that build the program with a sensor's driver.
pub(crate) fn how_to_build(sensor: Sensor) -> &'static str {
    match sensor {
        Sensor::Kinect1 => {
            "sudo apt-get install libfreenect-dev && cargo build --release --features kinect1"
        }
        Sensor::Kinect2 => {
            "install libfreenect2 as docs/devices.md says, then cargo build --release --features kinect2"
        }
    }
}

/// Whether there is space for a scan.
pub(super) fn disk(data: &Path) -> Finding {
    let check = Check::Disk;
    // A folder that is yet to be made lies where the first one above it does.
    let existing = data.ancestors().find(|folder| folder.is_dir());
    let existing = existing.unwrap_or(Path::new("."));
    let place = data.display();
    let free = match rustix::fs::statvfs(existing) {
        Ok(disk) => disk.f_bavail.saturating_mul(disk.f_frsize),
        Err(error) => {
            return Finding::warning(
                check,
                format!("the space at {place} is not known: {error}"),
                "name another folder by --data",
            );
        }
    };
    let says = format!(
        "{:.1} GiB are free at {place}",
        free as f64 / f64::from(1 << 30)
    );
    let mend = "remove old scans, or name a folder on another disk by --data";
    match free {
        SPACE_FOR_A_SCAN_BYTES.. => Finding::ok(check, says),
        SPACE_FOR_MESHES_BYTES.. => Finding::warning(check, says, mend),
        _ => Finding::error(check, says, mend),
    }
}
