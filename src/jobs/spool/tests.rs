//! The spool against a model, with the process ending before any of its changes of the disk.

use super::{durable::interruption, *};
use crate::jobs::{JobState, scenes::scan};
use fastrand::Rng;
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
        spool.fail(&id(1), reason, true).unwrap();
    }
    let (_, record) = spool.find(&id(1)).unwrap().unwrap();
    assert_eq!(states(&spool)[&id(1)], JobState::Failed);
    let expected = ["reason 1", "reason 2", "reason 3", "reason 4"];
    assert_eq!(record.failures, expected);
    assert_eq!(record.ending.unwrap().message.unwrap(), "reason 4");

    // What cannot be mended is not repeated; asked for again, a job begins anew.
    spool.submit(&request(1, "a")).unwrap();
    spool.claim().unwrap().unwrap();
    spool.fail(&id(1), "hopeless".to_owned(), false).unwrap();
    let (_, record) = spool.find(&id(1)).unwrap().unwrap();
    assert_eq!(record.failures, ["hopeless"]);
    assert_eq!(states(&spool)[&id(1)], JobState::Failed);
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

/// What the model knows of a job: the last state that the spool has confirmed, or `None` while a change was cut off.
type Model = BTreeMap<JobId, Option<JobState>>;

/// Asks one thing of the spool, at random; says of which job, and what it is after that.
fn act(spool: &Spool, rng: &mut Rng) -> (Option<JobId>, Result<Option<JobState>, JobError>) {
    let jobs = spool.list().unwrap();
    let running = jobs.iter().find(|(place, _)| *place == Place::Running);
    let running = running.map(|(_, record)| record.id.clone());
    let digit = rng.u32(1..7);
    let asked = Some(id(digit));
    let state_of = |spool: &Spool, id: &JobId| states(spool).get(id).copied();
    match (rng.u32(0..8), running) {
        (0..=2, _) => {
            let scan = ["a", "b"][digit as usize % 2];
            let done = spool.submit(&request(digit, scan));
            (asked, done.map(|_| state_of(spool, &id(digit))))
        }
        (3, _) => {
            let done = match spool.cancel(&id(digit)) {
                Err(JobError::Unknown(_) | JobError::Ended { .. }) => Ok(Place::Waiting),
                cancelled => cancelled,
            };
            (asked, done.map(|_| state_of(spool, &id(digit))))
        }
        (_, None) => {
            let done = spool.claim();
            let claimed = done.as_ref().ok().and_then(Option::as_ref);
            let claimed = claimed.map(|record| {
                let out = spool.output_folder(record).unwrap();
                fs::create_dir_all(out).unwrap();
                record.id.clone()
            });
            (
                claimed.clone(),
                done.map(|_| claimed.and_then(|id| state_of(spool, &id))),
            )
        }
        (4, Some(id)) => {
            clear(spool, &id);
            let done = spool.fail(&id, "it failed".to_owned(), true);
            (Some(id.clone()), done.map(|()| state_of(spool, &id)))
        }
        (5, Some(id)) => {
            clear(spool, &id);
            let done = spool.put_back(&id);
            (Some(id.clone()), done.map(|()| state_of(spool, &id)))
        }
        (6, Some(id)) => {
            let done = spool.begin_landing(&id).map(|_| ());
            (Some(id.clone()), done.map(|()| state_of(spool, &id)))
        }
        (_, Some(id)) => {
            clear(spool, &id);
            let state = [JobState::Done, JobState::Refused][rng.usize(0..2)];
            let done = spool.end(&id, state, None);
            (Some(id.clone()), done.map(|()| state_of(spool, &id)))
        }
    }
}

/// Removes what an attempt left, as the worker does before it lets go of a job.
fn clear(spool: &Spool, id: &JobId) {
    let (_, record) = spool.find(id).unwrap().unwrap();
    if let Some(out) = spool.output_folder(&record) {
        remove_folder(&out).ok();
    }
}

/// What must hold once the spool has been opened.
fn check(spool: &Spool, root: &Path, model: &Model) {
    let mut seen = BTreeMap::new();
    let mut waiting_of = BTreeMap::new();
    for (place, record) in spool.list().unwrap() {
        assert!(
            seen.insert(record.id.clone(), record.job(place).state)
                .is_none(),
            "one file a job"
        );
        let home = record.ending.as_ref().map(Ending::place);
        match place {
            Place::Running => assert!(record.is_landing && record.attempt.is_some()),
            Place::Waiting => {
                assert_eq!((home, record.attempt), (None, None));
                *waiting_of.entry(record.scan.clone()).or_insert(0) += 1;
            }
            Place::Done | Place::Failed => assert_eq!((home, record.attempt), (Some(place), None)),
        }
        let n_failures = record.failures.len() as u32;
        assert!(n_failures <= MAX_RETRIES + 1);
        if n_failures > MAX_RETRIES {
            assert_ne!(place, Place::Waiting);
        }
    }
    for (id, state) in model {
        let now = seen.get(id);
        assert!(now.is_some(), "a job that was taken is never lost");
        if let Some(state) = state.filter(|state| state.is_ended()) {
            // Only a request makes it wait again, and the model knows of each.
            assert_eq!(now, Some(&state));
        }
    }
    assert!(waiting_of.values().all(|&n: &u32| n == 1));
    for place in Place::ALL {
        for entry in fs::read_dir(root.join("spool").join(place.folder())).unwrap() {
            let name = entry.unwrap().file_name().into_string().unwrap();
            assert!(name.len() == 69 && name.ends_with(".json"), "{name}");
        }
    }
    for scan in ["a", "b"] {
        for entry in fs::read_dir(root.join("sessions").join(scan)).unwrap() {
            let name = entry.unwrap().file_name().into_string().unwrap();
            let landing = spool.left_running().unwrap();
            let of_landing = landing.iter().any(|record| {
                record.scan == scan && spool.output_folder(record).unwrap().ends_with(&name)
            });
            assert!(!name.starts_with("refined-") || of_landing, "{name}");
        }
    }
}

#[test]
fn whatever_moment_the_process_ends_at_no_job_is_lost_doubled_or_stuck() {
    let mut n_cut_off = 0;
    for seed in 0..20 {
        let mut rng = Rng::with_seed(seed);
        let root = tempfile::tempdir().unwrap();
        for name in ["a", "b"] {
            scan(root.path(), name);
        }
        let mut model = Model::new();
        let mut spool = open(root.path());
        for _ in 0..40 {
            let cut = (rng.u32(0..3) == 0).then(|| rng.u32(0..4));
            let before: Vec<JobId> = states(&spool).into_keys().collect();
            interruption::after(cut);
            let (id, acted) = act(&spool, &mut rng);
            interruption::after(None);
            match acted {
                Ok(_) => model.extend(
                    states(&spool)
                        .into_iter()
                        .map(|(id, state)| (id, Some(state))),
                ),
                Err(_) => {
                    n_cut_off += 1;
                    // What was being changed may be either; nothing else may.
                    model.extend(id.filter(|id| before.contains(id)).map(|id| (id, None)));
                    for state in model.values_mut() {
                        *state = state.filter(|state| state.is_ended());
                    }
                    if rng.bool() {
                        let partial = format!("spool/waiting/.{}.json.partial", id_of(&mut rng));
                        fs::write(root.path().join(partial), "{").unwrap();
                    }
                    drop(spool);
                    reopen_with_interruptions(root.path(), &mut rng);
                    spool = open(root.path());
                    check(&spool, root.path(), &model);
                    model = states(&spool)
                        .into_iter()
                        .map(|(id, state)| (id, Some(state)))
                        .collect();
                }
            }
        }
        // In the end everything can be worked off.
        for record in spool.left_running().unwrap() {
            spool.end(&record.id, JobState::Done, None).unwrap();
        }
        while let Some(record) = spool.claim().unwrap() {
            spool.end(&record.id, JobState::Done, None).unwrap();
        }
        assert!(states(&spool).values().all(|state| state.is_ended()));
    }
    // So that the loop above is about what its name says.
    assert!(n_cut_off > 60, "{n_cut_off}");
}

fn id_of(rng: &mut Rng) -> JobId {
    id(rng.u32(1..7))
}

/// The process may end while it takes up what the last one left, more than once.
fn reopen_with_interruptions(root: &Path, rng: &mut Rng) {
    for _ in 0..rng.u32(0..3) {
        interruption::after(Some(rng.u32(0..3)));
        drop(Spool::open(root, MAX_RETRIES));
        interruption::after(None);
    }
}
