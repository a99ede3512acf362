//! Measurements into a device's file, key by key, and never over an older one unasked.

use super::{CalibrationKey, ConfigError, DeviceCalibration};
use crate::{atomic_file::write_atomically, shading::Calibration};
use rustix::fs::Access;
use std::{
    fs::{self, OpenOptions},
    io::{self, Write},
    path::{Component, Path, PathBuf},
};

/// The first lines of a file.
const HEADER: &str = "# Calibration of one device, measured by `relief calibrate`; keys that are not here are those shipped \
for the\n# kind of sensor. Comments are not kept when the next measurement is written.\n";

/// What became of a device's file.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct MergeReport {
    /// Keys that the file did not have.
    pub added: Vec<CalibrationKey>,
    /// Keys that the file had.
    pub replaced: Vec<CalibrationKey>,
    /// Where the file as it was is kept, if a value in it was replaced or converted.
    pub kept: Option<PathBuf>,
}

/// Why a measurement cannot be written; nothing was changed then.
#[derive(Debug, thiserror::Error)]
pub enum MergeError {
    /// The file, or what would be written, makes no sense, or is not to be changed.
    #[error(transparent)]
    Refused(#[from] ConfigError),
    /// The system does not take the file.
    #[error("cannot write {}: {cause}", path.display())]
    Write {
        /// The file or folder.
        path: PathBuf,
        /// What the system said.
        cause: io::Error,
    },
}

impl MergeError {
    fn write(path: &Path) -> impl Fn(io::Error) -> Self + '_ {
        move |cause| MergeError::Write {
            path: path.to_owned(),
            cause,
        }
    }
}

/// The file of a device in the folder of calibrations.
///
/// # Errors
/// For a serial number that is no plain file name.
pub fn calibration_path(folder: &Path, serial: &str) -> Result<PathBuf, ConfigError> {
    let mut parts = Path::new(serial).components();
    match (parts.next(), parts.next()) {
        (Some(Component::Normal(part)), None) if part == serial => {
            Ok(folder.join(format!("{serial}.toml")))
        }
        _ => Err(ConfigError {
            origin: "serial".to_owned(),
            what: format!("\"{serial}\" must be a plain file name to have a calibration file"),
        }),
    }
}

/// Adds what was measured to a device's file, which is created with its folder if it is missing. Other keys of the file stay
/// as they are, with their measurements; but a white level is converted to the intensity of a new gamma. Where the file says
/// nothing `shipped` holds.
///
/// A key that the file has is refused unless `replace` says otherwise; the old file is then kept beside it as
/// `<serial>.<n>.toml`, and so it is where a value was converted.
///
/// # Errors
/// For the file of another device, for a key that is there already, for a value that conversion takes beyond its bound, and for
/// files that cannot be read or written; nothing was changed then.
pub fn merge_into_file(
    path: &Path,
    new: &DeviceCalibration,
    shipped: &Calibration,
    replace: bool,
) -> Result<MergeReport, MergeError> {
    let in_file = |what: &dyn ToString| ConfigError::in_file(path, what.to_string());
    new.validate().map_err(|what| in_file(&what))?;
    let mut device = device_in(path, new)?;
    let (replaced, added): (Vec<_>, Vec<_>) = new.keys().partition(|key| device.holds(*key));
    if !replace && !replaced.is_empty() {
        let refused = replaced.iter().map(|key| refusal(*key, &device, new));
        return Err(in_file(&refused.collect::<Vec<_>>().join("; ")).into());
    }
    let converted = converted_white_level(&device, new, shipped);
    for key in new.keys() {
        device.take(key, new);
    }
    if converted.is_some() {
        device.light.white_level = converted;
        device.validate().map_err(|what| in_file(&what))?;
    }
    let text = toml::to_string(&device).map_err(|error| in_file(&error))?;
    let kept = match replaced.is_empty() && converted.is_none() {
        true => None,
        false => Some(keep(path).map_err(MergeError::write(path))?),
    };
    write(path, &text).map_err(MergeError::write(path))?;
    Ok(MergeReport {
        added,
        replaced,
        kept,
    })
}

/// Looks whether [`merge_into_file`] could write those keys of a device, of which nothing need be known yet.
///
/// # Errors
/// As of [`merge_into_file`].
pub fn check_merge(
    path: &Path,
    device: &DeviceCalibration,
    keys: &[CalibrationKey],
    replace: bool,
) -> Result<(), MergeError> {
    let old = device_in(path, device)?;
    if let Some(key) = keys.iter().find(|key| !replace && old.holds(**key)) {
        let there = already_there(*key, &old);
        let what = format!("{there}; say --replace to put a new value in its place");
        return Err(ConfigError::in_file(path, what).into());
    }
    rustix::fs::access(nearest_folder(path), Access::WRITE_OK | Access::EXEC_OK)
        .map_err(|error| MergeError::write(path)(error.into()))
}

/// The nearest of the folders that a file is to lie in, which may have to be made.
fn nearest_folder(path: &Path) -> &Path {
    let above = path.ancestors().skip(1).find(|above| above.exists());
    above.unwrap_or(Path::new("."))
}

/// What a device's file holds so far.
fn device_in(path: &Path, new: &DeviceCalibration) -> Result<DeviceCalibration, ConfigError> {
    let exists = path.try_exists();
    let device = match exists.map_err(|error| ConfigError::in_file(path, error))? {
        true => DeviceCalibration::read(path)?,
        false => DeviceCalibration::new(new.serial.clone(), new.sensor),
    };
    check_same_device(path, &device, new).map_err(|what| ConfigError::in_file(path, what))?;
    Ok(device)
}

fn check_same_device(
    path: &Path,
    old: &DeviceCalibration,
    new: &DeviceCalibration,
) -> Result<(), String> {
    if path.file_name() != Some(format!("{}.toml", new.serial).as_ref()) {
        return Err(format!("must be named {}.toml", new.serial));
    }
    if old.serial != new.serial {
        return Err(format!(
            "serial is \"{}\", must be \"{}\"",
            old.serial, new.serial
        ));
    }
    if old.sensor != new.sensor {
        return Err(format!(
            "sensor is \"{}\", must be \"{}\"",
            old.sensor.name(),
            new.sensor.name()
        ));
    }
    Ok(())
}

/// A device's white level in the intensity of a gamma that is measured after it; `None` where there is none to convert.
fn converted_white_level(
    device: &DeviceCalibration,
    new: &DeviceCalibration,
    shipped: &Calibration,
) -> Option<f64> {
    let gamma = new.gamma?;
    if device.light.white_level.is_none() || new.light.white_level.is_some() {
        return None;
    }
    let (in_force, _) = device.over(shipped.clone());
    in_force.with_gamma(gamma).light.white_level
}

fn refusal(key: CalibrationKey, old: &DeviceCalibration, new: &DeviceCalibration) -> String {
    format!(
        "{}; the new value is {}; say --replace to put it in its place",
        already_there(key, old),
        new.shown(key)
    )
}

fn already_there(key: CalibrationKey, old: &DeviceCalibration) -> String {
    let date = match old.measured.get(&key) {
        Some(measurement) => format!("measured {}", measurement.date),
        None => "set by hand".to_owned(),
    };
    format!("{key} is there already: {}, {date}", old.shown(key))
}

/// Copies the file to the first free `<serial>.<n>.toml` beside it.
fn keep(path: &Path) -> io::Result<PathBuf> {
    let old = fs::read(path)?;
    let mut number = 1_u32;
    loop {
        let kept = path.with_extension(format!("{number}.toml"));
        match OpenOptions::new().write(true).create_new(true).open(&kept) {
            Ok(mut file) => {
                file.write_all(&old)?;
                file.sync_all()?;
                return Ok(kept);
            }
            Err(error) if error.kind() == io::ErrorKind::AlreadyExists => number += 1,
            Err(error) => return Err(error),
        }
    }
}

fn write(path: &Path, text: &str) -> io::Result<()> {
    if let Some(folder) = path.parent() {
        fs::create_dir_all(folder)?;
    }
    write_atomically(path, |file| write!(file, "{HEADER}{text}"))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::{MeasuredLight, MeasuredSession, Measurement};
    use crate::geometry::RangeError;
    use depth_camera::Sensor;
    use std::{
        collections::BTreeMap,
        time::{Duration, SystemTime},
    };

    fn device() -> DeviceCalibration {
        DeviceCalibration::new("A1.2".to_owned(), Sensor::Kinect1)
    }

    fn shipped() -> Calibration {
        Calibration::shipped(Sensor::Kinect1).unwrap()
    }

    fn measurement() -> Measurement {
        let session = MeasuredSession {
            name: "sphere".to_owned(),
            content: "sha256:00".to_owned(),
        };
        let time = SystemTime::UNIX_EPOCH + Duration::from_secs(1_709_210_096);
        let figures = BTreeMap::from([("interval".to_owned(), 0.01)]);
        Measurement::new(time, vec![session], figures)
    }

    fn with_gamma(gamma: f64) -> DeviceCalibration {
        DeviceCalibration {
            gamma: Some(gamma),
            measured: BTreeMap::from([(CalibrationKey::Gamma, measurement())]),
            ..device()
        }
    }

    #[test]
    fn keys_are_added_and_others_left_alone() {
        let folder = tempfile::tempdir().unwrap();
        let path = calibration_path(&folder.path().join("new"), "A1.2").unwrap();
        merge_into_file(&path, &with_gamma(0.8), &shipped(), false).unwrap();
        let offset = DeviceCalibration {
            ir_offset_px: Some([5.0, 4.0]),
            ..device()
        };
        let report = merge_into_file(&path, &offset, &shipped(), false).unwrap();
        assert_eq!(report.added, [CalibrationKey::IrOffset]);
        assert_eq!((report.replaced, report.kept), (Vec::new(), None));
        let expected = DeviceCalibration {
            ir_offset_px: Some([5.0, 4.0]),
            ..with_gamma(0.8)
        };
        assert_eq!(DeviceCalibration::read(&path), Ok(expected));
    }

    #[test]
    fn an_error_by_range_goes_beside_a_white_level_and_back() {
        let folder = tempfile::tempdir().unwrap();
        let path = calibration_path(folder.path(), "A1.2").unwrap();
        let shipped = Calibration::shipped(Sensor::Kinect2).unwrap();
        let device = || DeviceCalibration::new("A1.2".to_owned(), Sensor::Kinect2);
        let with_error = |points| DeviceCalibration {
            range_error_m: Some(RangeError::through(points)),
            ..device()
        };
        let mut white = device();
        white.light.white_level = Some(0.2);
        merge_into_file(&path, &white, &shipped, false).unwrap();
        let error = with_error(vec![[0.5, 0.001], [1.0, -0.002]]);
        let report = merge_into_file(&path, &error, &shipped, false).unwrap();
        assert_eq!(report.added, [CalibrationKey::RangeError]);
        let mut both = error.clone();
        both.light.white_level = Some(0.2);
        assert_eq!(DeviceCalibration::read(&path), Ok(both));

        let other = with_error(vec![[0.5, 0.003]]);
        let refused = merge_into_file(&path, &other, &shipped, false).unwrap_err();
        let refused = refused.to_string();
        assert!(
            refused.contains("A1.2.toml: range_error_m is there already"),
            "{refused}"
        );
        let report = merge_into_file(&path, &other, &shipped, true).unwrap();
        assert_eq!(report.replaced, [CalibrationKey::RangeError]);
        let read = DeviceCalibration::read(&path).unwrap();
        assert_eq!(read.range_error_m, other.range_error_m);
    }

    #[test]
    fn a_key_is_replaced_only_when_asked_and_the_old_file_kept() {
        let folder = tempfile::tempdir().unwrap();
        let path = calibration_path(folder.path(), "A1.2").unwrap();
        merge_into_file(&path, &with_gamma(0.8), &shipped(), false).unwrap();
        let first = fs::read(&path).unwrap();
        let error = merge_into_file(&path, &with_gamma(0.9), &shipped(), false).unwrap_err();
        assert!(error.to_string().ends_with(
            "A1.2.toml: gamma is there already: 0.8, measured 2024-02-29T12:34:56Z; the new value is 0.9; say --replace to \
             put it in its place"
        ));
        assert_eq!(fs::read(&path).unwrap(), first);

        for (gamma, number) in [(0.9, 1), (1.0, 2)] {
            let report = merge_into_file(&path, &with_gamma(gamma), &shipped(), true).unwrap();
            let kept = folder.path().join(format!("A1.2.{number}.toml"));
            assert_eq!(report.kept, Some(kept.clone()));
            assert_eq!(report.replaced, [CalibrationKey::Gamma]);
        }
        assert_eq!(fs::read(folder.path().join("A1.2.1.toml")).unwrap(), first);
        assert_eq!(DeviceCalibration::read(&path), Ok(with_gamma(1.0)));
    }

    #[test]
    fn a_white_level_is_converted_to_a_gamma_that_is_measured_after_it() {
        let folder = tempfile::tempdir().unwrap();
        let path = calibration_path(folder.path(), "A1.2").unwrap();
        let white = DeviceCalibration {
            light: MeasuredLight {
                white_level: Some(0.25),
                ..MeasuredLight::default()
            },
            ..device()
        };
        merge_into_file(&path, &white, &shipped(), false).unwrap();
        let white_level = || DeviceCalibration::read(&path).unwrap().light.white_level;
        let is_near = |level: f64| (white_level().unwrap() - level).abs() < 1e-12;
        // The same counts: 0.25^0.8 = 0.0625^0.4.
        let gamma = shipped().gamma;
        let report = merge_into_file(&path, &with_gamma(0.5 * gamma), &shipped(), false).unwrap();
        assert_eq!(report.added, [CalibrationKey::Gamma]);
        assert_eq!(report.kept, Some(folder.path().join("A1.2.1.toml")));
        assert!(is_near(0.0625));
        // From now on the gamma in the file is in force.
        merge_into_file(&path, &with_gamma(gamma), &shipped(), true).unwrap();
        assert!(is_near(0.25));
    }

    #[test]
    fn what_could_not_be_written_is_known_beforehand() {
        let root = tempfile::tempdir().unwrap();
        let path = calibration_path(&root.path().join("a/b"), "A1.2").unwrap();
        let check =
            |path: &Path, replace| check_merge(path, &device(), &[CalibrationKey::Gamma], replace);
        check(&path, false).unwrap();
        assert!(!root.path().join("a").exists());
        merge_into_file(&path, &with_gamma(0.8), &shipped(), false).unwrap();
        let error = check(&path, false).unwrap_err();
        assert!(matches!(error, MergeError::Refused(_)), "{error}");
        let there = "gamma is there already: 0.8, measured 2024-02-29T12:34:56Z; say --replace";
        assert!(error.to_string().contains(there), "{error}");
        check(&path, true).unwrap();

        fs::write(root.path().join("file"), "").unwrap();
        let path = calibration_path(&root.path().join("file"), "A1.2").unwrap();
        let error = check(&path, false).unwrap_err();
        assert!(error.to_string().contains("Not a directory"), "{error}");
    }

    #[test]
    fn the_file_of_another_device_is_left_alone() {
        let folder = tempfile::tempdir().unwrap();
        let path = calibration_path(folder.path(), "A1.2").unwrap();
        merge_into_file(&path, &with_gamma(0.8), &shipped(), false).unwrap();
        let other = DeviceCalibration::new("A1.2".to_owned(), Sensor::Kinect2);
        let error = merge_into_file(&path, &other, &shipped(), true).unwrap_err();
        assert!(
            error
                .to_string()
                .ends_with(": sensor is \"kinect1\", must be \"kinect2\"")
        );
        let other = DeviceCalibration::new("B".to_owned(), Sensor::Kinect1);
        let error = merge_into_file(&path, &other, &shipped(), true).unwrap_err();
        assert!(error.to_string().ends_with(": must be named B.toml"));
        for serial in ["", "..", "a/b", "/a", "a/"] {
            assert!(calibration_path(folder.path(), serial).is_err(), "{serial}");
        }
    }

    #[test]
    fn values_beyond_their_bounds_are_not_written() {
        let folder = tempfile::tempdir().unwrap();
        let path = calibration_path(folder.path(), "A1.2").unwrap();
        let error = merge_into_file(&path, &with_gamma(7.0), &shipped(), false).unwrap_err();
        assert!(
            error
                .to_string()
                .ends_with(": gamma is 7, must be 0.2 to 3")
        );
        assert!(!path.exists());
    }
}
