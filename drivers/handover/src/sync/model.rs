//! What the tests put in the place of crossbeam's bounded channel, which no scheduler can look into: the same promises, by one
//! lock. A message is lost if the last receiver is dropped while it waits, as there.

use super::{Condvar, Mutex};
use crate::lock;
use crossbeam::channel::{RecvError, SendError, TryRecvError, TrySendError};
use std::{collections::VecDeque, iter, sync::Arc};

struct Channel<T> {
    state: Mutex<State<T>>,
    changed: Condvar,
    capacity: usize,
}

struct State<T> {
    waiting: VecDeque<T>,
    n_senders: usize,
    n_receivers: usize,
}

pub struct Sender<T>(Arc<Channel<T>>);

pub struct Receiver<T>(Arc<Channel<T>>);

pub fn bounded<T>(capacity: usize) -> (Sender<T>, Receiver<T>) {
    let channel = Arc::new(Channel {
        state: Mutex::new(State {
            waiting: VecDeque::new(),
            n_senders: 1,
            n_receivers: 1,
        }),
        changed: Condvar::new(),
        capacity,
    });
    (Sender(channel.clone()), Receiver(channel))
}

impl<T> Channel<T> {
    fn change<R>(&self, change: impl FnOnce(&mut State<T>) -> R) -> R {
        let changed = change(&mut lock(&self.state));
        self.changed.notify_all();
        changed
    }

    /// Tries until there is an answer.
    fn wait<R>(&self, mut attempt: impl FnMut(&mut State<T>) -> Option<R>) -> R {
        let mut state = lock(&self.state);
        loop {
            if let Some(answer) = attempt(&mut state) {
                drop(state);
                self.changed.notify_all();
                return answer;
            }
            state = self.changed.wait(state).unwrap();
        }
    }
}

impl<T> State<T> {
    fn put(&mut self, message: T, capacity: usize) -> Result<(), TrySendError<T>> {
        if self.n_receivers == 0 {
            return Err(TrySendError::Disconnected(message));
        }
        if self.waiting.len() == capacity {
            return Err(TrySendError::Full(message));
        }
        self.waiting.push_back(message);
        Ok(())
    }

    fn take(&mut self) -> Result<T, TryRecvError> {
        match self.waiting.pop_front() {
            Some(message) => Ok(message),
            None if self.n_senders == 0 => Err(TryRecvError::Disconnected),
            None => Err(TryRecvError::Empty),
        }
    }
}

impl<T> Sender<T> {
    pub fn try_send(&self, message: T) -> Result<(), TrySendError<T>> {
        let capacity = self.0.capacity;
        self.0.change(|state| state.put(message, capacity))
    }

    pub fn send(&self, message: T) -> Result<(), SendError<T>> {
        let mut held = Some(message);
        self.0
            .wait(|state| match state.put(held.take()?, self.0.capacity) {
                Ok(()) => Some(Ok(())),
                Err(TrySendError::Disconnected(message)) => Some(Err(SendError(message))),
                Err(TrySendError::Full(message)) => {
                    held = Some(message);
                    None
                }
            })
    }
}

impl<T> Receiver<T> {
    pub fn try_recv(&self) -> Result<T, TryRecvError> {
        self.0.change(State::take)
    }

    pub fn recv(&self) -> Result<T, RecvError> {
        self.0.wait(|state| match state.take() {
            Ok(message) => Some(Ok(message)),
            Err(TryRecvError::Disconnected) => Some(Err(RecvError)),
            Err(TryRecvError::Empty) => None,
        })
    }

    pub fn try_iter(&self) -> impl Iterator<Item = T> {
        iter::from_fn(|| self.try_recv().ok())
    }

    pub fn len(&self) -> usize {
        lock(&self.0.state).waiting.len()
    }
}

impl<T> Clone for Receiver<T> {
    fn clone(&self) -> Self {
        self.0.change(|state| state.n_receivers += 1);
        Receiver(self.0.clone())
    }
}

impl<T> Drop for Sender<T> {
    fn drop(&mut self) {
        self.0.change(|state| state.n_senders -= 1);
    }
}

impl<T> Drop for Receiver<T> {
    fn drop(&mut self) {
        let lost = self.0.change(|state| {
            state.n_receivers -= 1;
            match state.n_receivers {
                0 => std::mem::take(&mut state.waiting),
                _ => VecDeque::new(),
            }
        });
        drop(lost);
    }
}
