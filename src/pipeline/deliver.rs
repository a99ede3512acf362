//! The outputs of a run: what is written where, and what could not be.

use super::snapshot_meta::SnapshotMeta;
use crate::{
    capture::RecorderSummary,
    export::{
        ExportError, Report, ReportPictures, SnapshotRecord, write_glb, write_ply,
        write_report_html, write_report_json, write_snapshots, write_trajectory,
    },
    geometry::{Pose, TriMesh},
    refine::Refinement,
    snapshot::ShadingSnapshot,
};
use depth_camera::{CameraInfo, Image};
use std::{
    path::{Path, PathBuf},
    sync::{Mutex, PoisonError},
};

/// The base mesh's file.
pub const BASE_PLY: &str = "base.ply";
/// The refined mesh's files.
pub const REFINED_PLY: &str = "refined.ply";
const REFINED_GLB: &str = "refined.glb";
/// The poses of all fused frames.
pub const TRAJECTORY: &str = "trajectory.txt";
const SNAPSHOTS: &str = "snapshots";
const REPORT_HTML: &str = "report.html";
const REPORT_JSON: &str = "report.json";

/// Writes outputs into one folder and keeps account of them. A file that cannot be written costs the others nothing.
#[derive(Debug)]
pub struct Outbox {
    folder: PathBuf,
    account: Mutex<Account>,
}

/// What was written, and what could not be.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Account {
    /// Files and folders written, in order.
    pub outputs: Vec<PathBuf>,
    /// What could not be written, in sentences for the operator.
    pub failures: Vec<String>,
}

impl Outbox {
    /// An outbox into a folder that exists.
    pub fn new(folder: &Path) -> Self {
        Outbox {
            folder: folder.to_owned(),
            account: Mutex::default(),
        }
    }

    /// What was written so far, and what could not be.
    pub fn account(&self) -> Account {
        self.with_account(|account| account.clone())
    }

    /// Where an output of that name lies.
    pub fn path(&self, name: &str) -> PathBuf {
        self.folder.join(name)
    }

    /// Writes the base mesh.
    pub fn base_mesh(&self, base: &TriMesh) {
        let normals = base.vertex_normals();
        self.write(BASE_PLY, |path| write_ply(path, base, &normals, None));
    }

    /// Writes the refined mesh in both formats.
    pub fn refined_mesh(&self, refinement: &Refinement) {
        let mesh: &TriMesh = &refinement.mesh;
        let normals = mesh.vertex_normals();
        let albedo = Some(refinement.albedo.as_slice());
        self.write(REFINED_PLY, |path| write_ply(path, mesh, &normals, albedo));
        self.write(REFINED_GLB, |path| write_glb(path, mesh, &normals, albedo));
    }

    /// Writes the shading images. `masks` says for each which pixels refinement could use; before there are any, the mask
    /// says where there is depth.
    pub fn snapshots(
        &self,
        snapshots: &[ShadingSnapshot],
        masks: Option<&[Image<u8>]>,
        info: &CameraInfo,
    ) {
        let images: Vec<(Image<u16>, Image<u8>)> = snapshots
            .iter()
            .enumerate()
            .map(|(k, snapshot)| {
                let mask = masks.map_or_else(|| depth_mask(snapshot), |masks| masks[k].clone());
                (counts(snapshot), mask)
            })
            .collect();
        let records: Vec<SnapshotRecord> = snapshots
            .iter()
            .zip(&images)
            .map(|(snapshot, (ir, mask))| SnapshotRecord {
                ir,
                mask,
                depth_m: &snapshot.depth_m,
                world_from_camera: snapshot.world_from_camera,
                meta: SnapshotMeta::new(snapshot, info).to_json(),
                device_time_secs: snapshot.device_time_secs,
            })
            .collect();
        self.write(SNAPSHOTS, |_| write_snapshots(&self.folder, &records));
    }

    /// Takes what the recorder wrote into the account, and writes the trajectory.
    pub fn recorded(&self, summary: &RecorderSummary) {
        self.with_account(|account| {
            account.outputs.extend_from_slice(&summary.outputs);
            account.failures.extend_from_slice(&summary.failures);
        });
        self.trajectory(&summary.trajectory);
    }

    /// Writes times (s) and poses, if there are any.
    pub fn trajectory(&self, trajectory: &[(f64, Pose)]) {
        if !trajectory.is_empty() {
            self.write(TRAJECTORY, |path| write_trajectory(path, trajectory));
        }
    }

    /// Writes the report in both formats, last of all; it lists itself among the outputs.
    pub fn report(&self, report: &mut Report, pictures: &ReportPictures) {
        let listed = [REPORT_HTML, REPORT_JSON].map(|name| self.path(name).display().to_string());
        report.outputs.extend(listed);
        self.write(REPORT_HTML, |path| {
            write_report_html(path, report, pictures)
        });
        self.write(REPORT_JSON, |path| write_report_json(path, report));
    }

    /// Notes something that went wrong elsewhere.
    pub fn fail(&self, what: String) {
        tracing::error!("{what}");
        self.with_account(|account| account.failures.push(what));
    }

    fn write(&self, name: &str, write: impl FnOnce(&Path) -> Result<(), ExportError>) {
        let path = self.path(name);
        match write(&path) {
            Ok(()) => {
                tracing::debug!(path = %path.display(), "written");
                self.with_account(|account| {
                    if !account.outputs.contains(&path) {
                        account.outputs.push(path);
                    }
                });
            }
            Err(error) => self.fail(error.to_string()),
        }
    }

    fn with_account<T>(&self, f: impl FnOnce(&mut Account) -> T) -> T {
        // Entries are pushed whole: an account that a panic left behind is as good as any.
        f(&mut self.account.lock().unwrap_or_else(PoisonError::into_inner))
    }
}

/// The image as it is written.
fn counts(snapshot: &ShadingSnapshot) -> Image<u16> {
    snapshot.ir_counts.map(|&counts| counts.round() as u16)
}

/// Where a snapshot has depth to go with it.
fn depth_mask(snapshot: &ShadingSnapshot) -> Image<u8> {
    snapshot.depth_m.map(|&z| if z > 0.0 { 255 } else { 0 })
}
