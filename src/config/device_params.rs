//! What a device's calibration says of things that its driver has to know.

use super::{CalibrationPlaces, ConfigError, DeviceCalibration, calibration_path};
use crate::{devices::DeviceParams, shading::Calibration};
use std::{fs, path::Path};

/// The parameters for opening the device of that serial number: where its calibration knows the place of lamp and IR image, these
/// go before what the configuration says.
///
/// # Errors
/// For a calibration that cannot be read or parsed.
pub fn params_for_device(
    serial: &str,
    places: &CalibrationPlaces,
    params: &DeviceParams,
) -> Result<DeviceParams, ConfigError> {
    let of_serial = calibration_path(places.folder, serial).ok();
    let of_serial = of_serial.filter(|path| path.exists());
    let Some(path) = places.given.or(of_serial.as_deref()) else {
        return Ok(params.clone());
    };
    let (ir_offset_px, lamp_position_m) = measured(path)?;
    let mut params = params.clone();
    let kinect1 = &mut params.kinect1;
    kinect1.ir_offset_px = ir_offset_px.or(kinect1.ir_offset_px);
    kinect1.lamp_position_m = lamp_position_m.or(kinect1.lamp_position_m);
    Ok(params)
}

/// Offset of the IR image (pixels) and position of the light (metres), as far as a calibration knows them.
type Measured = (Option<[f64; 2]>, Option<[f64; 3]>);

fn measured(path: &Path) -> Result<Measured, ConfigError> {
    let in_file = |what: String| ConfigError::in_file(path, what);
    let text = fs::read_to_string(path).map_err(|error| in_file(error.to_string()))?;
    let table: toml::Table = toml::from_str(&text).map_err(|error| in_file(error.to_string()))?;
    if table.contains_key("version") {
        let device = DeviceCalibration::from_toml(&text).map_err(in_file)?;
        return Ok((device.ir_offset_px, device.light.position_m));
    }
    let calibration = Calibration::from_toml(&text).map_err(in_file)?;
    Ok((Some(calibration.ir_offset_px), calibration.light.position_m))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::merge_into_file;
    use depth_camera::Sensor;

    #[test]
    fn what_was_measured_goes_before_the_configuration() {
        let folder = tempfile::tempdir().unwrap();
        let places = CalibrationPlaces {
            given: None,
            folder: folder.path(),
            session: None,
        };
        let mut params = DeviceParams::default();
        params.kinect1.lamp_position_m = Some([0.1, 0.0, 0.0]);
        assert_eq!(
            params_for_device("A7", &places, &params),
            Ok(params.clone())
        );

        let mut device = DeviceCalibration::new("A7".to_owned(), Sensor::Kinect1);
        device.ir_offset_px = Some([4.2, 3.6]);
        let path = calibration_path(folder.path(), "A7").unwrap();
        let shipped = Calibration::shipped(Sensor::Kinect1).unwrap();
        merge_into_file(&path, &device, &shipped, false).unwrap();
        let found = params_for_device("A7", &places, &params).unwrap();
        assert_eq!(found.kinect1.ir_offset_px, Some([4.2, 3.6]));
        assert_eq!(found.kinect1.lamp_position_m, Some([0.1, 0.0, 0.0]));

        fs::write(&path, "serial = 7").unwrap();
        let error = params_for_device("A7", &places, &params).unwrap_err();
        assert!(error.to_string().contains("A7.toml"), "{error}");
    }
}
