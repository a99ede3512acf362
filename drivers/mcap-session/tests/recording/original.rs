//! A small recording whose chunks are known, to be damaged.

use std::{
    fs,
    path::{Path, PathBuf},
};

use depth_camera::CameraInfo;
use mcap_session::{SessionRecord, State, verify};

use crate::support::{camera_info, first_segment, record};

pub const N_FRAMES: u64 = 60;
pub const FRAMES_PER_CHUNK: u64 = 5;

/// A closed recording, and copies of it that are damaged.
pub struct Original {
    _folder: tempfile::TempDir,
    /// Where its folder lies, and that of the copy.
    pub root: PathBuf,
    /// Its camera.
    pub info: CameraInfo,
    /// Its only segment.
    pub bytes: Vec<u8>,
    /// First and last byte of each chunk that holds frames.
    pub chunks: Vec<(usize, usize)>,
}

impl Original {
    /// A recording of [`N_FRAMES`].
    pub fn new() -> Self {
        let folder = tempfile::tempdir().unwrap();
        let root = folder.path().to_owned();
        let info = camera_info(20, 16);
        record(&root.join("original"), &info, N_FRAMES, FRAMES_PER_CHUNK);
        let bytes = fs::read(first_segment(&root.join("original"))).unwrap();
        let summary = mcap::Summary::read(&bytes).unwrap().unwrap();
        let depth = summary.channels.values();
        let mut depth = depth.filter(|channel| channel.topic.ends_with("/depth/image"));
        let depth = depth.next().unwrap().id;
        let with_frames = summary
            .chunk_indexes
            .iter()
            .filter(|chunk| chunk.message_index_offsets.contains_key(&depth));
        let chunks: Vec<(usize, usize)> = with_frames
            .map(|chunk| {
                let start = chunk.chunk_start_offset as usize;
                (start, start + chunk.chunk_length as usize)
            })
            .collect();
        assert_eq!(chunks.len() as u64, N_FRAMES / FRAMES_PER_CHUNK);
        Original {
            _folder: folder,
            root,
            info,
            bytes,
            chunks,
        }
    }

    /// Whether a byte lies in a chunk that holds frames.
    pub fn is_in_chunk(&self, at: usize) -> bool {
        let mut chunks = self.chunks.iter();
        chunks.any(|(start, end)| (*start..*end).contains(&at))
    }

    /// The recording with other bytes, open or closed.
    pub fn with_bytes(&self, bytes: &[u8], state: State) -> PathBuf {
        let folder = self.root.join("copy");
        let _ = fs::remove_dir_all(&folder);
        fs::create_dir(&folder).unwrap();
        let record = SessionRecord::read(&self.root.join("original")).unwrap();
        let record = SessionRecord { state, ..record };
        record.write(&folder).unwrap();
        fs::write(first_segment(&folder), bytes).unwrap();
        folder
    }
}

/// How much verifying a recording finds.
pub fn n_problems(path: &Path) -> usize {
    let reports = verify(path).unwrap();
    reports.iter().map(|report| report.problems.len()).sum()
}
