//! Files cut anywhere and with any bit flipped: what is whole is kept, what is not is found.

use std::{
    fs,
    path::{Path, PathBuf},
};

use depth_camera::CameraInfo;
use mcap_session::{SessionRecord, State, repair, verify};

use crate::support::{assert_as_recorded, camera_info, first_segment, play, record};

const N_FRAMES: u64 = 60;
const FRAMES_PER_CHUNK: u64 = 5;
/// How many bits are flipped; more by hand.
const FLIPS: &str = "MCAP_SESSION_FLIPS";
/// Set to cut at every byte of the last two chunks; otherwise at every 37th.
const EVERY_CUT: &str = "MCAP_SESSION_EVERY_CUT";

/// A closed recording, and copies of it that are damaged.
struct Original {
    _folder: tempfile::TempDir,
    root: PathBuf,
    info: CameraInfo,
    bytes: Vec<u8>,
    /// First and last byte of each chunk that holds frames.
    chunks: Vec<(usize, usize)>,
}

impl Original {
    fn new() -> Self {
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

    /// The recording with other bytes, open or closed.
    fn with_bytes(&self, bytes: &[u8], state: State) -> PathBuf {
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

fn n_problems(path: &Path) -> usize {
    let reports = verify(path).unwrap();
    reports.iter().map(|report| report.problems.len()).sum()
}

#[test]
fn a_file_cut_anywhere_keeps_all_its_whole_chunks() {
    let original = Original::new();
    let n = original.bytes.len();
    let (last_two, _) = original.chunks[original.chunks.len() - 2];
    let step = match std::env::var_os(EVERY_CUT) {
        Some(_) => 1,
        None => 37,
    };
    let mut random = fastrand::Rng::with_seed(3);
    let anywhere: Vec<usize> = (0..60).map(|_| random.usize(0..n)).collect();
    let cuts: Vec<usize> = (last_two..n).step_by(step).chain(anywhere).collect();
    for &cut in &cuts {
        let whole = original.chunks.iter().filter(|(_, end)| *end <= cut);
        let n_frames = whole.count() as u64 * FRAMES_PER_CHUNK;
        let folder = original.with_bytes(&original.bytes[..cut], State::Open);
        if n_frames > 0 {
            // Without repair, as from a disk that cannot be written to.
            let played = play(&first_segment(&folder)).unwrap();
            assert_eq!(played.frames.len() as u64, n_frames, "cut at {cut}");
            assert_eq!(played.damages, Vec::<String>::new(), "cut at {cut}");
        }
        let note = repair(&folder).unwrap().unwrap();
        assert_eq!(note.frames_recovered, n_frames, "cut at {cut}");
        assert_eq!(note.bytes_passed_over, 0, "cut at {cut}");
        assert_eq!(n_problems(&folder), 0, "cut at {cut}");
        assert_eq!(repair(&folder).unwrap(), None, "cut at {cut}");
        let bytes = fs::read(first_segment(&folder)).unwrap();
        let summary = mcap::Summary::read(&bytes).unwrap().unwrap();
        let indexed = mcap::MessageStream::new(&bytes).unwrap();
        let stats = summary.stats.unwrap();
        assert_eq!(indexed.count() as u64, stats.message_count, "cut at {cut}");
        if n_frames > 0 {
            let played = play(&folder).unwrap();
            assert_as_recorded(&original.info, &played.frames);
            assert_eq!(played.frames.len() as u64, n_frames);
        }
    }
    println!("{} cuts of a file of {n} bytes", cuts.len());
}

#[test]
fn any_flipped_bit_is_found_and_costs_its_own_chunk_at_most() {
    let flips = std::env::var(FLIPS).map_or(1000, |text| text.parse().unwrap());
    let original = Original::new();
    let n_bits = 8 * original.bytes.len();
    let mut random = fastrand::Rng::with_seed(4);
    let (mut n_found, mut n_harmless, mut n_chunks_lost) = (0, 0, 0);
    for _ in 0..flips {
        let bit = random.usize(0..n_bits);
        let mut bytes = original.bytes.clone();
        bytes[bit / 8] ^= 1 << (bit % 8);
        let folder = original.with_bytes(&bytes, State::Closed);
        let at = bit / 8;
        n_found += usize::from(n_problems(&folder) > 0);

        let segment = first_segment(&folder);
        if at < mcap::MAGIC.len() {
            let error = play(&segment).err().unwrap().to_string();
            assert!(error.contains("not an MCAP file"), "{error}");
        } else {
            let played = play(&segment).unwrap();
            assert_as_recorded(&original.info, &played.frames);
            let lost = N_FRAMES - played.frames.len() as u64;
            assert!(lost <= FRAMES_PER_CHUNK, "{lost} lost by bit {bit}");
        }

        let note = repair(&folder).unwrap().expect("damage is mended");
        let lost = note.frames_lost.unwrap();
        let in_chunk = original
            .chunks
            .iter()
            .any(|(start, end)| (*start..*end).contains(&at));
        let bound = if in_chunk { FRAMES_PER_CHUNK } else { 0 };
        assert!(lost <= bound, "{lost} lost by bit {bit}");
        match lost {
            0 => n_harmless += 1,
            _ => n_chunks_lost += 1,
        }
        assert_eq!(n_problems(&folder), 0, "bit {bit}");
        let played = play(&folder).unwrap();
        assert_eq!(played.damages, Vec::<String>::new(), "bit {bit}");
        assert_eq!(played.frames.len() as u64, N_FRAMES - lost);
        assert_as_recorded(&original.info, &played.frames);
    }
    println!(
        "{flips} bits flipped in a file of {} bytes: {n_found} found, {n_chunks_lost} cost one chunk, {n_harmless} nothing",
        original.bytes.len()
    );
    assert_eq!(n_found, flips);
}

#[test]
fn random_damage_is_read_or_refused() {
    let original = Original::new();
    let mut random = fastrand::Rng::with_seed(5);
    for trial in 0..300 {
        let mut bytes = original.bytes.clone();
        for _ in 0..random.usize(1..20) {
            let at = random.usize(8..bytes.len());
            match random.u8(0..4) {
                0 => bytes[at] = random.u8(..),
                1 => drop(bytes.drain(at..(at + random.usize(0..2000)).min(bytes.len()))),
                2 => {
                    let noise = (0..random.usize(0..200)).map(|_| random.u8(..));
                    let noise: Vec<u8> = noise.collect();
                    bytes.splice(at..at, noise);
                }
                // Lengths that ask for everything.
                _ => bytes[at..].iter_mut().take(8).for_each(|byte| *byte = 0xff),
            }
            if bytes.len() < 100 {
                break;
            }
        }
        let folder = original.with_bytes(&bytes, State::Closed);
        if let Ok(played) = play(&first_segment(&folder)) {
            assert_as_recorded(&original.info, &played.frames);
        }
        repair(&folder).unwrap();
        assert_eq!(n_problems(&folder), 0, "trial {trial}");
    }
}

/// How many frames of full size a long segment has; more by hand, for the pace of repair.
const LONG: &str = "MCAP_SESSION_LONG";

#[test]
fn a_long_segment_is_mended_in_place() {
    let n_frames = std::env::var(LONG).map_or(40, |text| text.parse().unwrap());
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("long");
    let info = camera_info(512, 424);
    record(&path, &info, n_frames, 7);
    let segment = first_segment(&path);
    let n_bytes = fs::metadata(&segment).unwrap().len();
    let file = fs::OpenOptions::new().write(true).open(&segment).unwrap();
    file.set_len(n_bytes - 100_000).unwrap();
    let record = SessionRecord::read(&path).unwrap();
    let record = SessionRecord {
        state: State::Open,
        ..record
    };
    record.write(&path).unwrap();

    let start = std::time::Instant::now();
    let note = repair(&path).unwrap().unwrap();
    let secs = start.elapsed().as_secs_f64();
    println!(
        "{n_bytes} bytes of {n_frames} frames mended in {secs:.2} s, {:.2} s a GB; {note:?}",
        secs / (n_bytes as f64 / 1e9)
    );
    assert!(note.frames_recovered >= n_frames - 14, "{note:?}");
    assert_eq!(n_problems(&path), 0);
}
