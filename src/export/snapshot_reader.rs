//! Reads back the shading images that [`write_snapshots`](super::write_snapshots) wrote.

use super::{
    ExportError, read_trajectory,
    snapshots::{DEPTH_UNITS_PER_METRE, FILES, SNAPSHOTS, UNLIT, folder_name},
};
use crate::geometry::Pose;
use depth_camera::Image;
use rayon::prelude::*;
use std::{
    fs, io,
    path::{Path, PathBuf},
};

/// One shading image as it was read.
#[derive(Clone, Debug)]
pub struct StoredSnapshot {
    /// Its folder.
    pub folder: PathBuf,
    /// Raw IR counts.
    pub ir: Image<u16>,
    /// The same without the light, where that was taken.
    pub unlit: Option<Image<u16>>,
    /// Depth from the same pose, metres; 0 is none, everywhere in folders of versions that did not write it.
    pub depth_m: Image<f32>,
    /// Pose of the IR camera.
    pub world_from_camera: Pose,
    /// The device's own clock, seconds.
    pub device_time_secs: f64,
    /// Whatever else was known.
    pub meta: serde_json::Value,
}

/// The shading images of a folder.
#[derive(Clone, Debug, Default)]
pub struct StoredSnapshots {
    /// Those that are whole, by number.
    pub whole: Vec<StoredSnapshot>,
    /// The folders of those that are not, by number.
    pub unfinished: Vec<PathBuf>,
}

/// Reads `dir/snapshots/000`, `001`, …, whichever are there; none without any. Those that were being written when the program
/// was ended, which may be several, hold no `meta.json`, and are left out.
///
/// # Errors
/// [`ExportError::Read`] or [`ExportError::Malformed`] for a file that cannot be read or is not what it should be, and for an
/// unfinished folder if there is no other.
pub fn read_snapshots(dir: &Path) -> Result<StoredSnapshots, ExportError> {
    let folders = begun_snapshots(&dir.join(SNAPSHOTS))?;
    let (whole, unfinished): (Vec<_>, Vec<_>) =
        folders.into_iter().partition(|folder| is_whole(folder));
    if let ([], [first, ..]) = (whole.as_slice(), unfinished.as_slice()) {
        return Err(ExportError::malformed(
            first,
            "it holds no meta.json, nor does another".into(),
        ));
    }
    let read: Vec<Result<_, _>> = whole
        .par_iter()
        .with_max_len(1)
        .map(|folder| read_snapshot(folder))
        .collect();
    Ok(StoredSnapshots {
        whole: read.into_iter().collect::<Result<_, _>>()?,
        unfinished,
    })
}

/// The folders of snapshots by number, those of which anything is there.
fn begun_snapshots(root: &Path) -> Result<Vec<PathBuf>, ExportError> {
    let entries = match fs::read_dir(root) {
        Err(error) if error.kind() == io::ErrorKind::NotFound => return Ok(Vec::new()),
        entries => entries.map_err(|cause| ExportError::read(root, cause))?,
    };
    let mut numbered = Vec::new();
    for entry in entries {
        let folder = entry
            .map_err(|cause| ExportError::read(root, cause))?
            .path();
        let is_begun = FILES.iter().any(|name| folder.join(name).exists());
        numbered.extend(
            number_of(&folder)
                .filter(|_| is_begun)
                .map(|number| (number, folder)),
        );
    }
    numbered.sort();
    Ok(numbered.into_iter().map(|(_, folder)| folder).collect())
}

/// The number of a snapshot by its folder's name.
fn number_of(folder: &Path) -> Option<usize> {
    let name = folder.file_name()?.to_str()?;
    let number = name.parse().ok()?;
    (folder_name(number) == name).then_some(number)
}

/// Whether a snapshot was written to its end.
fn is_whole(folder: &Path) -> bool {
    let [.., meta] = FILES;
    folder.join(meta).is_file()
}

fn read_snapshot(folder: &Path) -> Result<StoredSnapshot, ExportError> {
    let [ir, _, depth, pose, meta] = FILES.map(|name| folder.join(name));
    let ir = read_png(&ir)?;
    let depth_m = match depth.is_file() {
        true => read_png(&depth)?.map(|&units| f32::from(units) / DEPTH_UNITS_PER_METRE),
        false => Image::filled(ir.width(), ir.height(), 0.0),
    };
    let same_size = |path: &Path, (width, height): (usize, usize)| {
        let reason = format!("it is not of the image's {}×{}", ir.width(), ir.height());
        match (width, height) == (ir.width(), ir.height()) {
            true => Ok(()),
            false => Err(ExportError::malformed(path, reason)),
        }
    };
    same_size(&depth, (depth_m.width(), depth_m.height()))?;
    let unlit_path = folder.join(UNLIT);
    let unlit = match unlit_path.is_file() {
        true => Some(read_png(&unlit_path)?),
        false => None,
    };
    if let Some(unlit) = &unlit {
        same_size(&unlit_path, (unlit.width(), unlit.height()))?;
    }
    let (device_time_secs, world_from_camera) = read_trajectory(&pose)?
        .first()
        .copied()
        .ok_or_else(|| ExportError::malformed(&pose, "it holds no pose".into()))?;
    let text = fs::read_to_string(&meta).map_err(|cause| ExportError::read(&meta, cause))?;
    let json = serde_json::from_str(&text);
    Ok(StoredSnapshot {
        folder: folder.to_owned(),
        ir,
        unlit,
        depth_m,
        world_from_camera,
        device_time_secs,
        meta: json.map_err(|error| ExportError::malformed(&meta, error.to_string()))?,
    })
}

fn read_png(path: &Path) -> Result<Image<u16>, ExportError> {
    let bytes = replay::read_ordinary_file(path).map_err(|cause| ExportError::read(path, cause))?;
    replay::decode_png(&bytes).map_err(|reason| ExportError::malformed(path, reason))
}

#[cfg(test)]
mod tests {
    use super::super::{SnapshotRecord, write_snapshots};
    use super::*;
    use serde_json::json;

    #[test]
    fn snapshots_survive_the_round_trip() {
        let folder = tempfile::tempdir().unwrap();
        let ir = Image::from_vec(4, 3, (0..12u16).map(|k| k * 5000).collect());
        let mask = Image::filled(4, 3, 255u8);
        let depth_m = Image::from_vec(4, 3, (0..12).map(|k| k as f32 * 0.1).collect());
        let unlit = ir.map(|counts| counts / 10);
        let record = SnapshotRecord {
            ir: &ir,
            unlit: Some(&unlit),
            mask: &mask,
            depth_m: &depth_m,
            world_from_camera: Pose::translation(0.1, 0.2, 0.5),
            meta: json!({"frame_id": 3}),
            device_time_secs: 1.5,
        };
        write_snapshots(folder.path(), &[record.clone(), record]).unwrap();
        let back = read_snapshots(folder.path()).unwrap().whole;
        assert_eq!(back.len(), 2);
        assert_eq!(back[1].ir, ir);
        assert_eq!(back[1].unlit.as_ref(), Some(&unlit));
        let pairs = back[1].depth_m.data().iter().zip(depth_m.data());
        // Half of a step of 1/5000 m.
        assert!(pairs.into_iter().all(|(a, b)| (a - b).abs() < 1.01e-4));
        assert_eq!(back[1].world_from_camera.translation.y, 0.2);
        assert_eq!(back[1].meta["frame_id"], json!(3));
    }

    #[test]
    fn every_whole_snapshot_is_read_and_those_that_are_not_are_named() {
        let folder = tempfile::tempdir().unwrap();
        let (ir, mask) = (Image::filled(4, 3, 7u16), Image::filled(4, 3, 255u8));
        let depth_m = Image::filled(4, 3, 0.7f32);
        let record = |k: usize| SnapshotRecord {
            ir: &ir,
            unlit: None,
            mask: &mask,
            depth_m: &depth_m,
            world_from_camera: Pose::identity(),
            meta: json!({"frame_id": k}),
            device_time_secs: k as f64,
        };
        let records: Vec<_> = (0..5).map(record).collect();
        write_snapshots(folder.path(), &records).unwrap();
        let root = folder.path().join("snapshots");
        let frames = || {
            let read = read_snapshots(folder.path()).unwrap();
            let ids = read.whole.iter();
            let ids = ids.filter_map(|snapshot| snapshot.meta["frame_id"].as_u64());
            (ids.collect::<Vec<_>>(), read.unfinished)
        };
        fs::remove_dir_all(root.join("001")).unwrap();
        fs::create_dir(root.join("005")).unwrap();
        assert_eq!(frames(), (vec![0, 2, 3, 4], Vec::new()));
        for name in ["002", "004"] {
            fs::remove_file(root.join(name).join("meta.json")).unwrap();
        }
        assert_eq!(
            frames(),
            (vec![0, 3], vec![root.join("002"), root.join("004")])
        );
        for name in ["000", "003"] {
            fs::remove_file(root.join(name).join("meta.json")).unwrap();
        }
        let error = read_snapshots(folder.path()).unwrap_err().to_string();
        assert!(
            error.contains("000 is malformed: it holds no meta.json"),
            "{error}"
        );
    }

    #[test]
    fn a_spoilt_image_is_named() {
        let folder = tempfile::tempdir().unwrap();
        let spoilt = folder.path().join("snapshots/000");
        fs::create_dir_all(&spoilt).unwrap();
        let none = read_snapshots(folder.path()).unwrap();
        assert!(none.whole.is_empty() && none.unfinished.is_empty());
        fs::write(spoilt.join("meta.json"), "{}").unwrap();
        fs::write(spoilt.join("ir.png"), "no image").unwrap();
        let error = read_snapshots(folder.path()).unwrap_err().to_string();
        assert!(
            error.contains("ir.png") && error.contains("malformed"),
            "{error}"
        );
    }
}
