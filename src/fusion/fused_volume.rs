//! A volume and what frames have left in it; frames that are kept are fused again where they are then known to belong.

use super::PoseCorrection;
use super::band::Band;
use super::eye::Eye;
use super::keyframes::Keyframe;
use super::turns::Turns;
use super::volume::TsdfVolume;

/// A volume with the band of the frames that were fused into it.
#[derive(Clone)]
pub struct FusedVolume {
    /// The distances.
    pub volume: TsdfVolume,
    /// What was touched and refused in it.
    pub band: Band,
}

impl FusedVolume {
    /// A volume into which nothing was fused yet.
    pub fn untouched(volume: TsdfVolume) -> Self {
        FusedVolume {
            volume,
            band: Band::default(),
        }
    }

    /// Fuses frames at their corrected poses, each by the weight of those that it stands for; or the first of them if it shall not
    /// go on, and says which.
    pub fn fuse_again(
        &mut self,
        frames: &[Keyframe],
        correction: &PoseCorrection,
        eye: &Eye,
        goes_on: &dyn Fn() -> bool,
    ) -> bool {
        let mut eye = eye.clone();
        for frame in frames {
            if !goes_on() {
                return false;
            }
            eye.take_kept(&frame.depth_m(), frame.n_frames);
            let pose = correction.apply(frame.time_secs, &frame.world_from_camera);
            eye.fuse_into(self, &pose, Turns::EveryFrame, &mut |_| {});
        }
        true
    }
}
