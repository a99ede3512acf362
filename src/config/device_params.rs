//! What a device's calibration says of things that its driver has to know.

use super::{
    CalibrationPlaces, ConfigError, DeviceCalibration, calibration::check_serial, calibration_path,
};
use crate::{devices::DeviceParams, shading::Calibration};
use std::{fs, path::Path};

/// The parameters for opening the device of that serial number: where its calibration knows the place of lamp and IR image, these
/// go before what the configuration says.
///
/// # Errors
/// For a calibration that cannot be read or parsed, and for one named by this serial number that states another.
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
    let Measured {
        serial: stated,
        ir_offset_px,
        lamp_position_m,
    } = measured(path)?;
    if let (None, Some(stated)) = (places.given, &stated) {
        check_serial(path, stated, serial)?;
    }
    let mut params = params.clone();
    let kinect1 = &mut params.kinect1;
    kinect1.ir_offset_px = ir_offset_px.or(kinect1.ir_offset_px);
    kinect1.lamp_position_m = lamp_position_m.or(kinect1.lamp_position_m);
    Ok(params)
}

/// What a calibration knows of this.
struct Measured {
    /// The device's serial number, if the file is its own.
    serial: Option<String>,
    ir_offset_px: Option<[f64; 2]>,
    lamp_position_m: Option<[f64; 3]>,
}

fn measured(path: &Path) -> Result<Measured, ConfigError> {
    let in_file = |what: String| ConfigError::in_file(path, what);
    let text = fs::read_to_string(path).map_err(|error| in_file(error.to_string()))?;
    let table: toml::Table = toml::from_str(&text).map_err(|error| in_file(error.to_string()))?;
    if table.contains_key("version") {
        let device = DeviceCalibration::from_toml(&text).map_err(in_file)?;
        return Ok(Measured {
            serial: Some(device.serial),
            ir_offset_px: device.ir_offset_px,
            lamp_position_m: device.light.position_m,
        });
    }
    let calibration = Calibration::from_toml(&text).map_err(in_file)?;
    Ok(Measured {
        serial: None,
        ir_offset_px: Some(calibration.ir_offset_px),
        lamp_position_m: calibration.light.position_m,
    })
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

        // Another device's is refused under this name, not where it is asked for.
        let renamed = calibration_path(folder.path(), "B8").unwrap();
        fs::copy(&path, &renamed).unwrap();
        let error = params_for_device("B8", &places, &params).unwrap_err();
        assert_eq!(error.what, "serial is \"A7\", must be \"B8\"");
        let given = CalibrationPlaces {
            given: Some(&renamed),
            ..places
        };
        let found = params_for_device("B8", &given, &params).unwrap();
        assert_eq!(found.kinect1.ir_offset_px, Some([4.2, 3.6]));

        fs::write(&path, "serial = 7").unwrap();
        let error = params_for_device("A7", &places, &params).unwrap_err();
        assert!(error.to_string().contains("A7.toml"), "{error}");
    }
}
