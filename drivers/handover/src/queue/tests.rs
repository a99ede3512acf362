//! A device and those who listen, in many orders. That every value is either taken or told of as dropped is asked in each.

use super::*;
use crate::{in_many_orders, sync::Mutex};
use shuttle::thread::{self, JoinHandle};

const CAPACITY: usize = 2;
const N_VALUES: u32 = 5;

/// How many values were dropped.
#[derive(Clone, Default)]
struct Dropped(Arc<Mutex<u32>>);

impl Dropped {
    fn get(&self) -> u32 {
        *self.0.lock().unwrap()
    }
}

fn counted(when_full: WhenFull) -> (QueueSender<u32>, QueueReceiver<u32>, Dropped) {
    let dropped = Dropped::default();
    let counter = dropped.clone();
    let on_dropped = move || *counter.0.lock().unwrap() += 1;
    let (sender, receiver) = queue(CAPACITY, when_full, on_dropped);
    (sender, receiver, dropped)
}

/// Sends values as the device thread does: until it is told to stop or nobody wants them. Returns how many, and whether
/// somebody listened to the last.
fn device(sender: QueueSender<u32>, stop: Arc<AtomicBool>) -> JoinHandle<(u32, bool)> {
    thread::spawn(move || {
        for value in 0..N_VALUES {
            if stop.load(Ordering::SeqCst) {
                return (value, true);
            }
            if !sender.send(value) {
                return (value + 1, false);
            }
        }
        (N_VALUES, true)
    })
}

fn never() -> Arc<AtomicBool> {
    Arc::new(AtomicBool::new(false))
}

/// Takes all values out until the sender is gone; they come in their order.
fn take_all(receiver: &QueueReceiver<u32>) -> Vec<u32> {
    let mut taken = Vec::new();
    while let Ok(value) = receiver.channel().recv() {
        assert!(taken.last().is_none_or(|last| *last < value), "in order");
        taken.push(value);
    }
    taken
}

#[test]
fn the_newest_is_always_taken_and_the_others_are_taken_or_dropped() {
    in_many_orders(|| {
        let (sender, receiver, dropped) = counted(WhenFull::Drop);
        let device = device(sender, never());
        let taken = take_all(&receiver);
        assert_eq!(device.join().unwrap(), (N_VALUES, true));
        assert_eq!(taken.last(), Some(&(N_VALUES - 1)));
        assert_eq!(taken.len() as u32 + dropped.get(), N_VALUES);
    });
}

#[test]
fn where_the_sender_waits_nothing_is_dropped() {
    in_many_orders(|| {
        let (sender, receiver, dropped) = counted(WhenFull::Block);
        let device = device(sender, never());
        assert_eq!(take_all(&receiver), (0..N_VALUES).collect::<Vec<_>>());
        assert_eq!(device.join().unwrap(), (N_VALUES, true));
        assert_eq!(dropped.get(), 0);
    });
}

#[test]
fn of_what_waits_the_newest_two_are_taken_while_more_comes() {
    in_many_orders(|| {
        let (sender, receiver, dropped) = counted(WhenFull::Drop);
        let device = device(sender, never());
        let mut taken = Vec::new();
        while let Ok(value) = receiver.channel().recv() {
            taken.extend(receiver.newest_two(value));
        }
        device.join().unwrap();
        assert!(taken.is_sorted_by(|a, b| a < b), "{taken:?}");
        assert_eq!(taken.last(), Some(&(N_VALUES - 1)));
        assert_eq!(taken.len() as u32 + dropped.get(), N_VALUES);
    });
}

/// The listener takes `n_taken` values at most and leaves, as a thread that panics does.
fn left_after(n_taken: u32, when_full: WhenFull) {
    let (sender, receiver, dropped) = counted(when_full);
    let device = device(sender, never());
    let taken = (0..n_taken).map_while(|_| receiver.channel().recv().ok());
    let n_taken = taken.count() as u32;
    drop(receiver);
    let (n_sent, _) = device.join().unwrap();
    assert_eq!(n_taken + dropped.get(), n_sent);
}

#[test]
fn a_listener_that_leaves_frees_the_sender_and_nothing_vanishes() {
    for when_full in [WhenFull::Block, WhenFull::Drop] {
        for n_taken in 0..3 {
            in_many_orders(move || left_after(n_taken, when_full));
        }
    }
}

#[test]
fn a_stop_ends_a_sender_that_waits_for_room_and_what_is_under_way_is_taken() {
    for when_full in [WhenFull::Block, WhenFull::Drop] {
        in_many_orders(move || {
            let (sender, receiver, dropped) = counted(when_full);
            let stop = never();
            let device = device(sender, stop.clone());
            let stopping = thread::spawn(move || stop.store(true, Ordering::SeqCst));
            let taken = take_all(&receiver);
            stopping.join().unwrap();
            let (n_sent, was_heard) = device.join().unwrap();
            assert!(was_heard);
            assert_eq!(taken.last().copied(), n_sent.checked_sub(1), "the newest");
            assert_eq!(taken.len() as u32 + dropped.get(), n_sent);
        });
    }
}
