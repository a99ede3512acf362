//! `relief calibrate offset`: where the IR image lies against the depth image.

use super::{OffsetArgs, check_beforehand, conclude, measured_session, merge, next_frame, open};
use crate::cli::{
    run::{Verdict, calibration_folder, session_name},
    stdout::Stdout,
    stopping::check_wanted,
};
use anyhow::{Context, ensure};
use depth_camera::{DepthCamera, Sensor};
use freenect1::NOMINAL_IR_OFFSET_PX;
use relief::{
    calibrate::{ImageOffset, OffsetEstimate, combine_offsets, image_offset},
    config::{CalibrationKey, Config, DeviceCalibration, Measurement, Overrides, calibration_path},
    fusion::TrackingOutcome,
    geometry::Pose,
    snapshot::{SnapshotParams, SnapshotSelector, TrackedFrame},
};
use std::{
    collections::BTreeMap,
    io::{self, Write},
    path::Path,
    sync::atomic::AtomicBool,
    time::SystemTime,
};

/// `relief calibrate offset`; of a Kinect II, whose offset is known, it only says what it finds.
pub fn offset(args: &OffsetArgs, stop: &AtomicBool) -> anyhow::Result<Verdict> {
    let config = Config::layered(None, &Overrides::default())?;
    let mut camera = open(&args.session, &config)?;
    let info = camera.info().clone();
    let serial = args.file.serial.clone().unwrap_or(info.serial.clone());
    let path = calibration_path(
        &calibration_folder(args.file.calibration_dir.as_deref(), None),
        &serial,
    )?;
    let full_scale = info
        .ir_full_scale
        .context("the session has no infrared images")?;
    let mut measured = DeviceCalibration::new(serial, info.sensor);
    let key = CalibrationKey::IrOffset;
    let is_written = !args.file.dry_run && info.sensor == Sensor::Kinect1;
    if is_written {
        check_beforehand(&path, &measured, &[key], args.file.replace)?;
    }
    let offsets = match info.sensor {
        Sensor::Kinect1 => of_shading_images(camera.as_mut(), full_scale, stop)?,
        Sensor::Kinect2 => of_every_frame(camera.as_mut(), full_scale, stop)?,
    };
    let estimate = combine_offsets(&offsets)?;
    check_wanted(stop)?;
    measured.ir_offset_px = Some(estimate.offset_px);
    let write = || {
        let measurement = measurement(&estimate, &args.session)?;
        measured.measured.insert(key, measurement);
        merge(&path, &measured, &info, args.file.replace)
    };
    let written = is_written.then(write).transpose();
    let printed = print(&estimate, info.sensor);
    conclude(&[key], &path, written, printed)
}

/// A Kinect I: the images under the lamp, each with the depth before the projector was covered.
fn of_shading_images(
    camera: &mut dyn DepthCamera,
    full_scale: f64,
    stop: &AtomicBool,
) -> anyhow::Result<Vec<ImageOffset>> {
    let params = SnapshotParams::default();
    let max_covered_share = params.max_covered_depth_share;
    let mut selector = SnapshotSelector::new(camera.info(), params)
        .context("the session has no light for its infrared images")?;
    while let Some(frame) = next_frame(camera, stop)? {
        // The pose does not matter here: depth and IR are compared on the image.
        let outcome = match frame.depth_share() > max_covered_share {
            true => TrackingOutcome::Tracked {
                world_from_camera: Pose::identity(),
                fit: None,
            },
            false => TrackingOutcome::NoDepth,
        };
        selector.observe(&TrackedFrame {
            frame: &frame,
            outcome: &outcome,
            model: None,
        });
    }
    let accepted = selector.finish().accepted;
    ensure!(
        !accepted.is_empty(),
        "the session has no shading image: depth empty, lamp lit, no speckle"
    );
    let mut offsets = Vec::new();
    for image in &accepted {
        check_wanted(stop)?;
        offsets.extend(image_offset(&image.depth_m, &image.ir_counts, full_scale));
    }
    Ok(offsets)
}

/// A Kinect II: depth and IR of every frame.
fn of_every_frame(
    camera: &mut dyn DepthCamera,
    full_scale: f64,
    stop: &AtomicBool,
) -> anyhow::Result<Vec<ImageOffset>> {
    let mut offsets = Vec::new();
    while let Some(frame) = next_frame(camera, stop)? {
        if let (Some(depth_m), Some(ir)) = (&frame.depth, &frame.ir) {
            let ir_counts = ir.map(|&counts| f32::from(counts));
            offsets.extend(image_offset(depth_m, &ir_counts, full_scale));
        }
    }
    Ok(offsets)
}

fn print(estimate: &OffsetEstimate, sensor: Sensor) -> io::Result<()> {
    let [right, down] = estimate.offset_px;
    let [right_interval, down_interval] = estimate.half_interval_px;
    writeln!(
        Stdout,
        "the infrared image lies {right:+.2} ± {right_interval:.2} px right of and {down:+.2} ± {down_interval:.2} px below the \
         depth image"
    )?;
    writeln!(
        Stdout,
        "from {} edges in {} images; the depth's silhouettes lie {:.2} px inside the true ones",
        estimate.n_edges, estimate.n_images, estimate.erosion_px
    )?;
    match sensor {
        Sensor::Kinect1 => writeln!(
            Stdout,
            "a raw Kinect I has about ({}, {}), one whose driver or recording removed it (0, 0)",
            NOMINAL_IR_OFFSET_PX[0], NOMINAL_IR_OFFSET_PX[1]
        ),
        Sensor::Kinect2 => writeln!(
            Stdout,
            "a Kinect II has (0, 0), depth and infrared are one image: nothing is written"
        ),
    }
}

fn measurement(estimate: &OffsetEstimate, session: &Path) -> anyhow::Result<Measurement> {
    let session = measured_session(session_name(session), session)?;
    let figures = [
        ("right_half_interval_px", estimate.half_interval_px[0]),
        ("down_half_interval_px", estimate.half_interval_px[1]),
        ("erosion_px", estimate.erosion_px),
        ("edges", estimate.n_edges as f64),
        ("images", estimate.n_images as f64),
    ];
    let figures: BTreeMap<_, _> = figures.map(|(name, value)| (name.to_owned(), value)).into();
    Ok(Measurement::new(SystemTime::now(), vec![session], figures))
}
