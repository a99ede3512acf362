//! The worker with a child that is a few lines of shell.

mod disk;
mod ends;

use super::{
    inputs::{VERSION, job_id},
    scenes::scan,
    spool::{Request, Spool},
    *,
};
use std::{
    collections::BTreeMap,
    fs,
    num::NonZeroUsize,
    os::unix::fs::PermissionsExt,
    path::{Path, PathBuf},
    thread,
    time::{Duration, Instant},
};

/// As the daemon is told.
const N_THREADS: NonZeroUsize = NonZeroUsize::new(3).unwrap();
/// Generous: a busy machine is no fault.
const GRACE: Duration = Duration::from_secs(60);

/// A data directory with one scan, and a program that does what a test says.
struct Workbench {
    root: tempfile::TempDir,
    scan: PathBuf,
}

/// What every child begins with: it counts its runs, and knows its folders.
const BEGIN: &str =
    "#!/bin/sh\nscan=$2\nout=$4\nhere=$(dirname $0)\necho run >> $here/runs\nmkdir -p $out\n";
/// A refinement that does its work.
const REFINE: &str = r#"
for name in refined.ply refined.glb report.html report.json base.ply; do echo new > $out/$name; done
echo '{"status":"complete","refined":true,"not_refined_reason":null}'
"#;

impl Workbench {
    fn new(script: &str) -> Self {
        let root = tempfile::tempdir().unwrap();
        let scan = scan(root.path(), "a");
        let bench = Workbench { root, scan };
        bench.become_child(script);
        bench
    }

    /// From now on children do this.
    fn become_child(&self, script: &str) {
        let next = self.path("next");
        fs::write(&next, format!("{BEGIN}{script}\n")).unwrap();
        fs::set_permissions(&next, fs::Permissions::from_mode(0o755)).unwrap();
        fs::rename(next, self.path("child")).unwrap();
    }

    fn path(&self, name: &str) -> PathBuf {
        self.root.path().join(name)
    }

    fn worker(&self) -> WorkerHandle {
        self.worker_with(WorkerParams {
            grace_secs: 0.5,
            ..WorkerParams::default()
        })
    }

    fn worker_with(&self, params: WorkerParams) -> WorkerHandle {
        Worker::spawn(WorkerSetup {
            data_dir: self.root.path().to_owned(),
            program: self.path("child"),
            calibration_dir: self.path("calibration"),
            n_threads: N_THREADS,
            params,
            settings: "x = 1".to_owned(),
        })
        .unwrap()
    }

    /// The spool, in which a job of the scan waits that was asked of that version of the program.
    fn spool_with_job(&self, version: &str) -> (Spool, JobId) {
        let id = job_id(&self.scan, "x = 1", version).unwrap();
        let request = Request {
            id: id.clone(),
            scan: "a",
            settings: "x = 1",
            version,
            now_unix_ms: 1,
            has_refined_mesh: false,
        };
        let spool = Spool::open(self.root.path(), 3).unwrap();
        spool.submit(&request).unwrap();
        (spool, id)
    }

    /// What keeps the file of a running job from being written: its partial file cannot be made.
    fn refusal(&self, id: &JobId) -> PathBuf {
        self.path(&format!("spool/running/.{id}.json.partial"))
    }

    fn n_runs(&self) -> usize {
        fs::read_to_string(self.path("runs")).map_or(0, |runs| runs.lines().count())
    }

    /// Every file of the scan's folder.
    fn contents(&self) -> BTreeMap<PathBuf, Vec<u8>> {
        let mut found = BTreeMap::new();
        let mut folders = vec![self.scan.clone()];
        while let Some(folder) = folders.pop() {
            for entry in fs::read_dir(folder).unwrap() {
                let path = entry.unwrap().path();
                match path.is_dir() {
                    true => folders.push(path),
                    false => drop(found.insert(path.clone(), fs::read(path).unwrap())),
                }
            }
        }
        found
    }
}

/// Looks again and again until there is an answer.
fn poll<T>(what: &str, mut look: impl FnMut() -> Option<T>) -> T {
    let deadline = Instant::now() + GRACE;
    loop {
        if let Some(answer) = look() {
            return answer;
        }
        assert!(Instant::now() < deadline, "{what} took more than {GRACE:?}");
        thread::sleep(Duration::from_millis(5));
    }
}

fn end_of(worker: &WorkerHandle, id: &JobId) -> Job {
    poll("the end of the job", || {
        let job = worker.list().into_iter().find(|job| job.id == *id)?;
        job.state.is_ended().then_some(job)
    })
}

#[test]
fn a_refinement_is_delivered_when_it_is_whole_and_touches_nothing_else() {
    let bench = Workbench::new(&format!(
        "echo '{{\"progress\":{{\"round\":[1,4],\"step\":2,\"energy_share\":0.5,\"secs_left\":null}}}}'\n\
         echo half > $out/refined.ply\n\
         while [ ! -e $here/go ]; do sleep 0.02; done\n{REFINE}"
    ));
    fs::write(bench.scan.join("report.json"), "of the scan").unwrap();
    let before = bench.contents();
    let worker = bench.worker();
    let job = worker.submit(&bench.scan).unwrap();
    let progress = poll("progress", || worker.status().running?.progress);
    assert_eq!((progress.round, progress.step), ((1, 4), 2));
    assert!(!bench.scan.join("refined.ply").exists());
    assert_eq!(worker.submit(&bench.scan).unwrap().id, job.id);

    fs::write(bench.path("go"), "").unwrap();
    let ended = end_of(&worker, &job.id);
    assert_eq!((ended.state, ended.progress), (JobState::Done, None));
    assert_eq!(worker.of_scan("a"), Some(ended));
    assert_eq!(worker.status(), WorkerStatus::default());
    let mut expected = before;
    let kept = expected[&bench.scan.join("report.json")].clone();
    expected.insert(bench.scan.join("capture-report.json"), kept);
    for name in ["refined.ply", "refined.glb", "report.html", "report.json"] {
        expected.insert(bench.scan.join(name), b"new\n".to_vec());
    }
    assert_eq!(bench.contents(), expected);

    // What is done is not done again.
    assert_eq!(worker.submit(&bench.scan).unwrap().state, JobState::Done);
    assert_eq!(bench.n_runs(), 1);
    worker.stop();
}

#[test]
fn what_a_child_says_is_heard_though_it_would_be_killed_at_once() {
    let bench = Workbench::new(&format!("head -c 3000000 /dev/zero\necho\n{REFINE}"));
    let worker = bench.worker_with(WorkerParams {
        grace_secs: 0.0,
        ..WorkerParams::default()
    });
    let job = worker.submit(&bench.scan).unwrap();
    let ended = end_of(&worker, &job.id);
    assert_eq!((ended.state, ended.failures.len()), (JobState::Done, 0));
    worker.stop();
}

#[test]
fn a_child_that_is_killed_is_repeated_three_times() {
    let bench = Workbench::new("echo half > $out/refined.ply\necho about to die >&2\nkill -9 $$");
    let before = bench.contents();
    let worker = bench.worker();
    let job = worker.submit(&bench.scan).unwrap();
    let ended = end_of(&worker, &job.id);
    assert_eq!(ended.state, JobState::Failed);
    let reason = "killed by signal SIGKILL: about to die";
    assert_eq!(ended.failures, [reason; 4]);
    assert_eq!(ended.message.as_deref(), Some(reason));
    assert_eq!(bench.n_runs(), 4);
    assert_eq!(bench.contents(), before);

    // Asked for again it begins anew.
    bench.become_child(REFINE);
    worker.submit(&bench.scan).unwrap();
    poll("the end", || {
        (worker.of_scan("a")?.state == JobState::Done).then_some(())
    });
    worker.stop();
}

#[test]
fn a_child_that_dies_twice_succeeds_at_last() {
    let bench = Workbench::new(&format!(
        "if [ $(wc -l < $here/runs) -lt 3 ]; then exit 1; fi\n{REFINE}"
    ));
    let worker = bench.worker();
    let job = worker.submit(&bench.scan).unwrap();
    let ended = end_of(&worker, &job.id);
    assert_eq!(ended.state, JobState::Done);
    assert_eq!(ended.failures, ["exit code 1", "exit code 1"]);
    worker.stop();
}

#[test]
fn endings_that_another_attempt_cannot_mend_are_final() {
    for (script, state, message) in [
        (
            "echo '{\"refined\":false,\"not_refined_reason\":\"too dark\"}'",
            JobState::Refused,
            "too dark",
        ),
        (
            "echo 'error: refine.n_rounds is 0' >&2; exit 2",
            JobState::Failed,
            "bad usage or configuration: error: refine.n_rounds is 0",
        ),
    ] {
        let bench = Workbench::new(script);
        let before = bench.contents();
        let worker = bench.worker();
        let job = worker.submit(&bench.scan).unwrap();
        let ended = end_of(&worker, &job.id);
        assert_eq!(
            (ended.state, ended.message.as_deref()),
            (state, Some(message))
        );
        assert_eq!((bench.n_runs(), bench.contents()), (1, before));
        worker.stop();
    }
}

#[test]
fn a_scan_is_refined_with_its_own_calibration_where_it_has_one() {
    let bench = Workbench::new(&format!("echo \"$@\" > $here/arguments\n{REFINE}"));
    let own = bench.scan.join("calibration.toml");
    for has_own in [false, true] {
        if has_own {
            fs::write(&own, "gamma = 0.9").unwrap();
        }
        let worker = bench.worker();
        let job = worker.submit(&bench.scan).unwrap();
        assert_eq!(end_of(&worker, &job.id).state, JobState::Done);
        worker.stop();
        let arguments = fs::read_to_string(bench.path("arguments")).unwrap();
        let given = format!("--calibration {}", own.display());
        assert_eq!(arguments.contains(&given), has_own, "{arguments}");
    }
}

#[test]
fn a_child_is_given_the_settings_of_its_job_and_the_daemon_s_threads_and_no_others() {
    let bench = Workbench::new(&format!("echo \"$@\" > $here/arguments\n{REFINE}"));
    let worker = bench.worker();
    let job = worker.submit(&bench.scan).unwrap();
    assert_eq!(end_of(&worker, &job.id).state, JobState::Done);
    worker.stop();
    let arguments = fs::read_to_string(bench.path("arguments")).unwrap();
    let settings = bench.path("spool/settings");
    let given = format!("--config {}/", settings.display());
    assert!(arguments.contains(&given), "{arguments}");
    assert!(arguments.contains(" --config-alone "), "{arguments}");
    assert!(arguments.contains(" --threads 3 "), "{arguments}");
}

#[test]
fn a_child_that_hangs_is_ended_and_repeated() {
    // The first hangs in its own child, the second works for longer than one may hang.
    let bench = Workbench::new(&format!(
        "if [ $(wc -l < $here/runs) = 1 ]; then echo up > $here/up; sleep 600; fi\n\
         end=$(($(date +%s) + 2)); while [ $(date +%s) -lt $end ]; do :; done\n{REFINE}"
    ));
    let worker = bench.worker_with(WorkerParams {
        max_idle_secs: 1.0,
        ..WorkerParams::default()
    });
    let job = worker.submit(&bench.scan).unwrap();
    let ended = end_of(&worker, &job.id);
    assert_eq!(ended.state, JobState::Done);
    assert_eq!(ended.failures, ["it did nothing for 1s"]);
    assert_eq!(bench.n_runs(), 2);
    worker.stop();
}

#[test]
fn why_a_refinement_was_refused_stands_in_the_scan_s_report() {
    let bench = Workbench::new("echo '{\"refined\":false,\"not_refined_reason\":\"too dark\"}'");
    let report = bench.scan.join("report.json");
    fs::write(&report, "{\n  \"session\": \"a\"\n}\n").unwrap();
    let worker = bench.worker();
    let job = worker.submit(&bench.scan).unwrap();
    assert_eq!(end_of(&worker, &job.id).state, JobState::Refused);
    let report = fs::read_to_string(report).unwrap();
    assert!(
        report.contains("\"refinement_refused_reason\": \"too dark\""),
        "{report}"
    );
    worker.stop();
}

#[test]
fn the_result_of_a_scan_that_has_changed_is_dropped() {
    let bench = Workbench::new(&format!("echo more > $scan/snapshots/000/ir.png\n{REFINE}"));
    let worker = bench.worker();
    let job = worker.submit(&bench.scan).unwrap();
    let ended = end_of(&worker, &job.id);
    assert_eq!(ended.state, JobState::Superseded);
    assert_eq!(ended.message.as_deref(), Some("the scan has changed since"));
    assert!(!bench.scan.join("refined.ply").exists());
    worker.stop();
}

#[test]
fn other_settings_are_another_job_that_takes_the_waiting_one_s_place() {
    let bench = Workbench::new(&format!(
        "while [ ! -e $here/go ]; do sleep 0.02; done\ncp $8 $here/settings\n{REFINE}"
    ));
    let worker = bench.worker();
    let running = worker.submit(&bench.scan).unwrap();
    poll("the child", || worker.status().running.map(|_| ()));
    worker.set_settings("x = 2");
    let waiting = worker.submit(&bench.scan).unwrap();
    worker.set_settings("x = 3");
    let newest = worker.submit(&bench.scan).unwrap();
    fs::write(bench.path("go"), "").unwrap();
    for (job, state) in [
        (running, JobState::Done),
        (waiting, JobState::Superseded),
        (newest, JobState::Done),
    ] {
        assert_eq!(end_of(&worker, &job.id).state, state);
    }
    assert_eq!(bench.n_runs(), 2);
    let settings = fs::read_to_string(bench.path("settings")).unwrap();
    assert_eq!(settings, "x = 3");
    worker.stop();
}

#[test]
fn noise_and_processes_that_a_child_leaves_behind_hold_nobody_up() {
    let bench = Workbench::new(&format!(
        "head -c 3000000 /dev/zero\necho\necho '{{\"progress\":7}}'\necho '[]'\n\
         sleep 600 &\necho $! > $here/left\n{REFINE}"
    ));
    let worker = bench.worker();
    let job = worker.submit(&bench.scan).unwrap();
    assert_eq!(end_of(&worker, &job.id).state, JobState::Done);
    let left = fs::read_to_string(bench.path("left")).unwrap();
    let stat = PathBuf::from(format!("/proc/{}/stat", left.trim()));
    poll("the end of what was left", || {
        // A zombie waits for whoever adopted it, and does nothing.
        let stat = fs::read_to_string(&stat).unwrap_or_default();
        (stat.is_empty() || stat.contains(") Z ")).then_some(())
    });
    worker.stop();
}

#[test]
fn what_is_no_scan_of_the_data_directory_is_refused() {
    let bench = Workbench::new(REFINE);
    let worker = bench.worker();
    let elsewhere = tempfile::tempdir().unwrap();
    for path in [
        elsewhere.path(),
        Path::new("/"),
        &bench.scan.join(".."),
        &bench.scan.join("snapshots"),
        &bench.path("sessions/none"),
    ] {
        let error = worker.submit(path).unwrap_err();
        assert!(matches!(error, JobError::NoScan { .. }), "{error}");
    }
    assert!(worker.list().is_empty());
    worker.stop();
}
