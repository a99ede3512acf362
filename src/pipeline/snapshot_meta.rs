//! What stands beside a shading image in an output folder: all that is needed to refine from it again.

use crate::geometry::{Pose, increment, increment_of};
use crate::snapshot::ShadingSnapshot;
use depth_camera::{CameraInfo, Intrinsics, Light, LightKind, Sensor};
use serde::{Deserialize, Serialize};
use serde_json::Value;

/// No camera turns (rad) or moves (m) farther over a pause.
const MAX_MOVED: f64 = 1.0;

/// The contents of `meta.json`.
#[derive(Clone, Debug, PartialEq, Deserialize, Serialize)]
pub struct SnapshotMeta {
    /// The (first) frame.
    pub frame_id: u64,
    /// The device's own clock, seconds.
    pub device_time_secs: f64,
    /// How many exposures were averaged.
    pub n_exposures: usize,
    sensor: String,
    serial: String,
    driver: Option<String>,
    ir_full_scale: Option<f64>,
    /// The device's gain when it was taken, as read back.
    #[serde(default)]
    ir_gain: Option<u16>,
    light_position_camera_m: Option<[f64; 3]>,
    intrinsics: Intrinsics,
    /// How the camera moved over the pause for it, where it did not rest: a turn (rotation vector, rad), then a shift (m), in the camera
    /// frame.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    camera_moved: Option<[f64; 6]>,
}

impl SnapshotMeta {
    /// What is to be said of a snapshot and its camera.
    pub fn new(snapshot: &ShadingSnapshot, info: &CameraInfo) -> Self {
        SnapshotMeta {
            frame_id: snapshot.frame_id,
            device_time_secs: snapshot.device_time_secs,
            n_exposures: snapshot.n_exposures,
            sensor: info.sensor.name().to_owned(),
            serial: info.serial.clone(),
            driver: info.driver.clone(),
            ir_full_scale: info.ir_full_scale,
            ir_gain: info.ir_gain,
            light_position_camera_m: info.light.map(|light| light.position_m),
            intrinsics: info.intrinsics,
            camera_moved: snapshot.moved.map(|moved| increment_of(&moved).into()),
        }
    }

    /// How the camera moved over the pause for it; `None` where it rested, or nobody knows.
    pub fn moved(&self) -> Option<Pose> {
        self.camera_moved.map(|moved| increment(&moved.into()))
    }

    /// As it is written.
    pub fn to_json(&self) -> Value {
        serde_json::to_value(self).expect("its keys are strings")
    }

    /// The camera; the error names the key that makes no sense.
    pub fn camera(&self) -> Result<CameraInfo, String> {
        let sensor = Sensor::from_name(&self.sensor)
            .ok_or_else(|| format!("sensor is \"{}\", which is unknown", self.sensor))?;
        let i = &self.intrinsics;
        i.check_size()
            .map_err(|what| format!("intrinsics.{what}"))?;
        for (key, focal_px) in [("fx", i.fx), ("fy", i.fy)] {
            if !(focal_px > 0.0 && focal_px.is_finite()) {
                return Err(format!("intrinsics.{key} is {focal_px}, must be positive"));
            }
        }
        if let Some(full_scale) = self.ir_full_scale
            && !(full_scale > 0.0 && full_scale.is_finite())
        {
            return Err(format!(
                "ir_full_scale is {full_scale}, must be positive and finite"
            ));
        }
        let moved = self.camera_moved.iter().flatten();
        if let Some(part) = moved.copied().find(|part| part.abs() > MAX_MOVED) {
            return Err(format!(
                "camera_moved has {part}, must be within {MAX_MOVED} of 0"
            ));
        }
        let kind = match sensor {
            Sensor::Kinect1 => LightKind::Lamp,
            Sensor::Kinect2 => LightKind::Emitter,
        };
        let light = |position_m| Light { position_m, kind };
        Ok(CameraInfo {
            sensor,
            serial: self.serial.clone(),
            driver: self.driver.clone(),
            intrinsics: self.intrinsics,
            ir_full_scale: self.ir_full_scale,
            ir_gain: self.ir_gain,
            light: self.light_position_camera_m.map(light),
            n_frames: None,
        })
    }
}
