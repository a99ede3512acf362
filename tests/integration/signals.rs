//! A signal ends a run in order.

use crate::{
    daemon_process::Daemon,
    support::{PROGRAM, Workbench, fused_demo, poll, prolong, record, small_camera},
    worker::{child_of, send},
};
use serde_json::Value;
use std::{
    ffi::OsStr,
    fs,
    path::Path,
    process::{Child, Command, Stdio},
};

fn start(bench: &Workbench) -> Child {
    // As from a terminal, also where the tests outlive theirs.
    Command::new("env")
        .args(["--default-signal=HUP", PROGRAM, "replay"])
        .arg(bench.session())
        .arg("--out")
        .arg(bench.path("out"))
        .arg("--realtime")
        .stderr(Stdio::null())
        .stdout(Stdio::null())
        .spawn()
        .unwrap()
}

#[test]
fn a_run_that_is_told_to_stop_keeps_what_it_has() {
    // A terminal that is closed is told of twice.
    for signals in [&["-TERM"][..], &["-INT"], &["-HUP", "-HUP"]] {
        let bench = Workbench::with_frames(1);
        prolong(&bench.session());
        let mut child = start(&bench);
        let out = bench.path("out");
        poll("the first shading image", || {
            let events = fs::read_to_string(out.join("events.jsonl")).ok()?;
            events.contains("snapshot").then_some(())
        });
        let pid = child.id().to_string();
        for signal in signals {
            let killed = Command::new("kill").args([*signal, &pid]).status().unwrap();
            assert!(killed.success());
        }
        let status = poll("the end", || child.try_wait().unwrap());

        assert_eq!(status.code(), Some(130), "{signals:?}");
        for name in ["base.ply", "trajectory.txt", "report.html"] {
            assert!(out.join(name).is_file(), "{name}");
        }
        assert!(!out.join(".relief.lock").exists());
        let report = fs::read(out.join("report.json")).unwrap();
        let report: Value = serde_json::from_slice(&report).unwrap();
        assert_eq!(report["stopped_early"], true);
        let warnings = report["warnings"].to_string();
        assert!(warnings.contains("base.ply is not improved"), "{warnings}");
        let frames = &report["frames"];
        let count = |key: &str| frames[key].as_u64().unwrap();
        assert!(count("total") < 1800);
        let accounted = [
            "fused",
            "lost",
            "damaged",
            "dropped",
            "without_depth",
            "paused",
        ]
        .iter()
        .map(|key| count(key))
        .sum::<u64>();
        assert_eq!(accounted, count("total"));
        assert_eq!(frames["unaccounted"], 0);
    }
}

/// Starts a command that a hang-up ends in order, waits until it listens, and hangs up; returns its exit code.
fn code_after_hang_up(arguments: &[&OsStr]) -> Option<i32> {
    let mut child = Command::new("env")
        .args(["--default-signal=HUP", PROGRAM])
        .args(arguments)
        .stderr(Stdio::null())
        .stdout(Stdio::null())
        .spawn()
        .unwrap();
    poll("somebody who listens", || {
        listens_to_hang_up(child.id()).then_some(())
    });
    assert!(send("-HUP", Path::new(&child.id().to_string())));
    poll("the end", || child.try_wait().unwrap()).code()
}

/// Whether a process listens to SIGHUP, whose bit is the first, by its file of proc(5).
fn listens_to_hang_up(pid: u32) -> bool {
    let status = fs::read_to_string(format!("/proc/{pid}/status")).unwrap_or_default();
    let mask = status
        .lines()
        .find_map(|line| line.strip_prefix("SigCgt:"))
        .and_then(|mask| u64::from_str_radix(mask.trim(), 16).ok());
    mask.is_some_and(|mask| mask & 1 == 1)
}

#[test]
fn a_calibration_that_is_told_to_stop_ends_in_order() {
    let bench = Workbench::empty();
    // Of all pixels, so that it takes far longer than to be told.
    record(small_camera(1, 1), &bench.session());
    prolong(&bench.session());
    let session = bench.session();
    let arguments = ["calibrate", "offset", "--dry-run"].map(OsStr::new);
    let code = code_after_hang_up(&[&arguments[..], &[session.as_os_str()]].concat());
    assert_eq!(code, Some(130));
}

#[test]
fn an_evaluation_that_is_told_to_stop_writes_nothing() {
    let bench = Workbench::empty();
    let (scan, out) = (bench.path("scan"), bench.path("evaluation"));
    fused_demo(&scan);
    let arguments = ["evaluate", "--ablations", "--out"].map(OsStr::new);
    let paths = [out.as_os_str(), scan.as_os_str()];
    let code = code_after_hang_up(&[&arguments[..], &paths].concat());
    assert_eq!(code, Some(130));
    let written = fs::read_dir(&out).map_or(0, Iterator::count);
    assert_eq!(written, 0);
}

#[test]
fn a_second_signal_ends_a_daemon_whose_refinement_takes_its_time() {
    let bench = Workbench::with_frames(1);
    prolong(&bench.session());
    // Longer than is waited for here, and work enough for the child to be met.
    let config = "[worker]\ngrace_secs = 600.0\n[refine]\nedge_length_m = 0.0005\n";
    let config = bench.write("relief.toml", config);
    let daemon = Daemon::start_in(bench, &["--config", config.to_str().unwrap()]);
    let id = daemon.scan();
    daemon.await_surface();
    assert_eq!(daemon.client.post("/api/v1/scan/finish", "").status, 202);
    let scan = daemon.bench.path("data/sessions").join(id);
    let child = poll("the refinement", || child_of(&scan));
    assert!(send("-STOP", &child));
    daemon.await_state("idle");
    daemon.signal("-TERM");
    daemon.await_state("draining");
    daemon.signal("-TERM");
    let (_bench, status) = daemon.wait();
    // One that was stopped before it had bound itself to the daemon is still there.
    send("-KILL", &child);
    assert_eq!(status.code(), Some(130));
}
