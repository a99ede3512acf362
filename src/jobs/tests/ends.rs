//! Jobs whose child, worker or daemon is ended.

use super::*;

#[test]
fn a_running_job_is_cancelled_even_if_the_child_does_not_listen() {
    for trap in ["trap 'exit 130' TERM", "trap '' TERM"] {
        let bench = Workbench::new(&format!(
            "{trap}\necho up > $here/up\nwhile :; do sleep 0.02; done"
        ));
        let before = bench.contents();
        let worker = bench.worker();
        let job = worker.submit(&bench.scan).unwrap();
        poll("the child", || bench.path("up").exists().then_some(()));
        worker.cancel(&job.id).unwrap();
        poll("the end of the child", || {
            worker.status().running.is_none().then_some(())
        });
        let ended = end_of(&worker, &job.id);
        assert_eq!(
            (ended.state, ended.failures.len()),
            (JobState::Cancelled, 0)
        );
        assert!(matches!(
            worker.cancel(&job.id),
            Err(JobError::Ended {
                state: JobState::Cancelled,
                ..
            })
        ));
        worker.stop();
        assert_eq!((bench.n_runs(), bench.contents()), (1, before));
    }
}

#[test]
fn a_worker_that_stops_puts_its_job_back_and_the_next_one_takes_it_up() {
    let bench = Workbench::new("echo up > $here/up\nwhile :; do sleep 0.02; done");
    let worker = bench.worker();
    let job = worker.submit(&bench.scan).unwrap();
    poll("the child", || bench.path("up").exists().then_some(()));
    worker.begin_stop();
    // A scan that ends while the daemon does is left to the next one.
    let other = scan(bench.root.path(), "b");
    assert_eq!(worker.submit(&other).unwrap().state, JobState::Waiting);
    worker.stop();
    let late = scan(bench.root.path(), "c");
    let late = worker.submit(&late).unwrap();
    assert_eq!((late.state, bench.n_runs()), (JobState::Waiting, 1));
    drop(worker);

    bench.become_child(REFINE);
    let worker = bench.worker();
    let ended = end_of(&worker, &job.id);
    assert_eq!((ended.state, ended.failures.len()), (JobState::Done, 0));
    assert_eq!(end_of(&worker, &late.id).state, JobState::Done);
    worker.stop();
}

#[test]
fn what_ran_or_landed_when_the_daemon_was_killed_is_taken_up() {
    for was_landing in [false, true] {
        let bench = Workbench::new(REFINE);
        let (spool, id) = bench.spool_with_job(VERSION);
        let claimed = spool.claim().unwrap().unwrap();
        let out = spool.output_folder(&claimed).unwrap();
        fs::create_dir(&out).unwrap();
        fs::write(out.join("refined.ply"), "of the first attempt").unwrap();
        if was_landing {
            spool.begin_landing(&id).unwrap();
        }
        drop(spool);

        let worker = bench.worker();
        let ended = end_of(&worker, &id);
        assert_eq!(ended.state, JobState::Done);
        let refined = fs::read_to_string(bench.scan.join("refined.ply")).unwrap();
        let (expected, n_runs, n_failures) = match was_landing {
            true => ("of the first attempt", 0, 0),
            false => ("new\n", 1, 0),
        };
        assert_eq!((refined.as_str(), bench.n_runs()), (expected, n_runs));
        assert_eq!(ended.failures.len(), n_failures);
        worker.stop();
    }
}

#[test]
fn what_waits_when_the_program_is_replaced_is_run_by_the_new_one() {
    let bench = Workbench::new(REFINE);
    let (spool, id) = bench.spool_with_job("0.0.9");
    drop(spool);
    let worker = bench.worker();
    assert_eq!(end_of(&worker, &id).state, JobState::Done);
    assert_eq!(bench.n_runs(), 1);
    // What is asked for now is asked of this program.
    assert_ne!(worker.submit(&bench.scan).unwrap().id, id);
    worker.stop();
}

#[test]
fn a_scan_is_worked_on_until_its_last_child_has_ended() {
    let bench = Workbench::new(
        "trap '' TERM\necho up > $here/up\nwhile [ ! -e $here/go ]; do sleep 0.02; done",
    );
    let worker = bench.worker_with(WorkerParams {
        grace_secs: 600.0,
        ..WorkerParams::default()
    });
    let running = worker.submit(&bench.scan).unwrap();
    poll("the child", || bench.path("up").exists().then_some(()));
    worker.set_settings("x = 2");
    let newer = worker.submit(&bench.scan).unwrap();
    worker.cancel(&newer.id).unwrap();
    assert_eq!(worker.of_scan("a").unwrap().state, JobState::Cancelled);
    assert_eq!(worker.at_work_on("a").unwrap().id, running.id);
    // What it is told is not what it has done.
    worker.cancel(&running.id).unwrap();
    assert_eq!(worker.at_work_on("a").unwrap().id, running.id);
    fs::write(bench.path("go"), "").unwrap();
    poll("the end of the child", || {
        worker.at_work_on("a").is_none().then_some(())
    });
    worker.stop();
}
