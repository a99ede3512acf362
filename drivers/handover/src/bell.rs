//! How a thread that waits for work is called, and sent home.

use crate::{
    lock,
    sync::{Condvar, Mutex},
};
use std::{sync::PoisonError, time::Duration};

/// The bell of one thread. It is heard though the thread is busy: it then wakes at once when it next waits. Rings that come
/// meanwhile are one.
#[derive(Debug, Default)]
pub struct Bell {
    state: Mutex<State>,
    changed: Condvar,
}

#[derive(Debug, Default)]
struct State {
    is_rung: bool,
    is_stopped: bool,
}

impl Bell {
    /// Tells the thread that there may be something to do.
    pub fn ring(&self) {
        lock(&self.state).is_rung = true;
        self.changed.notify_all();
    }

    /// Tells the thread to end, for good.
    pub fn stop(&self) {
        lock(&self.state).is_stopped = true;
        self.changed.notify_all();
    }

    /// Whether the thread is to end.
    pub fn is_stopped(&self) -> bool {
        lock(&self.state).is_stopped
    }

    /// Waits for something to do; false when the thread is to end.
    pub fn wait(&self) -> bool {
        let is_idle = |state: &mut State| !state.is_rung && !state.is_stopped;
        let waited = self.changed.wait_while(lock(&self.state), is_idle);
        let mut state = waited.unwrap_or_else(PoisonError::into_inner);
        state.is_rung = false;
        !state.is_stopped
    }

    /// Waits for so long, whatever there is to do, or until the thread is to end.
    pub fn rest(&self, duration: Duration) {
        let goes_on = |state: &mut State| !state.is_stopped;
        drop(
            self.changed
                .wait_timeout_while(lock(&self.state), duration, goes_on),
        );
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::in_many_orders;
    use shuttle::thread;
    use std::sync::Arc;

    const N_JOBS: usize = 4;

    /// What a thread of jobs shares with those who give them.
    #[derive(Default)]
    struct Desk {
        bell: Bell,
        jobs: Mutex<Vec<usize>>,
    }

    impl Desk {
        fn take_all(&self) -> Vec<usize> {
            std::mem::take(&mut lock(&self.jobs))
        }
    }

    /// Puts down half of the jobs each, and rings for every one.
    fn two_who_ask(desk: &Arc<Desk>) -> [thread::JoinHandle<()>; 2] {
        [0, 1].map(|first| {
            let desk = desk.clone();
            thread::spawn(move || {
                for job in (first..N_JOBS).step_by(2) {
                    lock(&desk.jobs).push(job);
                    desk.bell.ring();
                }
            })
        })
    }

    fn join(asking: [thread::JoinHandle<()>; 2]) {
        for thread in asking {
            thread.join().unwrap();
        }
    }

    #[test]
    fn no_job_is_left_lying_while_the_thread_waits() {
        in_many_orders(|| {
            let desk = Arc::new(Desk::default());
            let asking = two_who_ask(&desk);
            let mut done = Vec::new();
            while done.len() < N_JOBS {
                assert!(desk.bell.wait(), "nobody has stopped it");
                done.extend(desk.take_all());
            }
            done.sort_unstable();
            assert_eq!(done, (0..N_JOBS).collect::<Vec<_>>());
            join(asking);
        });
    }

    #[test]
    fn a_thread_that_is_stopped_ends_wherever_it_is_and_leaves_its_jobs() {
        in_many_orders(|| {
            let desk = Arc::new(Desk::default());
            let of_thread = desk.clone();
            let working = thread::spawn(move || {
                let mut n_done = 0;
                while of_thread.bell.wait() {
                    let jobs = of_thread.take_all();
                    n_done += jobs.len();
                    if jobs.contains(&1) {
                        // The scheduler lets no time pass: what is not stopped rests for ever.
                        of_thread.bell.rest(Duration::from_secs(5));
                    }
                }
                n_done
            });
            let asking = two_who_ask(&desk);
            desk.bell.stop();
            let n_done = working.join().unwrap();
            join(asking);
            assert!(desk.bell.is_stopped());
            assert!(!desk.bell.wait(), "rings that come later call nobody back");
            assert_eq!(n_done + desk.take_all().len(), N_JOBS);
        });
    }
}
