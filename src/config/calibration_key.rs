//! The parts of a calibration that are measured one by one, and what is known of each.

use serde::{Deserialize, Serialize};
use std::{collections::BTreeMap, fmt, time::SystemTime};
use toml::value::Datetime;

/// A part of a calibration that is measured for itself.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Deserialize, Serialize)]
pub enum CalibrationKey {
    /// Exponent of the response.
    #[serde(rename = "gamma")]
    Gamma,
    /// How the lens darkens the image.
    #[serde(rename = "flat_field")]
    FlatField,
    /// Exponent of the light's lobe.
    #[serde(rename = "light.lobe_power")]
    LightLobePower,
    /// Where the light is.
    #[serde(rename = "light.position_m")]
    LightPosition,
    /// How bright the light is.
    #[serde(rename = "light.white_level")]
    LightWhiteLevel,
    /// Noise of an IR pixel.
    #[serde(rename = "noise")]
    Noise,
    /// Where the IR image lies against the depth image.
    #[serde(rename = "ir_offset_px")]
    IrOffset,
    /// Error of the depth by range alone.
    #[serde(rename = "range_error_m")]
    RangeError,
}

impl CalibrationKey {
    /// All of them, in the order of the file.
    pub const ALL: [CalibrationKey; 8] = [
        CalibrationKey::Gamma,
        CalibrationKey::FlatField,
        CalibrationKey::LightLobePower,
        CalibrationKey::LightPosition,
        CalibrationKey::LightWhiteLevel,
        CalibrationKey::Noise,
        CalibrationKey::IrOffset,
        CalibrationKey::RangeError,
    ];

    /// The name in files and messages.
    pub fn name(self) -> &'static str {
        match self {
            CalibrationKey::Gamma => "gamma",
            CalibrationKey::FlatField => "flat_field",
            CalibrationKey::LightLobePower => "light.lobe_power",
            CalibrationKey::LightPosition => "light.position_m",
            CalibrationKey::LightWhiteLevel => "light.white_level",
            CalibrationKey::Noise => "noise",
            CalibrationKey::IrOffset => "ir_offset_px",
            CalibrationKey::RangeError => "range_error_m",
        }
    }
}

impl fmt::Display for CalibrationKey {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.name())
    }
}

/// How a key was measured.
#[derive(Clone, Debug, PartialEq, Deserialize, Serialize)]
#[serde(deny_unknown_fields)]
pub struct Measurement {
    /// When, in UTC.
    pub date: Datetime,
    /// What from.
    pub sessions: Vec<MeasuredSession>,
    /// What the measurement says of itself: intervals, residuals, counts; units stand in the names.
    #[serde(default)]
    pub figures: BTreeMap<String, f64>,
}

/// A session that a key was measured from.
#[derive(Clone, Debug, PartialEq, Eq, Deserialize, Serialize)]
#[serde(deny_unknown_fields)]
pub struct MeasuredSession {
    /// Name of its folder.
    pub name: String,
    /// Hash of its contents, with the method: `sha256:…`.
    pub content: String,
}

impl Measurement {
    /// A measurement at a time of the system's clock, which the caller reads; whole seconds are kept.
    ///
    /// # Panics
    /// If the time lies before 1970 or beyond the year 9999.
    pub fn new(
        time: SystemTime,
        sessions: Vec<MeasuredSession>,
        figures: BTreeMap<String, f64>,
    ) -> Self {
        let date = humantime::format_rfc3339_seconds(time).to_string();
        Measurement {
            date: date.parse().expect("a date of RFC 3339 is one of TOML"),
            sessions,
            figures,
        }
    }
}

/// Where the value of a key comes from.
#[derive(Clone, Debug, PartialEq)]
pub enum KeyOrigin {
    /// The calibration file, with the date of the measurement where it has one.
    File(Option<Datetime>),
    /// The file shipped for every sensor of the kind.
    Shipped,
    /// The device's or session's own statement: the light's position, and that IR and depth share one grid.
    Stated,
    /// Nothing tells it beforehand: each scan finds it by itself.
    Estimated,
}

impl fmt::Display for KeyOrigin {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            KeyOrigin::File(Some(date)) => write!(f, "measured {date}"),
            KeyOrigin::File(None) => f.write_str("file"),
            KeyOrigin::Shipped => f.write_str("shipped"),
            KeyOrigin::Stated => f.write_str("as the session states"),
            KeyOrigin::Estimated => f.write_str("estimated from each scan"),
        }
    }
}

/// The origin of every key.
pub type KeyOrigins = BTreeMap<CalibrationKey, KeyOrigin>;

#[cfg(test)]
mod tests {
    use super::*;
    use std::time::Duration;

    #[test]
    fn names_in_files_and_messages_are_the_same() {
        for key in CalibrationKey::ALL {
            let table = BTreeMap::from([(key, 1)]);
            let text = toml::to_string(&table).unwrap();
            assert!(text.replace('"', "").starts_with(key.name()), "{text}");
            assert_eq!(toml::from_str::<BTreeMap<_, _>>(&text), Ok(table));
        }
    }

    #[test]
    fn a_date_is_written_in_utc() {
        let time = SystemTime::UNIX_EPOCH + Duration::from_secs(1_709_210_096);
        let measured = Measurement::new(time, Vec::new(), BTreeMap::new());
        assert_eq!(measured.date.to_string(), "2024-02-29T12:34:56Z");
    }
}
