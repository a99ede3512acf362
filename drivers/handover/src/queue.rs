//! A bounded queue from one thread to another in which nothing vanishes: what was put in is taken out, or told of as dropped.

use crate::sync::{AtomicBool, Receiver, Sender, bounded};
use crossbeam::channel::TrySendError;
use std::sync::{Arc, atomic::Ordering};

/// What a sender does when those who listen are slower.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum WhenFull {
    /// Waits: every frame of a recording is used, and results do not depend on the machine.
    #[default]
    Block,
    /// Drops and counts, so that the device never waits.
    Drop,
}

/// Called once for each value that was dropped.
type OnDropped = Arc<dyn Fn() + Send + Sync>;

/// The sending end, of which there is one.
pub struct QueueSender<T> {
    channel: Sender<T>,
    /// Takes out what makes way, and what nobody else will take out.
    own_end: Receiver<T>,
    when_full: WhenFull,
    is_heard: Arc<AtomicBool>,
    on_dropped: OnDropped,
}

/// The receiving end.
pub struct QueueReceiver<T> {
    channel: Receiver<T>,
    when_full: WhenFull,
    is_heard: Arc<AtomicBool>,
    on_dropped: OnDropped,
}

/// A queue of so many values. With [`WhenFull::Drop`] the oldest makes way for the newest.
pub fn queue<T>(
    capacity: usize,
    when_full: WhenFull,
    on_dropped: impl Fn() + Send + Sync + 'static,
) -> (QueueSender<T>, QueueReceiver<T>) {
    let (channel, own_end) = bounded(capacity);
    let is_heard = Arc::new(AtomicBool::new(true));
    let on_dropped: OnDropped = Arc::new(on_dropped);
    let receiver = QueueReceiver {
        channel: own_end.clone(),
        when_full,
        is_heard: is_heard.clone(),
        on_dropped: on_dropped.clone(),
    };
    let sender = QueueSender {
        channel,
        own_end,
        when_full,
        is_heard,
        on_dropped,
    };
    (sender, receiver)
}

impl<T> QueueSender<T> {
    /// Sends a value; false if nobody listens any more: it was taken by who then left, or dropped.
    pub fn send(&self, value: T) -> bool {
        match self.when_full {
            // There is always a receiver, our own. One that leaves makes room for this value.
            WhenFull::Block => drop(self.channel.send(value)),
            WhenFull::Drop => self.send_newest(value),
        }
        let is_heard = self.is_heard.load(Ordering::SeqCst);
        if !is_heard {
            self.own_end.try_iter().for_each(|_| (self.on_dropped)());
        }
        is_heard
    }

    /// Puts a value in, the oldest one out if there is no room.
    fn send_newest(&self, mut value: T) {
        while let Err(TrySendError::Full(refused)) = self.channel.try_send(value) {
            value = refused;
            if self.own_end.try_recv().is_ok() {
                (self.on_dropped)();
            }
        }
    }
}

impl<T> QueueReceiver<T> {
    /// The channel itself, to be waited for among others.
    pub fn channel(&self) -> &Receiver<T> {
        &self.channel
    }

    /// Of a value that was taken out and those that wait behind it the newest two, the older first; the others are dropped. Where
    /// nothing may be dropped, the value alone.
    pub fn newest_two(&self, value: T) -> impl Iterator<Item = T> {
        let (mut older, mut newest) = (None, value);
        if self.when_full == WhenFull::Drop {
            let n_waiting = self.channel.len();
            for newer in self.channel.try_iter().take(n_waiting) {
                let before = older.replace(std::mem::replace(&mut newest, newer));
                before.into_iter().for_each(|_| (self.on_dropped)());
            }
        }
        older.into_iter().chain([newest])
    }
}

impl<T> Drop for QueueReceiver<T> {
    fn drop(&mut self) {
        // In this order: what the sender puts in later it takes out itself.
        self.is_heard.store(false, Ordering::SeqCst);
        self.channel.try_iter().for_each(|_| (self.on_dropped)());
    }
}

#[cfg(test)]
mod tests;
