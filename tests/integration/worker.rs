//! The refinement worker with the real program as its child.

use crate::support::{PROGRAM, assert_says, fused_demo, poll};
use relief::{
    config::Config,
    control::all_processors,
    export::read_ply,
    jobs::{JobState, Turns, Worker, WorkerHandle, WorkerParams, WorkerSetup},
};
use serde_json::Value;
use std::{
    collections::BTreeMap,
    fs,
    path::{Path, PathBuf},
    process::Command,
};

/// A data directory with the demo, fused.
fn data_with_demo() -> (tempfile::TempDir, PathBuf) {
    let root = tempfile::tempdir().unwrap();
    let scan = root.path().join("sessions/demo");
    fused_demo(&scan);
    (root, scan)
}

/// A coarser mesh than by default, since what is tested is the worker, metres.
const COARSE_EDGE_M: f64 = 0.002;

/// A mesh that no machine refines within a second of its processor, metres.
const FINE_EDGE_M: f64 = 0.0005;

/// Fewer rounds than by default.
fn settings(edge_length_m: f64) -> String {
    let mut config = Config::default();
    config.refine.edge_length_m = edge_length_m;
    config.refine.n_rounds = 2;
    toml::to_string(&config).unwrap()
}

fn worker(data_dir: &Path, params: WorkerParams, edge_length_m: f64) -> WorkerHandle {
    Worker::spawn(WorkerSetup {
        data_dir: data_dir.to_owned(),
        program: PROGRAM.into(),
        calibration_dir: data_dir.join("calibration"),
        n_threads: all_processors(),
        params,
        settings: settings(edge_length_m),
    })
    .unwrap()
}

/// The process that refines a scan.
pub fn child_of(scan: &Path) -> Option<PathBuf> {
    let scan = scan.to_str().unwrap();
    let mut processes = fs::read_dir("/proc").unwrap().filter_map(Result::ok);
    processes.find_map(|process| {
        let command = fs::read_to_string(process.path().join("cmdline")).ok()?;
        let arguments: Vec<&str> = command.split('\0').collect();
        let is_it = arguments.get(1) == Some(&"refine") && arguments.get(2) == Some(&scan);
        is_it.then(|| process.path())
    })
}

/// Sends a signal to such a process; whether it was there.
pub fn send(signal: &str, process: &Path) -> bool {
    let pid = process.file_name().unwrap();
    let sent = Command::new("kill").arg(signal).arg(pid).status();
    sent.unwrap().success()
}

fn niceness(process: &Path) -> i32 {
    let stat = fs::read_to_string(process.join("stat")).unwrap();
    let after_name = stat.rsplit_once(") ").unwrap().1;
    after_name.split(' ').nth(16).unwrap().parse().unwrap()
}

/// The class of a process at the processor, sched(7): 0 is the common one.
fn scheduling_policy(process: &Path) -> u32 {
    let stat = fs::read_to_string(process.join("stat")).unwrap();
    let after_name = stat.rsplit_once(") ").unwrap().1;
    after_name.split(' ').nth(38).unwrap().parse().unwrap()
}

fn files(folder: &Path) -> BTreeMap<PathBuf, Vec<u8>> {
    let mut found = BTreeMap::new();
    for entry in fs::read_dir(folder).unwrap() {
        let path = entry.unwrap().path();
        if path.is_file() {
            found.insert(path.clone(), fs::read(path).unwrap());
        }
    }
    found
}

#[test]
fn a_child_that_is_killed_in_the_middle_costs_an_attempt_and_nothing_else() {
    let (root, scan) = data_with_demo();
    let before = files(&scan);
    let images = files(&scan.join("snapshots/000"));
    // Nicer, it would not get on where other tests keep the processors busy.
    let params = WorkerParams {
        turns: Turns::Shared,
        nice: 3,
        ..WorkerParams::default()
    };
    let worker = worker(root.path(), params, COARSE_EDGE_M);
    let job = worker.submit(&scan).unwrap();
    let step = |step: usize| {
        let progress = worker.status().running?.progress?;
        (progress.step >= step).then_some(progress)
    };
    poll("the first step", || step(1));
    let child = child_of(&scan).expect("the child runs");

    // Priority and limits, as the child has imposed them on itself.
    let own = niceness(Path::new("/proc/self"));
    assert_eq!(niceness(&child), (own + 3).min(19));
    assert_eq!(scheduling_policy(&child), 0);
    let limits = fs::read_to_string(child.join("limits")).unwrap();
    for (name, value) in [
        ("Max address space", "8589934592"),
        ("Max cpu time", "14400"),
    ] {
        let line = limits.lines().find(|line| line.starts_with(name)).unwrap();
        assert!(line.contains(value), "{line}");
    }
    let wish = fs::read_to_string(child.join("oom_score_adj")).unwrap();
    assert_eq!(wish.trim(), "1000", "it is killed before the daemon");

    assert!(send("-KILL", &child));
    let ended = poll("the end", || {
        let job = worker.of_scan("demo")?;
        job.state.is_ended().then_some(job)
    });
    assert_eq!((ended.id, ended.state), (job.id, JobState::Done));
    assert_eq!(ended.failures.len(), 1);
    assert!(ended.failures[0].starts_with("killed by signal SIGKILL"));
    worker.stop();

    let refined = read_ply(&scan.join("refined.ply")).unwrap();
    assert!(refined.faces.len() > 1000);
    let after = files(&scan);
    for (path, bytes) in &before {
        if !path
            .file_name()
            .unwrap()
            .to_str()
            .unwrap()
            .starts_with("report.")
        {
            assert_eq!(after.get(path), Some(bytes), "{}", path.display());
        }
    }
    assert_eq!(files(&scan.join("snapshots/000")), images);
    assert!(fs::read_dir(&scan).unwrap().all(|entry| {
        let name = entry.unwrap().file_name();
        !name.to_str().unwrap().starts_with("refined-")
    }));
    // The report names its outputs where they are now.
    let report: Value = serde_json::from_slice(&after[&scan.join("report.json")]).unwrap();
    let path = scan.join("refined.ply");
    assert_eq!(report["refined_mesh"]["path"], path.to_str().unwrap());
    let outputs = report["outputs"].as_array().unwrap();
    assert!(outputs.contains(&path.to_str().unwrap().into()));
    let kept: Value = serde_json::from_slice(&after[&scan.join("capture-report.json")]).unwrap();
    assert_eq!(kept["refined_mesh"], Value::Null);
    assert_eq!(kept["frames"]["total"], 48);
}

#[test]
fn a_child_that_needs_more_than_it_may_have_fails_and_says_so() {
    let memory = WorkerParams {
        max_memory_mb: 96,
        max_retries: 1,
        ..WorkerParams::default()
    };
    let processor = WorkerParams {
        max_cpu_secs: 1,
        max_retries: 0,
        ..WorkerParams::default()
    };
    for (params, edge_length_m, reason) in [
        (
            memory,
            COARSE_EDGE_M,
            "SIGABRT, as where memory is used up: ",
        ),
        (
            processor,
            FINE_EDGE_M,
            "SIGXCPU: its processor time is used up",
        ),
    ] {
        let (root, scan) = data_with_demo();
        let before = files(&scan);
        let n_attempts = params.max_retries as usize + 1;
        let turns = Turns::Shared;
        let params = WorkerParams { turns, ..params };
        let worker = worker(root.path(), params, edge_length_m);
        worker.submit(&scan).unwrap();
        let ended = poll("the end", || {
            let job = worker.of_scan("demo")?;
            job.state.is_ended().then_some(job)
        });
        worker.stop();
        assert_eq!(ended.state, JobState::Failed);
        assert_eq!(ended.failures.len(), n_attempts);
        let first = &ended.failures[0];
        let expected = format!("killed by signal {reason}");
        assert!(first.starts_with(&expected), "{first}");
        assert_eq!(files(&scan), before);
    }
}

#[test]
fn a_child_takes_the_settings_of_its_job_and_nothing_of_the_machine() {
    let root = tempfile::tempdir().unwrap();
    let etc = root.path().join("etc/relief");
    fs::create_dir_all(&etc).unwrap();
    fs::write(etc.join("relief.toml"), "half = ").unwrap();
    let own = root.path().join("settings.toml");
    fs::write(&own, settings(COARSE_EDGE_M)).unwrap();
    let refine = |more: &[&str]| {
        Command::new(PROGRAM)
            .args(["refine", "no-such-scan", "--out", "no-such-folder"])
            .arg("--config")
            .arg(&own)
            .args(more)
            .env("RELIEF_CONFIG_ROOT", root.path())
            .env("RELIEF_REFINE__N_ROUNDS", "0")
            .output()
            .unwrap()
    };
    assert_says(&refine(&[]), 2, &["etc/relief/relief.toml"]);
    // The settings are taken, and the scan is looked for.
    assert_says(&refine(&["--config-alone"]), 1, &["no-such-scan"]);
}
