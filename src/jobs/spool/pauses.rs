//! A job whose outputs found no room on the disk is tried again later, each time later than the last.

use crate::jobs::JobId;
use std::{
    collections::BTreeMap,
    time::{Duration, Instant},
};

/// The first pause of a job; each further one is twice as long.
const FIRST: Duration = Duration::from_secs(5);
/// The longest. Arbitrary: an attempt takes minutes, and whoever makes room is not to wait for longer than that.
const LONGEST: Duration = Duration::from_secs(600);

/// Until when jobs pause. In this process: the next one tries them again at once.
#[derive(Debug, Default)]
pub struct Pauses(BTreeMap<JobId, Instant>);

impl Pauses {
    /// A job pauses, for the `n_times`-th time, from 1 on.
    pub fn begin(&mut self, id: &JobId, n_times: u32) {
        let now = Instant::now();
        self.0.retain(|_, end| *end > now);
        self.0.insert(id.clone(), now + length(n_times));
    }

    /// A job pauses no longer.
    pub fn end(&mut self, id: &JobId) {
        self.0.remove(id);
    }

    /// Whether a job pauses.
    pub fn hold(&self, id: &JobId) -> bool {
        self.0.get(id).is_some_and(|end| Instant::now() < *end)
    }
}

fn length(n_times: u32) -> Duration {
    let n_doublings = n_times.saturating_sub(1);
    FIRST
        .saturating_mul(2u32.saturating_pow(n_doublings))
        .min(LONGEST)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn pauses_grow_up_to_a_bound_and_can_be_ended() {
        let secs = [1, 2, 3, 7, 8, u32::MAX].map(|n_times| length(n_times).as_secs());
        assert_eq!(secs, [5, 10, 20, 320, 600, 600]);
        let [one, other]: [JobId; 2] = [1, 2].map(|digit| format!("{digit:064x}").parse().unwrap());
        let mut pauses = Pauses::default();
        pauses.begin(&one, u32::MAX);
        assert!(pauses.hold(&one) && !pauses.hold(&other));
        pauses.end(&one);
        assert!(!pauses.hold(&one));
    }
}
