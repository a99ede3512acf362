//! A scan read back from an output folder, to be refined again without fusing it again.

use super::{
    deliver::{BASE_PLY, SCENE_PLY, TRAJECTORY},
    fusion_stage::FusedScan,
    snapshot_meta::SnapshotMeta,
};
use crate::{
    capture::EVENTS_FILE,
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
    /// It is what came of a refinement.
    #[error("{} is the output of `relief refine`; give the folder that was fused", .0.display())]
    Refinement(PathBuf),
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
    /// An image is of another sensor, size, lens, scale or light than the first one.
    #[error("{}: another camera, lens, full scale or light than that of the first shading image", .0.display())]
    OtherCamera(PathBuf),
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
        if is_refinement(folder) {
            return Err(RecordedScanError::Refinement(folder.to_owned()));
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
            if !is_same_camera(info.get_or_insert_with(|| camera.clone()), &camera) {
                return Err(RecordedScanError::OtherCamera(path));
            }
            accepted.push(shading_snapshot(snapshot, &meta));
        }
        let info = info.ok_or_else(|| RecordedScanError::NoSnapshots(folder.to_owned()))?;
        Ok(RecordedScan {
            scan: FusedScan {
                base,
                world_from_cameras: trajectory.into_iter().map(|(_, pose)| pose).collect(),
                snapshots: Some(SnapshotSelection {
                    accepted,
                    rejected: Vec::new(),
                }),
                intrinsics: info.intrinsics,
                last_depth: None,
                delivered,
                warnings,
            },
            info,
        })
    }
}

/// Whether a folder is what `relief refine` leaves: a base mesh, of which a part may be missing or made up, and neither poses nor events.
fn is_refinement(folder: &Path) -> bool {
    let has = |name: &str| folder.join(name).exists();
    has(BASE_PLY) && !has(TRAJECTORY) && !has(EVENTS_FILE)
}

/// Whether two images are of one camera; its gain may have changed between them.
fn is_same_camera(first: &CameraInfo, other: &CameraInfo) -> bool {
    first.sensor == other.sensor
        && first.serial == other.serial
        && first.intrinsics == other.intrinsics
        && first.ir_full_scale == other.ir_full_scale
        && first.light == other.light
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
                intrinsics: info.intrinsics,
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
        moved: meta.moved(),
    }
}

#[cfg(test)]
mod tests {
    use super::super::deliver::Outbox;
    use super::*;
    use crate::geometry::{Pose, increment, increment_of};
    use depth_camera::{DepthCamera, Image};
    use nalgebra::Vector6;
    use simulated::SimulatedCamera;
    use std::fs;

    fn info() -> CameraInfo {
        let camera = SimulatedCamera::kinect2_plaque(1, 0);
        let mut info = camera.info().clone();
        let lens = &mut info.intrinsics;
        (lens.width, lens.height, lens.cx, lens.cy) = (16, 16, 8.0, 8.0);
        info.n_frames = None;
        info
    }

    /// How the camera went over the pause for the second image.
    fn moved() -> Pose {
        increment(&Vector6::new(0.01, -0.02, 0.03, 0.004, 0.005, -0.006))
    }

    /// Writes a scan without surface, with one shading image of each of two cameras.
    fn write(folder: &Path, cameras: [&CameraInfo; 2]) {
        let outbox = Outbox::inside(folder);
        outbox.base_mesh(&TriMesh::default());
        outbox.trajectory(&[(1.0, Pose::identity())]);
        for (number, info) in cameras.into_iter().enumerate() {
            let (width, height) = (info.intrinsics.width, info.intrinsics.height);
            let snapshot = ShadingSnapshot {
                frame_id: number as u64,
                device_time_secs: 1.0,
                n_exposures: 1,
                ir_counts: Image::filled(width, height, 100.0),
                unlit_counts: None,
                depth_m: Image::filled(width, height, 0.5),
                world_from_camera: Pose::identity(),
                moved: (number == 1).then(moved),
            };
            let alone = folder.join(format!("of-{number}"));
            fs::create_dir(&alone).unwrap();
            Outbox::inside(&alone).snapshots(&[snapshot], info);
            let numbered = folder.join(SNAPSHOTS).join(format!("{number:03}"));
            fs::create_dir_all(folder.join(SNAPSHOTS)).unwrap();
            fs::rename(alone.join(SNAPSHOTS).join("000"), numbered).unwrap();
        }
    }

    fn refusal(cameras: [&CameraInfo; 2]) -> String {
        let folder = tempfile::tempdir().unwrap();
        write(folder.path(), cameras);
        RecordedScan::read(folder.path()).unwrap_err().to_string()
    }

    #[test]
    fn all_shading_images_are_of_one_camera() {
        let first = info();
        let folder = tempfile::tempdir().unwrap();
        let other_gain = CameraInfo {
            ir_gain: Some(7),
            ..first.clone()
        };
        write(folder.path(), [&first, &other_gain]);
        let read = RecordedScan::read(folder.path()).unwrap();
        assert_eq!(read.info.ir_gain, first.ir_gain);
        let [rested, went] = &read.scan.snapshots.unwrap().accepted[..] else {
            panic!("two were written");
        };
        assert_eq!(rested.moved, None);
        let off = went.moved.unwrap().inverse() * moved();
        assert!(increment_of(&off).norm() < 1e-12, "{off}");

        let mut larger = first.clone();
        larger.intrinsics.width = 32;
        let other_scale = CameraInfo {
            ir_full_scale: Some(1023.0),
            ..first.clone()
        };
        let without_light = CameraInfo {
            light: None,
            ..first.clone()
        };
        for other in [larger, other_scale, without_light] {
            let refusal = refusal([&first, &other]);
            assert!(
                refusal.ends_with(
                    "snapshots/001/meta.json: another camera, lens, full scale or light than that of the first shading image"
                ),
                "{refusal}"
            );
        }
    }

    #[test]
    fn the_output_of_a_refinement_is_told_from_a_scan_that_lacks_its_poses() {
        let folder = tempfile::tempdir().unwrap();
        write(folder.path(), [&info(), &info()]);
        fs::remove_file(folder.path().join(TRAJECTORY)).unwrap();
        let refusal = || RecordedScan::read(folder.path()).unwrap_err().to_string();
        assert!(
            refusal().ends_with("the output of `relief refine`; give the folder that was fused"),
            "{}",
            refusal()
        );
        fs::write(folder.path().join(EVENTS_FILE), "").unwrap();
        assert!(refusal().contains("trajectory.txt"), "{}", refusal());
    }

    #[test]
    fn full_scale_is_positive() {
        for full_scale in [0.0, -1.0] {
            let bad = CameraInfo {
                ir_full_scale: Some(full_scale),
                ..info()
            };
            let refusal = refusal([&bad, &bad]);
            let reason = format!("ir_full_scale is {full_scale}, must be positive and finite");
            assert!(refusal.ends_with(&reason), "{refusal}");
        }
    }
}
