//! What becomes of jobs in the spool.

mod interruptions;

use super::{durable::interruption, *};
use crate::jobs::{JobState, scenes::scan};
use std::{collections::BTreeMap, thread, time::Duration};

const MAX_RETRIES: u32 = 3;

fn id(digit: u32) -> JobId {
    format!("{digit:064x}").parse().unwrap()
}

fn request(digit: u32, scan: &str) -> Request<'_> {
    Request {
        id: id(digit),
        scan,
        settings: "x = 1",
        version: "0.1.0",
        now_unix_ms: 1,
        has_refined_mesh: true,
    }
}

/// Opens a spool that was closed a moment ago: a process that another test is just starting may hold its lock until it runs.
fn open(root: &Path) -> Spool {
    for _ in 0..10_000 {
        match Spool::open(root, MAX_RETRIES) {
            Err(JobError::InUse(_)) => thread::sleep(Duration::from_millis(1)),
            opened => return opened.unwrap(),
        }
    }
    panic!("the spool stays in use")
}

/// The state of each job.
fn states(spool: &Spool) -> BTreeMap<JobId, JobState> {
    let jobs = spool.list().unwrap();
    let states = jobs.iter().map(|(place, record)| record.job(*place));
    states.map(|job| (job.id, job.state)).collect()
}

#[test]
fn a_job_goes_its_way() {
    let root = tempfile::tempdir().unwrap();
    scan(root.path(), "a");
    let spool = open(root.path());
    spool.submit(&request(1, "a")).unwrap();
    spool.submit(&request(1, "a")).unwrap();
    assert_eq!(spool.list().unwrap().len(), 1);

    let claimed = spool.claim().unwrap().unwrap();
    assert_eq!((claimed.id.clone(), claimed.attempt), (id(1), Some(1)));
    assert!(spool.claim().unwrap().is_none());
    assert!(spool.begin_landing(&id(1)).unwrap());
    assert!(matches!(
        spool.cancel(&id(1)),
        Err(JobError::Ended {
            state: JobState::Done,
            ..
        })
    ));
    spool.end(&id(1), JobState::Done, None).unwrap();
    let (place, _) = spool.submit(&request(1, "a")).unwrap();
    assert_eq!(place, Place::Done);

    // Another job has put its mesh in the place of the first one's.
    spool.submit(&request(2, "a")).unwrap();
    spool.claim().unwrap().unwrap();
    spool.end(&id(2), JobState::Done, None).unwrap();
    let (place, again) = spool.submit(&request(1, "a")).unwrap();
    assert_eq!((place, again.ending), (Place::Waiting, None));
    assert!(matches!(spool.cancel(&id(9)), Err(JobError::Unknown(_))));
}

#[test]
fn failures_are_kept_and_counted() {
    let root = tempfile::tempdir().unwrap();
    let spool = open(root.path());
    spool.submit(&request(1, "a")).unwrap();
    for attempt in 1..=MAX_RETRIES + 1 {
        assert_eq!(states(&spool)[&id(1)], JobState::Waiting);
        spool.claim().unwrap().unwrap();
        let reason = format!("reason {attempt}");
        spool.fail(&id(1), reason).unwrap();
    }
    let (_, record) = spool.find(&id(1)).unwrap().unwrap();
    assert_eq!(states(&spool)[&id(1)], JobState::Failed);
    let expected = ["reason 1", "reason 2", "reason 3", "reason 4"];
    assert_eq!(record.failures, expected);
    assert_eq!(record.ending.unwrap().message.unwrap(), "reason 4");

    // What cannot be mended is not repeated; asked for again, a job begins anew.
    spool.submit(&request(1, "a")).unwrap();
    spool.claim().unwrap().unwrap();
    spool.give_up(&id(1), "hopeless".to_owned()).unwrap();
    let (_, record) = spool.find(&id(1)).unwrap().unwrap();
    assert_eq!(record.failures, ["hopeless"]);
    assert_eq!(states(&spool)[&id(1)], JobState::Failed);
}

#[test]
fn who_finds_no_room_lets_all_others_go_first() {
    let root = tempfile::tempdir().unwrap();
    let spool = open(root.path());
    for (digit, scan) in [(1, "a"), (2, "b")] {
        spool.submit(&request(digit, scan)).unwrap();
    }
    spool.claim().unwrap().unwrap();
    let without_room = |spool: &Spool| spool.put_behind(&id(1), "full".to_owned()).unwrap();
    assert_eq!(without_room(&spool), Some(1));
    let (place, record) = spool.find(&id(1)).unwrap().unwrap();
    let job = record.job(place);
    assert_eq!((job.state, job.failures.len()), (JobState::Waiting, 0));
    assert_eq!(job.lacks_room.as_deref(), Some("full"));
    // Asked for again it does not pause, and waits behind the others all the same.
    spool.submit(&request(1, "a")).unwrap();
    spool.submit(&request(3, "c")).unwrap();
    for digit in [2, 3] {
        assert_eq!(spool.claim().unwrap().unwrap().id, id(digit));
        spool.end(&id(digit), JobState::Done, None).unwrap();
    }
    for n_times in 2..=9 {
        spool.submit(&request(1, "a")).unwrap();
        assert_eq!(spool.claim().unwrap().unwrap().id, id(1));
        assert_eq!(without_room(&spool), Some(n_times));
    }
    // By now it pauses for minutes.
    assert_eq!(spool.claim().unwrap(), None);
    // The next daemon knows how often that was, and does not pause.
    drop(spool);
    let spool = open(root.path());
    let again = spool.claim().unwrap().unwrap();
    assert_eq!((again.n_times_without_room(), &again.id), (9, &id(1)));
    assert_eq!(again.job(Place::Running).lacks_room, None, "it runs");
    spool.cancel(&id(1)).unwrap();
    assert_eq!(without_room(&spool), None);
    assert_eq!(states(&spool)[&id(1)], JobState::Cancelled);
}

#[test]
fn a_job_outlives_many_ends_of_the_daemon_but_not_all() {
    let root = tempfile::tempdir().unwrap();
    let mut spool = open(root.path());
    spool.submit(&request(1, "a")).unwrap();
    let mut n_ends = 0;
    while spool.claim().unwrap().is_some() {
        drop(spool);
        spool = open(root.path());
        n_ends += 1;
    }
    assert_eq!(n_ends, 11);
    let (_, record) = spool.find(&id(1)).unwrap().unwrap();
    assert_eq!(states(&spool)[&id(1)], JobState::Failed);
    let ending = record.ending.unwrap();
    assert_eq!((record.failures.len(), record.n_interruptions), (0, 11));
    assert!(ending.message.unwrap().contains("ended 11 times"));

    // Asked for again it begins anew, and an end that it was told of is none of these.
    spool.submit(&request(1, "a")).unwrap();
    spool.claim().unwrap().unwrap();
    spool.put_back(&id(1)).unwrap();
    drop(spool);
    let (_, record) = open(root.path()).find(&id(1)).unwrap().unwrap();
    assert_eq!(record.n_interruptions, 0);
}

#[test]
fn a_full_disk_costs_neither_the_start_nor_the_job() {
    let root = tempfile::tempdir().unwrap();
    let spool = open(root.path());
    for (digit, scan) in [(1, "a"), (2, "b")] {
        spool.submit(&request(digit, scan)).unwrap();
        spool.claim().unwrap().unwrap();
    }
    spool.cancel(&id(2)).unwrap();
    drop(spool);
    interruption::fill(true);
    let spool = open(root.path());
    interruption::fill(false);
    let expected = [(id(1), JobState::Running), (id(2), JobState::Cancelled)];
    assert_eq!(states(&spool), BTreeMap::from(expected));
    // As the worker does when there is room.
    for record in spool.left_running().unwrap() {
        spool.put_back(&record.id).unwrap();
    }
    let again = spool.claim().unwrap().unwrap();
    assert_eq!((again.id, again.n_interruptions), (id(1), 0));
    assert!(spool.left_running().unwrap().len() == 1);
}

#[test]
fn what_an_attempt_left_and_cannot_be_removed_costs_neither_the_start_nor_the_job() {
    let root = tempfile::tempdir().unwrap();
    let scan = scan(root.path(), "a");
    let spool = open(root.path());
    spool.submit(&request(1, "a")).unwrap();
    spool.claim().unwrap().unwrap();
    // A file cannot be removed as a folder, whoever asks.
    fs::write(scan.join("refined-1"), "").unwrap();
    drop(spool);
    let spool = open(root.path());
    assert_eq!(states(&spool)[&id(1)], JobState::Waiting);
    assert_eq!(spool.claim().unwrap().unwrap().attempt, Some(2));
}

#[test]
fn a_newer_job_takes_the_place_of_one_that_waits_but_not_of_one_that_runs() {
    let root = tempfile::tempdir().unwrap();
    let spool = open(root.path());
    spool.submit(&request(1, "a")).unwrap();
    spool.claim().unwrap().unwrap();
    for digit in [2, 3] {
        spool.submit(&request(digit, "a")).unwrap();
    }
    spool.submit(&request(4, "b")).unwrap();
    let expected = [
        (id(1), JobState::Running),
        (id(2), JobState::Superseded),
        (id(3), JobState::Waiting),
        (id(4), JobState::Waiting),
    ];
    assert_eq!(states(&spool), BTreeMap::from(expected));
    spool.put_back(&id(1)).unwrap();
    // The older one of the scan does not come before the newer one.
    assert_eq!(spool.claim().unwrap().unwrap().id, id(3));
    assert_eq!(states(&spool)[&id(1)], JobState::Superseded);
}

#[test]
fn a_job_asked_for_again_while_it_is_being_cancelled_begins_anew() {
    let root = tempfile::tempdir().unwrap();
    scan(root.path(), "a");
    let spool = open(root.path());
    spool.submit(&request(1, "a")).unwrap();
    spool.claim().unwrap().unwrap();
    spool.cancel(&id(1)).unwrap();
    assert_eq!(states(&spool)[&id(1)], JobState::Cancelled);
    let (place, again) = spool.submit(&request(1, "a")).unwrap();
    assert_eq!((place, again.attempt), (Place::Running, Some(1)));
    assert_eq!(states(&spool)[&id(1)], JobState::Running);
    // The child that was told to end has ended.
    spool.put_back(&id(1)).unwrap();
    assert_eq!(spool.claim().unwrap().unwrap().id, id(1));
}

#[test]
fn a_spool_has_one_owner_and_keeps_what_is_no_job() {
    let root = tempfile::tempdir().unwrap();
    let spool = open(root.path());
    assert!(matches!(
        Spool::open(root.path(), MAX_RETRIES),
        Err(JobError::InUse(_))
    ));
    spool.submit(&request(1, "a")).unwrap();
    drop(spool);
    let waiting = root.path().join("spool/waiting");
    let spoilt = [
        ("no-job.json", "{".to_owned()),
        (
            "wrong.json",
            fs::read_to_string(waiting.join(format!("{}.json", id(1)))).unwrap(),
        ),
    ];
    for (name, text) in &spoilt {
        fs::write(waiting.join(name), text).unwrap();
    }
    let mut elsewhere = spoilt[1].1.replace("\"scan\": \"a\"", "\"scan\": \"../a\"");
    elsewhere = elsewhere.replace(id(1).as_str(), id(2).as_str());
    assert!(elsewhere.contains("../a"));
    fs::write(waiting.join(format!("{}.json", id(2))), elsewhere).unwrap();
    let spool = open(root.path());
    assert_eq!(states(&spool).len(), 1);
    for name in ["no-job".to_owned(), "wrong".to_owned(), id(2).to_string()] {
        assert!(waiting.join(format!("{name}.damaged")).exists(), "{name}");
    }
}
