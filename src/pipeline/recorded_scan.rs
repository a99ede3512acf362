//! A scan read back from an output folder, to be refined again without fusing it again.

use super::{
    deliver::{BASE_PLY, SCENE_PLY, TRAJECTORY},
    fusion_stage::FusedScan,
    snapshot_meta::SnapshotMeta,
};
use crate::{
    export::{
        ExportError, SNAPSHOTS, StoredSnapshot, StoredSnapshots, read_ply, read_snapshots,
        read_trajectory,
    },
    geometry::{CameraModel, RayGrid, TriMesh},
    refine::{Optics, surface_of_view},
    shading::Calibration,
    snapshot::{ShadingSnapshot, SnapshotSelection},
};
use depth_camera::CameraInfo;
use nalgebra::Point3;
use std::{
    collections::HashSet,
    path::{Path, PathBuf},
};

/// A scan with the camera that made it.
#[derive(Clone, Debug)]
pub struct RecordedScan {
    /// The camera.
    pub info: CameraInfo,
    /// Base mesh, poses and shading images.
    pub scan: FusedScan,
}

/// Why an output folder gives no scan.
#[derive(Debug, thiserror::Error)]
pub enum RecordedScanError {
    /// A file is missing or spoilt.
    #[error(transparent)]
    File(#[from] ExportError),
    /// There is no such folder.
    #[error("{} is no output folder of a scan", .0.display())]
    NoFolder(PathBuf),
    /// There are no shading images, so that the camera is unknown too.
    #[error("{} holds no shading images", .0.display())]
    NoSnapshots(PathBuf),
    /// The frame asked for is no shading image.
    #[error("frame {frame_id} is none of the shading images, which are of frames {}", list(.known))]
    NotAShadingImage {
        /// The frame asked for.
        frame_id: u64,
        /// The frames that there are.
        known: Vec<u64>,
    },
    /// The image cannot be understood.
    #[error("the scan does not say where its light is, or what full scale is")]
    NoLight,
    /// What stands beside an image makes no sense.
    #[error("{} is malformed: {reason}", path.display())]
    Meta {
        /// The file.
        path: PathBuf,
        /// The key and what is wrong.
        reason: String,
    },
}

impl RecordedScan {
    /// Reads `base.ply`, or `scene.ply` where that is all that was fused, `trajectory.txt` and `snapshots` of an output folder.
    /// Positions of the mesh have single precision.
    ///
    /// # Errors
    /// If a file is missing or spoilt, or there are no shading images.
    pub fn read(folder: &Path) -> Result<Self, RecordedScanError> {
        if !folder.is_dir() {
            return Err(RecordedScanError::NoFolder(folder.to_owned()));
        }
        let (meshes, stored) = rayon::join(|| read_meshes(folder), || read_snapshots(folder));
        let ((base, delivered), StoredSnapshots { whole, unfinished }) = (meshes?, stored?);
        let warnings: Vec<String> = left_out(&unfinished).into_iter().collect();
        for warning in &warnings {
            tracing::warn!("{warning}");
        }
        let trajectory = read_trajectory(&folder.join(TRAJECTORY))?;
        let mut info = None;
        let mut accepted = Vec::with_capacity(whole.len());
        for snapshot in whole {
            let path = snapshot.folder.join("meta.json");
            let in_meta = |reason: String| RecordedScanError::Meta {
                path: path.clone(),
                reason,
            };
            let meta: SnapshotMeta = serde_json::from_value(snapshot.meta.clone())
                .map_err(|error| in_meta(error.to_string()))?;
            let camera = meta.camera().map_err(in_meta)?;
            let (width, height) = (camera.intrinsics.width, camera.intrinsics.height);
            if (snapshot.ir.width(), snapshot.ir.height()) != (width, height) {
                return Err(in_meta(format!(
                    "the camera has {width}×{height} pixels, the image has not"
                )));
            }
            info.get_or_insert(camera);
            accepted.push(shading_snapshot(snapshot, &meta));
        }
        Ok(RecordedScan {
            info: info.ok_or_else(|| RecordedScanError::NoSnapshots(folder.to_owned()))?,
            scan: FusedScan {
                base,
                world_from_cameras: trajectory.into_iter().map(|(_, pose)| pose).collect(),
                snapshots: Some(SnapshotSelection {
                    accepted,
                    rejected: Vec::new(),
                }),
                last_depth: None,
                delivered,
                warnings,
            },
        })
    }
}

/// The warning about shading images that are not whole, if there are any.
fn left_out(unfinished: &[PathBuf]) -> Option<String> {
    let names = unfinished
        .iter()
        .filter_map(|folder| folder.file_name()?.to_str());
    let names: Vec<&str> = names.collect();
    (!names.is_empty()).then(|| {
        format!(
            "shading images that were not written to their end are left out: {SNAPSHOTS}/{}",
            names.join(", ")
        )
    })
}

/// What was fused, and the part of it that was delivered, if that is not all.
fn read_meshes(folder: &Path) -> Result<(TriMesh, Option<TriMesh>), RecordedScanError> {
    let base = read_ply(&folder.join(BASE_PLY))?;
    let path = folder.join(SCENE_PLY);
    if !path.is_file() {
        return Ok((base, None));
    }
    let scene = read_ply(&path)?;
    // What fills holes is not of the scene.
    let place = |vertex: &Point3<f64>| [vertex.x, vertex.y, vertex.z].map(f64::to_bits);
    let delivered: HashSet<[u64; 3]> = base.vertices.iter().map(place).collect();
    let is_delivered = |vertex: &Point3<f64>| delivered.contains(&place(vertex));
    let is_delivered: Vec<bool> = scene.vertices.iter().map(is_delivered).collect();
    let corners_are = |face: usize| {
        scene.faces[face]
            .iter()
            .all(|&at| is_delivered[at as usize])
    };
    let part = scene.filter_faces(corners_are);
    let is_all = part.faces.len() == scene.faces.len();
    Ok((scene, (!is_all).then_some(part)))
}

impl RecordedScan {
    /// The scan as one of its shading images alone shows it: the surface is that of its depth map.
    ///
    /// # Errors
    /// If there is no shading image of that frame, or the scan does not say where its light is.
    pub fn single_view(
        self,
        frame_id: u64,
        calibration: &Calibration,
    ) -> Result<RecordedScan, RecordedScanError> {
        let RecordedScan { info, scan } = self;
        let warnings = scan.warnings;
        let accepted = scan.snapshots.map(|snapshots| snapshots.accepted);
        let accepted = accepted.unwrap_or_default();
        let known = accepted.iter().map(|snapshot| snapshot.frame_id).collect();
        let snapshot = accepted
            .into_iter()
            .find(|snapshot| snapshot.frame_id == frame_id)
            .ok_or(RecordedScanError::NotAShadingImage { frame_id, known })?;
        let rays = RayGrid::new(CameraModel::new(info.intrinsics));
        let optics = Optics::of(&info, &rays, calibration).ok_or(RecordedScanError::NoLight)?;
        Ok(RecordedScan {
            scan: FusedScan {
                base: surface_of_view(&snapshot, &optics),
                world_from_cameras: vec![snapshot.world_from_camera],
                snapshots: Some(SnapshotSelection {
                    accepted: vec![snapshot],
                    rejected: Vec::new(),
                }),
                last_depth: None,
                delivered: None,
                warnings,
            },
            info,
        })
    }
}

/// Numbers between commas.
fn list(numbers: &[u64]) -> String {
    let words: Vec<String> = numbers.iter().map(u64::to_string).collect();
    words.join(", ")
}

fn shading_snapshot(stored: StoredSnapshot, meta: &SnapshotMeta) -> ShadingSnapshot {
    ShadingSnapshot {
        frame_id: meta.frame_id,
        device_time_secs: meta.device_time_secs,
        n_exposures: meta.n_exposures,
        ir_counts: stored.ir.map(|&counts| f32::from(counts)),
        unlit_counts: stored.unlit.map(|image| image.map(|&c| f32::from(c))),
        depth_m: stored.depth_m,
        world_from_camera: stored.world_from_camera,
    }
}
