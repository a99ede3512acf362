//! Processes killed while they record lose what came in the last moments, and nothing else.

use std::{
    fs,
    io::{BufRead, BufReader},
    path::Path,
    process::{Command, Stdio},
    thread,
    time::{Duration, Instant},
};

use mcap_session::{RecordingParams, SegmentWriter, SessionRecord, State, repair, verify};

use crate::support::{assert_as_recorded, camera_info, frame, play};

/// Where the killed process records: it runs the same test as the one that kills it, which is told of no folder.
const FOLDER: &str = "MCAP_SESSION_CHILD_FOLDER";
/// How many processes are killed; more by hand.
const TRIALS: &str = "MCAP_SESSION_KILLS";
/// How many are killed at a time: they sleep for most of their lives.
const AT_A_TIME: usize = 4;
const FRAME_PERIOD: Duration = Duration::from_micros(33_333);
/// 300 ms: 8 frames wait for less than 250 ms, and the ninth is on its way when it hands them on.
const MOST_LOST: u64 = 9;

/// What the killed process does: records frames at the pace of a Kinect, telling of each before it is handed to the recorder.
fn record_until_killed(folder: &Path) {
    let info = camera_info(256, 212);
    let params = RecordingParams {
        min_free_bytes: 0,
        // Several segments within one life.
        max_segment: Duration::from_millis(700),
        ..RecordingParams::default()
    };
    let frames: Vec<_> = (0..90).map(|frame_id| frame(&info, frame_id)).collect();
    let start = Instant::now();
    let mut writer = SegmentWriter::create(folder, &info, params).unwrap();
    for (frame, n) in frames.iter().zip(0..) {
        while start.elapsed() < FRAME_PERIOD * n {
            thread::sleep(Duration::from_millis(1));
            writer.tick().unwrap();
        }
        println!("\ngave {}", frame.frame_id);
        writer.write(frame).unwrap();
    }
    thread::sleep(Duration::from_secs(60));
}

/// What one killed process lost: frames given and not recovered, and the seconds of repair.
fn kill_once(seed: u64) -> (u64, f64) {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("recording");
    let mut child = Command::new(std::env::current_exe().unwrap())
        .args([
            "--exact",
            "kill::a_killed_process_loses_its_last_moments_alone",
        ])
        .args(["--nocapture", "--test-threads=1"])
        .env(FOLDER, &path)
        .stdout(Stdio::piped())
        .stderr(Stdio::null())
        .spawn()
        .unwrap();
    let told = child.stdout.take().unwrap();
    let told = thread::Builder::new()
        .name("told".to_owned())
        .spawn(move || {
            let lines = BufReader::new(told).lines().map_while(Result::ok);
            lines.filter(|line| line.starts_with("gave ")).count() as u64
        })
        .unwrap();
    while !path.join("segment-0000.mcap").is_file() {
        thread::sleep(Duration::from_millis(2));
    }
    let mut random = fastrand::Rng::with_seed(seed);
    thread::sleep(Duration::from_micros(random.u64(0..2_500_000)));
    child.kill().unwrap();
    child.wait().unwrap();
    let n_given = told.join().unwrap();

    let start = Instant::now();
    let note = repair(&path).unwrap().expect("an open recording is mended");
    let secs = start.elapsed().as_secs_f64();
    let record = SessionRecord::read(&path).unwrap();
    assert_eq!(record.state, State::Repaired);
    for report in verify(&path).unwrap() {
        assert_eq!(report.problems, Vec::<String>::new(), "seed {seed}");
    }
    let info = camera_info(256, 212);
    let n_played = match n_given {
        0 => 0,
        _ => {
            let played = play(&path).unwrap();
            assert_eq!(played.damages, Vec::<String>::new());
            assert_as_recorded(&info, &played.frames);
            let ids = played.frames.iter().map(|frame| frame.frame_id);
            assert!(ids.eq(0..played.frames.len() as u64), "seed {seed}");
            played.frames.len() as u64
        }
    };
    assert_eq!(note.frames_recovered, n_played);
    // The last frame may have been told of and not yet given.
    let lost = n_given.saturating_sub(n_played);
    let told_lost = note.frames_lost.unwrap();
    assert!(
        told_lost <= lost && lost <= told_lost + 1,
        "{told_lost} {lost}"
    );
    (lost, secs)
}

#[test]
fn a_killed_process_loses_its_last_moments_alone() {
    if let Some(folder) = std::env::var_os(FOLDER) {
        return record_until_killed(Path::new(&folder));
    }
    let trials: u64 = std::env::var(TRIALS).map_or(20, |text| text.parse().unwrap());
    let killed: Vec<(u64, f64)> = thread::scope(|scope| {
        let kill_some = |first: u64| {
            let seeds = (first..trials).step_by(AT_A_TIME);
            scope.spawn(move || seeds.map(kill_once).collect::<Vec<_>>())
        };
        let threads: Vec<_> = (0..AT_A_TIME as u64).map(kill_some).collect();
        let killed = threads.into_iter().map(|thread| thread.join().unwrap());
        killed.flatten().collect()
    });
    let (mut lost, mut secs): (Vec<u64>, Vec<f64>) = killed.into_iter().unzip();
    lost.sort_unstable();
    secs.sort_by(f64::total_cmp);
    let (p50, max) = (lost[lost.len() / 2], lost[lost.len() - 1]);
    println!(
        "{trials} processes killed: frames lost p50 {p50}, max {max}; repair p50 {:.1} ms, max {:.1} ms; {lost:?}",
        1e3 * secs[secs.len() / 2],
        1e3 * secs[secs.len() - 1],
    );
    assert!(max <= MOST_LOST, "{lost:?}");
}

#[test]
fn frames_that_come_faster_than_the_clock_goes_do_not_wait_for_it() {
    let folder = tempfile::tempdir().unwrap();
    let (path, left) = (folder.path().join("recording"), folder.path().join("left"));
    let info = camera_info(256, 212);
    let params = RecordingParams {
        min_free_bytes: 0,
        ..RecordingParams::default()
    };
    let mut writer = SegmentWriter::create(&path, &info, params).unwrap();
    for n in 1..=30 {
        writer.write(&frame(&info, n - 1)).unwrap();
        if n % 7 != 0 {
            continue;
        }
        // What a process that is killed now leaves behind.
        fs::create_dir(&left).unwrap();
        for entry in fs::read_dir(&path).unwrap() {
            let entry = entry.unwrap();
            fs::copy(entry.path(), left.join(entry.file_name())).unwrap();
        }
        repair(&left).unwrap();
        let n_left = play(&left).unwrap().frames.len() as u64;
        assert!(n_left + MOST_LOST >= n, "{n_left} of {n}");
        fs::remove_dir_all(&left).unwrap();
    }
}
