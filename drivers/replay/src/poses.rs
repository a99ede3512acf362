//! Pose files of the TUM RGB-D benchmark: `timestamp tx ty tz qx qy qz qw`, one a line.

use std::{fs, path::Path};

use depth_camera::CameraError;

use crate::{
    lists::{at_line, check_order, content_lines, parse_time},
    session::invalid,
};

/// Files carry six decimals or more; a quaternion further from unit length is not a rotation that was rounded.
const MAX_NORM_ERROR: f64 = 1e-2;

/// A camera pose at one time, world from camera.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct TimedPose {
    /// The device's clock, seconds.
    pub time_secs: f64,
    /// The camera's position in the world, metres.
    pub translation_m: [f64; 3],
    /// The camera's rotation as a unit quaternion: x, y, z, w.
    pub rotation_xyzw: [f64; 4],
}

/// Reads a pose file; quaternions are normalised, times increase strictly.
///
/// # Errors
/// [`CameraError::Invalid`] naming file, line and value, and for a file that holds no pose.
pub fn read_poses(path: &Path) -> Result<Vec<TimedPose>, CameraError> {
    let text = fs::read_to_string(path).map_err(|error| invalid(path, error))?;
    let mut poses: Vec<TimedPose> = Vec::new();
    for (number, line) in content_lines(&text) {
        let pose = parse_pose(line).map_err(|what| at_line(path, number, what))?;
        if let Some(previous) = poses.last() {
            check_order(previous.time_secs, pose.time_secs)
                .map_err(|what| at_line(path, number, what))?;
        }
        poses.push(pose);
    }
    if poses.is_empty() {
        return Err(invalid(path, "holds no pose"));
    }
    Ok(poses)
}

fn parse_pose(line: &str) -> Result<TimedPose, String> {
    let fields: Vec<&str> = line.split_whitespace().collect();
    let [time, tx, ty, tz, qx, qy, qz, qw] = fields[..] else {
        return Err(format!(
            "{} values, must be 8: timestamp tx ty tz qx qy qz qw",
            fields.len()
        ));
    };
    let quaternion = [
        parse_finite("qx", qx)?,
        parse_finite("qy", qy)?,
        parse_finite("qz", qz)?,
        parse_finite("qw", qw)?,
    ];
    let norm = quaternion.iter().map(|q| q * q).sum::<f64>().sqrt();
    if (norm - 1.0).abs() > MAX_NORM_ERROR {
        return Err(format!(
            "the quaternion's norm is {norm}, must be within {MAX_NORM_ERROR} of 1"
        ));
    }
    Ok(TimedPose {
        time_secs: parse_time(time)?,
        translation_m: [
            parse_finite("tx", tx)?,
            parse_finite("ty", ty)?,
            parse_finite("tz", tz)?,
        ],
        rotation_xyzw: quaternion.map(|q| q / norm),
    })
}

fn parse_finite(key: &str, text: &str) -> Result<f64, String> {
    match text.parse::<f64>() {
        Ok(value) if value.is_finite() => Ok(value),
        _ => Err(format!("{key} is \"{text}\", must be a finite number")),
    }
}
