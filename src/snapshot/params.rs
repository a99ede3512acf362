//! What can be set about taking shading images.

use serde::{Deserialize, Serialize};

/// When an IR image is taken for shading, and how many are kept.
#[derive(Clone, Debug, PartialEq, Deserialize, Serialize)]
#[serde(default, deny_unknown_fields)]
pub struct SnapshotParams {
    /// Most shading images that a scan keeps; twice as many are held while it goes on.
    pub max_snapshots: usize,
    /// Kinect II: choosing ends when one more image adds less than this share of the information chosen.
    pub min_gain_share: f64,
    /// Kinect II: an image taken while turning faster counts less by the fourth power of how much, and beyond twice as fast is not
    /// used; radians per second. A walk round an object in 7 s turns at 0.94 and is sharp, since the object stays in place on the
    /// image.
    pub max_rotation_rad_per_s: f64,
    /// Kinect II: the same for the speed of the camera, metres per second; 0.7 on that walk at 0.75 m.
    pub max_speed_m_per_s: f64,
    /// Kinect II: the same for the surface looked at on the image, which blurs, pixels per second: 1.5 px in the 10 ms or so that a
    /// frame is exposed. The tremor of a hand makes 20 to 60.
    pub max_image_speed_px_per_s: f64,
    /// More saturated pixels than this share make an image useless; single views of a near board have up to 0.13.
    pub max_saturated_share: f64,
    /// Kinect I: with more valid depth than this share the projector is not covered. Covered frames have none, others 0.38
    /// and more.
    pub max_covered_depth_share: f64,
    /// Kinect I: a shading pose with fewer exposures is not used; one alone cannot tell that something moved.
    pub min_exposures: usize,
    /// Kinect I: exposures of one pose beyond this number are not used.
    pub max_exposures: usize,
    /// Kinect I: which pose the exposures are given.
    pub held_pose: HeldPose,
    /// Kinect I: largest distance between the poses before and after the exposures, metres; about the tracker's noise.
    pub max_still_translation_m: f64,
    /// Kinect I: largest turn between the poses before and after the exposures, radians (0.3°). Both limits are of
    /// [`HeldPose::Between`].
    pub max_still_rotation_rad: f64,
    /// Kinect I: an exposure that differs from the others in more than this share of its lit area is not used.
    pub max_changed_share: f64,
}

/// The pose of a Kinect I's exposures, which carry no depth to track.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Deserialize, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum HeldPose {
    /// Halfway between the last one before and the first one after where they agree; else, for a hand that moved on before
    /// depth was back, the last one before, at most a second old. Then only the exposures' agreement says that the hand
    /// was still; at the end of the scan the image is put where on the way from before to after its light agrees best with the
    /// surface, and refinement aligns the view by its image.
    #[default]
    BetweenOrBefore,
    /// Halfway between the last one before and the first one after, which must agree: the hand is measured to be still.
    Between,
    /// The same, unless the first one after comes more than a second after the exposures, too late to tell whether the hand was still:
    /// then the last one before, at most a second old. For calibrations, whose images nobody aligns; no configuration says it.
    #[serde(skip)]
    BetweenUnlessLate,
}

impl Default for SnapshotParams {
    fn default() -> Self {
        SnapshotParams {
            max_snapshots: 36,
            min_gain_share: 0.004,
            max_rotation_rad_per_s: 1.5,
            max_speed_m_per_s: 1.0,
            max_image_speed_px_per_s: 150.0,
            max_saturated_share: 0.2,
            max_covered_depth_share: 0.04,
            min_exposures: 2,
            max_exposures: 16,
            held_pose: HeldPose::default(),
            max_still_translation_m: 0.0025,
            max_still_rotation_rad: 0.0052,
            max_changed_share: 0.02,
        }
    }
}

impl SnapshotParams {
    /// Checks every value against its bound.
    ///
    /// # Errors
    /// Names the key, its value and the bound.
    pub fn validate(&self) -> Result<(), String> {
        let max_exposures = self.max_exposures as f64;
        for (key, value, low, high) in [
            ("max_snapshots", self.max_snapshots as f64, 1.0, 128.0),
            ("min_gain_share", self.min_gain_share, 0.0, 0.5),
            (
                "max_rotation_rad_per_s",
                self.max_rotation_rad_per_s,
                0.01,
                100.0,
            ),
            ("max_speed_m_per_s", self.max_speed_m_per_s, 0.01, 100.0),
            (
                "max_image_speed_px_per_s",
                self.max_image_speed_px_per_s,
                1.0,
                10_000.0,
            ),
            ("max_saturated_share", self.max_saturated_share, 0.0, 1.0),
            (
                "max_covered_depth_share",
                self.max_covered_depth_share,
                0.0,
                0.3,
            ),
            ("max_exposures", max_exposures, 1.0, 64.0),
            (
                "min_exposures",
                self.min_exposures as f64,
                1.0,
                max_exposures,
            ),
            (
                "max_still_translation_m",
                self.max_still_translation_m,
                0.0,
                0.1,
            ),
            (
                "max_still_rotation_rad",
                self.max_still_rotation_rad,
                0.0,
                0.2,
            ),
            ("max_changed_share", self.max_changed_share, 0.0, 1.0),
        ] {
            if !(value >= low && value <= high) {
                return Err(format!(
                    "snapshot.{key} is {value}, must be {low} to {high}"
                ));
            }
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn defaults_are_valid_and_bad_values_are_named() {
        assert_eq!(SnapshotParams::default().validate(), Ok(()));
        let params = SnapshotParams {
            max_snapshots: 129,
            ..SnapshotParams::default()
        };
        assert_eq!(
            params.validate(),
            Err("snapshot.max_snapshots is 129, must be 1 to 128".into())
        );
        let params = SnapshotParams {
            max_saturated_share: f64::NAN,
            ..SnapshotParams::default()
        };
        assert_eq!(
            params.validate(),
            Err("snapshot.max_saturated_share is NaN, must be 0 to 1".into())
        );
    }

    #[test]
    fn unknown_keys_are_refused_and_missing_ones_have_defaults() {
        let params: SnapshotParams = toml::from_str("max_snapshots = 8").unwrap();
        assert_eq!(params.max_snapshots, 8);
        assert_eq!(params.max_exposures, 16);
        assert!(toml::from_str::<SnapshotParams>("max_snapshot = 8").is_err());
    }
}
