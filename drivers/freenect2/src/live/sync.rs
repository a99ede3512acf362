//! Locks, which in the unit tests are those of a scheduler that tries the orders in which threads may meet.

#[cfg(test)]
pub use shuttle::sync::{Condvar, Mutex, MutexGuard};
#[cfg(not(test))]
pub use std::sync::{Condvar, Mutex, MutexGuard};
