//! How far a refinement is, for the process that started it: JSON lines on standard output.

use crate::{
    jobs::{JobProgress, ProgressLine},
    lock::lock,
    pipeline::{Phase, Status},
};
use std::{
    io::{self, Write},
    sync::Mutex,
    time::{Duration, Instant},
};

/// Lines that tell of nothing but the time left are this far apart.
const BETWEEN_LINES: Duration = Duration::from_secs(2);

/// Prints a line when a step is made, and now and then meanwhile.
#[derive(Debug, Default)]
pub struct ProgressLines(Mutex<Clock>);

/// When what was seen.
#[derive(Debug, Default)]
struct Clock {
    /// The start of the first round.
    began: Option<Instant>,
    /// The newest round, and its start since then.
    round: Option<(usize, Duration)>,
    last: Option<(Instant, JobProgress)>,
}

impl ProgressLines {
    /// Prints how far refinement is, if it runs and there is something new to tell.
    pub fn show(&self, status: &Status) {
        if status.phase != Phase::Refining {
            return;
        }
        let mut clock = lock(&self.0);
        let Some(progress) = clock.tell(status, Instant::now()) else {
            return;
        };
        let line = serde_json::to_string(&ProgressLine { progress });
        // If nobody reads any more, nobody waits for it either.
        let _ = line.map(|line| writeln!(io::stdout(), "{line}"));
    }
}

impl Clock {
    /// What is to be told now.
    fn tell(&mut self, status: &Status, now: Instant) -> Option<JobProgress> {
        let refinement = &status.refinement;
        let (begun, of) = refinement.rounds;
        if begun > 0 {
            let elapsed = now - *self.began.get_or_insert(now);
            if self.round.is_none_or(|(round, _)| round != begun) {
                self.round = Some((begun, elapsed));
            }
        }
        let progress = JobProgress {
            round: refinement.rounds,
            step: refinement.n_steps,
            energy_share: match refinement.n_steps {
                0 => 1.0,
                _ => refinement.energy_share,
            },
            secs_left: self.secs_left(of, now),
        };
        let is_due = self.last.is_none_or(|(when, last)| {
            (last.round, last.step) != (progress.round, progress.step)
                || now - when >= BETWEEN_LINES
        });
        if is_due {
            self.last = Some((now, progress));
        }
        is_due.then_some(progress)
    }

    /// The rounds that are over tell how long the others take; `None` where they do not, or one takes longer, by more turns.
    fn secs_left(&self, n_rounds: usize, now: Instant) -> Option<f64> {
        let ((round, started), began) = (self.round?, self.began?);
        let n_over = round - 1;
        if n_over == 0 {
            return None;
        }
        let secs_a_round = started.as_secs_f64() / n_over as f64;
        let in_round = (now - began).saturating_sub(started).as_secs_f64();
        let n_left = n_rounds.saturating_sub(n_over) as f64;
        let left = n_left * secs_a_round - in_round;
        (left > 0.0).then_some(left)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_time_left_follows_from_the_rounds_that_are_over() {
        let start = Instant::now();
        let mut clock = Clock::default();
        let mut tell = |secs: f64, round: usize, step: usize| {
            let mut status = Status::default();
            status.refinement.rounds = (round, 4);
            status.refinement.n_steps = step;
            status.refinement.energy_share = 0.5;
            clock.tell(&status, start + Duration::from_secs_f64(secs))
        };
        let told = tell(0.0, 0, 0).unwrap();
        assert_eq!((told.energy_share, told.secs_left), (1.0, None));
        assert_eq!(tell(0.5, 0, 0), None);
        assert_eq!(tell(1.0, 1, 1).unwrap().secs_left, None);
        // One round took 10 s; three are left.
        let told = tell(11.0, 2, 2).unwrap();
        assert_eq!((told.round, told.step), ((2, 4), 2));
        assert_eq!(told.secs_left, Some(30.0));
        // Nothing new but time.
        assert_eq!(tell(12.0, 2, 2), None);
        assert_eq!(tell(13.5, 2, 2).unwrap().secs_left, Some(27.5));
        // The last round takes as long as the others did, then longer.
        assert_eq!(tell(31.0, 4, 8).unwrap().secs_left, Some(10.0));
        assert_eq!(tell(99.0, 4, 8).unwrap().secs_left, None);
    }
}
