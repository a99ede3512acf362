//! Locks whose values are put whole.

use std::sync::{Mutex, MutexGuard, PoisonError};

/// Locks a value that is never left half changed: what a panic left behind is as good as any.
pub fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}
