//! `relief calibrate depth`: how bright white is, which tells how strong multipath is, and what depth gets wrong by range alone.

use super::{DepthArgs, check_beforehand, conclude, measured_session, merge, next_frame, open};
use crate::cli::{
    run::{Verdict, all_processors, calibration_folder, session_name},
    stdout::Stdout,
    stopping::check_wanted,
};
use anyhow::ensure;
use depth_camera::Sensor;
use relief::{
    calibrate::INTERVAL_SIGMAS,
    config::{
        CalibrationKey, CalibrationPlaces, Config, DeviceCalibration, Measurement, Overrides,
        calibration_path, find_calibration,
    },
    depth_correction::{DepthCorrection, MeasuredDepth, MeasuredWhite},
    fusion::{DepthNoise, Fusion, FusionParams},
    geometry::CameraModel,
    shading::{Calibration, LightCalibration},
};
use std::{
    collections::BTreeMap,
    io::{self, Write},
    path::Path,
    sync::atomic::AtomicBool,
    time::SystemTime,
};

/// `relief calibrate depth`.
pub fn depth(args: &DepthArgs, stop: &AtomicBool) -> anyhow::Result<Verdict> {
    let config = Config::layered(args.config.as_deref(), &Overrides::default())?;
    let mut camera = open(&args.session, &config)?;
    let info = camera.info().clone();
    ensure!(
        info.sensor == Sensor::Kinect2,
        "the session is of a {}: multipath is a kinect2's, and the slow error of a kinect1 is measured by every scan itself",
        info.sensor.name()
    );
    let folder = calibration_folder(args.file.calibration_dir.as_deref(), None);
    let serial = args.file.serial.clone().unwrap_or(info.serial.clone());
    let path = calibration_path(&folder, &serial)?;
    let mut device = DeviceCalibration::new(serial, info.sensor);
    if !args.file.dry_run {
        let keys = [CalibrationKey::LightWhiteLevel, CalibrationKey::RangeError];
        check_beforehand(&path, &device, &keys, args.file.replace)?;
    }
    let places = CalibrationPlaces {
        given: path.exists().then_some(path.as_path()),
        folder: &folder,
        session: Some(&args.session),
    };
    let calibration = without_white_level(find_calibration(&info, &places)?.calibration);
    let params = FusionParams {
        range_error: true,
        ..config.fusion
    };
    let mut correction = DepthCorrection::new(&info, &calibration, true, &params);
    let pool = rayon::ThreadPoolBuilder::new()
        .num_threads(all_processors().get())
        .build()?;
    let measured = pool.install(|| -> anyhow::Result<_> {
        let camera_model = CameraModel::new(info.intrinsics);
        let noise = DepthNoise::of_sensor(info.sensor);
        let mut fusion = Fusion::new(camera_model, noise, params);
        while let Some(frame) = next_frame(camera.as_mut(), stop)? {
            correction.thin_out(&fusion);
            let corrected = correction.correct(&frame).unwrap_or(frame);
            if let Some(depth_m) = &corrected.depth {
                fusion.fuse(depth_m, corrected.device_time_secs);
            }
        }
        Ok(correction.measure(&fusion, &|_| check_wanted(stop).is_ok()))
    })?;
    check_wanted(stop)?;
    if let Some(wrong) = measured.wrong_rays {
        tracing::warn!("{wrong}");
    }
    device.light.white_level = measured.white.map(|measured| measured.white.0);
    let known = DeviceCalibration::read_if_there(&path)?.and_then(|file| file.range_error_m);
    device.range_error_m = measured
        .range_error
        .clone()
        .filter(|_| known != measured.range_error);
    let keys: Vec<CalibrationKey> = device.keys().collect();
    ensure!(
        !keys.is_empty(),
        "the session shows no multipath, and nothing new of what range gets wrong: scan a matt object on a table from many sides, with depth and infrared"
    );
    let write = || {
        for key in &keys {
            let measurement = measurement(*key, &measured, &args.session)?;
            device.measured.insert(*key, measurement);
        }
        merge(&path, &device, &info, args.file.replace)
    };
    let written = (!args.file.dry_run).then(write).transpose();
    let printed = print(&measured);
    conclude(&keys, &path, written, printed)
}

/// A calibration that leaves to the scan how bright white is.
fn without_white_level(calibration: Calibration) -> Calibration {
    let light = LightCalibration {
        white_level: None,
        ..calibration.light
    };
    Calibration {
        light,
        ..calibration
    }
}

fn print(measured: &MeasuredDepth) -> io::Result<()> {
    match &measured.white {
        Some(measured) => {
            let white = measured.white.0;
            writeln!(
                Stdout,
                "a perfectly white surface a metre before the light shows {white:.3} ± {:.3} of full scale",
                half_interval(measured)
            )?;
            writeln!(
                Stdout,
                "views of one place then disagree by {:.2} mm, root mean square over {} patches",
                1e3 * measured.evidence.residual_m,
                measured.evidence.n_patches
            )?;
        }
        None => writeln!(Stdout, "the session shows no multipath")?,
    }
    if measured.constant_m != 0.0 {
        writeln!(
            Stdout,
            "the scan shows that all ranges alike are off by {:+.1} mm, within 5 mm or so",
            1e3 * measured.constant_m
        )?;
    }
    match &measured.range_error {
        Some(error) => writeln!(
            Stdout,
            "by its range alone depth is up to {:.1} mm off from {:.2} to {:.2} m",
            1e3 * error.largest_m(),
            error.from_m(),
            error.to_m()
        ),
        None => writeln!(Stdout, "by its range alone depth is not known to be off"),
    }
}

/// Of the white level, with 95 %.
fn half_interval(measured: &MeasuredWhite) -> f64 {
    INTERVAL_SIGMAS * measured.relative_sigma * measured.white.0
}

fn measurement(
    key: CalibrationKey,
    measured: &MeasuredDepth,
    session: &Path,
) -> anyhow::Result<Measurement> {
    let session = measured_session(session_name(session), session)?;
    let mut figures = BTreeMap::new();
    let mut state = |name: &str, value: f64| figures.insert(name.to_owned(), value);
    if key == CalibrationKey::RangeError && measured.constant_m != 0.0 {
        state("constant_m", measured.constant_m);
    }
    if let Some(white) = &measured.white {
        state("disagreement_m", white.evidence.residual_m);
        state("patches", white.evidence.n_patches as f64);
        if key == CalibrationKey::LightWhiteLevel {
            state("half_interval_95", half_interval(white));
        }
    }
    Ok(Measurement::new(SystemTime::now(), vec![session], figures))
}
