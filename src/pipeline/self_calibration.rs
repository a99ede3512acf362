//! Response and light by the images of a scan whose depth is still to be corrected by them: what the fusion thread asks of refinement
//! before it lets the depth be revised.

use super::fusion_stage::choose_object;
use crate::{
    geometry::{CameraModel, Pose, RayGrid, TriMesh},
    refine::{Crop, Optics, RefineParams, Roi, Subject, contradiction_as_tracked},
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
    /// The box of what is refined; without one the crop takes it.
    pub roi: Option<Roi>,
    /// Which part of the scan is refined.
    pub crop: Crop,
    /// Refinement.
    pub refine: RefineParams,
}

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
        let object = self.object(base, world_from_cameras)?;
        let subject = Subject {
            scene: base,
            object: &object,
            snapshots,
            optics: &optics,
        };
        contradiction_as_tracked(&subject, &self.refine)
            .inspect_err(|error| tracing::warn!(%error, "not recalibrated"))
            .ok()?
            .map(|told| told.calibration)
    }

    /// The part of the scan that is to be refined, which the images are asked about.
    fn object(&self, base: &TriMesh, world_from_cameras: &[Pose]) -> Option<TriMesh> {
        choose_object(base, world_from_cameras, self.roi.as_ref(), self.crop)
            .inspect_err(|reason| tracing::warn!(%reason, "no object to recalibrate by"))
            .ok()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use depth_camera::DepthCamera;
    use nalgebra::Point3;
    use simulated::SimulatedCamera;

    #[test]
    fn images_are_asked_about_what_lies_in_the_box() {
        let info = SimulatedCamera::kinect2_plaque(1, 0).info().clone();
        let mut asked = SelfCalibration {
            calibration: Calibration::shipped_for(&info).unwrap(),
            info,
            roi: None,
            crop: Crop::None,
            refine: RefineParams::default(),
        };
        let corners = |x: f64| [[x, 0.0, 1.0], [x + 0.1, 0.0, 1.0], [x, 0.1, 1.0]];
        let vertices = [0.0, 1.0].map(corners).concat();
        let base = TriMesh {
            vertices: vertices.into_iter().map(Point3::from).collect(),
            faces: vec![[0, 1, 2], [3, 4, 5]],
        };
        let mut n_faces = |roi: Option<[f64; 6]>| {
            asked.roi = roi.map(|bounds| Roi::of_bounds(bounds).unwrap());
            asked.object(&base, &[]).map(|object| object.faces.len())
        };
        assert_eq!(n_faces(None), Some(2));
        assert_eq!(n_faces(Some([-0.5, -0.5, 0.5, 0.5, 0.5, 1.5])), Some(1));
        assert_eq!(n_faces(Some([-0.5, -0.5, 2.0, 0.5, 0.5, 3.0])), None);
    }
}
