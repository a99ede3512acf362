//! `session.toml`: the camera's description, read, checked and written.

use std::{fs, path::Path};

use crate::depth_scale::DepthScale;
use depth_camera::{CameraError, CameraInfo, Intrinsics, Light, LightKind, Sensor};
use serde::{Deserialize, Serialize};

/// The name of the description in a session's folder.
pub const FILE_NAME: &str = "session.toml";

/// Larger images than any depth camera delivers: a wrong size must not ask for gigabytes.
const MAX_SIDE_PX: usize = 16_384;

/// A light further from the camera is not the near light that shading needs.
const MAX_LIGHT_DISTANCE_M: f64 = 2.0;

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
    ir_camera: IrCamera,
    #[serde(skip_serializing_if = "Option::is_none")]
    light: Option<LightEntry>,
}

/// Brown–Conrady camera, pixels. No key has a default: a forgotten distortion would be a wrong camera.
#[derive(Clone, Debug, Serialize, Deserialize)]
struct IrCamera {
    width: usize,
    height: usize,
    fx: f64,
    fy: f64,
    cx: f64,
    cy: f64,
    k1: f64,
    k2: f64,
    p1: f64,
    p2: f64,
    k3: f64,
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
        let text = fs::read_to_string(path).map_err(|error| invalid(path, error))?;
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

    /// Whether the camera delivers IR.
    pub fn has_infrared(&self) -> bool {
        self.ir_full_scale.is_some() || self.light.is_some()
    }

    /// How depth is stored.
    pub fn depth_scale(&self) -> DepthScale {
        DepthScale {
            units_per_metre: self.depth_units_per_metre,
        }
    }

    /// The description of a camera about to be recorded.
    pub fn of_camera(name: &str, info: &CameraInfo, depth_units_per_metre: f64) -> Self {
        let i = &info.intrinsics;
        SessionFile {
            name: name.to_owned(),
            sensor: info.sensor.name().to_owned(),
            serial: Some(info.serial.clone()),
            driver: info.driver.clone(),
            depth_units_per_metre,
            ir_full_scale: info.ir_full_scale,
            ir_gain: info.ir_gain,
            ir_camera: IrCamera {
                width: i.width,
                height: i.height,
                fx: i.fx,
                fy: i.fy,
                cx: i.cx,
                cy: i.cy,
                k1: i.k1,
                k2: i.k2,
                p1: i.p1,
                p2: i.p2,
                k3: i.k3,
            },
            light: info.light.map(|light| LightEntry {
                position: light.position_m,
                kind: light.kind.name().to_owned(),
            }),
        }
    }

    /// The camera that this file describes, every value checked; `path` is named in errors.
    ///
    /// `with_ir` says whether there are IR images: they are of no use without their scale, and those of a sensor that lights them
    /// itself not without its light.
    ///
    /// # Errors
    /// [`CameraError::Invalid`] naming file, key, value and bound.
    pub fn camera_info(&self, path: &Path, with_ir: bool) -> Result<CameraInfo, CameraError> {
        self.check(with_ir).map_err(|what| invalid(path, what))?;
        let sensor = sensor_named(&self.sensor).map_err(|what| invalid(path, what))?;
        let light = self.light.as_ref().map(LightEntry::light).transpose();
        let light = light.map_err(|what| invalid(path, what))?;
        Ok(CameraInfo {
            sensor,
            serial: self.serial.clone().unwrap_or_else(|| self.name.clone()),
            driver: self.driver.clone(),
            intrinsics: self.ir_camera.intrinsics(),
            ir_full_scale: self.ir_full_scale.filter(|_| with_ir),
            ir_gain: self.ir_gain.filter(|_| with_ir),
            light: light.filter(|_| with_ir),
            n_frames: None,
        })
    }

    fn check(&self, with_ir: bool) -> Result<(), String> {
        if self.name.is_empty() {
            return Err("name is empty, must name the session".to_owned());
        }
        check_positive("depth_units_per_metre", self.depth_units_per_metre)?;
        if let Some(full_scale) = self.ir_full_scale {
            check_positive("ir_full_scale", full_scale)?;
            check_at_most("ir_full_scale", full_scale, f64::from(u16::MAX))?;
        }
        self.ir_camera.check()?;
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

impl IrCamera {
    fn check(&self) -> Result<(), String> {
        for (key, side) in [("width", self.width), ("height", self.height)] {
            if !(1..=MAX_SIDE_PX).contains(&side) {
                return Err(format!(
                    "ir_camera.{key} is {side}, must be from 1 to {MAX_SIDE_PX}"
                ));
            }
        }
        check_positive("ir_camera.fx", self.fx)?;
        check_positive("ir_camera.fy", self.fy)?;
        check_in_image("ir_camera.cx", self.cx, self.width)?;
        check_in_image("ir_camera.cy", self.cy, self.height)?;
        for (key, value) in [
            ("ir_camera.k1", self.k1),
            ("ir_camera.k2", self.k2),
            ("ir_camera.p1", self.p1),
            ("ir_camera.p2", self.p2),
            ("ir_camera.k3", self.k3),
        ] {
            check_finite(key, value)?;
        }
        Ok(())
    }

    fn intrinsics(&self) -> Intrinsics {
        Intrinsics {
            width: self.width,
            height: self.height,
            fx: self.fx,
            fy: self.fy,
            cx: self.cx,
            cy: self.cy,
            k1: self.k1,
            k2: self.k2,
            p1: self.p1,
            p2: self.p2,
            k3: self.k3,
        }
    }
}

impl LightEntry {
    fn light(&self) -> Result<Light, String> {
        for value in self.position {
            check_finite("light.position", value)?;
        }
        let distance_m = self.position.iter().map(|x| x * x).sum::<f64>().sqrt();
        if distance_m > MAX_LIGHT_DISTANCE_M {
            return Err(format!(
                "light.position is {distance_m} m from the camera, must be at most {MAX_LIGHT_DISTANCE_M} m"
            ));
        }
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

/// An error that begins with the file's name.
pub(crate) fn invalid(path: &Path, what: impl std::fmt::Display) -> CameraError {
    CameraError::Invalid(format!("{}: {what}", path.display()))
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
