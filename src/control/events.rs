//! What happened, numbered: the newest events for whoever follows them.

use crate::lock::lock;
use serde::Serialize;
use std::{
    collections::VecDeque,
    sync::{Arc, Mutex, MutexGuard},
};
use tokio::sync::watch;

/// Events beyond these are forgotten; who was away for longer looks at the status anew.
const CAPACITY: usize = 512;

/// What an event is about.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Topic {
    /// The whole status, once a second.
    Status,
    /// The state has changed.
    State,
    /// An infrared image became a shading image.
    Snapshot,
    /// Tracking was weak, lost or found, or a frame could not be used.
    Loss,
    /// A refinement has begun, moved or ended.
    Refinement,
    /// The camera came, went or fell silent.
    Device,
}

impl Topic {
    /// Its name in the stream.
    pub fn name(self) -> &'static str {
        match self {
            Topic::Status => "status",
            Topic::State => "state",
            Topic::Snapshot => "snapshot",
            Topic::Loss => "loss",
            Topic::Refinement => "refinement",
            Topic::Device => "device",
        }
    }
}

/// An event.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Event {
    /// Counts from 1 over the daemon's life.
    pub number: u64,
    /// What it is about.
    pub topic: Topic,
    /// What happened, as JSON on one line.
    pub data: Arc<str>,
}

/// The newest events.
#[derive(Debug)]
pub struct Events {
    kept: Mutex<VecDeque<Event>>,
    newest: watch::Sender<u64>,
}

impl Default for Events {
    fn default() -> Self {
        Events {
            kept: Mutex::default(),
            newest: watch::Sender::new(0),
        }
    }
}

impl Events {
    /// Adds an event.
    pub fn tell(&self, topic: Topic, what: &impl Serialize) {
        let data = match serde_json::to_string(what) {
            Ok(data) => data,
            Err(error) => {
                tracing::error!(%error, topic = topic.name(), "an event cannot be told");
                return;
            }
        };
        let mut kept = self.kept();
        if kept.len() == CAPACITY {
            kept.pop_front();
        }
        let number = *self.newest.borrow() + 1;
        kept.push_back(Event {
            number,
            topic,
            data: data.into(),
        });
        self.newest.send_replace(number);
    }

    /// The oldest event after a number that is still kept.
    pub fn after(&self, number: u64) -> Option<Event> {
        let kept = self.kept();
        let first = kept.partition_point(|event| event.number <= number);
        kept.get(first).cloned()
    }

    /// Tells of the newest number, which changes with every event.
    pub fn follow(&self) -> watch::Receiver<u64> {
        self.newest.subscribe()
    }

    /// Whether anybody follows.
    pub fn is_followed(&self) -> bool {
        self.newest.receiver_count() > 0
    }

    fn kept(&self) -> MutexGuard<'_, VecDeque<Event>> {
        lock(&self.kept)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn events_are_numbered_and_the_oldest_are_forgotten() {
        let events = Events::default();
        assert_eq!(events.after(0), None);
        for k in 0..600 {
            events.tell(Topic::State, &k);
        }
        let oldest = events.after(0).unwrap();
        assert_eq!((oldest.number, &*oldest.data), (89, "88"));
        assert_eq!(events.after(599).unwrap().number, 600);
        assert_eq!(events.after(600), None);
    }

    #[test]
    fn a_follower_is_woken() {
        let events = Events::default();
        assert!(!events.is_followed());
        let mut follower = events.follow();
        assert!(events.is_followed());
        events.tell(Topic::Loss, &"x");
        assert!(follower.has_changed().unwrap());
        assert_eq!(*follower.borrow_and_update(), 1);
    }
}
