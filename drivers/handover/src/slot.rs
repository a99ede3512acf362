//! A place for the newest value of something, which knows whether anybody looks.

use crate::{lock, sync::Mutex};
use std::{
    sync::Arc,
    time::{Duration, Instant},
};

/// Who has looked within this time is looking.
const LOOKING: Duration = Duration::from_secs(2);

/// The newest value of something. Clones are the same slot.
#[derive(Debug)]
pub struct Slot<T>(Arc<Mutex<Inner<T>>>);

#[derive(Debug)]
struct Inner<T> {
    value: Option<Arc<T>>,
    last_read: Option<Instant>,
    last_written: Option<Instant>,
}

impl<T> Default for Slot<T> {
    fn default() -> Self {
        Slot(Arc::new(Mutex::new(Inner {
            value: None,
            last_read: None,
            last_written: None,
        })))
    }
}

impl<T> Clone for Slot<T> {
    fn clone(&self) -> Self {
        Slot(self.0.clone())
    }
}

impl<T> Inner<T> {
    fn is_watched(&self) -> bool {
        self.last_read.is_some_and(|read| read.elapsed() < LOOKING)
    }
}

impl<T> Slot<T> {
    /// The newest value; says that somebody looks.
    pub fn read(&self) -> Option<Arc<T>> {
        self.with(|inner| {
            inner.last_read = Some(Instant::now());
            inner.value.clone()
        })
    }

    /// Whether somebody looks.
    pub fn is_watched(&self) -> bool {
        self.with(|inner| inner.is_watched())
    }

    /// Whether somebody looks, and the value there is older than `min_age`.
    pub fn is_due(&self, min_age: Duration) -> bool {
        self.with(|inner| {
            inner.is_watched() && inner.last_written.is_none_or(|at| at.elapsed() >= min_age)
        })
    }

    /// Puts a value in place of the one there; the old one is freed here, or by its last reader.
    pub fn write(&self, value: Option<T>) {
        let value = value.map(Arc::new);
        let old = self.with(|inner| {
            inner.last_written = Some(Instant::now());
            std::mem::replace(&mut inner.value, value)
        });
        drop(old);
    }

    fn with<R>(&self, f: impl FnOnce(&mut Inner<T>) -> R) -> R {
        f(&mut lock(&self.0))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::in_many_orders;
    use shuttle::{check_random, thread};

    const NEWEST: u32 = 4;

    #[test]
    fn a_value_is_due_only_while_somebody_looks_and_not_too_often() {
        check_random(becomes_due, 1);
    }

    fn becomes_due() {
        let slot = Slot::default();
        assert!(!slot.is_due(Duration::ZERO));
        assert_eq!(slot.read(), None);
        assert!(slot.is_due(Duration::from_secs(3600)), "none was made yet");
        slot.write(Some(7));
        assert!(slot.is_due(Duration::ZERO));
        assert!(!slot.is_due(Duration::from_secs(3600)));
        slot.with(|inner| inner.last_read = inner.last_read.and_then(|at| at.checked_sub(LOOKING)));
        assert!(!slot.is_due(Duration::ZERO), "nobody looks any more");
    }

    #[test]
    fn only_the_newest_value_is_held() {
        check_random(is_held, 1);
    }

    fn is_held() {
        let slot = Slot::default();
        slot.write(Some(1));
        let held = slot.read().unwrap();
        slot.write(Some(2));
        assert_eq!((*held, Arc::strong_count(&held)), (1, 1));
        assert_eq!(slot.clone().read().as_deref(), Some(&2));
        slot.write(None);
        assert_eq!(slot.read(), None);
    }

    /// Reads until the newest value is there; what is read never grows older.
    fn look_on(slot: &Slot<u32>) {
        let mut before = None;
        while before != Some(NEWEST) {
            let seen = slot.read().map(|value| *value);
            assert!(seen >= before, "{seen:?} after {before:?}");
            before = seen;
            thread::yield_now();
        }
    }

    #[test]
    fn all_who_look_on_see_the_newest_value_and_none_that_is_older_than_the_last() {
        in_many_orders(|| {
            let slot = Slot::default();
            let looking = [slot.clone(), slot.clone()]
                .map(|slot: Slot<u32>| thread::spawn(move || look_on(&slot)));
            for value in 0..=NEWEST {
                slot.write(Some(value));
            }
            for thread in looking {
                thread.join().unwrap();
            }
        });
    }

    #[test]
    fn who_looks_is_served_by_a_writer_that_writes_for_those_who_look_alone() {
        in_many_orders(|| {
            let slot = Slot::default();
            let of_writer = slot.clone();
            let writing = thread::spawn(move || {
                while !of_writer.is_due(Duration::ZERO) {
                    thread::yield_now();
                }
                of_writer.write(Some(NEWEST));
            });
            look_on(&slot);
            writing.join().unwrap();
        });
    }

    /// A value that, when it is freed, looks at the slot in which it was.
    struct Curious(Slot<Curious>);

    impl Drop for Curious {
        fn drop(&mut self) {
            self.0.is_watched();
        }
    }

    #[test]
    fn nobody_waits_while_an_old_value_is_freed() {
        in_many_orders(|| {
            let slot = Slot::default();
            let reader = slot.clone();
            let reading = thread::spawn(move || drop(reader.read()));
            for _ in 0..2 {
                slot.write(Some(Curious(slot.clone())));
            }
            // Else slot and value would hold one another.
            slot.write(None);
            reading.join().unwrap();
        });
    }
}
