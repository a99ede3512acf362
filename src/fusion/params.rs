//! What fusion needs to know, and the bounds of it.

use super::icp::IcpParams;
use super::loop_closing::LoopClosingParams;
use super::polish::PolishParams;
use super::preprocess::DepthRange;
use super::volume::{HALF_SIDE_VOXELS, TsdfVolume};
use serde::{Deserialize, Serialize};

/// What fusion needs to know; distances in metres.
#[derive(Clone, Debug, PartialEq, Deserialize, Serialize)]
#[serde(default, deny_unknown_fields)]
pub struct FusionParams {
    /// Distance between voxels: 2 mm for an object within a metre, 5 mm for a room.
    pub voxel_size_m: f64,
    /// Truncation distance in voxels. Three depth sigmas should fit, and what views of one place disagree by.
    pub truncation_voxels: f64,
    /// Truncation distance in voxels for parts of the finished model that are thinner than the other one, rims and leaves; from
    /// that one on there is no difference.
    pub thin_truncation_voxels: f64,
    /// Nearer depth is ignored.
    pub depth_min_m: f64,
    /// Farther depth is ignored.
    pub depth_max_m: f64,
    /// Voxels of 2 mm that were seen with less than this weight (1 is one frontal view at 0.6 m) do not make a surface; wider ones
    /// need less, as of [`Self::surface_weight`].
    pub min_surface_weight: f64,
    /// Memory that the volumes of a scan may take together, MiB, of which the model may have a third; parts of the scene
    /// beyond it are not fused, and told of.
    pub memory_budget_mb: usize,
    /// Alignment.
    pub icp: IcpParams,
    /// Below this share of points on the model the camera is lost: a 15 % gate let garbage in, 35 % never fired falsely.
    pub min_inlier_share: f64,
    /// Above this share of points behind the model's surface the camera is lost: up to 3 % when right, 11 % in
    /// fast turns that uncover what was hidden, 17 to 45 % in a false lock.
    pub max_see_through_share: f64,
    /// Above this distance of the inliers to the model the camera is lost, in sigmas of the depth noise at their range.
    pub max_rmse_sigmas: f64,
    /// Below this conditioning the geometry does not hold the camera (a bare plane has 0).
    pub min_conditioning: f64,
    /// A faster turn is not believed, radians per second, but for one that was as fast before, and up to twice as fast.
    pub max_rotation_rad_per_s: f64,
    /// The same for moves, metres per second.
    pub max_speed_m_per_s: f64,
    /// Whether the slow error of a Kinect I is measured by the scan itself and taken off.
    pub depth_field: bool,
    /// Whether the time in which a Kinect I's rows are read is measured by the scan itself, and its motion meanwhile taken off.
    pub rolling_shutter: bool,
    /// Whether the focal lengths of a Kinect I are measured by the scan itself, and put right.
    pub focal_length: bool,
    /// Whether the error that a Kinect II's depth has by range alone, wiggle or constant, is measured by the scan itself and taken off.
    pub range_error: bool,
    /// Whether depth of a Kinect II was computed with the rays of its image upside down, as libfreenect2's CPU and OpenGL decoders do, and
    /// is to be put right from the first frame; a scan tells it at its end.
    pub rays_upside_down: bool,
    /// How often a scan may be fused again at its end with what it has told of its depth; beside that once or twice to put a constant,
    /// a wiggle and rays right, and a Kinect II's scan of many frames, of which a part tells, once more with all of them.
    pub max_revisions: usize,
    /// Polishing of given poses.
    pub polish: PolishParams,
    /// Whether infrared images hold the camera where the geometry lets it slide, along a wall.
    pub use_infrared: bool,
    /// Closing loops at the end of the scan.
    pub loop_closing: LoopClosingParams,
}

/// Volumes that there are at once: at the end of a scan the model as it was tracked, as it was fused last with its depth corrected, and as
/// it is being fused again.
const VOLUMES_AT_ONCE: usize = 3;

/// Voxels wider than by this factor need as much weight as those: a single sight at a distance is no surface, however coarse it is.
const MAX_EASING: f64 = 2.5;
/// Width of voxels for an object within a metre.
const OBJECT_VOXEL_M: f64 = 0.002;

impl Default for FusionParams {
    fn default() -> Self {
        FusionParams {
            voxel_size_m: OBJECT_VOXEL_M,
            truncation_voxels: 5.0,
            thin_truncation_voxels: 2.0,
            depth_min_m: 0.35,
            depth_max_m: 2.0,
            min_surface_weight: 2.0,
            memory_budget_mb: 4096,
            icp: IcpParams::default(),
            min_inlier_share: 0.35,
            max_see_through_share: 0.15,
            max_rmse_sigmas: 5.0,
            min_conditioning: 1e-4,
            max_rotation_rad_per_s: 4.0,
            max_speed_m_per_s: 2.0,
            depth_field: true,
            rolling_shutter: true,
            focal_length: true,
            range_error: true,
            rays_upside_down: false,
            max_revisions: 4,
            use_infrared: true,
            polish: PolishParams::default(),
            loop_closing: LoopClosingParams::default(),
        }
    }
}

impl FusionParams {
    /// Voxels that were seen with less weight do not make a surface. What a mean may be off by falls with the root of its weight, and
    /// matters beside the width of a voxel: with 2 mm's weight a Kinect I would have to look at a wall at 3 m for 240 frames, not 39.
    pub fn surface_weight(&self) -> f32 {
        let width = (self.voxel_size_m / OBJECT_VOXEL_M).clamp(1.0, MAX_EASING);
        (self.min_surface_weight / (width * width)) as f32
    }

    /// Checks every value against its bound.
    ///
    /// # Errors
    /// Names the key, its value and the bound.
    pub fn validate(&self) -> Result<(), String> {
        let within = |key: &str, value: f64, low: f64, high: f64| {
            if value >= low && value <= high {
                Ok(())
            } else {
                Err(format!("fusion.{key} is {value}, must be {low} to {high}"))
            }
        };
        within("voxel_size_m", self.voxel_size_m, 0.0005, 0.1)?;
        within("truncation_voxels", self.truncation_voxels, 2.0, 20.0)?;
        let thin = self.thin_truncation_voxels;
        within("thin_truncation_voxels", thin, 1.5, 20.0)?;
        within("depth_min_m", self.depth_min_m, 0.1, 10.0)?;
        // In whole micrometres: the sum of two decimal numbers is told as 0.39999999999999997.
        let least_max_m = (1e6 * (self.depth_min_m + 0.05)).round() / 1e6;
        within("depth_max_m", self.depth_max_m, least_max_m, 12.0)?;
        within("min_surface_weight", self.min_surface_weight, 0.0, 200.0)?;
        within(
            "memory_budget_mb",
            self.memory_budget_mb as f64,
            64.0,
            1_048_576.0,
        )?;
        within("min_inlier_share", self.min_inlier_share, 0.0, 1.0)?;
        within(
            "max_see_through_share",
            self.max_see_through_share,
            0.0,
            1.0,
        )?;
        within("max_rmse_sigmas", self.max_rmse_sigmas, 0.1, 100.0)?;
        within("min_conditioning", self.min_conditioning, 0.0, 1.0)?;
        within(
            "max_rotation_rad_per_s",
            self.max_rotation_rad_per_s,
            0.01,
            100.0,
        )?;
        within("max_speed_m_per_s", self.max_speed_m_per_s, 0.01, 100.0)?;
        let icp = &self.icp;
        for level in 0..3 {
            within("icp.iterations", icp.iterations[level] as f64, 0.0, 100.0)?;
            within("icp.max_distance_m", icp.max_distance_m[level], 0.001, 1.0)?;
        }
        within(
            "icp.max_normal_angle_rad",
            icp.max_normal_angle_rad,
            0.01,
            1.57,
        )?;
        let [coarse, fine] = icp.sdf_iterations.map(|n| n as f64);
        within("icp.sdf_iterations", coarse, 0.0, 100.0)?;
        within("icp.sdf_iterations", fine, 1.0, 100.0)?;
        within("max_revisions", self.max_revisions as f64, 0.0, 10.0)?;
        self.polish.validate(within)?;
        self.loop_closing.validate(within)
    }

    /// How far the volume reaches from the world's origin along each axis, metres.
    pub fn reach_m(&self) -> f64 {
        self.voxel_size_m * f64::from(HALF_SIDE_VOXELS)
    }

    /// Distance at which signed distances are cut off, metres.
    pub(super) fn truncation_m(&self) -> f64 {
        self.voxel_size_m * self.truncation_voxels
    }

    /// A volume in which nothing is fused yet.
    pub(super) fn empty_volume(&self) -> TsdfVolume {
        self.volume_of(self.voxel_size_m, self.truncation_m())
    }

    /// A volume for thin parts.
    pub(super) fn thin_volume(&self) -> TsdfVolume {
        let truncation_m = self.voxel_size_m * self.thin_truncation_voxels;
        self.volume_of(self.voxel_size_m, truncation_m)
    }

    /// A volume for a fragment: voxels twice as large, for its surface serves alignment alone.
    pub(super) fn fragment_volume(&self) -> TsdfVolume {
        self.volume_of(2.0 * self.voxel_size_m, self.truncation_m())
    }

    fn volume_of(&self, voxel_size_m: f64, truncation_m: f64) -> TsdfVolume {
        let budget_bytes = self.volume_budget_bytes();
        TsdfVolume::new(voxel_size_m as f32, truncation_m as f32, budget_bytes)
    }

    /// What one of the volumes may take.
    pub(super) fn volume_budget_bytes(&self) -> usize {
        (self.memory_budget_mb << 20) / VOLUMES_AT_ONCE
    }

    /// The working range.
    pub(super) fn depth_range(&self) -> DepthRange {
        DepthRange {
            near_m: self.depth_min_m as f32,
            far_m: self.depth_max_m as f32,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn wide_voxels_make_a_surface_sooner_and_narrow_ones_not_later() {
        let weight = |voxel_size_m| {
            let params = FusionParams {
                voxel_size_m,
                ..FusionParams::default()
            };
            params.surface_weight()
        };
        assert_eq!([0.001, 0.002].map(weight), [2.0; 2]);
        for voxel_size_m in [0.005, 0.1] {
            assert!((weight(voxel_size_m) - 0.32).abs() < 1e-6);
        }
    }

    #[test]
    fn the_least_working_range_is_told_and_taken_as_it_is_written() {
        let checked = |depth_min_m: f64, depth_max_m: f64| {
            let params = FusionParams {
                depth_min_m,
                depth_max_m,
                ..FusionParams::default()
            };
            params.validate()
        };
        // Sums of which one is a little less than its decimal, and the other a little more.
        assert_eq!(
            checked(0.35, 0.39),
            Err("fusion.depth_max_m is 0.39, must be 0.4 to 12".into())
        );
        assert_eq!(checked(0.35, 0.4), Ok(()));
        assert_eq!(checked(0.1, 0.15), Ok(()));
    }
}
