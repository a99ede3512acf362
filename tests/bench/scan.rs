//! A fused scan, for benches and for comparison with other solvers.

use anyhow::Context;
use depth_camera::CameraInfo;
use relief::{
    config::{self, CalibrationPlaces},
    geometry::{CameraModel, RayGrid, TriMesh},
    pipeline::RecordedScan,
    refine::{Optics, Subject, select_object},
    shading::Calibration,
    snapshot::ShadingSnapshot,
};
use std::path::Path;

/// A scan with all that its refinement needs.
pub struct Scan {
    /// The whole base mesh.
    pub base: TriMesh,
    /// What stands out of it.
    pub object: TriMesh,
    /// The camera.
    pub info: CameraInfo,
    snapshots: Vec<ShadingSnapshot>,
    calibration: Calibration,
}

impl Scan {
    /// Reads the output folder of `relief replay`; the calibration is the one beside it, or the one shipped.
    pub fn read(folder: &Path) -> anyhow::Result<Scan> {
        let RecordedScan { info, scan } = RecordedScan::read(folder)?;
        let places = CalibrationPlaces {
            given: None,
            folder,
            session: Some(folder),
        };
        Ok(Scan {
            calibration: config::find_calibration(&info, &places)?.calibration,
            object: select_object(&scan.base, &scan.world_from_cameras).0,
            snapshots: scan.snapshots.context("no shading images")?.accepted,
            base: scan.base,
            info,
        })
    }

    /// Does something with it as a subject of refinement.
    pub fn with_subject<T>(
        &self,
        what: impl FnOnce(&Subject) -> anyhow::Result<T>,
    ) -> anyhow::Result<T> {
        let rays = RayGrid::new(CameraModel::new(self.info.intrinsics));
        let optics = Optics::of(&self.info, &rays, &self.calibration)
            .context("the scan does not say where its light is, or what full scale is")?;
        what(&Subject {
            scene: &self.base,
            object: &self.object,
            snapshots: &self.snapshots,
            optics: &optics,
        })
    }
}
