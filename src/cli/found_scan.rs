//! A scan in an output folder that is read again, to be refined or evaluated.

use super::{
    RecordedScanArgs,
    run::{calibration_folder, calibrations},
};
use relief::{
    config::{
        self, CalibrationPlaces, Config, FoundCalibration, LayerPlaces, LayeredConfig, Overrides,
    },
    pipeline::RecordedScan,
    shading::Calibration,
};
use std::{fs, path::Path};

/// A recorded scan with its configuration and calibration.
pub struct FoundScan {
    /// The configuration.
    pub config: Config,
    /// The scan.
    pub recorded: RecordedScan,
    /// The calibration of its device.
    pub found: FoundCalibration,
    /// What of that it no longer takes, in a sentence.
    pub too_late: Option<String>,
}

impl FoundScan {
    /// Reads what the arguments name.
    pub fn read(args: &RecordedScanArgs) -> anyhow::Result<Self> {
        let config = Config::layered(args.config.as_deref(), &Overrides::default())?;
        let folder = calibrations(args.calibration_dir.as_deref(), args.config.as_deref())?;
        Self::read_with(config, args, &folder)
    }

    /// Reads what the arguments name, with the configuration given and nothing of this machine.
    pub fn read_alone(args: &RecordedScanArgs) -> anyhow::Result<Self> {
        let places = LayerPlaces::only(args.config.as_deref());
        let layered = LayeredConfig::read(&places, &Overrides::default())?;
        // The daemon's worker names its folder, whether there is one or not.
        let folder = calibration_folder(args.calibration_dir.as_deref(), args.config.as_deref());
        Self::read_with(layered.config, args, &folder)
    }

    fn read_with(config: Config, args: &RecordedScanArgs, folder: &Path) -> anyhow::Result<Self> {
        let recorded = RecordedScan::read(&args.output)?;
        let places = CalibrationPlaces {
            given: args.calibration.as_deref(),
            folder,
            session: Some(&args.output),
        };
        let found = config::find_calibration(&recorded.info, &places)?;
        Ok(FoundScan {
            config,
            recorded,
            too_late: too_late(&found, &args.output),
            found,
        })
    }
}

/// What of a calibration the scan in an output folder no longer takes, if it says by which it was fused.
fn too_late(found: &FoundCalibration, output: &Path) -> Option<String> {
    let path = output.join(Calibration::FILE_NAME);
    let text = fs::read_to_string(&path).ok()?;
    let said = match Calibration::from_toml(&text) {
        Ok(as_fused) => found.comes_too_late(&as_fused),
        Err(what) => Some(format!(
            "{}, by which the scan was fused, cannot be understood: {what}",
            path.display()
        )),
    };
    said.inspect(|warning| tracing::warn!("{warning}"))
}
