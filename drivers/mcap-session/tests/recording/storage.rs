//! Disks that are full or broken: recording ends, says so, and keeps what it had.

use std::{
    cell::RefCell,
    fs,
    io::{self, Write},
    path::Path,
    rc::Rc,
};

use mcap_session::{
    RecordingError, RecordingParams, Segment, SegmentWriter, SessionRecord, State,
    messages::encode_string, repair_segment, streams::Stream, verify,
};
use replay::WriteError;

use crate::{
    small_disk::SmallDisk,
    support::{assert_as_recorded, camera_info, first_segment, frame, params, play},
};

/// What a disk holds that refuses its n-th write, having taken a part of it.
#[derive(Clone)]
struct FailingDisk {
    held: Rc<RefCell<Vec<u8>>>,
    writes_left: Rc<RefCell<usize>>,
    errno: i32,
}

impl Write for FailingDisk {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        let mut left = self.writes_left.borrow_mut();
        if *left == 0 {
            return Err(io::Error::from_raw_os_error(self.errno));
        }
        *left -= 1;
        let taken = if *left == 0 {
            bytes.len().div_ceil(2)
        } else {
            bytes.len()
        };
        self.held.borrow_mut().extend(&bytes[..taken]);
        Ok(taken)
    }

    fn flush(&mut self) -> io::Result<()> {
        Ok(())
    }
}

/// Ten messages in five chunks.
fn write_segment(disk: FailingDisk) -> io::Result<()> {
    let mut segment = Segment::create(disk, "test")?;
    for n in 0..10 {
        segment.write(Stream::Events, n, u64::from(n), &encode_string("{}"))?;
        if n % 2 == 1 {
            segment.flush()?;
        }
    }
    segment.finish().map(drop)
}

#[test]
fn every_write_may_fail_and_what_came_before_is_mended() {
    const ENOSPC: i32 = 28;
    const EIO: i32 = 5;
    let folder = tempfile::tempdir().unwrap();
    let path = first_segment(folder.path());
    for errno in [ENOSPC, EIO] {
        for n_writes in 0.. {
            let disk = FailingDisk {
                held: Rc::default(),
                writes_left: Rc::new(RefCell::new(n_writes)),
                errno,
            };
            let written = write_segment(disk.clone());
            let is_done = written.is_ok();
            if let Err(error) = written {
                assert_eq!(error.raw_os_error(), Some(errno), "write {n_writes}");
            }
            fs::write(&path, &*disk.held.borrow()).unwrap();
            let repaired = repair_segment(&path, "test").unwrap();
            assert_eq!(repaired.was_damaged, !is_done, "write {n_writes}");
            let report = verify(&path).unwrap().remove(0);
            assert_eq!(report.problems, Vec::<String>::new(), "write {n_writes}");
            if is_done {
                assert_eq!(report.summary.n_messages(), 10);
                assert!(n_writes > 20, "{n_writes} writes are few");
                println!("{n_writes} writes failed in turn, errno {errno}");
                break;
            }
        }
    }
}

/// Records frames until that ends; how many were taken, how many are told to be kept, and why it ended.
fn record_until_it_ends(path: &Path, params: RecordingParams) -> (u64, u64, RecordingError) {
    let info = camera_info(256, 212);
    let mut writer = SegmentWriter::create(path, &info, params).unwrap();
    for frame_id in 0..10_000 {
        if let Err(error) = writer.write(&frame(&info, frame_id)) {
            let again = writer.write(&frame(&info, frame_id + 1)).unwrap_err();
            assert!(matches!(again, RecordingError::Ended(_)), "{again}");
            return (frame_id, writer.progress().counters.frames, error);
        }
    }
    panic!("the disk never filled");
}

#[test]
fn recording_stops_before_the_disk_is_full() {
    let root = tempfile::tempdir().unwrap();
    let Some(disk) = SmallDisk::mount(root.path(), 16) else {
        return;
    };
    let path = disk.0.join("recording");
    let floor = RecordingParams {
        min_free_bytes: 4 << 20,
        ..params()
    };
    let (n_frames, n_kept, error) = record_until_it_ends(&path, floor);
    let RecordingError::DiskFloor { free_bytes, .. } = error else {
        panic!("{error}");
    };
    println!("stopped after {n_frames} frames with {free_bytes} bytes free");
    // One flush of one frame is at most what the floor is passed by.
    assert!(free_bytes > (4 << 20) - 500_000, "{free_bytes}");
    let record = SessionRecord::read(&path).unwrap();
    assert_eq!(record.state, State::Closed);
    let why = record.stopped_because.unwrap();
    assert!(why.contains("recording stops below 4194304"), "{why}");
    assert_eq!(verify(&path).unwrap()[0].problems, Vec::<String>::new());
    assert_eq!(record.counters.frames, n_kept);
    assert_eq!(play(&path).unwrap().frames.len() as u64, n_kept);
}

#[test]
fn a_segment_that_cannot_be_begun_ends_the_recording_and_keeps_those_before() {
    let root = tempfile::tempdir().unwrap();
    let path = root.path().join("recording");
    let info = camera_info(20, 16);
    let short = RecordingParams {
        max_segment_bytes: 20_000,
        ..params()
    };
    let mut writer = SegmentWriter::create(&path, &info, short).unwrap();
    let in_the_way = path.join("segment-0001.mcap");
    fs::create_dir(&in_the_way).unwrap();
    let written = (0..1000).try_for_each(|frame_id| writer.write(&frame(&info, frame_id)));
    let error = written.unwrap_err().to_string();
    assert!(error.contains("segment-0001.mcap"), "{error}");
    let n_kept = writer.progress().counters.frames;
    let record = SessionRecord::read(&path).unwrap();
    assert_eq!(record.state, State::Repaired);
    assert_eq!(record.stopped_because, Some(error));
    assert_eq!(record.counters.frames, n_kept);
    assert!(!path.join("open.lock").exists());
    let played = play(&path).unwrap();
    assert_eq!(
        (played.frames.len() as u64, played.damages.len()),
        (n_kept, 0)
    );
    assert_as_recorded(&info, &played.frames);
    let again = writer.write(&frame(&info, 1000)).unwrap_err();
    assert!(matches!(again, RecordingError::Ended(_)), "{again}");
}

#[test]
fn a_full_disk_ends_the_recording_and_keeps_what_was_written() {
    // In segments of one to four frames, so that it is full at the end of one, and in one that never ends.
    for max_segment_bytes in [1, 150_000, 220_000, 290_000, u64::MAX] {
        let root = tempfile::tempdir().unwrap();
        let Some(disk) = SmallDisk::mount(root.path(), 16) else {
            return;
        };
        let path = disk.0.join("recording");
        let params = RecordingParams {
            max_segment_bytes,
            ..params()
        };
        let (n_frames, n_kept, error) = record_until_it_ends(&path, params);
        let RecordingError::Write(WriteError::Io { source, .. }) = error else {
            panic!("{error}");
        };
        assert_eq!(source.kind(), io::ErrorKind::StorageFull);
        let record = SessionRecord::read(&path).unwrap();
        assert_eq!(record.state, State::Repaired);
        let why = record.stopped_because.unwrap();
        assert!(why.contains("No space left on device"), "{why}");
        let played = play(&path).unwrap();
        assert_as_recorded(&camera_info(256, 212), &played.frames);
        let note = record.repair.unwrap();
        assert_eq!(played.frames.len() as u64, note.frames_recovered);
        assert_eq!(note.frames_recovered, n_kept);
        println!("{n_frames} frames, then the disk was full: {why}; {note:?}");
        assert!(note.frames_recovered + 1 >= n_frames, "{note:?}");
        for report in verify(&path).unwrap() {
            assert_eq!(report.problems, Vec::<String>::new());
        }
    }
}

#[test]
fn a_disk_that_is_full_already_is_not_begun_on() {
    let root = tempfile::tempdir().unwrap();
    let everything = RecordingParams {
        min_free_bytes: u64::MAX,
        ..params()
    };
    let path = root.path().join("recording");
    let error = SegmentWriter::create(&path, &camera_info(20, 16), everything).err();
    assert!(
        matches!(error, Some(RecordingError::DiskFloor { .. })),
        "{error:?}"
    );
}
