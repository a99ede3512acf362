//! Files cut anywhere and damaged in any way: what is whole is kept, what is not is found.

use std::{fs, path::Path};

use mcap_session::{
    RecordingParams, SESSION_FILE_NAME, SegmentWriter, SessionRecord, State, repair, verify,
};

use crate::{
    original::{FRAMES_PER_CHUNK, N_FRAMES, Original, n_problems},
    support::{assert_as_recorded, camera_info, first_segment, frame, params, play, record},
};

/// Set to cut at every byte of the last two chunks; otherwise at every 37th.
const EVERY_CUT: &str = "MCAP_SESSION_EVERY_CUT";

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
fn a_closed_recording_that_was_cut_is_told_of() {
    let original = Original::new();
    let (cut, _) = original.chunks[8];
    let folder = original.with_bytes(&original.bytes[..cut + 100], State::Closed);
    let torn = format!("segment-0000.mcap: {cut} bytes into it the rest is missing");
    let n_missing = N_FRAMES - 8 * FRAMES_PER_CHUNK;
    let missing = format!("{n_missing} of the {N_FRAMES} frames");
    let damage_of = |path: &Path| {
        let played = play(path).unwrap();
        assert_eq!(played.frames.len() as u64, N_FRAMES - n_missing);
        assert_eq!(played.damages.len(), 1, "{:?}", played.damages);
        played.damages.concat()
    };
    let damage = damage_of(&folder);
    assert!(damage.contains(&missing), "{damage}");
    assert!(damage.contains(&torn), "{damage}");
    // A segment alone does not know of the others.
    let damage = damage_of(&first_segment(&folder));
    assert!(!damage.contains(&missing), "{damage}");
    assert!(damage.contains(&torn), "{damage}");
}

#[test]
fn bytes_that_are_missing_from_a_chunk_cost_no_other() {
    let original = Original::new();
    let (start, end) = original.chunks[3];
    // Enough that the chunk's length reaches over its indexes into the next chunk.
    for n_missing in [1, 300, end - start - 200] {
        let mut bytes = original.bytes.clone();
        bytes.drain(start + 100..start + 100 + n_missing);
        let folder = original.with_bytes(&bytes, State::Closed);
        let n_frames = N_FRAMES - FRAMES_PER_CHUNK;
        let played = play(&first_segment(&folder)).unwrap();
        assert_eq!(played.frames.len() as u64, n_frames, "{n_missing} missing");
        let note = repair(&folder).unwrap().unwrap();
        assert_eq!(note.frames_recovered, n_frames, "{n_missing} missing");
        assert_eq!(n_problems(&folder), 0, "{n_missing} missing");
    }
}

#[test]
fn header_and_definitions_may_both_be_lost() {
    let original = Original::new();
    let mut bytes = original.bytes.clone();
    let header = mcap::MAGIC.len();
    bytes[header..header + 200].fill(0x55);
    let folder = original.with_bytes(&bytes, State::Closed);
    let played = play(&first_segment(&folder)).unwrap();
    assert_eq!(played.frames.len() as u64, N_FRAMES);
    let note = repair(&folder).unwrap().unwrap();
    assert_eq!(
        (note.frames_recovered, note.frames_lost),
        (N_FRAMES, Some(0))
    );
    assert_eq!(n_problems(&folder), 0);
    let played = play(&folder).unwrap();
    assert_eq!(played.damages, Vec::<String>::new());
    assert_eq!(played.frames.len() as u64, N_FRAMES);
    assert_as_recorded(&original.info, &played.frames);
}

#[test]
fn a_header_that_bytes_are_missing_from_is_mended_or_passed_over() {
    let original = Original::new();
    let header = mcap::MAGIC.len();
    let (length, _) = original.bytes[header + 1..].split_at(8);
    let n_bytes = 9 + u64::from_le_bytes(length.try_into().unwrap()) as usize;
    for n_missing in 1..n_bytes {
        let mut bytes = original.bytes.clone();
        bytes.drain(header + n_bytes - n_missing..header + n_bytes);
        let folder = original.with_bytes(&bytes, State::Closed);
        let note = repair(&folder).unwrap().unwrap();
        assert_eq!(note.frames_recovered, N_FRAMES, "{n_missing} missing");
        assert_eq!(n_problems(&folder), 0, "{n_missing} missing");
        let played = play(&folder).unwrap();
        assert_eq!(played.frames.len() as u64, N_FRAMES, "{n_missing} missing");
    }
}

#[test]
fn a_segment_that_is_missing_is_found_and_the_others_are_played() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a");
    let info = camera_info(20, 16);
    let short = RecordingParams {
        max_segment_bytes: 20_000,
        ..params()
    };
    let mut writer = SegmentWriter::create(&path, &info, short).unwrap();
    for frame_id in 0..N_FRAMES {
        writer.write(&frame(&info, frame_id)).unwrap();
    }
    writer.finish().unwrap();
    assert_eq!(n_problems(&path), 0);
    let segments = mcap_session::files(&path).unwrap();
    assert!(segments.len() > 2, "{segments:?}");

    let lost = play(&segments[1]).unwrap().frames.len() as u64;
    assert!(lost > 0);
    let left = N_FRAMES - lost;
    // One of which nothing is left.
    fs::write(&segments[1], "").unwrap();
    assert_eq!(play(&path).unwrap().frames.len() as u64, left);
    fs::remove_file(&segments[1]).unwrap();
    let played = play(&path).unwrap();
    let expected =
        format!("{lost} of the {N_FRAMES} frames that session.json tells of are missing");
    assert!(
        played.damages[0].ends_with(&expected),
        "{:?}",
        played.damages
    );
    assert_eq!(
        (played.frames.len() as u64, played.damages.len()),
        (left, 1)
    );
    let reports = verify(&path).unwrap();
    let problems: Vec<&String> = reports.iter().flat_map(|report| &report.problems).collect();
    let expected = format!(
        "the recording has {N_FRAMES} depth images of which {left} were found, {N_FRAMES} IR images of which {left} were found"
    );
    assert_eq!(problems, [&expected]);
    let note = repair(&path).unwrap().unwrap();
    assert_eq!(note.frames_lost, Some(lost));
    assert_eq!(n_problems(&path), 0);
    let played = play(&path).unwrap();
    assert_eq!(played.frames.len() as u64, left);
    assert_as_recorded(&info, &played.frames);
}

#[test]
fn a_description_that_is_damaged_is_found_and_refused() {
    let original = Original::new();
    let folder = original.with_bytes(&original.bytes, State::Closed);
    assert_eq!(n_problems(&folder), 0);
    let path = folder.join(SESSION_FILE_NAME);
    let text = fs::read_to_string(&path).unwrap();
    fs::write(&path, text.replacen('{', "[", 1)).unwrap();
    assert_eq!(n_problems(&folder), 1);
    let error = repair(&folder).unwrap_err().to_string();
    assert!(error.contains(SESSION_FILE_NAME), "{error}");
    let error = play(&folder).err().unwrap().to_string();
    assert!(error.contains(SESSION_FILE_NAME), "{error}");
}

/// A chunk of such contents as another program compresses it.
fn chunk(compression: &str, n_uncompressed: u64, crc: u32, data: &[u8]) -> Vec<u8> {
    let mut body = [0; 16].to_vec();
    body.extend(n_uncompressed.to_le_bytes());
    body.extend(crc.to_le_bytes());
    body.extend((compression.len() as u32).to_le_bytes());
    body.extend(compression.as_bytes());
    body.extend((data.len() as u64).to_le_bytes());
    body.extend(data);
    let length = body.len() as u64;
    [&[6][..], &length.to_le_bytes(), &body].concat()
}

#[test]
fn a_segment_with_a_chunk_that_is_not_read_is_left_as_it_is() {
    let original = Original::new();
    let (start, end) = original.chunks[3];
    let n_large = (128 << 20) + 1;
    let large = vec![0; n_large];
    let crc = crc32fast::hash(&large);
    let packed = zstd::bulk::compress(&large, 1).unwrap();
    let too_large = "134217729 bytes when decompressed, must be at most 134217728";
    for (unread, expected) in [
        (
            chunk("lz4", 1000, 0, &[7; 300]),
            "compression \"lz4\", must be zstd or none",
        ),
        (
            chunk("lz4", n_large as u64, crc, &[7; 300]),
            "compression \"lz4\", must be zstd or none",
        ),
        (chunk("zstd", n_large as u64, crc, &packed), too_large),
        (
            chunk("", n_large as u64, crc, &large),
            "134217769 bytes, must be at most 134217728",
        ),
    ] {
        let expected =
            format!("segment-0000.mcap: {start} bytes into it a chunk is not read: {expected}");
        let with_unread = [&original.bytes[..start], &unread, &original.bytes[end..]].concat();
        // Alone among chunks that are damaged, and with what lies behind it torn off.
        let mut alone = with_unread.clone();
        for (start, end) in &original.chunks[..3] {
            alone[start + 60..*end].fill(0);
        }
        alone.truncate(start + unread.len());
        for bytes in [&with_unread, &alone] {
            for state in [State::Open, State::Closed] {
                let folder = original.with_bytes(bytes, state);
                let error = repair(&folder).unwrap_err().to_string();
                assert!(error.ends_with(&expected), "{error}");
                assert!(fs::read(first_segment(&folder)).unwrap() == *bytes);
            }
        }
        for state in [State::Open, State::Closed] {
            let played = play(&original.with_bytes(&with_unread, state)).unwrap();
            assert_eq!(played.frames.len() as u64, N_FRAMES - FRAMES_PER_CHUNK);
            let told = &played.damages[0];
            assert!(told.ends_with(&expected), "{told}");
            assert_as_recorded(&original.info, &played.frames);
        }
        let folder = original.with_bytes(&with_unread, State::Closed);
        let reports = verify(&folder).unwrap();
        let told = &reports[0].problems;
        assert!(told.len() == 1 && expected.ends_with(&told[0]), "{told:?}");
    }
    // Of which not so many bytes come is damaged.
    let damaged = chunk("zstd", n_large as u64 + 1, crc, &packed);
    let bytes = [&original.bytes[..start], &damaged, &original.bytes[end..]].concat();
    let folder = original.with_bytes(&bytes, State::Closed);
    let note = repair(&folder).unwrap().unwrap();
    assert_eq!(note.frames_recovered, N_FRAMES - FRAMES_PER_CHUNK);
    assert_eq!(n_problems(&folder), 0);
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
        // Refused where no description is left.
        if let Ok(played) = play(&folder) {
            assert_eq!(played.damages, Vec::<String>::new(), "trial {trial}");
            assert_as_recorded(&original.info, &played.frames);
        }
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
