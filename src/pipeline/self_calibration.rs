//! Response and light by the images of a scan whose depth is still to be corrected by them.

use crate::{
    geometry::{CameraModel, Pose, RayGrid, TriMesh},
    refine::{Crop, Optics, RefineParams, Subject, contradiction_as_tracked},
    shading::Calibration,
    snapshot::ShadingSnapshot,
};
use depth_camera::CameraInfo;

/// Asks the shading images of a scan whether they contradict the calibration.
pub struct SelfCalibration {
    /// The camera.
    pub info: CameraInfo,
    /// The calibration that is believed.
    pub calibration: Calibration,
    /// Which part of the scan is refined.
    pub crop: Crop,
    /// Refinement.
    pub refine: RefineParams,
}

/// Shading images that are asked at most: all of them need a hundred megabytes while the scan's frames are still held.
const MAX_VIEWS: usize = 16;

impl SelfCalibration {
    /// The calibration that the images tell of; `None` where that is the one believed, or nothing.
    pub fn contradiction(
        &self,
        base: &TriMesh,
        world_from_cameras: &[Pose],
        snapshots: &[ShadingSnapshot],
    ) -> Option<Calibration> {
        let rays = RayGrid::new(CameraModel::new(self.info.intrinsics));
        let optics = Optics::of(&self.info, &rays, &self.calibration)?;
        let object = self.crop.object(base, world_from_cameras).ok()?;
        let every = snapshots.len().div_ceil(MAX_VIEWS).max(1);
        let spread: Vec<ShadingSnapshot> = snapshots.iter().step_by(every).cloned().collect();
        let subject = Subject {
            scene: base,
            object: &object,
            snapshots: &spread,
            optics: &optics,
        };
        contradiction_as_tracked(&subject, &self.refine).map(|told| told.calibration)
    }
}
