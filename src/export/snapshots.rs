//! The shading images of a scan, with their poses, for other programs: one folder for each.

use super::{
    ExportError,
    atomic::write_atomically,
    encode_png_grey8, encode_png_grey16,
    trajectory::{TUM_HEADER, check_pose, tum_line},
};
use crate::geometry::Pose;
use depth_camera::Image;
use rayon::prelude::*;
use std::{
    fs,
    io::{self, Write},
    path::{Path, PathBuf},
    sync::atomic::{AtomicBool, Ordering},
};

/// One shading image as it is written.
#[derive(Clone, Debug)]
pub struct SnapshotRecord<'a> {
    /// Raw IR counts.
    pub ir: &'a Image<u16>,
    /// The same without the light, of the same size, where that was taken.
    pub unlit: Option<&'a Image<u16>>,
    /// Which pixels count, of the same size as `ir`: 0 is masked out.
    pub mask: &'a Image<u8>,
    /// Depth from the same pose, of the same size, metres; 0 is none.
    pub depth_m: &'a Image<f32>,
    /// Pose of the IR camera.
    pub world_from_camera: Pose,
    /// Whatever else there is to know: exposure, light, intrinsics, frame.
    pub meta: serde_json::Value,
    /// The device's own clock, seconds.
    pub device_time_secs: f64,
}

/// The folder of the snapshots in a scan's folder.
pub const SNAPSHOTS: &str = "snapshots";
/// The files of a snapshot, `meta.json` being the last: where it stands the snapshot is whole.
pub(super) const FILES: [&str; 5] = ["ir.png", "mask.png", "depth.png", "pose.txt", "meta.json"];
/// Beside them where ambient light was measured.
pub(super) const UNLIT: &str = "unlit.png";
/// Depth is stored in steps of 1 / this many metres, as in the TUM RGB-D benchmark.
pub(super) const DEPTH_UNITS_PER_METRE: f32 = 5000.0;

/// Writes snapshot k of `records` to `dir/snapshots/` in folder `000`, `001`, …: `ir.png` (16 bit, raw counts), `unlit.png` where
/// that is known (the same without the light), `mask.png`
/// (8 bit), `depth.png` (16 bit, 5000 a metre), `pose.txt` (one TUM line, world from camera) and, last of all, `meta.json`.
///
/// Snapshots of an earlier export are replaced; those beyond the last record are removed, but only these files.
///
/// # Errors
/// [`ExportError::Unfit`] if a mask differs in size from its image or a pose is not finite, before anything is written;
/// [`ExportError::Write`] if a file cannot be written.
pub fn write_snapshots(dir: &Path, records: &[SnapshotRecord]) -> Result<(), ExportError> {
    SnapshotExport::new(dir, records).write()
}

/// [`write_snapshots`] where the disk may refuse and is asked again: what one attempt wrote whole, the next leaves alone.
#[derive(Debug)]
pub struct SnapshotExport<'a> {
    root: PathBuf,
    records: &'a [SnapshotRecord<'a>],
    /// Of each record.
    is_written: Vec<AtomicBool>,
}

impl<'a> SnapshotExport<'a> {
    /// Of records into `dir/snapshots`; writes nothing yet.
    pub fn new(dir: &Path, records: &'a [SnapshotRecord<'a>]) -> Self {
        SnapshotExport {
            root: dir.join(SNAPSHOTS),
            records,
            is_written: records.iter().map(|_| AtomicBool::new(false)).collect(),
        }
    }

    /// Writes what is not written yet.
    ///
    /// # Errors
    /// As [`write_snapshots`].
    pub fn write(&self) -> Result<(), ExportError> {
        let (root, records) = (&self.root, self.records);
        for (index, record) in records.iter().enumerate() {
            let unfit = |what| ExportError::unfit(&root.join(folder_name(index)), what);
            check(record).map_err(unfit)?;
        }
        fs::create_dir_all(root).map_err(|cause| ExportError::write(root, cause))?;
        let folders = records.par_iter().zip(&self.is_written).with_max_len(1);
        let folders = folders.enumerate();
        folders.try_for_each(|(index, (record, is_written))| {
            write_once(&root.join(folder_name(index)), record, is_written)
        })?;
        for index in records.len().. {
            let stale = root.join(folder_name(index));
            if !stale.is_dir() {
                break;
            }
            remove_snapshot(&stale).map_err(|cause| ExportError::write(&stale, cause))?;
        }
        Ok(())
    }
}

/// Writes other masks to the snapshots that [`write_snapshots`] wrote to `dir`, the first mask to the first snapshot.
///
/// # Errors
/// [`ExportError::Write`] if a file cannot be written.
pub fn write_masks(dir: &Path, masks: &[Image<u8>]) -> Result<(), ExportError> {
    let root = dir.join(SNAPSHOTS);
    let masks = masks.par_iter().with_max_len(1).enumerate();
    masks.try_for_each(|(index, mask)| write_mask(&root.join(folder_name(index)), mask))
}

fn write_mask(folder: &Path, mask: &Image<u8>) -> Result<(), ExportError> {
    let [_, path, ..] = FILES;
    write_atomically(&folder.join(path), |file| {
        file.write_all(&encode_png_grey8(mask)?)
    })
}

pub(super) fn folder_name(index: usize) -> String {
    format!("{index:03}")
}

fn check(record: &SnapshotRecord) -> Result<(), String> {
    let size = |width: usize, height: usize| format!("{width}×{height}");
    let ir = size(record.ir.width(), record.ir.height());
    let mask = size(record.mask.width(), record.mask.height());
    if ir != mask {
        return Err(format!("the mask is {mask}, the image {ir}"));
    }
    let depth = size(record.depth_m.width(), record.depth_m.height());
    if ir != depth {
        return Err(format!("the depth is {depth}, the image {ir}"));
    }
    let unlit = record.unlit.unwrap_or(record.ir);
    let unlit = size(unlit.width(), unlit.height());
    if ir != unlit {
        return Err(format!(
            "the image without light is {unlit}, the image {ir}"
        ));
    }
    check_pose(record.device_time_secs, &record.world_from_camera)
}

/// Writes a snapshot that is not written yet.
fn write_once(
    folder: &Path,
    record: &SnapshotRecord,
    is_written: &AtomicBool,
) -> Result<(), ExportError> {
    if !is_written.load(Ordering::Relaxed) {
        write_snapshot(folder, record)?;
        is_written.store(true, Ordering::Relaxed);
    }
    Ok(())
}

fn write_snapshot(folder: &Path, record: &SnapshotRecord) -> Result<(), ExportError> {
    let [ir, _, depth, pose, meta] = FILES.map(|name| folder.join(name));
    fs::create_dir_all(folder).map_err(|cause| ExportError::write(folder, cause))?;
    // While the files are of two exports, nothing may say that they belong together.
    remove_file(&meta).map_err(|cause| ExportError::write(&meta, cause))?;
    write_atomically(&ir, |file| file.write_all(&encode_png_grey16(record.ir)?))?;
    let unlit = folder.join(UNLIT);
    match record.unlit {
        Some(counts) => {
            write_atomically(&unlit, |file| file.write_all(&encode_png_grey16(counts)?))?;
        }
        None => remove_file(&unlit).map_err(|cause| ExportError::write(&unlit, cause))?,
    }
    write_mask(folder, record.mask)?;
    let units = record
        .depth_m
        .map(|z| (DEPTH_UNITS_PER_METRE * z).round() as u16);
    write_atomically(&depth, |file| file.write_all(&encode_png_grey16(&units)?))?;
    let line = tum_line(record.device_time_secs, &record.world_from_camera);
    write_atomically(&pose, |file| writeln!(file, "{TUM_HEADER}\n{line}"))?;
    write_atomically(&meta, |file| writeln!(file, "{:#}", record.meta))
}

fn remove_snapshot(folder: &Path) -> io::Result<()> {
    for name in FILES.iter().rev().chain(&[UNLIT]) {
        remove_file(&folder.join(name))?;
    }
    match fs::remove_dir(folder) {
        // Somebody keeps files of their own there.
        Err(error) if error.kind() == io::ErrorKind::DirectoryNotEmpty => Ok(()),
        result => result,
    }
}

/// Removes a file if it is there.
fn remove_file(path: &Path) -> io::Result<()> {
    match fs::remove_file(path) {
        Err(error) if error.kind() == io::ErrorKind::NotFound => Ok(()),
        result => result,
    }
}

#[cfg(test)]
mod tests {
    use super::super::read_trajectory;
    use super::*;
    use serde_json::json;

    fn record<'a>(
        ir: &'a Image<u16>,
        mask: &'a Image<u8>,
        depth_m: &'a Image<f32>,
    ) -> SnapshotRecord<'a> {
        SnapshotRecord {
            ir,
            unlit: None,
            mask,
            depth_m,
            world_from_camera: Pose::identity(),
            meta: json!({}),
            device_time_secs: 0.0,
        }
    }

    #[test]
    fn a_second_export_leaves_no_snapshot_of_the_first() {
        let folder = tempfile::tempdir().unwrap();
        let ir = Image::from_vec(4, 3, (0..12u16).map(|k| k * 5000).collect());
        let mask = Image::filled(4, 3, 255u8);
        let depth_m = Image::filled(4, 3, 0.7f32);
        let record = |k: usize| SnapshotRecord {
            unlit: (k == 1).then_some(&ir),
            world_from_camera: Pose::translation(0.1 * k as f64, 0.0, 0.5),
            meta: json!({"frame_id": k}),
            device_time_secs: k as f64,
            ..record(&ir, &mask, &depth_m)
        };
        write_snapshots(folder.path(), &[record(0), record(1), record(2)]).unwrap();
        let root = folder.path().join("snapshots");
        fs::write(root.join("001/note.txt"), "mine").unwrap();
        write_snapshots(folder.path(), &[record(7)]).unwrap();

        for name in FILES {
            assert!(root.join("000").join(name).is_file());
            assert!(!root.join("001").join(name).exists());
        }
        assert!(!root.join("001").join(UNLIT).exists());
        assert!(root.join("001/note.txt").is_file() && !root.join("002").exists());
        let meta: serde_json::Value =
            serde_json::from_slice(&fs::read(root.join("000/meta.json")).unwrap()).unwrap();
        assert_eq!(meta["frame_id"], json!(7));
        let poses = read_trajectory(&root.join("000/pose.txt")).unwrap();
        assert!((poses[0].0 - 7.0).abs() < 1e-6 && (poses[0].1.translation.x - 0.7).abs() < 1e-9);
    }

    #[test]
    fn another_attempt_leaves_alone_what_is_written() {
        let folder = tempfile::tempdir().unwrap();
        let (ir, mask) = (Image::filled(4, 3, 7u16), Image::filled(4, 3, 255u8));
        let depth_m = Image::filled(4, 3, 0.7f32);
        let records = [record(&ir, &mask, &depth_m), record(&ir, &mask, &depth_m)];
        let export = SnapshotExport::new(folder.path(), &records);
        let root = folder.path().join("snapshots");
        fs::create_dir(&root).unwrap();
        // Where its folder belongs a file stands.
        fs::write(root.join("001"), "").unwrap();
        assert!(export.write().is_err());
        fs::remove_file(root.join("001")).unwrap();
        export.write().unwrap();
        for name in ["000", "001"] {
            assert!(root.join(name).join("meta.json").is_file());
            fs::write(root.join(name).join("ir.png"), "as it was").unwrap();
        }
        export.write().unwrap();
        for name in ["000", "001"] {
            assert_eq!(
                fs::read(root.join(name).join("ir.png")).unwrap(),
                b"as it was"
            );
        }
    }

    #[test]
    fn other_masks_leave_the_rest() {
        let folder = tempfile::tempdir().unwrap();
        let ir = Image::from_vec(4, 3, (0..12u16).map(|k| k * 5000).collect());
        let (all, none) = (Image::filled(4, 3, 255u8), Image::filled(4, 3, 0u8));
        let depth_m = Image::filled(4, 3, 0.7f32);
        let record = record(&ir, &all, &depth_m);
        write_snapshots(folder.path(), &[record.clone(), record]).unwrap();
        let read = |index: usize| {
            let of_snapshot = folder.path().join("snapshots").join(folder_name(index));
            FILES.map(|name| fs::read(of_snapshot.join(name)).unwrap())
        };
        let before = [read(0), read(1)];
        write_masks(folder.path(), &[all.clone(), none.clone()]).unwrap();
        assert!(read(0) == before[0]);
        for ((name, before), after) in FILES.iter().zip(&before[1]).zip(read(1)) {
            assert_eq!(*before == after, *name != "mask.png", "{name}");
        }
        assert_eq!(read(1)[1], encode_png_grey8(&none).unwrap());
    }

    #[test]
    fn a_mask_of_another_size_is_refused() {
        let folder = tempfile::tempdir().unwrap();
        let (ir, mask) = (Image::filled(4, 3, 0u16), Image::filled(3, 4, 0u8));
        let depth_m = Image::filled(4, 3, 0.7f32);
        let error = write_snapshots(folder.path(), &[record(&ir, &mask, &depth_m)])
            .unwrap_err()
            .to_string();
        assert!(error.contains("3×4") && !folder.path().join("snapshots").exists());
    }
}
