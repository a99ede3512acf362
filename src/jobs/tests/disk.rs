//! Where the disk refuses.

use super::*;

#[test]
fn a_job_that_the_disk_keeps_from_beginning_begins_when_it_lets_it() {
    let bench = Workbench::new(REFINE);
    let worker = bench.worker();
    let refusal = bench.refusal(&job_id(&bench.scan, "x = 1", VERSION).unwrap());
    fs::create_dir(&refusal).unwrap();
    let job = worker.submit(&bench.scan).unwrap();
    poll("the refusal", || worker.status().refusal);
    // It was claimed, and nothing is at work on it.
    let status = worker.status();
    assert_eq!((status.running, status.n_waiting), (None, 1));
    assert_eq!(bench.n_runs(), 0);
    fs::remove_dir(&refusal).unwrap();
    let ended = end_of(&worker, &job.id);
    assert_eq!((ended.state, ended.failures.len()), (JobState::Done, 0));
    assert_eq!(worker.status(), WorkerStatus::default());
    worker.stop();
}

#[test]
fn a_child_whose_outputs_find_no_room_costs_no_attempt() {
    let bench = Workbench::new(&format!(
        "if [ $(wc -l < $here/runs) = 1 ]; then echo no space left >&2; exit 5; fi\n{REFINE}"
    ));
    let worker = bench.worker();
    let job = worker.submit(&bench.scan).unwrap();
    let (refusal, n_waiting) = poll("the refusal", || {
        let status = worker.status();
        Some((status.refusal?, status.n_waiting))
    });
    assert!(refusal.ends_with(": no space left"), "{refusal}");
    assert_eq!(n_waiting, 1);
    let ended = end_of(&worker, &job.id);
    assert_eq!((ended.state, ended.failures.len()), (JobState::Done, 0));
    assert_eq!(bench.n_runs(), 2);
    worker.stop();
}

#[test]
fn a_refinement_that_finds_no_room_lets_others_go_first() {
    let bench = Workbench::new(&format!(
        "case $scan in */a) echo no space left >&2; exit 5;; esac\n{REFINE}"
    ));
    let other = scan(bench.root.path(), "b");
    let worker = bench.worker();
    worker.submit(&bench.scan).unwrap();
    let next = worker.submit(&other).unwrap();
    assert_eq!(end_of(&worker, &next.id).state, JobState::Done);
    // It may have its next turn just now.
    let (first, refusal) = poll("the refusal", || {
        let refusal = worker.status().refusal?;
        Some((worker.of_scan("a")?, refusal))
    });
    assert_eq!(first.failures.len(), 0);
    let why = "its outputs found no room: no space left";
    assert_eq!(refusal, format!("the refinement of a waits: {why}"));
    worker.stop();
}

#[test]
fn a_result_that_the_disk_keeps_from_landing_is_not_made_again() {
    let bench = Workbench::new(&format!(
        "mkdir $(cat $here/refusal)\n{REFINE}echo $$ > $here/pid"
    ));
    let id = job_id(&bench.scan, "x = 1", VERSION).unwrap();
    let refusal = bench.refusal(&id);
    fs::write(bench.path("refusal"), refusal.to_str().unwrap()).unwrap();
    let worker = bench.worker();
    worker.submit(&bench.scan).unwrap();
    let pid = poll("the child", || {
        let pid = fs::read_to_string(bench.path("pid")).ok();
        pid.filter(|pid| pid.ends_with('\n'))
    });
    let process = PathBuf::from(format!("/proc/{}", pid.trim()));
    poll("the end of the child", || (!process.exists()).then_some(()));
    fs::remove_dir(&refusal).unwrap();
    let ended = end_of(&worker, &id);
    assert_eq!((ended.state, ended.failures.len()), (JobState::Done, 0));
    assert_eq!(bench.n_runs(), 1);
    worker.stop();
}

#[test]
fn a_result_whose_scan_cannot_be_read_for_a_moment_is_not_made_again() {
    // A link to itself leads nowhere.
    let bench = Workbench::new(&format!(
        "mv $scan/trajectory.txt $here/kept\nln -s trajectory.txt $scan/trajectory.txt\n{REFINE}"
    ));
    let worker = bench.worker();
    let job = worker.submit(&bench.scan).unwrap();
    let refusal = poll("the refusal", || worker.status().refusal);
    assert!(refusal.contains("trajectory.txt"), "{refusal}");
    fs::rename(bench.path("kept"), bench.scan.join("trajectory.txt")).unwrap();
    let ended = end_of(&worker, &job.id);
    assert_eq!((ended.state, ended.failures.len()), (JobState::Done, 0));
    assert_eq!(bench.n_runs(), 1);
    assert_eq!(worker.status(), WorkerStatus::default());
    worker.stop();
}

#[test]
fn a_job_whose_scan_cannot_be_read_can_be_cancelled() {
    let bench = Workbench::new(REFINE);
    let (spool, id) = bench.spool_with_job(VERSION);
    drop(spool);
    let trajectory = bench.scan.join("trajectory.txt");
    fs::remove_file(&trajectory).unwrap();
    std::os::unix::fs::symlink("trajectory.txt", &trajectory).unwrap();
    let worker = bench.worker();
    poll("the refusal", || worker.status().refusal);
    worker.cancel(&id).unwrap();
    poll("the end of the job", || {
        worker.at_work_on("a").is_none().then_some(())
    });
    assert_eq!(
        (worker.list()[0].state, bench.n_runs()),
        (JobState::Cancelled, 0)
    );
    worker.stop();
}

#[test]
fn what_an_attempt_left_and_cannot_be_removed_holds_nobody_up() {
    // A file cannot be removed as a folder, whoever asks.
    let bench = Workbench::new(&format!(
        "if [ $(wc -l < $here/runs) = 1 ]; then rmdir $out; echo > $out; exit 1; fi\n{REFINE}"
    ));
    let worker = bench.worker();
    let job = worker.submit(&bench.scan).unwrap();
    let ended = end_of(&worker, &job.id);
    assert_eq!(ended.state, JobState::Done);
    assert_eq!(ended.failures, ["exit code 1"]);
    assert!(bench.scan.join("refined-1").is_file());
    worker.stop();
}
