//! A daemon whose disk fills up while it records: the scan goes on, and what was recorded is kept. Skipped where the user cannot
//! mount a small disk.

use crate::{
    daemon_process::Daemon,
    small_disk::SmallDisk,
    support::{PROGRAM, Workbench, assert_says, prolong, summary},
};
use mcap_session::free_bytes;
use serde_json::{Value, json};
use std::{
    fs::{self, File},
    io::{self, Read},
    os::unix::fs::symlink,
    path::{Path, PathBuf},
    process::Command,
};
use tempfile::TempDir;

/// A daemon that records onto a disk of its own; it ends before the disk does.
struct RecordingDaemon {
    daemon: Daemon,
    disk: SmallDisk,
    _mounted_at: TempDir,
}

impl RecordingDaemon {
    /// Starts a daemon that leaves so much of its disk free, MB; `None` where this user cannot mount one.
    fn start(min_free_disk_mb: u32) -> Option<Self> {
        let mounted_at = tempfile::tempdir().unwrap();
        let disk = SmallDisk::mount(mounted_at.path(), 64)?;
        let bench = Workbench::with_frames(1);
        prolong(&bench.session());
        symlink(&disk.0, bench.path("data")).unwrap();
        Some(RecordingDaemon {
            daemon: Daemon::start_wanting(min_free_disk_mb, bench, &["--record"]),
            disk,
            _mounted_at: mounted_at,
        })
    }

    /// Starts a scan; its name, and how many frames have been handed to the disk.
    fn scan(&self) -> (String, u64) {
        let id = self.daemon.scan();
        let n_given = recorded(&self.daemon.await_surface());
        // Of a second of the camera's time what is older than a quarter does not wait any more.
        self.daemon
            .await_status("a second more", |status| recorded(status) > n_given + 30);
        (id, n_given)
    }

    /// Takes room from the disk until so much of it is free, bytes, or none; the file that takes it.
    fn leave_free(&self, n_bytes: u64) -> PathBuf {
        let path = self.disk.0.join("filler");
        let taken = free_bytes(&self.disk.0).unwrap() - n_bytes;
        let mut file = File::create(&path).unwrap();
        // What is recorded meanwhile may leave less.
        if let Err(error) = io::copy(&mut io::repeat(0).take(taken), &mut file) {
            assert_eq!(error.kind(), io::ErrorKind::StorageFull);
        }
        path
    }

    /// Waits until recording has ended and the operator is told so by a reason, and the scan has gone on after that; the status then.
    fn await_end_of_recording(&self, reason: &str) -> Value {
        let status = self.daemon.await_status(reason, |status| {
            status["recording"]["active"] == false && status["reason"] == reason
        });
        let fused = |status: &Value| status["frames"]["fused"].as_u64().unwrap();
        let later = self.daemon.await_status("frames after it", |later| {
            fused(later) > fused(&status) + 10
        });
        assert_eq!(later["recording"]["active"], false);
        assert_eq!(recorded(&later), recorded(&status));
        status
    }

    /// Ends the scan, which has a mesh, and returns it as clients see it.
    fn finish(&self, id: &str) -> Value {
        let client = self.daemon.client;
        assert_eq!(client.post("/api/v1/scan/finish", "").status, 202);
        self.daemon.await_state("idle");
        let base = client.get(&format!("/api/v1/sessions/{id}/files/base.ply"));
        assert_eq!(base.status, 200);
        client.get(&format!("/api/v1/sessions/{id}")).json()
    }

    /// How many frames the recording of a scan holds, which is whole.
    fn frames_kept(&self, id: &str) -> u64 {
        let recording = self.disk.0.join("sessions").join(id).join("recording");
        let verified = Command::new(PROGRAM)
            .args(["session", "verify", "--json"])
            .arg(recording)
            .output()
            .unwrap();
        assert_says(&verified, 0, &[]);
        let files = &summary(&verified)["files"];
        let frames = files.as_array().unwrap().iter();
        frames.map(|file| file["frames"].as_u64().unwrap()).sum()
    }

    /// Ends the daemon, which has nothing to complain of.
    fn end(self) {
        self.daemon.signal("-TERM");
        let (_bench, status) = self.daemon.wait();
        assert_eq!(status.code(), Some(0));
    }
}

fn recorded(status: &Value) -> u64 {
    status["recording"]["recorded"].as_u64().unwrap()
}

/// Whether a line tells why recording stopped, as the stream of events and `events.jsonl` do.
fn tells(line: &str, reason: &str) -> bool {
    let event = line.strip_prefix("data: ").unwrap_or(line);
    let event = serde_json::from_str::<Value>(event).unwrap_or_default();
    event["event"] == "recording_stopped" && event["reason"] == reason
}

/// The event in a scan's file.
fn is_in_file(scan: &Path, reason: &str) -> bool {
    let events = fs::read_to_string(scan.join("events.jsonl")).unwrap();
    events.lines().any(|line| tells(line, reason))
}

#[test]
fn a_recording_that_finds_little_room_ends_in_order_and_the_scan_goes_on() {
    let Some(it) = RecordingDaemon::start(16) else {
        return;
    };
    let mut events = it.daemon.client.events();
    let (id, n_safe) = it.scan();
    it.leave_free(8 << 20);
    let status = it.await_end_of_recording("disk_low");
    assert_eq!(status["state"], "degraded");
    let reason = status["recording"]["reason"].as_str().unwrap();
    assert!(
        reason.ends_with("recording stops below 16000000"),
        "{reason}"
    );
    assert!(events.any(|line| tells(&line, reason)));

    let session = it.finish(&id);
    assert_eq!(
        (&session["state"], &session["failures"]),
        (&json!("complete"), &json!([]))
    );
    let warnings = session["report"]["warnings"].as_array().unwrap();
    assert!(warnings.contains(&json!(reason)), "{warnings:?}");
    let n_kept = it.frames_kept(&id);
    assert_eq!(n_kept, recorded(&status));
    assert!(n_kept >= n_safe, "{n_kept} of {n_safe}");
    assert!(is_in_file(&it.disk.0.join("sessions").join(&id), reason));
    it.end();
}

#[test]
fn a_recording_that_finds_no_room_keeps_what_it_had_and_the_scan_goes_on() {
    let Some(it) = RecordingDaemon::start(0) else {
        return;
    };
    let mut events = it.daemon.client.events();
    let (id, n_safe) = it.scan();
    let filler = it.leave_free(0);
    let status = it.await_end_of_recording("storage_failed");
    assert_eq!(status["state"], "fault");
    let reason = status["recording"]["reason"].as_str().unwrap();
    for piece in ["recording stopped: ", "No space left on device"] {
        assert!(reason.contains(piece), "{reason}");
    }
    assert!(events.any(|line| tells(&line, reason)));

    fs::remove_file(filler).unwrap();
    let session = it.finish(&id);
    // Frames are lost, as few as they are.
    assert_eq!(
        (&session["state"], &session["failures"]),
        (&json!("failed"), &json!([reason]))
    );
    let n_kept = it.frames_kept(&id);
    assert_eq!(n_kept, recorded(&status));
    assert!(n_kept >= n_safe, "{n_kept} of {n_safe}");
    assert!(is_in_file(&it.disk.0.join("sessions").join(&id), reason));
    it.end();
}
