//! The newest events of a run, numbered, for whoever follows them while it goes on.

use crate::{capture::Event, lock::lock};
use std::{
    collections::VecDeque,
    sync::{Arc, Mutex},
};

/// Events beyond these are forgotten here; `events.jsonl` has them all.
const CAPACITY: usize = 256;

/// The newest events.
#[derive(Clone, Debug, Default)]
pub struct EventLog(Arc<Mutex<Inner>>);

#[derive(Debug, Default)]
struct Inner {
    events: VecDeque<Arc<Event>>,
    /// Number of the first of them.
    first: u64,
}

impl EventLog {
    /// Adds an event.
    pub(super) fn push(&self, event: Event) {
        self.with(|inner| {
            if inner.events.len() == CAPACITY {
                inner.events.pop_front();
                inner.first += 1;
            }
            inner.events.push_back(Arc::new(event));
        });
    }

    /// The events from a number on, with their numbers, which count from 0; those that were forgotten are missing.
    pub fn since(&self, number: u64) -> Vec<(u64, Arc<Event>)> {
        self.with(|inner| {
            let numbered = (inner.first..).zip(inner.events.iter().cloned());
            let skipped = number.saturating_sub(inner.first) as usize;
            numbered.skip(skipped).collect()
        })
    }

    fn with<T>(&self, f: impl FnOnce(&mut Inner) -> T) -> T {
        f(&mut lock(&self.0))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::capture::EventKind;

    #[test]
    fn the_newest_events_are_kept_under_their_numbers() {
        let log = EventLog::default();
        for frame_id in 0..300 {
            log.push(Event {
                frame_id,
                device_time_secs: None,
                kind: EventKind::Found,
            });
        }
        let numbers = |from| -> Vec<u64> { log.since(from).iter().map(|(n, _)| *n).collect() };
        assert_eq!(numbers(0), (44..300).collect::<Vec<_>>());
        assert_eq!(numbers(298), [298, 299]);
        assert!(log.since(299).iter().all(|(n, event)| *n == event.frame_id));
        assert!(numbers(300).is_empty());
    }
}
