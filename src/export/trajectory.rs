//! Trajectories in the text format of the TUM RGB-D benchmark, which every evaluation tool reads.

use super::{ExportError, atomic::write_atomically};
use crate::geometry::Pose;
use nalgebra::{Isometry3, Quaternion, Translation3, UnitQuaternion};
use std::{fs, io::Write, path::Path};

/// The first line of every trajectory that we write.
pub(super) const TUM_HEADER: &str =
    "# timestamp tx ty tz qx qy qz qw (seconds, metres, world from camera)";

/// Writes poses, each with its time in seconds, one to a line: `timestamp tx ty tz qx qy qz qw`, world from camera.
///
/// Times keep six decimals, positions and quaternions nine.
///
/// # Errors
/// [`ExportError::Unfit`] if a number is not finite; [`ExportError::Write`] if the file cannot be written.
pub fn write_trajectory(path: &Path, poses: &[(f64, Pose)]) -> Result<(), ExportError> {
    for (index, (time_secs, world_from_camera)) in poses.iter().enumerate() {
        check_pose(*time_secs, world_from_camera)
            .map_err(|what| ExportError::unfit(path, format!("pose {index}: {what}")))?;
    }
    write_atomically(path, |file| {
        writeln!(file, "{TUM_HEADER}")?;
        for (time_secs, world_from_camera) in poses {
            writeln!(file, "{}", tum_line(*time_secs, world_from_camera))?;
        }
        Ok(())
    })
}

/// Reads the trajectory of a TUM text file; empty lines and lines that begin with `#` are skipped.
///
/// # Errors
/// [`ExportError::Read`] if the file cannot be read; [`ExportError::Malformed`], naming the line, if a line has not eight
/// finite numbers or its quaternion is not of unit length within 1 %.
pub fn read_trajectory(path: &Path) -> Result<Vec<(f64, Pose)>, ExportError> {
    let text = fs::read_to_string(path).map_err(|cause| ExportError::read(path, cause))?;
    let mut poses = Vec::new();
    for (number, line) in text.lines().enumerate() {
        let line = line.trim();
        if line.is_empty() || line.starts_with('#') {
            continue;
        }
        poses.push(parse_tum_line(line).map_err(|what| {
            ExportError::malformed(path, format!("line {}: {what}", number + 1))
        })?);
    }
    Ok(poses)
}

/// Says which part of a pose is not finite.
pub(super) fn check_pose(time_secs: f64, pose: &Pose) -> Result<(), String> {
    let numbers = pose
        .translation
        .vector
        .iter()
        .chain(pose.rotation.coords.iter());
    if !time_secs.is_finite() {
        return Err(format!("the time is {time_secs} s"));
    }
    match numbers.copied().find(|x| !x.is_finite()) {
        Some(_) => Err("the pose is not finite".into()),
        None => Ok(()),
    }
}

/// A pose as the TUM format has it: `tx ty tz qx qy qz qw`, translation in metres.
pub fn tum_numbers(pose: &Pose) -> [f64; 7] {
    let (t, q) = (&pose.translation.vector, &pose.rotation.coords);
    [t.x, t.y, t.z, q.x, q.y, q.z, q.w]
}

/// One line of a TUM file, without its end.
pub(super) fn tum_line(time_secs: f64, world_from_camera: &Pose) -> String {
    let [tx, ty, tz, qx, qy, qz, qw] = tum_numbers(world_from_camera);
    format!("{time_secs:.6} {tx:.9} {ty:.9} {tz:.9} {qx:.9} {qy:.9} {qz:.9} {qw:.9}")
}

fn parse_tum_line(line: &str) -> Result<(f64, Pose), String> {
    let mut numbers = Vec::with_capacity(8);
    for word in line.split_ascii_whitespace() {
        let number: f64 = word
            .parse()
            .map_err(|_| format!("`{word}` is not a number"))?;
        if !number.is_finite() {
            return Err(format!("`{word}` is not finite"));
        }
        numbers.push(number);
    }
    let [time_secs, tx, ty, tz, qx, qy, qz, qw] = numbers[..] else {
        return Err(format!("{} numbers, must be 8", numbers.len()));
    };
    let quaternion = Quaternion::new(qw, qx, qy, qz);
    if (quaternion.norm() - 1.0).abs() > 0.01 {
        let norm = quaternion.norm();
        return Err(format!("the quaternion's length is {norm:.3}, must be 1"));
    }
    let rotation = UnitQuaternion::from_quaternion(quaternion);
    Ok((
        time_secs,
        Isometry3::from_parts(Translation3::new(tx, ty, tz), rotation),
    ))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::{increment, motion_between};
    use nalgebra::Vector6;

    #[test]
    fn poses_survive_the_round_trip() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("trajectory.txt");
        let poses: Vec<(f64, Pose)> = (0..20)
            .map(|k| {
                let s = k as f64 / 7.0;
                let xi = Vector6::new(s, 0.4 - s, s * s, -s, 2.0 * s, 0.1);
                (1_305_031_102.175_304 + s, increment(&xi))
            })
            .collect();
        write_trajectory(&path, &poses).unwrap();
        assert!(
            fs::read_to_string(&path)
                .unwrap()
                .starts_with("# timestamp")
        );
        let back = read_trajectory(&path).unwrap();
        assert_eq!(back.len(), poses.len());
        for ((time, pose), (time_back, pose_back)) in poses.iter().zip(&back) {
            let motion = motion_between(pose, pose_back);
            // Rounding of the ninth decimal; half a microsecond of time.
            assert!(motion.translation_m < 2e-9 && motion.rotation_rad < 1e-8);
            assert!((time - time_back).abs() < 1e-6);
        }
    }

    #[test]
    fn defects_are_named_with_their_line() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("bad.txt");
        let fault = |text: &str| {
            fs::write(&path, text).unwrap();
            read_trajectory(&path).unwrap_err().to_string()
        };
        assert!(fault("# ok\n1 2 3\n").contains("line 2: 3 numbers"));
        assert!(fault("0 0 0 0 0 0 0 0.5\n").contains("0.500"));
        assert!(fault("0 0 0 x 0 0 0 1\n").contains("`x`"));
        assert!(fault("0 0 0 nan 0 0 0 1\n").contains("not finite"));
        let poses = [(f64::NAN, Pose::identity())];
        assert!(write_trajectory(&path, &poses).is_err());
    }
}
