//! Which calibration of the IR image belongs to a device.

use super::{
    CalibrationKey, ConfigError, DeviceCalibration, KeyOrigin, KeyOrigins, calibration_path,
};
use crate::capture::IrOffset;
use crate::shading::Calibration;
use depth_camera::{CameraInfo, Sensor};
use std::{
    fmt, fs,
    path::{Path, PathBuf},
};

/// Where a calibration may be found, the most binding first; the last resort is the one shipped.
#[derive(Clone, Copy, Debug)]
pub struct CalibrationPlaces<'a> {
    /// The file that the operator names.
    pub given: Option<&'a Path>,
    /// The folder of the files named by serial number.
    pub folder: &'a Path,
    /// The recording, a folder or a file in one: that folder may hold the calibration that it was made with.
    pub session: Option<&'a Path>,
}

/// A calibration with what is known of it.
#[derive(Clone, Debug, PartialEq)]
pub struct FoundCalibration {
    /// What the stages are told.
    pub calibration: Calibration,
    /// Where it was found.
    pub source: CalibrationSource,
    /// Where each key comes from.
    pub origins: KeyOrigins,
    /// The serial number in the file, if it states one.
    serial: Option<String>,
}

/// Where a calibration comes from.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum CalibrationSource {
    /// A file.
    File(PathBuf),
    /// The one shipped for every sensor of the kind, read by that driver where it is known.
    Shipped(Sensor, Option<String>),
}

impl fmt::Display for CalibrationSource {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            CalibrationSource::File(path) => write!(f, "{}", path.display()),
            CalibrationSource::Shipped(sensor, None) => {
                write!(f, "the one shipped for every {}", sensor.name())
            }
            CalibrationSource::Shipped(sensor, Some(driver)) => {
                write!(
                    f,
                    "the one shipped for every {} read by {driver}",
                    sensor.name()
                )
            }
        }
    }
}

/// The calibration of a device: the file given, else `<serial>.toml` in the folder of calibrations, else `calibration.toml`
/// in the session's folder, else the shipped one. A file is either a device's own or a complete [`Calibration`].
///
/// # Errors
/// For a file that cannot be read or parsed, for a value beyond its bound, for the file of another kind of sensor, and for
/// one named by this serial number that states another.
pub fn find_calibration(
    info: &CameraInfo,
    places: &CalibrationPlaces,
) -> Result<FoundCalibration, ConfigError> {
    if let Some(path) = places.given {
        return read(path, info);
    }
    let of_serial = calibration_path(places.folder, &info.serial).ok();
    if let Some(path) = of_serial.filter(|path| path.exists()) {
        return read(&path, info).and_then(|found| found.of_serial(&path, &info.serial));
    }
    let of_session = places
        .session
        .map(|session| session_folder(session).join(Calibration::FILE_NAME));
    if let Some(path) = of_session.filter(|path| path.exists()) {
        return read(&path, info);
    }
    let nothing = DeviceCalibration::new(info.serial.clone(), info.sensor);
    over_shipped(&nothing, info, shipped_source(info))
}

/// The folder that a session lies in: its own, or that of its file.
pub fn session_folder(session: &Path) -> &Path {
    match (session.is_file(), session.parent()) {
        (true, Some(folder)) => folder,
        _ => session,
    }
}

fn shipped_source(info: &CameraInfo) -> CalibrationSource {
    CalibrationSource::Shipped(info.sensor, info.driver.clone())
}

fn read(path: &Path, info: &CameraInfo) -> Result<FoundCalibration, ConfigError> {
    let in_file = |what: String| ConfigError::in_file(path, what);
    let text = fs::read_to_string(path).map_err(|error| in_file(error.to_string()))?;
    let table: toml::Table = toml::from_str(&text).map_err(|error| in_file(error.to_string()))?;
    let source = CalibrationSource::File(path.to_owned());
    if table.contains_key("version") {
        let device = DeviceCalibration::from_toml(&text).map_err(in_file)?;
        if device.sensor != info.sensor {
            return Err(in_file(format!(
                "sensor is \"{}\", must be \"{}\"",
                device.sensor.name(),
                info.sensor.name()
            )));
        }
        return over_shipped(&device, info, source);
    }
    let calibration = Calibration::from_toml(&text).map_err(in_file)?;
    let position = match calibration.light.position_m {
        Some(_) => KeyOrigin::File(None),
        None => KeyOrigin::Stated,
    };
    let mut origins: KeyOrigins = CalibrationKey::ALL
        .map(|key| (key, KeyOrigin::File(None)))
        .into();
    origins.insert(CalibrationKey::LightPosition, position);
    if calibration.light.white_level.is_none() {
        origins.insert(CalibrationKey::LightWhiteLevel, KeyOrigin::Estimated);
    }
    if calibration.range_error_m.is_none() {
        origins.insert(CalibrationKey::RangeError, KeyOrigin::Estimated);
    }
    Ok(FoundCalibration {
        calibration,
        source,
        origins,
        serial: None,
    })
}

fn over_shipped(
    device: &DeviceCalibration,
    info: &CameraInfo,
    source: CalibrationSource,
) -> Result<FoundCalibration, ConfigError> {
    let shipped = Calibration::shipped_for(info).map_err(|what| ConfigError {
        origin: shipped_source(info).to_string(),
        what,
    })?;
    let (calibration, origins) = device.over(shipped);
    Ok(FoundCalibration {
        calibration,
        source,
        origins,
        serial: Some(device.serial.clone()),
    })
}

/// Refuses a file that is named by one serial number and states another.
pub(super) fn check_serial(path: &Path, stated: &str, serial: &str) -> Result<(), ConfigError> {
    match stated == serial {
        true => Ok(()),
        false => Err(ConfigError::in_file(
            path,
            format!("serial is \"{stated}\", must be \"{serial}\""),
        )),
    }
}

impl FoundCalibration {
    fn of_serial(self, path: &Path, serial: &str) -> Result<Self, ConfigError> {
        if let Some(stated) = &self.serial {
            check_serial(path, stated, serial)?;
        }
        Ok(self)
    }

    /// Logs which calibration is used, and returns what the operator should know of it.
    pub fn announce(&self, info: &CameraInfo) -> Vec<String> {
        // Without IR there is nothing to calibrate.
        if info.ir_full_scale.is_none() {
            return Vec::new();
        }
        let is_asked = |key: CalibrationKey| {
            key != CalibrationKey::RangeError || info.sensor == Sensor::Kinect2
        };
        let origins = self.origins.iter();
        let origins: Vec<_> = origins
            .filter(|(key, _)| is_asked(**key))
            .map(|(key, origin)| format!("{key}: {origin}"))
            .collect();
        tracing::info!(file = %self.source, keys = origins.join(", "), "calibration");
        let warnings = self.warnings(info);
        for warning in &warnings {
            tracing::warn!("{warning}");
        }
        warnings
    }

    /// Says whose it is, if that is another device.
    pub fn of_another(&self, info: &CameraInfo) -> Option<String> {
        let stranger = self.serial.as_ref();
        let stranger = stranger.filter(|serial| **serial != info.serial)?;
        Some(format!(
            "{} is the calibration of the device {stranger}, this one is {}",
            self.source, info.serial
        ))
    }

    /// Says which keys of it a scan that was fused by another calibration no longer takes: infrared images were moved, and depth was
    /// corrected, before it was fused.
    pub fn comes_too_late(&self, as_fused: &Calibration) -> Option<String> {
        let offset = |calibration: &Calibration| IrOffset::nearest(calibration.ir_offset_px);
        let keys = [
            (
                CalibrationKey::IrOffset,
                offset(&self.calibration) != offset(as_fused),
            ),
            (
                CalibrationKey::RangeError,
                self.calibration.range_error_m != as_fused.range_error_m,
            ),
        ];
        let differing = keys.iter().filter(|(_, differs)| *differs);
        let names: Vec<&str> = differing.map(|(key, _)| key.name()).collect();
        (!names.is_empty()).then(|| {
            format!(
                "{} has another {} than this scan was fused with, which is not put right by refining it: fuse its recording again",
                self.source,
                names.join(" and another ")
            )
        })
    }

    /// What the operator should know before trusting it.
    pub fn warnings(&self, info: &CameraInfo) -> Vec<String> {
        let kind = info.sensor.name();
        let path = match &self.source {
            CalibrationSource::File(path) => path.display(),
            CalibrationSource::Shipped(..) => {
                return vec![format!(
                    "no calibration of the device {} is known, the one shipped for every {kind} is used",
                    info.serial
                )];
            }
        };
        let mut warnings: Vec<String> = self.of_another(info).into_iter().collect();
        let shipped = self.origins.iter();
        let shipped = shipped.filter(|(_, origin)| **origin == KeyOrigin::Shipped);
        let shipped: Vec<&str> = shipped.map(|(key, _)| key.name()).collect();
        if !shipped.is_empty() {
            warnings.push(format!(
                "{path} does not have {}: what is shipped for every {kind} is used",
                shipped.join(", ")
            ));
        }
        warnings
    }
}

#[cfg(test)]
mod tests;
