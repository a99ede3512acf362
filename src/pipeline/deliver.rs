//! The outputs of a run: what is written where, and what could not be.

use super::{
    handle::Watch, output_folder::OutputFolder, patience::Patience, snapshot_meta::SnapshotMeta,
};
use crate::{
    capture::RecorderSummary,
    export::{
        ExportError, Report, ReportPictures, SNAPSHOTS, SnapshotExport, SnapshotRecord,
        VertexAttributes, is_passing, write_atomically, write_glb, write_masks, write_ply,
        write_report_html, write_report_json, write_trajectory,
    },
    geometry::{Pose, TriMesh},
    lock::lock,
    refine::Refinement,
    shading::Calibration,
    snapshot::ShadingSnapshot,
};
use depth_camera::{CameraInfo, Image};
use rayon::prelude::*;
use std::{
    io::Write,
    path::{Path, PathBuf},
    sync::Mutex,
};

/// The base mesh's file.
pub const BASE_PLY: &str = "base.ply";
/// All that was fused, where the base mesh is a part of it or has its holes filled.
pub const SCENE_PLY: &str = "scene.ply";
/// The refined mesh, with albedo, for tools of measurement.
pub const REFINED_PLY: &str = "refined.ply";
/// The refined mesh, for viewers.
pub const REFINED_GLB: &str = "refined.glb";
/// The poses of all fused frames.
pub const TRAJECTORY: &str = "trajectory.txt";
/// The calibration that the scan was made with.
pub const CALIBRATION: &str = Calibration::FILE_NAME;
/// What was written down on the way lies in a folder whose name begins so, in that of the scan.
pub const INTERIM: &str = "interim-";
/// The report as a page.
pub const REPORT_HTML: &str = "report.html";
/// The report for programs.
pub const REPORT_JSON: &str = "report.json";

/// Writes outputs into one folder and keeps account of them. A file that cannot be written costs the others nothing.
#[derive(Debug)]
pub struct Outbox {
    folder: PathBuf,
    /// The folder as the account names it.
    name: PathBuf,
    /// Waits where the disk is full; `None` where a file that finds no room is given up.
    patience: Option<Patience>,
    account: Mutex<Account>,
}

/// What was written, and what could not be.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Account {
    /// Files and folders written, in order.
    pub outputs: Vec<PathBuf>,
    /// What could not be written, in sentences for the operator.
    pub failures: Vec<String>,
    /// How many of these the disk may take later: it was full, read-only or away.
    pub n_passing: usize,
    /// What the operator should know although nothing is lost, in sentences.
    pub warnings: Vec<String>,
}

impl Outbox {
    /// An outbox into a folder; the pipeline's watch tells what waits for room there, and ends the wait.
    pub fn new(folder: &OutputFolder, watch: &Watch) -> Self {
        let waits = folder.waits_for_room();
        Outbox {
            name: folder.name().to_owned(),
            patience: waits.then(|| Patience::new(&watch.status, &watch.stop)),
            ..Outbox::inside(folder.path())
        }
    }

    /// An outbox into a folder that lies in one that is held already.
    pub fn inside(folder: &Path) -> Self {
        Outbox {
            folder: folder.to_owned(),
            name: folder.to_owned(),
            patience: None,
            account: Mutex::default(),
        }
    }

    /// What was written so far, and what could not be.
    pub fn account(&self) -> Account {
        self.with_account(|account| account.clone())
    }

    /// Writes the calibration, with which the scan can be refined again, at the scan's start, where nothing is waited for.
    pub fn calibration(&self, calibration: &Calibration) {
        match calibration.to_toml() {
            Ok(text) => {
                let path = self.folder.join(CALIBRATION);
                let written = write_atomically(&path, |file| file.write_all(text.as_bytes()));
                self.note(CALIBRATION, written);
            }
            Err(what) => self.fail(format!("the calibration cannot be written: {what}")),
        }
    }

    /// Writes the base mesh.
    pub fn base_mesh(&self, base: &TriMesh) {
        self.fused_mesh(BASE_PLY, base);
    }

    /// Writes all that was fused, which a refinement begins with, where the base mesh is not that.
    pub fn scene_mesh(&self, scene: &TriMesh) {
        self.fused_mesh(SCENE_PLY, scene);
    }

    fn fused_mesh(&self, name: &str, mesh: &TriMesh) {
        let normals = mesh.vertex_normals();
        self.write(name, |path| write_ply(path, mesh, &normals, None));
    }

    /// Writes the refined mesh in both formats.
    pub fn refined_mesh(&self, refinement: &Refinement) {
        let mesh: &TriMesh = &refinement.mesh;
        let normals = mesh.vertex_normals();
        let evidence = &refinement.evidence;
        let known = Some(&VertexAttributes {
            albedo: &refinement.albedo,
            sigma_m: &evidence.sigma_m,
            confidence: &evidence.confidence,
            coverage: &evidence.coverage,
            n_views: &evidence.n_views,
            label: &refinement.labels,
        });
        rayon::join(
            || self.write(REFINED_PLY, |path| write_ply(path, mesh, &normals, known)),
            || self.write(REFINED_GLB, |path| write_glb(path, mesh, &normals, known)),
        );
    }

    /// Writes the shading images; their masks say where there is depth.
    pub fn snapshots(&self, snapshots: &[ShadingSnapshot], info: &CameraInfo) {
        let images: Vec<(Image<u16>, Image<u8>)> = snapshots
            .par_iter()
            .with_max_len(1)
            .map(|snapshot| (counts(&snapshot.ir_counts), depth_mask(snapshot)))
            .collect();
        let unlit = snapshots.iter().map(|snapshot| &snapshot.unlit_counts);
        let unlit: Vec<Option<Image<u16>>> =
            unlit.map(|unlit| unlit.as_ref().map(counts)).collect();
        let records: Vec<SnapshotRecord> = snapshots
            .iter()
            .zip(&images)
            .zip(&unlit)
            .map(|((snapshot, (ir, mask)), unlit)| SnapshotRecord {
                ir,
                unlit: unlit.as_ref(),
                mask,
                depth_m: &snapshot.depth_m,
                world_from_camera: snapshot.world_from_camera,
                meta: SnapshotMeta::new(snapshot, info).to_json(),
                device_time_secs: snapshot.device_time_secs,
            })
            .collect();
        let export = SnapshotExport::new(&self.folder, &records);
        self.write(SNAPSHOTS, |_| export.write());
    }

    /// Writes which pixels of the shading images refinement could use, in place of the masks of [`Outbox::snapshots`], if those were
    /// written: where they were not, the folders are missing for the same reason, which is told of already.
    pub fn masks(&self, masks: &[Image<u8>]) {
        if self.has_written(SNAPSHOTS) {
            self.write(SNAPSHOTS, |_| write_masks(&self.folder, masks));
        }
    }

    /// Takes what the recorder wrote into the account.
    pub fn recorded(&self, summary: &RecorderSummary) {
        self.with_account(|account| {
            account.outputs.extend_from_slice(&summary.outputs);
            for failure in &summary.failures {
                let may_pass = failure.cause.is_some_and(|kind| is_passing(&kind.into()));
                account.n_passing += usize::from(may_pass);
                account.failures.push(failure.what.clone());
            }
            account.warnings.extend_from_slice(&summary.warnings);
        });
    }

    /// Writes times (s) and poses, if there are any.
    pub fn trajectory(&self, trajectory: &[(f64, Pose)]) {
        if !trajectory.is_empty() {
            self.write(TRAJECTORY, |path| write_trajectory(path, trajectory));
        }
    }

    /// Writes the report in both formats, last of all; it lists itself among the outputs, but for a format that was not written.
    pub fn report(&self, report: &mut Report, pictures: &ReportPictures) {
        let [html, json] =
            [REPORT_HTML, REPORT_JSON].map(|name| self.name.join(name).display().to_string());
        report.outputs.extend([html.clone(), json.clone()]);
        self.write(REPORT_HTML, |path| {
            write_report_html(path, report, pictures)
        });
        if !self.has_written(REPORT_HTML) {
            report.outputs.retain(|output| *output != html);
        }
        self.write(REPORT_JSON, |path| write_report_json(path, report));
        if !self.has_written(REPORT_JSON) {
            report.outputs.retain(|output| *output != json);
        }
    }

    /// Notes something that went wrong elsewhere.
    pub fn fail(&self, what: String) {
        tracing::error!("{what}");
        self.with_account(|account| account.failures.push(what));
    }

    fn write(&self, name: &str, write: impl Fn(&Path) -> Result<(), ExportError>) {
        let path = self.folder.join(name);
        let written = match &self.patience {
            Some(patience) => patience.write(name, || write(&path)),
            None => write(&path),
        };
        self.note(name, written);
    }

    /// Takes what was written, or could not be, into the account.
    fn note(&self, name: &str, written: Result<(), ExportError>) {
        match written {
            Ok(()) => {
                tracing::debug!(path = %self.folder.join(name).display(), "written");
                let listed = self.name.join(name);
                self.with_account(|account| {
                    if !account.outputs.contains(&listed) {
                        account.outputs.push(listed);
                    }
                });
            }
            Err(error) => {
                if error.is_passing() {
                    self.with_account(|account| account.n_passing += 1);
                }
                self.fail(error.to_string());
            }
        }
    }

    fn has_written(&self, name: &str) -> bool {
        let listed = self.name.join(name);
        self.with_account(|account| account.outputs.contains(&listed))
    }

    fn with_account<T>(&self, f: impl FnOnce(&mut Account) -> T) -> T {
        f(&mut lock(&self.account))
    }
}

/// The image as it is written.
fn counts(image: &Image<f32>) -> Image<u16> {
    image.map(|&counts| counts.round() as u16)
}

/// Where a snapshot has depth to go with it.
fn depth_mask(snapshot: &ShadingSnapshot) -> Image<u8> {
    snapshot.depth_m.map(|&z| if z > 0.0 { 255 } else { 0 })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::capture::Unrecorded;
    use depth_camera::DepthCamera;
    use rayon::ThreadPoolBuilder;
    use simulated::SimulatedCamera;
    use std::{fs, io::ErrorKind, os::unix::fs::symlink};

    #[test]
    fn what_the_disk_may_take_later_is_counted_among_what_could_not_be_written() {
        let folder = tempfile::tempdir().unwrap();
        let partial = folder.path().join(".trajectory.txt.partial");
        let outbox = Outbox::inside(folder.path());
        let write = || outbox.trajectory(&[(0.0, Pose::identity())]);
        symlink("/dev/full", &partial).unwrap();
        write();
        // The failure has taken the link away.
        fs::create_dir(&partial).unwrap();
        write();
        let account = outbox.account();
        assert_eq!((account.failures.len(), account.n_passing), (2, 1));
    }

    #[test]
    fn masks_of_shading_images_that_found_no_room_are_not_missed_as_well() {
        let folder = tempfile::tempdir().unwrap();
        let root = folder.path().join(SNAPSHOTS);
        let outbox = Outbox::inside(folder.path());
        let camera = SimulatedCamera::kinect2_plaque(1, 0);
        let snapshot = ShadingSnapshot {
            frame_id: 0,
            device_time_secs: 0.0,
            n_exposures: 1,
            ir_counts: Image::filled(1, 1, 0.0),
            unlit_counts: None,
            depth_m: Image::filled(1, 1, 0.0),
            world_from_camera: Pose::identity(),
            moved: None,
        };
        let (snapshots, masks) = (vec![snapshot; 3], vec![Image::filled(1, 1, 255); 3]);
        // One thread makes no folder after the one that finds no room.
        let pool = ThreadPoolBuilder::new().num_threads(1).build().unwrap();
        let write = || pool.install(|| outbox.snapshots(&snapshots, camera.info()));
        fs::create_dir_all(root.join("000")).unwrap();
        symlink("/dev/full", root.join("000/.ir.png.partial")).unwrap();
        write();
        assert!(!root.join("001").exists());
        outbox.masks(&masks);
        let account = outbox.account();
        assert_eq!((account.failures.len(), account.n_passing), (1, 1));
        // The failure has taken the link away.
        write();
        let mask = || fs::read(root.join("002/mask.png")).unwrap();
        let of_depth = mask();
        outbox.masks(&masks);
        assert!(mask() != of_depth);
        assert_eq!(outbox.account().failures, account.failures);
    }

    #[test]
    fn a_report_lists_itself_where_it_was_written() {
        for (refused, written) in [(REPORT_HTML, REPORT_JSON), (REPORT_JSON, REPORT_HTML)] {
            let folder = tempfile::tempdir().unwrap();
            let partial = folder.path().join(format!(".{refused}.partial"));
            symlink("/dev/full", partial).unwrap();
            let mut report = Report::default();
            Outbox::inside(folder.path()).report(&mut report, &ReportPictures::default());
            let written = folder.path().join(written);
            assert!(written.is_file());
            assert_eq!(report.outputs, [written.display().to_string()]);
        }
    }

    #[test]
    fn what_the_recorder_found_no_room_for_is_counted_as_well() {
        let outbox = Outbox::inside(Path::new("out"));
        let causes = [
            Some(ErrorKind::StorageFull),
            Some(ErrorKind::PermissionDenied),
            None,
        ];
        let failures = causes.map(|cause| Unrecorded {
            what: "3 events are missing".to_owned(),
            cause,
        });
        outbox.recorded(&RecorderSummary {
            failures: failures.into(),
            ..RecorderSummary::default()
        });
        let account = outbox.account();
        assert_eq!((account.failures.len(), account.n_passing), (3, 1));
    }
}
