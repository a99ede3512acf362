//! The spool against a model, with the process ending before any of its changes of the disk.

use super::*;
use fastrand::Rng;

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
            let done = spool.fail(&id, "it failed".to_owned());
            (Some(id.clone()), done.map(|()| state_of(spool, &id)))
        }
        (5, Some(id)) => {
            clear(spool, &id);
            let done = match rng.bool() {
                true => spool.put_back(&id),
                false => spool.put_behind(&id, "full".to_owned()).map(|_| ()),
            };
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
        // In the end everything can be worked off, by a process in which no job pauses.
        drop(spool);
        let spool = open(root.path());
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
