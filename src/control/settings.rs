//! What scans are made with: the configuration, read anew on request.

use super::camera_source::CameraSource;
use crate::{
    config::{
        self, CalibrationPlaces, Config, ConfigError, ControlParams, FoundCalibration, Overrides,
    },
    devices::DeviceParams,
    jobs::WorkerParams,
    lock::lock,
    pipeline::{PipelineParams, WhenFull},
};
use depth_camera::CameraInfo;
use std::{
    num::NonZeroUsize,
    path::{Path, PathBuf},
    sync::{Mutex, MutexGuard},
    thread,
};

/// Where the settings come from.
#[derive(Clone, Debug)]
pub struct SettingsPlaces {
    /// The configuration; without one all keys keep their defaults.
    pub config: Option<PathBuf>,
    /// The calibration that the operator names.
    pub calibration: Option<PathBuf>,
    /// The folder of the calibrations named by serial number.
    pub calibration_dir: PathBuf,
    /// Threads of each pool.
    pub n_threads: NonZeroUsize,
    /// Whether frames are recorded.
    pub record: bool,
}

/// The settings in force, and why the newest file is not, if it is not.
#[derive(Debug)]
pub struct Settings {
    places: SettingsPlaces,
    current: Mutex<Current>,
}

#[derive(Clone, Debug)]
struct Current {
    config: Config,
    error: Option<ConfigError>,
}

impl Settings {
    /// Reads the settings.
    ///
    /// # Errors
    /// For a configuration that cannot be read or makes no sense.
    pub fn read(places: SettingsPlaces) -> Result<Self, ConfigError> {
        let config = read_config(&places)?;
        Ok(Settings {
            places,
            current: Mutex::new(Current {
                config,
                error: None,
            }),
        })
    }

    /// Reads the file anew, for the scans that start from now on; if it makes no sense the old settings stay.
    ///
    /// # Errors
    /// As [`Settings::read`]; the error is kept until a reload goes well.
    pub fn reload(&self) -> Result<(), ConfigError> {
        let read = read_config(&self.places);
        let mut current = self.current();
        match read {
            Ok(config) => {
                *current = Current {
                    config,
                    error: None,
                };
                Ok(())
            }
            Err(error) => {
                current.error = Some(error.clone());
                Err(error)
            }
        }
    }

    /// The configuration in force.
    pub fn config(&self) -> Config {
        self.current().config.clone()
    }

    /// What refinements are made with, as TOML, all keys; it names them. How they are run and how the daemon is reached changes
    /// nothing of what comes of them, and stands there as by default.
    pub fn of_refinement(&self) -> String {
        let config = Config {
            worker: WorkerParams::default(),
            control: ControlParams::default(),
            ..self.config()
        };
        // A configuration came from TOML, or is the default, which a test writes as TOML.
        toml::to_string(&config).unwrap_or_default()
    }

    /// Threads of each pool.
    pub fn n_threads(&self) -> NonZeroUsize {
        self.places.n_threads
    }

    /// Where calibrations named by serial number lie.
    pub fn calibration_dir(&self) -> &Path {
        &self.places.calibration_dir
    }

    /// Why the newest file is not in force.
    pub fn error(&self) -> Option<ConfigError> {
        self.current().error.clone()
    }

    /// Whether there is a file to read anew, and which.
    pub fn file(&self) -> Option<&Path> {
        self.places.config.as_deref()
    }

    /// What a driver has to know of a device.
    ///
    /// # Errors
    /// For a calibration that cannot be read.
    pub fn device_params(&self, serial: &str) -> Result<DeviceParams, ConfigError> {
        let places = CalibrationPlaces {
            given: self.places.calibration.as_deref(),
            folder: &self.places.calibration_dir,
            session: None,
        };
        config::params_for_device(serial, &places, &self.config().devices)
    }

    /// What a scan with a camera is to know; refinement is another process's.
    ///
    /// # Errors
    /// For a calibration that cannot be read or makes no sense.
    pub fn scan_params(
        &self,
        session: &str,
        info: &CameraInfo,
        source: &CameraSource,
    ) -> Result<PipelineParams, ConfigError> {
        let config = self.config();
        let found = config::find_calibration(
            info,
            &CalibrationPlaces {
                given: self.places.calibration.as_deref(),
                folder: &self.places.calibration_dir,
                session: source.session(),
            },
        )?;
        Ok(PipelineParams {
            is_refined: false,
            n_threads: self.places.n_threads,
            when_full: WhenFull::Drop,
            record: self.places.record,
            ..params_of_run(session.to_owned(), config, found, info)
        })
    }

    fn current(&self) -> MutexGuard<'_, Current> {
        lock(&self.current)
    }
}

/// What a run is to know by its configuration and its calibration, which is announced. All else is as `relief replay` has it without
/// flags: the run refines, tracks, finds the object, takes all processors, lets frames wait, and does not record them.
pub fn params_of_run(
    session: String,
    config: Config,
    found: FoundCalibration,
    info: &CameraInfo,
) -> PipelineParams {
    PipelineParams {
        session,
        capture: config.capture,
        multipath: config.multipath,
        fusion: config.fusion,
        snapshot: config.snapshot,
        object: config.object,
        refine: config.refine,
        is_refined: true,
        warnings: found.announce(info),
        calibration_source: found.source.to_string(),
        calibration: found.calibration,
        roi: None,
        poses: None,
        n_threads: all_processors(),
        when_full: WhenFull::Block,
        record: false,
    }
}

/// As many threads as there are processors.
pub fn all_processors() -> NonZeroUsize {
    thread::available_parallelism().unwrap_or(NonZeroUsize::MIN)
}

fn read_config(places: &SettingsPlaces) -> Result<Config, ConfigError> {
    Config::layered(places.config.as_deref(), &Overrides::default())
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::fs;

    /// Settings with a configuration file, in whose folder calibrations are looked for.
    fn read(config: &Path) -> Settings {
        Settings::read(SettingsPlaces {
            config: Some(config.to_owned()),
            calibration: None,
            calibration_dir: config.parent().unwrap().to_owned(),
            n_threads: NonZeroUsize::MIN,
            record: false,
        })
        .unwrap()
    }

    #[test]
    fn a_file_that_makes_no_sense_changes_nothing_and_is_told_of() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("relief.toml");
        fs::write(&path, "[fusion]\nvoxel_size_m = 0.004\n").unwrap();
        let settings = read(&path);
        fs::write(&path, "[fusion]\nvoxel_size_m = -1.0\n").unwrap();
        settings.reload().unwrap_err();
        assert_eq!(settings.config().fusion.voxel_size_m, 0.004);
        let error = settings.error().unwrap().to_string();
        assert!(error.contains("fusion.voxel_size_m is -1"), "{error}");
        fs::write(&path, "[fusion]\nvoxel_size_m = 0.005\n").unwrap();
        settings.reload().unwrap();
        assert_eq!(settings.config().fusion.voxel_size_m, 0.005);
        assert_eq!(settings.error(), None);
    }

    #[test]
    fn what_refinements_are_made_with_does_not_tell_how_they_are_run() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("relief.toml");
        let made_with = |text: &str| {
            fs::write(&path, text).unwrap();
            read(&path).of_refinement()
        };
        let plain = made_with("");
        assert_eq!(made_with("[worker]\nnice = 5\n"), plain);
        assert_ne!(made_with("[refine]\nn_rounds = 2\n"), plain);
        let read: Config = toml::from_str(&plain).unwrap();
        assert_eq!(read.refine, Config::default().refine);
    }
}
