//! The configuration: what every stage needs to know, gathered in layers.
//!
//! Defaults stand in the stages' own `Params`; files of the system, of the administrator and of the user, a file given by
//! `--config`, environment variables and the command line ([`Overrides`]) are laid on them in this order ([`LayerPlaces`]).
//! Every layer is checked as it is laid on, so that an error names file and line, variable or flag, the key, its value and
//! the bound, and of every key is known who set it ([`LayeredConfig`]). Stages never see [`Config`].

mod layer;
mod layer_places;
mod layers;
mod origin;

mod calibration;
mod calibration_file;
mod calibration_key;
mod calibration_merge;
mod control_params;
mod device_params;

pub use calibration::{
    CalibrationPlaces, CalibrationSource, FoundCalibration, find_calibration, session_folder,
};
pub use calibration_file::{DeviceCalibration, MeasuredLight};
pub use calibration_key::{CalibrationKey, KeyOrigin, KeyOrigins, MeasuredSession, Measurement};
pub use calibration_merge::{
    MergeError, MergeReport, calibration_path, check_merge, merge_into_file,
};
pub use control_params::ControlParams;
pub use device_params::params_for_device;
pub use layer_places::LayerPlaces;
pub use layers::LayeredConfig;
pub use origin::Origin;

use crate::{
    capture::CaptureParams,
    devices::DeviceParams,
    fusion::FusionParams,
    jobs::WorkerParams,
    multipath::MultipathParams,
    refine::{Crop, ObjectParams, RefineParams},
    snapshot::SnapshotParams,
};
use serde::{Deserialize, Serialize};
use std::path::Path;

/// A configuration that makes no sense: the text names its origin, the key, the value and the bound.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("{origin}: {what}")]
pub struct ConfigError {
    /// A file, with its line where there is one, an environment variable, or the command line.
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
    /// The daemon's refinement worker.
    pub worker: WorkerParams,
    /// How the daemon is reached.
    pub control: ControlParams,
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
    /// The layers of this machine, with the file that is given: [`LayerPlaces::of_machine`].
    ///
    /// # Errors
    /// As [`LayeredConfig::read`].
    pub fn layered(given: Option<&Path>, overrides: &Overrides) -> Result<Self, ConfigError> {
        let layered = LayeredConfig::read(&LayerPlaces::of_machine(given), overrides)?;
        for path in &layered.files {
            tracing::debug!(path = %path.display(), "configuration read");
        }
        Ok(layered.config)
    }

    /// Checks every value against its bound.
    ///
    /// # Errors
    /// Names the key, its value and the bound.
    pub fn validate(&self) -> Result<(), String> {
        self.capture.validate()?;
        self.devices.validate()?;
        self.fusion.validate()?;
        self.capture.check_depth_range(self.fusion.depth_max_m)?;
        self.snapshot.validate()?;
        self.object.validate()?;
        self.refine.validate()?;
        self.worker.validate()?;
        self.control.validate()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::collections::BTreeSet;

    const SHIPPED: &str = include_str!("../config/relief.toml");

    fn keys_of(text: &str) -> BTreeSet<String> {
        let mut found = BTreeSet::new();
        let table = toml::from_str(text).unwrap();
        layer::leaves(&table, "", &mut |key, _| {
            found.insert(key);
        });
        found
    }

    #[test]
    fn the_shipped_file_is_complete_and_states_the_defaults() {
        let shipped: Config = toml::from_str(SHIPPED).unwrap();
        assert_eq!(shipped, Config::default());
        let every_key = toml::to_string(&Config::default()).unwrap();
        assert_eq!(keys_of(SHIPPED), keys_of(&every_key));
    }
}
