//! What threads of the daemon meet on: the newest value of something ([`Slot`]), a queue in which nothing vanishes
//! ([`queue()`]), and the bell of a thread that waits for work ([`Bell`]).
//!
//! A crate of its own, because its unit tests run under a scheduler that tries the orders in which the threads may meet: all
//! locks and channels come from `sync`, which in these tests are the scheduler's. What it does not try is memory that
//! processors see in different orders: flags that matter are sequentially consistent.

mod bell;
mod queue;
mod slot;
mod sync;

pub use bell::Bell;
pub use queue::{QueueReceiver, QueueSender, WhenFull, queue};
pub use slot::Slot;

use std::sync::PoisonError;
use sync::{Mutex, MutexGuard};

/// Locks a value that is never left half changed: what a panic left behind is as good as any.
fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

/// Tries many orders in which the threads of a test may meet: any at all, and those with few, well placed interruptions. One in
/// which they wait for ever fails too.
#[cfg(test)]
fn in_many_orders(test: impl Fn() + Clone + Send + Sync + 'static) {
    const N_ORDERS: usize = 3000;
    const N_INTERRUPTIONS: usize = 3;
    shuttle::check_random(test.clone(), N_ORDERS);
    shuttle::check_pct(test, N_ORDERS, N_INTERRUPTIONS);
}
