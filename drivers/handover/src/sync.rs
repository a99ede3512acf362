//! Locks, flags and channels, which in the unit tests are those of a scheduler that tries the orders in which threads may meet.

#[cfg(test)]
mod model;

#[cfg(not(test))]
pub use crossbeam::channel::{Receiver, Sender, bounded};
#[cfg(test)]
pub use model::{Receiver, Sender, bounded};
#[cfg(test)]
pub use shuttle::sync::{Condvar, Mutex, MutexGuard, atomic::AtomicBool};
#[cfg(not(test))]
pub use std::sync::{Condvar, Mutex, MutexGuard, atomic::AtomicBool};
