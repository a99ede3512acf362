//! The configuration: what every stage needs to know, gathered in layers.
//!
//! Defaults stand in the stages' own `Params`; a file given by `--config` overrides them, and the command line overrides
//! both ([`Overrides`]). Every layer is checked as it is laid on, so that an error names the file or the flag, the key, its
//! value and the bound. Stages never see [`Config`].

mod calibration;
mod calibration_file;
mod calibration_key;
mod calibration_merge;
mod device_params;

pub use calibration::{CalibrationPlaces, CalibrationSource, FoundCalibration, find_calibration};
pub use calibration_file::{DeviceCalibration, MeasuredLight};
pub use calibration_key::{CalibrationKey, KeyOrigin, KeyOrigins, MeasuredSession, Measurement};
pub use calibration_merge::{MergeReport, calibration_path, merge_into_file};
pub use device_params::params_for_device;

use crate::{
    capture::CaptureParams,
    devices::DeviceParams,
    fusion::FusionParams,
    multipath::MultipathParams,
    refine::{Crop, ObjectParams, RefineParams},
    snapshot::SnapshotParams,
};
use serde::{Deserialize, Serialize};
use std::{fs, path::Path};

/// A configuration that makes no sense: the text names its origin, the key, the value and the bound.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("{origin}: {what}")]
pub struct ConfigError {
    /// A file, or the command line.
    pub origin: String,
    /// What is wrong.
    pub what: String,
}

impl ConfigError {
    fn in_file(path: &Path, what: impl ToString) -> Self {
        ConfigError {
            origin: path.display().to_string(),
            what: what.to_string().trim_end().to_owned(),
        }
    }
}

/// What every stage needs to know.
#[derive(Clone, Debug, Default, PartialEq, Deserialize, Serialize)]
#[serde(default, deny_unknown_fields)]
pub struct Config {
    /// The device thread and the recorder.
    pub capture: CaptureParams,
    /// Live devices.
    pub devices: DeviceParams,
    /// Multipath of a Kinect II.
    pub multipath: MultipathParams,
    /// Tracking and fusion.
    pub fusion: FusionParams,
    /// Selection of shading images.
    pub snapshot: SnapshotParams,
    /// Which part of the scan becomes meshes.
    pub object: ObjectParams,
    /// Refinement.
    pub refine: RefineParams,
}

/// What the command line says; `None` leaves the value of the layers below.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Overrides {
    /// `fusion.voxel_size_m`.
    pub voxel_size_m: Option<f64>,
    /// `fusion.depth_max_m`.
    pub depth_max_m: Option<f64>,
    /// `snapshot.max_snapshots`.
    pub max_snapshots: Option<usize>,
    /// `fusion.polish.enabled`.
    pub polish_poses: Option<bool>,
    /// `object.crop`.
    pub crop: Option<Crop>,
    /// `object.watertight`.
    pub watertight: Option<bool>,
}

impl Config {
    /// Lays the layers one on the other: defaults, the file if there is one, the command line.
    ///
    /// # Errors
    /// For a file that cannot be read or parsed, and for a value beyond its bound in either layer.
    pub fn layered(file: Option<&Path>, overrides: &Overrides) -> Result<Self, ConfigError> {
        let mut config = match file {
            Some(path) => Config::read(path)?,
            None => Config::default(),
        };
        config.apply(overrides);
        config.validate().map_err(|what| ConfigError {
            origin: "command line".to_owned(),
            what,
        })?;
        Ok(config)
    }

    /// Reads and checks a file; keys that it does not name keep their defaults.
    ///
    /// # Errors
    /// For a file that cannot be read or parsed, naming the line, and for a value beyond its bound.
    pub fn read(path: &Path) -> Result<Self, ConfigError> {
        let text = fs::read_to_string(path).map_err(|error| ConfigError::in_file(path, error))?;
        let config: Config =
            toml::from_str(&text).map_err(|error| ConfigError::in_file(path, error))?;
        config
            .validate()
            .map_err(|what| ConfigError::in_file(path, what))?;
        Ok(config)
    }

    fn apply(&mut self, overrides: &Overrides) {
        let fusion = &mut self.fusion;
        fusion.voxel_size_m = overrides.voxel_size_m.unwrap_or(fusion.voxel_size_m);
        fusion.depth_max_m = overrides.depth_max_m.unwrap_or(fusion.depth_max_m);
        fusion.polish.enabled = overrides.polish_poses.unwrap_or(fusion.polish.enabled);
        let object = &mut self.object;
        object.crop = overrides.crop.unwrap_or(object.crop);
        object.watertight = overrides.watertight.unwrap_or(object.watertight);
        let snapshot = &mut self.snapshot;
        snapshot.max_snapshots = overrides.max_snapshots.unwrap_or(snapshot.max_snapshots);
    }

    /// Checks every value against its bound.
    ///
    /// # Errors
    /// Names the key, its value and the bound.
    pub fn validate(&self) -> Result<(), String> {
        self.capture.validate()?;
        self.devices.validate()?;
        self.fusion.validate()?;
        self.snapshot.validate()?;
        self.object.validate()?;
        self.refine.validate()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::collections::BTreeSet;

    const SHIPPED: &str = include_str!("../config/relief.toml");

    /// Every key of a table, with the names of the tables around it.
    fn keys(table: &toml::Table, prefix: &str, found: &mut BTreeSet<String>) {
        for (key, value) in table {
            let name = format!("{prefix}{key}");
            match value {
                toml::Value::Table(inner) => keys(inner, &format!("{name}."), found),
                _ => {
                    found.insert(name);
                }
            }
        }
    }

    fn keys_of(text: &str) -> BTreeSet<String> {
        let mut found = BTreeSet::new();
        keys(&toml::from_str(text).unwrap(), "", &mut found);
        found
    }

    #[test]
    fn the_shipped_file_is_complete_and_states_the_defaults() {
        let shipped: Config = toml::from_str(SHIPPED).unwrap();
        assert_eq!(shipped, Config::default());
        let every_key = toml::to_string(&Config::default()).unwrap();
        assert_eq!(keys_of(SHIPPED), keys_of(&every_key));
    }

    #[test]
    fn flags_override_the_file_and_errors_name_their_origin() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("mine.toml");
        fs::write(&path, "[fusion]\nvoxel_size_m = 0.004\n").unwrap();
        let overrides = Overrides {
            depth_max_m: Some(3.0),
            ..Overrides::default()
        };
        let config = Config::layered(Some(&path), &overrides).unwrap();
        assert_eq!(
            (config.fusion.voxel_size_m, config.fusion.depth_max_m),
            (0.004, 3.0)
        );

        let bad_flag = Overrides {
            voxel_size_m: Some(0.0),
            ..Overrides::default()
        };
        let error = Config::layered(Some(&path), &bad_flag).unwrap_err();
        assert_eq!(
            error.to_string(),
            "command line: fusion.voxel_size_m is 0, must be 0.0005 to 0.1"
        );

        fs::write(&path, "[fusion]\nvoxel_size = 0.004\n").unwrap();
        let error = Config::read(&path).unwrap_err().to_string();
        assert!(error.starts_with(&path.display().to_string()), "{error}");
        assert!(error.contains("line 2"), "{error}");
        assert!(error.contains("voxel_size"), "{error}");
    }
}
