//! `session.toml`: the camera's description, read, checked and written.

use std::path::Path;

use crate::{depth_scale::DepthScale, files::read_ordinary_text};
use depth_camera::{CameraError, CameraInfo, Intrinsics, Light, LightKind, Sensor};
use serde::{Deserialize, Serialize};
use toml::de::{DeTable, DeValue};

/// The name of the description in a session's folder.
pub const FILE_NAME: &str = "session.toml";

/// Every key that is read here.
const KEYS: [&str; 20] = [
    "name",
    "sensor",
    "serial",
    "driver",
    "depth_units_per_metre",
    "ir_full_scale",
    "ir_gain",
    "ir_camera.width",
    "ir_camera.height",
    "ir_camera.fx",
    "ir_camera.fy",
    "ir_camera.cx",
    "ir_camera.cy",
    "ir_camera.k1",
    "ir_camera.k2",
    "ir_camera.p1",
    "ir_camera.p2",
    "ir_camera.k3",
    "light.position",
    "light.kind",
];

/// A table for those who score: where the object stands.
const OBJECT: &str = "object";

/// Larger images than any depth camera delivers: a wrong size must not ask for gigabytes.
const MAX_SIDE_PX: usize = 16_384;

/// Which images a session holds.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Images {
    /// Depth alone.
    Depth,
    /// Depth and IR.
    DepthAndInfrared,
}

/// The contents of `session.toml`; keys that are not named here are for other readers.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct SessionFile {
    name: String,
    sensor: String,
    #[serde(skip_serializing_if = "Option::is_none")]
    serial: Option<String>,
    #[serde(skip_serializing_if = "Option::is_none")]
    driver: Option<String>,
    depth_units_per_metre: f64,
    #[serde(skip_serializing_if = "Option::is_none")]
    ir_full_scale: Option<f64>,
    #[serde(skip_serializing_if = "Option::is_none")]
    ir_gain: Option<u16>,
    ir_camera: Intrinsics,
    #[serde(skip_serializing_if = "Option::is_none")]
    light: Option<LightEntry>,
}

/// The near light, in the IR camera frame.
#[derive(Clone, Debug, Serialize, Deserialize)]
struct LightEntry {
    position: [f64; 3],
    kind: String,
}

impl SessionFile {
    /// Reads a description; values are checked by [`Self::camera_info`].
    ///
    /// # Errors
    /// [`CameraError::Invalid`] naming the file and what is wrong with its text.
    pub fn read(path: &Path) -> Result<Self, CameraError> {
        let text = read_ordinary_text(path).map_err(|error| invalid(path, error))?;
        Self::parse(path, &text)
    }

    /// The description in a text; `path` is named in errors.
    ///
    /// # Errors
    /// [`CameraError::Invalid`] for a text that is none.
    pub fn parse(path: &Path, text: &str) -> Result<Self, CameraError> {
        toml::from_str(text).map_err(|error| invalid(path, error.to_string().trim_end()))
    }

    /// The text of the description; numbers are read back to the last bit.
    ///
    /// # Errors
    /// [`CameraError::Invalid`] for what cannot be written; `path` is named.
    pub fn to_text(&self, path: &Path) -> Result<String, CameraError> {
        toml::to_string(self).map_err(|error| invalid(path, error))
    }

    /// Which images the camera delivers by its description.
    pub fn images(&self) -> Images {
        match self.ir_full_scale.is_some() || self.light.is_some() {
            true => Images::DepthAndInfrared,
            false => Images::Depth,
        }
    }

    /// How depth is stored.
    pub fn depth_scale(&self) -> DepthScale {
        DepthScale {
            units_per_metre: self.depth_units_per_metre,
        }
    }

    /// The description of a camera about to be recorded.
    pub fn of_camera(name: &str, info: &CameraInfo, depth_units_per_metre: f64) -> Self {
        SessionFile {
            name: name.to_owned(),
            sensor: info.sensor.name().to_owned(),
            serial: Some(info.serial.clone()),
            driver: info.driver.clone(),
            depth_units_per_metre,
            ir_full_scale: info.ir_full_scale,
            ir_gain: info.ir_gain,
            ir_camera: info.intrinsics,
            light: info.light.map(|light| LightEntry {
                position: light.position_m,
                kind: light.kind.name().to_owned(),
            }),
        }
    }

    /// The camera that this file describes, every value checked; `path` is named in errors.
    ///
    /// IR images are of no use without their scale, and those of a sensor that lights them itself not without its light.
    ///
    /// # Errors
    /// [`CameraError::Invalid`] naming file, key, value and bound.
    pub fn camera_info(&self, path: &Path, images: Images) -> Result<CameraInfo, CameraError> {
        let with_ir = images == Images::DepthAndInfrared;
        self.check(images).map_err(|what| invalid(path, what))?;
        let sensor = sensor_named(&self.sensor).map_err(|what| invalid(path, what))?;
        let light = self.light.as_ref().map(LightEntry::light).transpose();
        let light = light.map_err(|what| invalid(path, what))?;
        Ok(CameraInfo {
            sensor,
            serial: self.serial.clone().unwrap_or_else(|| self.name.clone()),
            driver: self.driver.clone(),
            intrinsics: self.ir_camera,
            ir_full_scale: self.ir_full_scale.filter(|_| with_ir),
            ir_gain: self.ir_gain.filter(|_| with_ir),
            light: light.filter(|_| with_ir),
            n_frames: None,
        })
    }

    fn check(&self, images: Images) -> Result<(), String> {
        let with_ir = images == Images::DepthAndInfrared;
        if self.name.is_empty() {
            return Err("name is empty, must name the session".to_owned());
        }
        check_positive("depth_units_per_metre", self.depth_units_per_metre)?;
        if let Some(full_scale) = self.ir_full_scale {
            check_positive("ir_full_scale", full_scale)?;
            check_at_most("ir_full_scale", full_scale, f64::from(u16::MAX))?;
        }
        check_camera(&self.ir_camera)?;
        if with_ir && self.ir_full_scale.is_none() {
            return Err(
                "ir_full_scale is missing, must be given where there is an ir.txt".to_owned(),
            );
        }
        // A Kinect I may have no lamp, or one that nobody has measured: then its IR gives no shading images.
        let is_lit_by_itself = self.sensor != Sensor::Kinect1.name();
        if with_ir && self.light.is_none() && is_lit_by_itself {
            return Err("[light] is missing, must be given where there is an ir.txt".to_owned());
        }
        Ok(())
    }
}

impl LightEntry {
    fn light(&self) -> Result<Light, String> {
        Light::check_position("light.position", self.position)?;
        let kind = [LightKind::Emitter, LightKind::Lamp]
            .into_iter()
            .find(|kind| kind.name() == self.kind)
            .ok_or_else(|| {
                format!(
                    "light.kind is \"{}\", must be \"emitter\" or \"lamp\"",
                    self.kind
                )
            })?;
        Ok(Light {
            position_m: self.position,
            kind,
        })
    }
}

/// The keys of a session's description that nobody reads, in sentences with file and line: they may be misspelt.
pub fn unknown_keys(folder: &Path) -> Vec<String> {
    let path = folder.join(FILE_NAME);
    let text = read_ordinary_text(&path).unwrap_or_default();
    let Ok(table) = DeTable::parse(&text) else {
        return Vec::new();
    };
    let mut found = Vec::new();
    for (key, value) in table.get_ref().iter() {
        match value.get_ref() {
            DeValue::Table(_) if key.get_ref() == OBJECT => {}
            DeValue::Table(inner) => found.extend(inner.iter().map(|(inner, _)| {
                let name = format!("{}.{}", key.get_ref(), inner.get_ref());
                (name, inner.span().start)
            })),
            _ => found.push((key.get_ref().to_string(), key.span().start)),
        }
    }
    found.sort_by_key(|(_, at)| *at);
    let unknown = found
        .into_iter()
        .filter(|(name, _)| !KEYS.contains(&name.as_str()));
    unknown
        .map(|(name, at)| {
            let line = 1 + text[..at].matches('\n').count();
            format!(
                "{}: line {line}: nobody reads the key {name}",
                path.display()
            )
        })
        .collect()
}

/// An error that begins with the file's name.
pub(crate) fn invalid(path: &Path, what: impl std::fmt::Display) -> CameraError {
    CameraError::Invalid(format!("{}: {what}", path.display()))
}

fn check_camera(camera: &Intrinsics) -> Result<(), String> {
    for (key, side) in [("width", camera.width), ("height", camera.height)] {
        if !(1..=MAX_SIDE_PX).contains(&side) {
            return Err(format!(
                "ir_camera.{key} is {side}, must be from 1 to {MAX_SIDE_PX}"
            ));
        }
    }
    check_positive("ir_camera.fx", camera.fx)?;
    check_positive("ir_camera.fy", camera.fy)?;
    check_in_image("ir_camera.cx", camera.cx, camera.width)?;
    check_in_image("ir_camera.cy", camera.cy, camera.height)?;
    for (key, value) in [
        ("ir_camera.k1", camera.k1),
        ("ir_camera.k2", camera.k2),
        ("ir_camera.p1", camera.p1),
        ("ir_camera.p2", camera.p2),
        ("ir_camera.k3", camera.k3),
    ] {
        check_finite(key, value)?;
    }
    Ok(())
}

fn sensor_named(name: &str) -> Result<Sensor, String> {
    Sensor::from_name(name)
        .ok_or_else(|| format!("sensor is \"{name}\", must be \"kinect1\" or \"kinect2\""))
}

fn check_finite(key: &str, value: f64) -> Result<(), String> {
    if value.is_finite() {
        return Ok(());
    }
    Err(format!("{key} is {value}, must be finite"))
}

fn check_positive(key: &str, value: f64) -> Result<(), String> {
    if value.is_finite() && value > 0.0 {
        return Ok(());
    }
    Err(format!("{key} is {value}, must be positive and finite"))
}

fn check_at_most(key: &str, value: f64, limit: f64) -> Result<(), String> {
    if value <= limit {
        return Ok(());
    }
    Err(format!("{key} is {value}, must be at most {limit}"))
}

fn check_in_image(key: &str, value: f64, side: usize) -> Result<(), String> {
    let last = side - 1;
    if (0.0..=last as f64).contains(&value) {
        return Ok(());
    }
    Err(format!(
        "{key} is {value}, must lie in the image, 0 to {last}"
    ))
}
