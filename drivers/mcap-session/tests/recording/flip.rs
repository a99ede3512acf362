//! Files with a bit flipped: it is found, it costs its own chunk at most, and what was mended is read without a word.

use std::fs;

use mcap::records::{Record, op};
use mcap_session::{State, repair};

use crate::{
    original::{FRAMES_PER_CHUNK, N_FRAMES, Original, n_problems},
    support::{assert_as_recorded, first_segment, play},
};

/// How many bits are flipped; more by hand.
const FLIPS: &str = "MCAP_SESSION_FLIPS";
/// Set to flip every bit that lies outside of the chunks with frames; otherwise every 101st.
const EVERY_BIT: &str = "MCAP_SESSION_EVERY_BIT";

/// What came of a flipped bit.
struct Flip {
    /// Whether verifying the recording finds something.
    is_found: bool,
    /// Frames that repair gives up.
    n_lost: u64,
}

impl Flip {
    /// Flips a bit, reads the recording as it is, mends it and reads it again. Panics unless all frames are as recorded, at most
    /// those of the bit's own chunk are missing, and nothing is found in what was mended.
    fn of(original: &Original, bit: usize) -> Self {
        let mut bytes = original.bytes.clone();
        bytes[bit / 8] ^= 1 << (bit % 8);
        let folder = original.with_bytes(&bytes, State::Closed);
        let at = bit / 8;
        let is_found = n_problems(&folder) > 0;

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
        let n_lost = note.frames_lost.unwrap();
        let bound = if original.is_in_chunk(at) {
            FRAMES_PER_CHUNK
        } else {
            0
        };
        assert!(n_lost <= bound, "{n_lost} lost by bit {bit}");
        assert_eq!(n_problems(&folder), 0, "bit {bit}");
        let played = play(&folder).unwrap();
        assert_eq!(played.damages, Vec::<String>::new(), "bit {bit}");
        assert_eq!(played.frames.len() as u64, N_FRAMES - n_lost);
        assert_as_recorded(&original.info, &played.frames);
        Flip { is_found, n_lost }
    }
}

#[test]
fn any_flipped_bit_is_found_and_costs_its_own_chunk_at_most() {
    let flips = std::env::var(FLIPS).map_or(1000, |text| text.parse().unwrap());
    let original = Original::new();
    let n_bits = 8 * original.bytes.len();
    let mut random = fastrand::Rng::with_seed(4);
    let (mut n_found, mut n_harmless, mut n_chunks_lost) = (0, 0, 0);
    for _ in 0..flips {
        let flip = Flip::of(&original, random.usize(0..n_bits));
        n_found += usize::from(flip.is_found);
        match flip.n_lost {
            0 => n_harmless += 1,
            _ => n_chunks_lost += 1,
        }
    }
    println!(
        "{flips} bits flipped in a file of {} bytes: {n_found} found, {n_chunks_lost} cost one chunk, {n_harmless} nothing",
        original.bytes.len()
    );
    assert_eq!(n_found, flips);
}

#[test]
fn a_flipped_bit_outside_of_the_chunks_costs_no_frame() {
    let original = Original::new();
    let step = match std::env::var_os(EVERY_BIT) {
        Some(_) => 1,
        None => 101,
    };
    let outside = (0..8 * original.bytes.len()).filter(|bit| !original.is_in_chunk(bit / 8));
    let mut n_flips = 0;
    for bit in outside.step_by(step) {
        let flip = Flip::of(&original, bit);
        assert!(flip.is_found, "bit {bit}");
        assert_eq!(flip.n_lost, 0, "bit {bit}");
        n_flips += 1;
    }
    println!(
        "{n_flips} bits flipped outside of the chunks of a file of {} bytes",
        original.bytes.len()
    );
}

#[test]
fn an_index_that_a_flipped_bit_makes_a_message_is_none() {
    let original = Original::new();
    let summary = mcap::Summary::read(&original.bytes).unwrap().unwrap();
    let indexes = summary
        .chunk_indexes
        .iter()
        .flat_map(|chunk| chunk.message_index_offsets.values());
    let mut n_indexes = 0;
    for &index in indexes {
        let at = index as usize;
        assert_eq!(original.bytes[at], op::MESSAGE_INDEX);
        let bit = op::MESSAGE_INDEX ^ op::MESSAGE;
        assert_eq!(bit.count_ones(), 1);
        let flip = Flip::of(&original, 8 * at + bit.trailing_zeros() as usize);
        assert!(flip.is_found);
        assert_eq!(flip.n_lost, 0);
        n_indexes += 1;
    }
    // Of both images in each chunk, and of what describes them.
    assert!(n_indexes > 2 * original.chunks.len(), "{n_indexes}");
}

#[test]
fn a_header_with_a_flipped_bit_is_written_anew() {
    let original = Original::new();
    let header = mcap::MAGIC.len();
    assert_eq!(original.bytes[header], op::HEADER);
    // The kind, the profile, and the first letters of the library.
    let profile = header + 9 + 4;
    assert_eq!(&original.bytes[profile..profile + 4], b"ros2");
    let library = profile + 4 + 4;
    assert_eq!(&original.bytes[library..library + 7], b"relief ");
    let bytes = [
        header..header + 1,
        profile..profile + 4,
        library..library + 7,
    ];
    for bit in bytes
        .into_iter()
        .flatten()
        .flat_map(|at| 8 * at..8 * at + 8)
    {
        let flip = Flip::of(&original, bit);
        assert!(flip.is_found, "bit {bit}");
        assert_eq!(flip.n_lost, 0, "bit {bit}");
        let mended = fs::read(first_segment(&original.root.join("copy"))).unwrap();
        let (kind, body) = (mended[header], &mended[header + 9..]);
        let Ok(Record::Header(found)) = mcap::parse_record(kind, body) else {
            panic!("a record of kind {kind} where the header was, by bit {bit}");
        };
        assert_eq!(found.profile, "ros2", "bit {bit}");
        assert!(found.library.starts_with("relief "), "{}", found.library);
    }
}

#[test]
fn what_was_passed_over_is_again_when_its_length_is_damaged() {
    let original = Original::new();
    let (lost, _) = original.chunks[3];
    let mut bytes = original.bytes.clone();
    bytes[lost + 1000] ^= 1;
    let folder = original.with_bytes(&bytes, State::Closed);
    let note = repair(&folder).unwrap().unwrap();
    assert_eq!(note.frames_lost, Some(FRAMES_PER_CHUNK));
    let mended = fs::read(first_segment(&folder)).unwrap();
    assert_eq!(mended[lost], 0x80);
    let n_frames = N_FRAMES - FRAMES_PER_CHUNK;
    for bit in 0..8 * 9 {
        let mut bytes = mended.clone();
        bytes[lost + bit / 8] ^= 1 << (bit % 8);
        let folder = original.with_bytes(&bytes, State::Closed);
        assert!(n_problems(&folder) > 0, "bit {bit}");
        let note = repair(&folder).unwrap().unwrap();
        assert_eq!(note.frames_recovered, n_frames, "bit {bit}");
        assert_eq!(n_problems(&folder), 0, "bit {bit}");
        let played = play(&folder).unwrap();
        assert_eq!(played.damages, Vec::<String>::new(), "bit {bit}");
        assert_as_recorded(&original.info, &played.frames);
        assert_eq!(played.frames.len() as u64, n_frames, "bit {bit}");
    }
}
