//! Values of options, as they are written on the command line.

use anyhow::{Context, anyhow, bail, ensure};
use clap::ValueEnum;
use depth_camera::Sensor;
use nalgebra::{Quaternion, Translation3, Unit};
use relief::geometry::Pose;
use relief::refine::{Crop, MAX_VIEWS, Roi};
use std::{num::NonZeroUsize, str::FromStr};

/// A number of folds, at most one for each view.
pub fn folds(text: &str) -> anyhow::Result<usize> {
    let n: usize = text
        .parse()
        .with_context(|| format!("\"{text}\" is no number"))?;
    ensure!(
        n == 0 || (2..=MAX_VIEWS).contains(&n),
        "{n} folds, must be 0 or 2 to {MAX_VIEWS}"
    );
    Ok(n)
}

/// More threads than any machine has use for.
const MAX_THREADS: usize = 1024;

/// A number of threads.
pub fn threads(text: &str) -> anyhow::Result<NonZeroUsize> {
    let n: usize = text
        .parse()
        .with_context(|| format!("\"{text}\" is no number"))?;
    NonZeroUsize::new(n)
        .filter(|n| n.get() <= MAX_THREADS)
        .with_context(|| format!("{n} threads, must be 1 to {MAX_THREADS}"))
}

/// A sensor by name.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum SensorArg {
    /// Structured light
    Kinect1,
    /// Time of flight
    Kinect2,
}

impl From<SensorArg> for Sensor {
    fn from(arg: SensorArg) -> Sensor {
        match arg {
            SensorArg::Kinect1 => Sensor::Kinect1,
            SensorArg::Kinect2 => Sensor::Kinect2,
        }
    }
}

/// A box as six numbers.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct RoiArg(pub Roi);

impl FromStr for RoiArg {
    type Err = anyhow::Error;

    fn from_str(text: &str) -> anyhow::Result<Self> {
        let roi = Roi::of_bounds(numbers(text)?).map_err(anyhow::Error::msg)?;
        Ok(RoiArg(roi))
    }
}

/// A pose as seven numbers: translation in metres, quaternion with its real part last.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PoseArg(pub Pose);

impl FromStr for PoseArg {
    type Err = anyhow::Error;

    fn from_str(text: &str) -> anyhow::Result<Self> {
        let [tx, ty, tz, qx, qy, qz, qw] = numbers(text)?;
        let rotation = Unit::try_new(Quaternion::new(qw, qx, qy, qz), 1e-6)
            .with_context(|| format!("the quaternion of \"{text}\" has no length"))?;
        let translation = Translation3::new(tx, ty, tz);
        Ok(PoseArg(Pose::from_parts(translation, rotation)))
    }
}

/// Which part of the scene is taken.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct CropArg(pub Crop);

impl FromStr for CropArg {
    type Err = anyhow::Error;

    fn from_str(text: &str) -> anyhow::Result<Self> {
        let crop = match (text, text.strip_prefix("box=")) {
            ("none", _) => Crop::None,
            ("object", _) => Crop::Object,
            (_, Some(bounds)) => {
                let bounds = numbers(bounds)?;
                Roi::of_bounds(bounds).map_err(anyhow::Error::msg)?;
                Crop::Box(bounds)
            }
            _ => {
                bail!("\"{text}\" is neither none nor object nor box=XMIN,YMIN,ZMIN,XMAX,YMAX,ZMAX")
            }
        };
        Ok(CropArg(crop))
    }
}

/// So many finite numbers between commas.
pub fn numbers<const N: usize>(text: &str) -> anyhow::Result<[f64; N]> {
    let mut numbers = Vec::new();
    for number in text.split(',') {
        let value: f64 = number
            .trim()
            .parse()
            .with_context(|| format!("\"{number}\" is no number"))?;
        ensure!(value.is_finite(), "{value} must be finite");
        numbers.push(value);
    }
    let n_numbers = numbers.len();
    <[f64; N]>::try_from(numbers).map_err(|_| anyhow!("{n_numbers} numbers, must be {N}"))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_box_needs_six_numbers_in_order() {
        let roi = "-0.1,-0.2,0.3,0.1,0.2,0.9".parse::<RoiArg>().unwrap().0;
        assert_eq!((roi.min.y, roi.max.z), (-0.2, 0.9));
        for (text, message) in [
            ("1,2,3", "3 numbers, must be 6"),
            ("0,0,0,1,x,1", "\"x\" is no number"),
            ("0,0,0,1,0,1", "ymin is 0, must be below ymax, 0"),
            ("0,0,0,1,nan,1", "NaN must be finite"),
        ] {
            let error = text.parse::<RoiArg>().unwrap_err();
            assert_eq!(error.to_string(), message);
            let error = format!("box={text}").parse::<CropArg>().unwrap_err();
            assert_eq!(error.to_string(), message);
        }
    }

    #[test]
    fn folds_are_as_many_as_views_may_be() {
        for n in [0, 2, MAX_VIEWS] {
            assert_eq!(folds(&n.to_string()).unwrap(), n);
        }
        for n in [1, MAX_VIEWS + 1] {
            assert_eq!(
                folds(&n.to_string()).unwrap_err().to_string(),
                format!("{n} folds, must be 0 or 2 to {MAX_VIEWS}")
            );
        }
    }

    #[test]
    fn threads_are_as_many_as_a_machine_may_have() {
        assert_eq!(threads("1024").unwrap().get(), 1024);
        for (text, message) in [
            ("0", "0 threads, must be 1 to 1024"),
            ("100000", "100000 threads, must be 1 to 1024"),
            ("two", "\"two\" is no number"),
        ] {
            assert_eq!(threads(text).unwrap_err().to_string(), message);
        }
    }

    #[test]
    fn a_pose_is_seven_numbers() {
        let pose = "0.1,-0.2,0.3,0,0,2,0".parse::<PoseArg>().unwrap().0;
        let point = pose * nalgebra::Point3::new(1.0, 0.0, 0.0);
        assert!((point - nalgebra::Point3::new(-0.9, -0.2, 0.3)).norm() < 1e-12);
        let error = |text: &str| text.parse::<PoseArg>().unwrap_err().to_string();
        assert_eq!(error("1,2,3"), "3 numbers, must be 7");
        assert!(error("0,0,0,0,0,0,0").contains("has no length"));
    }

    #[test]
    fn a_crop_is_a_word_or_a_box() {
        let crop = |text: &str| text.parse::<CropArg>().map(|crop| crop.0);
        assert_eq!(crop("none").unwrap(), Crop::None);
        assert_eq!(crop("object").unwrap(), Crop::Object);
        let bounds = [-0.1, -0.2, 0.3, 0.1, 0.2, 0.9];
        assert_eq!(
            crop("box=-0.1,-0.2,0.3,0.1,0.2,0.9").unwrap(),
            Crop::Box(bounds)
        );
        let error = crop("table").unwrap_err().to_string();
        assert!(
            error.starts_with("\"table\" is neither none nor object nor box="),
            "{error}"
        );
    }
}
