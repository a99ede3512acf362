//! A signal ends a run in order.

use crate::support::{PROGRAM, Workbench, poll, prolong};
use serde_json::Value;
use std::{
    fs,
    process::{Child, Command, Stdio},
};

fn start(bench: &Workbench) -> Child {
    Command::new(PROGRAM)
        .arg("replay")
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
    for signal in ["-TERM", "-INT"] {
        let bench = Workbench::with_frames(1);
        prolong(&bench.session());
        let mut child = start(&bench);
        let out = bench.path("out");
        poll("the first shading image", || {
            let events = fs::read_to_string(out.join("events.jsonl")).ok()?;
            events.contains("snapshot").then_some(())
        });
        let pid = child.id().to_string();
        let killed = Command::new("kill").args([signal, &pid]).status().unwrap();
        assert!(killed.success());
        let status = poll("the end", || child.try_wait().unwrap());

        assert_eq!(status.code(), Some(130), "{signal}");
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
