//! The calibration of one device: what was measured of it, key by key, with how it was measured.
//!
//! `calibration/<serial>.toml` is *partial*: what was not measured is left out, and stays as it is shipped for the kind of
//! sensor. Each measured key may carry a table `measured.<key>` with date, sessions and figures; a key set by hand has none.

use super::{
    CalibrationKey, ConfigError, Measurement,
    calibration_key::{KeyOrigin, KeyOrigins},
};
use crate::geometry::RangeError;
use crate::shading::{Calibration, FlatField, ImageNoise, LightCalibration};
use depth_camera::Sensor;
use serde::{Deserialize, Serialize};
use std::{collections::BTreeMap, fs, path::Path};

/// The only version of the file so far.
const VERSION: u32 = 1;

/// What was measured of one device.
#[derive(Clone, Debug, PartialEq, Deserialize, Serialize)]
#[serde(deny_unknown_fields)]
pub struct DeviceCalibration {
    /// Of the file's layout.
    pub version: u32,
    /// The device's serial number.
    pub serial: String,
    /// Its kind.
    #[serde(with = "sensor_name")]
    pub sensor: Sensor,
    /// Exponent of the response.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub gamma: Option<f64>,
    /// How far the IR image's content lies right of and below the depth image's, pixels.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub ir_offset_px: Option<[f64; 2]>,
    /// Error of the depth by range alone: points of range and how much too long it is, metres.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub range_error_m: Option<RangeError>,
    /// How the lens darkens the image.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub flat_field: Option<FlatField>,
    /// The light.
    #[serde(default)]
    pub light: MeasuredLight,
    /// Noise of the observed values.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub noise: Option<ImageNoise>,
    /// How each key was measured.
    #[serde(default)]
    pub measured: BTreeMap<CalibrationKey, Measurement>,
}

/// What was measured of the light.
#[derive(Clone, Debug, Default, PartialEq, Deserialize, Serialize)]
#[serde(deny_unknown_fields)]
pub struct MeasuredLight {
    /// Exponent of the lobe.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub lobe_power: Option<f64>,
    /// Position in the IR camera frame, metres.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub position_m: Option<[f64; 3]>,
    /// Linear intensity of a perfectly white surface a metre before the light, share of full scale.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub white_level: Option<f64>,
}

impl DeviceCalibration {
    /// A device of which nothing was measured yet.
    pub fn new(serial: String, sensor: Sensor) -> Self {
        DeviceCalibration {
            version: VERSION,
            serial,
            sensor,
            gamma: None,
            ir_offset_px: None,
            flat_field: None,
            light: MeasuredLight::default(),
            noise: None,
            range_error_m: None,
            measured: BTreeMap::new(),
        }
    }

    /// Reads and checks a file; `None` where there is none.
    ///
    /// # Errors
    /// As [`Self::read`] has them.
    pub fn read_if_there(path: &Path) -> Result<Option<Self>, ConfigError> {
        path.exists().then(|| Self::read(path)).transpose()
    }

    /// Reads and checks a file.
    ///
    /// # Errors
    /// For a file that cannot be read or parsed, for another version, and for a value beyond its bound, naming file, key,
    /// value and bound.
    pub fn read(path: &Path) -> Result<Self, ConfigError> {
        let text = fs::read_to_string(path).map_err(|error| ConfigError::in_file(path, error))?;
        Self::from_toml(&text).map_err(|what| ConfigError::in_file(path, what))
    }

    /// Parses and checks a calibration.
    ///
    /// # Errors
    /// Names the key, its value and the bound.
    pub fn from_toml(text: &str) -> Result<Self, String> {
        // A later version may have other keys: its number is looked at before they are.
        let table: toml::Table = toml::from_str(text).map_err(|error| error.to_string())?;
        match table.get("version") {
            Some(version) if version.as_integer() != Some(i64::from(VERSION)) => {
                return Err(format!("version is {version}, must be {VERSION}"));
            }
            _ => {}
        }
        let device: DeviceCalibration = toml::from_str(text).map_err(|error| error.to_string())?;
        device.validate()?;
        Ok(device)
    }

    /// Checks every value against its bound.
    ///
    /// # Errors
    /// Names the key, its value and the bound.
    pub fn validate(&self) -> Result<(), String> {
        if let Some(key) = self.measured.keys().find(|key| !self.holds(**key)) {
            return Err(format!("measured.{key} is there, but {key} is not"));
        }
        if self.sensor == Sensor::Kinect1 && self.range_error_m.is_some() {
            return Err("range_error_m is there, but only a kinect2's is known".to_owned());
        }
        let (calibration, _) = self.over(Calibration::shipped(self.sensor)?);
        calibration.validate()
    }

    /// Whether a key is in the file.
    pub fn holds(&self, key: CalibrationKey) -> bool {
        match key {
            CalibrationKey::Gamma => self.gamma.is_some(),
            CalibrationKey::FlatField => self.flat_field.is_some(),
            CalibrationKey::LightLobePower => self.light.lobe_power.is_some(),
            CalibrationKey::LightPosition => self.light.position_m.is_some(),
            CalibrationKey::LightWhiteLevel => self.light.white_level.is_some(),
            CalibrationKey::Noise => self.noise.is_some(),
            CalibrationKey::IrOffset => self.ir_offset_px.is_some(),
            CalibrationKey::RangeError => self.range_error_m.is_some(),
        }
    }

    /// The keys that are in the file.
    pub fn keys(&self) -> impl Iterator<Item = CalibrationKey> + '_ {
        CalibrationKey::ALL
            .into_iter()
            .filter(|key| self.holds(*key))
    }

    /// The measured keys over those shipped for the sensor, and where each comes from.
    pub fn over(&self, shipped: Calibration) -> (Calibration, KeyOrigins) {
        let light = LightCalibration {
            lobe_power: self.light.lobe_power.unwrap_or(shipped.light.lobe_power),
            position_m: self.light.position_m.or(shipped.light.position_m),
            white_level: self.light.white_level.or(shipped.light.white_level),
        };
        let calibration = Calibration {
            gamma: self.gamma.unwrap_or(shipped.gamma),
            ir_offset_px: self.ir_offset_px.unwrap_or(shipped.ir_offset_px),
            flat_field: self.flat_field.clone().unwrap_or(shipped.flat_field),
            light,
            noise: self.noise.unwrap_or(shipped.noise),
            range_error_m: self.range_error_m.clone().or(shipped.range_error_m),
        };
        let origin = |key| (key, self.origin(key));
        (calibration, CalibrationKey::ALL.map(origin).into())
    }

    fn origin(&self, key: CalibrationKey) -> KeyOrigin {
        match key {
            key if self.holds(key) => KeyOrigin::File(self.measured.get(&key).map(|m| m.date)),
            CalibrationKey::LightPosition | CalibrationKey::IrOffset => KeyOrigin::Stated,
            CalibrationKey::LightWhiteLevel | CalibrationKey::RangeError => KeyOrigin::Estimated,
            _ => KeyOrigin::Shipped,
        }
    }

    /// Takes a key over from another calibration, with how it was measured.
    pub(super) fn take(&mut self, key: CalibrationKey, from: &DeviceCalibration) {
        match key {
            CalibrationKey::Gamma => self.gamma = from.gamma,
            CalibrationKey::FlatField => self.flat_field.clone_from(&from.flat_field),
            CalibrationKey::LightLobePower => self.light.lobe_power = from.light.lobe_power,
            CalibrationKey::LightPosition => self.light.position_m = from.light.position_m,
            CalibrationKey::LightWhiteLevel => self.light.white_level = from.light.white_level,
            CalibrationKey::Noise => self.noise = from.noise,
            CalibrationKey::IrOffset => self.ir_offset_px = from.ir_offset_px,
            CalibrationKey::RangeError => self.range_error_m.clone_from(&from.range_error_m),
        }
        match from.measured.get(&key) {
            Some(measurement) => self.measured.insert(key, measurement.clone()),
            None => self.measured.remove(&key),
        };
    }

    /// The value of a key for a message, empty if it is not there.
    pub(super) fn shown(&self, key: CalibrationKey) -> String {
        let number = |value: Option<f64>| value.map(|value| value.to_string());
        let shown = match key {
            CalibrationKey::Gamma => number(self.gamma),
            CalibrationKey::FlatField => self.flat_field.as_ref().map(ToString::to_string),
            CalibrationKey::LightLobePower => number(self.light.lobe_power),
            CalibrationKey::LightPosition => self.light.position_m.map(|p| format!("{p:?}")),
            CalibrationKey::LightWhiteLevel => number(self.light.white_level),
            CalibrationKey::Noise => self
                .noise
                .map(|noise| format!("read {}, shot {}", noise.read, noise.shot)),
            CalibrationKey::IrOffset => self.ir_offset_px.map(|offset| format!("{offset:?}")),
            CalibrationKey::RangeError => self
                .range_error_m
                .as_ref()
                .map(|error| format!("up to {:.1} mm", 1e3 * error.largest_m())),
        };
        shown.unwrap_or_default()
    }
}

/// A sensor in a file, by its name.
mod sensor_name {
    use depth_camera::Sensor;
    use serde::{Deserialize, Deserializer, Serialize, Serializer, de::Error};

    pub fn serialize<S: Serializer>(sensor: &Sensor, serializer: S) -> Result<S::Ok, S::Error> {
        sensor.name().serialize(serializer)
    }

    pub fn deserialize<'de, D: Deserializer<'de>>(deserializer: D) -> Result<Sensor, D::Error> {
        let name = String::deserialize(deserializer)?;
        Sensor::from_name(&name).ok_or_else(|| {
            D::Error::custom(format!(
                "sensor is \"{name}\", must be \"kinect1\" or \"kinect2\""
            ))
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const PARTIAL: &str = "version = 1\nserial = \"A1\"\nsensor = \"kinect2\"\ngamma = 1.0\n\
        light.position_m = [0.1, 0.0, 0.0]\n\
        [measured.gamma]\ndate = 2024-02-29T12:34:56Z\nsessions = []\nfigures = { interval = 0.01 }\n";

    #[test]
    fn measured_keys_lie_over_the_shipped_ones() {
        let device = DeviceCalibration::from_toml(PARTIAL).unwrap();
        let shipped = Calibration::shipped(Sensor::Kinect2).unwrap();
        let (calibration, origins) = device.over(shipped.clone());
        let light = LightCalibration {
            position_m: Some([0.1, 0.0, 0.0]),
            ..shipped.light
        };
        let expected = Calibration {
            gamma: 1.0,
            light,
            ..shipped
        };
        assert_eq!(calibration, expected);
        let origins: Vec<_> = origins
            .iter()
            .map(|(key, origin)| format!("{key}: {origin}"))
            .collect();
        assert_eq!(
            origins,
            [
                "gamma: measured 2024-02-29T12:34:56Z",
                "flat_field: shipped",
                "light.lobe_power: shipped",
                "light.position_m: file",
                "light.white_level: estimated from each scan",
                "noise: shipped",
                "ir_offset_px: as the session states",
                "range_error_m: estimated from each scan",
            ]
        );
    }

    #[test]
    fn a_calibration_survives_its_file() {
        let mut device = DeviceCalibration::from_toml(PARTIAL).unwrap();
        let error = RangeError::through(vec![[0.5, 0.001], [0.51, -0.002]]);
        device.range_error_m = Some(error);
        let text = toml::to_string(&device).unwrap();
        assert_eq!(DeviceCalibration::from_toml(&text), Ok(device));
    }

    #[test]
    fn what_makes_no_sense_is_refused_by_name() {
        for (old, new, expected) in [
            ("version = 1", "version = 2", "version is 2, must be 1"),
            ("version = 1", "", "missing field `version`"),
            ("gamma = 1.0", "gama = 1.0", "gama"),
            ("gamma = 1.0", "gamma = 9.0", "gamma is 9, must be 0.2 to 3"),
            (
                "gamma = 1.0",
                "",
                "measured.gamma is there, but gamma is not",
            ),
            (
                "\"kinect2\"\n",
                "\"kinect1\"\nrange_error_m = [[0.5, 0.001]]\n",
                "only a kinect2's is known",
            ),
            ("kinect2", "kinect3", "sensor is \"kinect3\", must be"),
            ("measured.gamma", "measured.gain", "gain"),
            ("[0.1, 0.0", "[9.1, 0.0", "light.position_m holds 9.1"),
            (
                "gamma = 1.0",
                "gamma = 1.0\nrange_error_m = [[0.5, 3.0]]",
                "range_error_m holds an error of 3, must be",
            ),
        ] {
            let error = DeviceCalibration::from_toml(&PARTIAL.replace(old, new)).unwrap_err();
            assert!(error.contains(expected), "{error}");
        }
    }
}
