//! What has to be known of a sensor before its IR values measure light and its depth distance.

use super::{FlatField, NearLight};
use crate::geometry::RangeError;
use depth_camera::{CameraInfo, Sensor};
use nalgebra::Point3;
use serde::{Deserialize, Serialize};

/// Response, flat field and noise of one sensor's IR image, and what its depth gets wrong.
#[derive(Clone, Debug, PartialEq, Deserialize, Serialize)]
#[serde(deny_unknown_fields)]
pub struct Calibration {
    /// Exponent of the response: observed = linear^gamma, both as shares of full scale.
    pub gamma: f64,
    /// How far right of and below its place in the depth image a point lies in the IR image, pixels; a raw Kinect I has
    /// about (5, 4). The camera's intrinsics are those of the depth image.
    #[serde(default)]
    pub ir_offset_px: [f64; 2],
    /// Measured error of the depth by range alone, of a Kinect II: points of range and how much too long it is, metres.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub range_error_m: Option<RangeError>,
    /// How the lens darkens the image towards its corners.
    pub flat_field: FlatField,
    /// The light's lobe and place.
    pub light: LightCalibration,
    /// Noise of the observed values.
    pub noise: ImageNoise,
}

/// What is known of the light beside its kind.
#[derive(Clone, Copy, Debug, PartialEq, Deserialize, Serialize)]
#[serde(deny_unknown_fields)]
pub struct LightCalibration {
    /// Exponent of the emission's cosine about the optical axis; 0 shines evenly.
    pub lobe_power: f64,
    /// Measured position in the IR camera frame, metres; without it the device's own statement holds.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub position_m: Option<[f64; 3]>,
    /// Measured brightness: linear intensity, as a share of full scale, that a perfectly white surface shows a metre before
    /// the light and facing it; it tells how strong multipath is.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub white_level: Option<f64>,
}

impl LightCalibration {
    /// The light, which stands at `stated_m` (metres, camera frame) where its place is not measured.
    pub fn near_light(&self, stated_m: [f64; 3]) -> NearLight {
        NearLight {
            position: Point3::from(self.position_m.unwrap_or(stated_m)),
            lobe_power: self.lobe_power,
        }
    }
}

/// Noise of one observed pixel as shares of full scale: variance = read² + shot · value.
#[derive(Clone, Copy, Debug, PartialEq, Deserialize, Serialize)]
#[serde(deny_unknown_fields)]
pub struct ImageNoise {
    /// Standard deviation in the dark.
    pub read: f64,
    /// Variance for each unit of value.
    pub shot: f64,
}

impl ImageNoise {
    /// Standard deviation of an observed value.
    pub fn sigma(&self, value: f64) -> f64 {
        (self.read * self.read + self.shot * value.max(0.0)).sqrt()
    }
}

impl Calibration {
    /// Name of the file in a session's folder that holds the calibration it was recorded with.
    pub const FILE_NAME: &str = "calibration.toml";

    /// The calibration that `config/` carries for a sensor that has none of its own.
    ///
    /// # Errors
    /// If the file shipped with the program does not parse, which a test excludes.
    pub fn shipped(sensor: Sensor) -> Result<Self, String> {
        let text = match sensor {
            Sensor::Kinect1 => include_str!("../../config/calibration-kinect1.toml"),
            Sensor::Kinect2 => include_str!("../../config/calibration-kinect2.toml"),
        };
        Self::from_toml(text)
    }

    /// The calibration that `config/` carries for what a camera says of itself: of its driver where that decides the
    /// response, else of its kind.
    ///
    /// # Errors
    /// As for [`Self::shipped`].
    pub fn shipped_for(info: &CameraInfo) -> Result<Self, String> {
        match (info.sensor, info.driver.as_deref()) {
            (Sensor::Kinect1, Some("libfreenect")) => Self::from_toml(include_str!(
                "../../config/calibration-kinect1-libfreenect.toml"
            )),
            (Sensor::Kinect2, Some("libfreenect2")) => Self::from_toml(include_str!(
                "../../config/calibration-kinect2-libfreenect2.toml"
            )),
            (sensor, _) => Self::shipped(sensor),
        }
    }

    /// The same with another exponent of the response: white is as many counts as before, which are another intensity then.
    pub fn with_gamma(&self, gamma: f64) -> Self {
        let white_level = self.light.white_level;
        Calibration {
            gamma,
            light: LightCalibration {
                white_level: white_level.map(|level| level.powf(self.gamma / gamma)),
                ..self.light
            },
            ..self.clone()
        }
    }

    /// Parses and checks a calibration.
    ///
    /// # Errors
    /// Names the key, its value and the bound.
    pub fn from_toml(text: &str) -> Result<Self, String> {
        let calibration: Calibration = toml::from_str(text).map_err(|error| error.to_string())?;
        calibration.validate()?;
        Ok(calibration)
    }

    /// What [`Self::from_toml`] reads.
    ///
    /// # Errors
    /// If the format cannot hold it, which a test excludes.
    pub fn to_toml(&self) -> Result<String, String> {
        toml::to_string(self).map_err(|error| error.to_string())
    }

    /// Checks every value against its bound.
    ///
    /// # Errors
    /// Names the key, its value and the bound.
    pub fn validate(&self) -> Result<(), String> {
        self.flat_field.validate()?;
        for (key, value, low, high) in [
            ("gamma", self.gamma, 0.2, 3.0),
            ("light.lobe_power", self.light.lobe_power, 0.0, 12.0),
            ("noise.read", self.noise.read, 1e-6, 0.2),
            ("noise.shot", self.noise.shot, 0.0, 0.2),
        ] {
            if !(value >= low && value <= high) {
                return Err(format!("{key} is {value}, must be {low} to {high}"));
            }
        }
        for value in self.ir_offset_px {
            if !(-20.0..=20.0).contains(&value) {
                return Err(format!("ir_offset_px holds {value}, must be -20 to 20"));
            }
        }
        for value in self.light.position_m.unwrap_or_default() {
            if !(-2.0..=2.0).contains(&value) {
                return Err(format!("light.position_m holds {value}, must be -2 to 2"));
            }
        }
        if let Some(error) = &self.range_error_m {
            error.validate("range_error_m")?;
        }
        match self.light.white_level {
            Some(level) if !(level > 1e-4 && level <= 1e3) => Err(format!(
                "light.white_level is {level}, must be 0.0001 to 1000"
            )),
            _ => Ok(()),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn shipped_calibrations_parse_and_differ() {
        let one = Calibration::shipped(Sensor::Kinect1).expect("shipped");
        let two = Calibration::shipped(Sensor::Kinect2).expect("shipped");
        assert_ne!(one.gamma, two.gamma);
        for calibration in [one, two] {
            let text = calibration.to_toml().expect("serialises");
            assert_eq!(Calibration::from_toml(&text), Ok(calibration));
        }
    }

    #[test]
    fn bad_values_are_named_with_their_bound() {
        let text = "gamma = 0.0\nflat_field = { model = \"cosine_power\", power = 3.0 }\nlight = { lobe_power = 0.0 }\nnoise = { read = 0.01, shot = 0.0 }";
        assert_eq!(
            Calibration::from_toml(text),
            Err("gamma is 0, must be 0.2 to 3".into())
        );
        let text = text
            .replace("gamma = 0.0", "gamma = 1.0")
            .replace("3.0 }", "nan }");
        assert_eq!(
            Calibration::from_toml(&text),
            Err("flat_field.power is NaN, must be 0 to 12".into())
        );
    }
}
