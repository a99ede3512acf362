//! Which calibration of the IR image belongs to a device.

use super::ConfigError;
use crate::shading::Calibration;
use depth_camera::{CameraInfo, Sensor};
use std::{
    fmt, fs,
    path::{Component, Path, PathBuf},
};

/// Where a calibration comes from.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum CalibrationSource {
    /// A file made for this device.
    File(PathBuf),
    /// The one shipped for every sensor of the kind.
    Shipped(Sensor),
}

impl fmt::Display for CalibrationSource {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            CalibrationSource::File(path) => write!(f, "{}", path.display()),
            CalibrationSource::Shipped(sensor) => {
                write!(f, "the one shipped for every {}", sensor.name())
            }
        }
    }
}

/// The calibration of a device: `given` if there is one, else `calibration/<serial>.toml` in the configuration's folder if
/// that exists, else the shipped one.
///
/// # Errors
/// For a file that cannot be read or parsed, and for a value beyond its bound.
pub fn find_calibration(
    info: &CameraInfo,
    given: Option<&Path>,
    config_folder: Option<&Path>,
) -> Result<(Calibration, CalibrationSource), ConfigError> {
    let own = || own_file(&info.serial, config_folder?);
    match given.map(Path::to_owned).or_else(own) {
        Some(path) => Ok((read(&path)?, CalibrationSource::File(path))),
        None => {
            let source = CalibrationSource::Shipped(info.sensor);
            let calibration = Calibration::shipped(info.sensor).map_err(|what| ConfigError {
                origin: source.to_string(),
                what,
            })?;
            Ok((calibration, source))
        }
    }
}

/// The file of a serial number, if there is one; a serial that is no plain file name has none.
fn own_file(serial: &str, config_folder: &Path) -> Option<PathBuf> {
    let mut parts = Path::new(serial).components();
    let is_plain = matches!(
        (parts.next(), parts.next()),
        (Some(Component::Normal(_)), None)
    );
    let path = config_folder
        .join("calibration")
        .join(format!("{serial}.toml"));
    (is_plain && path.exists()).then_some(path)
}

fn read(path: &Path) -> Result<Calibration, ConfigError> {
    let text = fs::read_to_string(path).map_err(|error| ConfigError::in_file(path, error))?;
    Calibration::from_toml(&text).map_err(|what| ConfigError::in_file(path, what))
}

#[cfg(test)]
mod tests {
    use super::*;
    use depth_camera::DepthCamera;
    use simulated::SimulatedCamera;

    #[test]
    fn a_device_finds_its_own_file_and_no_other() {
        let folder = tempfile::tempdir().unwrap();
        fs::create_dir(folder.path().join("calibration")).unwrap();
        let shipped = include_str!("../../config/calibration-kinect2.toml");
        let own = folder.path().join("calibration/simulated-5.toml");
        fs::write(&own, shipped.replace("gamma = 0.87", "gamma = 0.9")).unwrap();
        let find = |info: &CameraInfo| find_calibration(info, None, Some(folder.path())).unwrap();

        let mut info = SimulatedCamera::kinect2_plaque(1, 5).info().clone();
        let (calibration, source) = find(&info);
        assert_eq!(calibration.gamma, 0.9);
        assert_eq!(source, CalibrationSource::File(own));
        for stranger in ["simulated-6", "../calibration/simulated-5", ""] {
            info.serial = stranger.to_owned();
            assert_eq!(find(&info).1, CalibrationSource::Shipped(Sensor::Kinect2));
        }
    }
}
