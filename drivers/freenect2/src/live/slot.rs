//! The one place between the library's thread and the camera's: the newest packet, and nothing older.
//!
//! A packet is copied once, out of the library's memory, and then changes hands by swapping buffers: one is being filled,
//! one is the newest, one is being decoded. The library's thread never waits for a decoder.

use std::{
    sync::PoisonError,
    time::{Duration, Instant},
};

use super::sync::{Condvar, Mutex, MutexGuard};
use crate::packet::PACKET_BYTES;

/// Seconds of one tick of the device's clock.
const TICK_SECS: f64 = 0.000_125;

/// After so many packets in a row, a second's, whose numbers are behind that of the last good one, the device has begun to number
/// anew; arbitrary.
const MAX_BEHIND: u32 = 30;

/// What became of the packets of a device, since the camera was opened.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct PacketCounts {
    /// Whole and in order.
    pub good: u64,
    /// Of these, replaced by a newer one before anybody took them.
    pub superseded: u64,
    /// Of the wrong length.
    pub truncated: u64,
    /// Called damaged by the library.
    pub damaged: u64,
    /// With the number of one that came before.
    pub out_of_order: u64,
    /// Never seen: gaps in the numbers.
    pub lost: u64,
}

impl PacketCounts {
    /// Frames that nobody got: packets that were replaced, and gaps in the numbers, which bad packets leave too.
    pub fn n_missed(&self) -> u64 {
        self.superseded + self.lost
    }
}

/// When a device was heard of last.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(super) struct Heard {
    /// Be it by a bad packet.
    pub any: Option<Instant>,
    /// By a good one.
    pub good: Option<Instant>,
}

/// A packet as the library hands it on.
#[derive(Clone, Copy, Debug)]
pub(super) struct Incoming<'a> {
    pub bytes: &'a [u8],
    /// Device clock, ticks; wraps.
    pub timestamp: u32,
    pub sequence: u32,
    pub status: u32,
}

/// A packet with its place in the stream.
#[derive(Clone, Debug)]
pub(super) struct Stamped {
    pub bytes: Vec<u8>,
    /// Counts packets from the first, lost ones too.
    pub position: u64,
    pub device_time_secs: f64,
    pub host_time: Instant,
}

impl Stamped {
    /// Memory for a packet.
    pub fn empty() -> Self {
        Stamped {
            bytes: vec![0; PACKET_BYTES],
            position: 0,
            device_time_secs: 0.0,
            host_time: Instant::now(),
        }
    }
}

/// The newest packet of a device.
#[derive(Debug)]
pub(super) struct PacketSlot {
    state: Mutex<State>,
    arrived: Condvar,
    /// Only the library's thread has this.
    filling: Mutex<Stamped>,
}

#[derive(Debug)]
struct State {
    newest: Stamped,
    fresh: bool,
    /// The last good packet's sequence and timestamp; `None` before the first of a stream.
    last: Option<(u32, u32)>,
    /// Position and time of the last good packet, over all streams.
    position: Option<u64>,
    device_time_secs: f64,
    heard: Heard,
    /// Packets since the last good one whose numbers are behind its number.
    n_behind: u32,
    counts: PacketCounts,
}

fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

impl PacketSlot {
    pub fn new() -> Self {
        PacketSlot {
            state: Mutex::new(State {
                newest: Stamped::empty(),
                fresh: false,
                last: None,
                position: None,
                device_time_secs: 0.0,
                heard: Heard::default(),
                n_behind: 0,
                counts: PacketCounts::default(),
            }),
            arrived: Condvar::new(),
            filling: Mutex::new(Stamped::empty()),
        }
    }

    /// Takes a packet from the library's thread: the only copy on a packet's way.
    pub fn offer(&self, packet: Incoming<'_>) {
        let host_time = Instant::now();
        let mut filling = lock(&self.filling);
        let Some((position, device_time_secs)) = lock(&self.state).admit(packet, host_time) else {
            return;
        };
        filling.bytes.copy_from_slice(packet.bytes);
        filling.position = position;
        filling.device_time_secs = device_time_secs;
        filling.host_time = host_time;
        let mut state = lock(&self.state);
        std::mem::swap(&mut state.newest, &mut *filling);
        state.counts.superseded += u64::from(state.fresh);
        state.fresh = true;
        drop(state);
        self.arrived.notify_one();
    }

    /// Waits until `deadline` for a packet that was not taken yet, and swaps it for `mine`.
    pub fn take(&self, mine: &mut Stamped, deadline: Instant) -> bool {
        let mut state = lock(&self.state);
        while !state.fresh {
            let remaining = deadline.saturating_duration_since(Instant::now());
            if remaining == Duration::ZERO {
                return false;
            }
            let waited = self.arrived.wait_timeout(state, remaining);
            state = waited.unwrap_or_else(PoisonError::into_inner).0;
        }
        std::mem::swap(&mut state.newest, mine);
        state.fresh = false;
        true
    }

    /// When the device was heard of last, over all streams.
    pub fn heard(&self) -> Heard {
        lock(&self.state).heard
    }

    pub fn counts(&self) -> PacketCounts {
        lock(&self.state).counts
    }

    /// Prepares for a stream that begins anew, with numbers and a clock of its own.
    pub fn begin_stream(&self) {
        let mut state = lock(&self.state);
        state.last = None;
        state.n_behind = 0;
        state.fresh = false;
    }
}

impl State {
    /// Judges a packet and gives a good one its place and time.
    fn admit(&mut self, packet: Incoming<'_>, host_time: Instant) -> Option<(u64, f64)> {
        self.heard.any = Some(host_time);
        if packet.bytes.len() != PACKET_BYTES {
            self.counts.truncated += 1;
            return None;
        }
        if packet.status != 0 {
            self.counts.damaged += 1;
            return None;
        }
        let (steps, elapsed_secs) = match self.last {
            Some((sequence, timestamp)) => {
                let steps = packet.sequence.wrapping_sub(sequence);
                if steps == 0 || steps > u32::MAX / 2 {
                    self.out_of_order(steps);
                    return None;
                }
                let ticks = packet.timestamp.wrapping_sub(timestamp);
                (steps, f64::from(ticks) * TICK_SECS)
            }
            // The device's clock begins anew with a stream; it goes on from the last good packet by this machine's.
            None => {
                let last = self.heard.good.unwrap_or(host_time);
                (1, (host_time - last).as_secs_f64().max(TICK_SECS))
            }
        };
        self.counts.lost += u64::from(steps - 1);
        self.counts.good += 1;
        self.heard.good = Some(host_time);
        self.n_behind = 0;
        self.last = Some((packet.sequence, packet.timestamp));
        let position = self.position.map_or(0, |last| last + u64::from(steps));
        if self.position.is_some() {
            self.device_time_secs += elapsed_secs;
        } else {
            self.device_time_secs = f64::from(packet.timestamp) * TICK_SECS;
        }
        self.position = Some(position);
        Some((position, self.device_time_secs))
    }

    /// Counts a packet whose number is so many steps from the last good one's, modulo all numbers: none, or backwards.
    fn out_of_order(&mut self, steps: u32) {
        self.counts.out_of_order += 1;
        // One number over and over is no stream.
        self.n_behind += u32::from(steps != 0);
        if self.n_behind >= MAX_BEHIND {
            self.last = None;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use shuttle::{check_random, thread};
    use std::sync::Arc;

    /// Orders that are tried; a packet has 3 MB.
    const N_ORDERS: usize = 200;

    fn offer(slot: &PacketSlot, bytes: &[u8], timestamp: u32, sequence: u32) {
        slot.offer(Incoming {
            bytes,
            timestamp,
            sequence,
            status: 0,
        });
    }

    /// Tries many orders in which the threads of a test may meet; one in which they wait for ever fails too.
    fn in_many_orders(test: impl Fn() + Send + Sync + 'static) {
        check_random(test, N_ORDERS);
    }

    /// Offers packets of these numbers, filled with them, as the library's thread does.
    fn offering(slot: &Arc<PacketSlot>, numbers: std::ops::Range<u32>) -> thread::JoinHandle<()> {
        let slot = slot.clone();
        thread::spawn(move || {
            let mut bytes = vec![0; PACKET_BYTES];
            for number in numbers {
                bytes.fill(number as u8);
                offer(&slot, &bytes, number, number);
            }
        })
    }

    /// Takes packets until that of a position, which comes last; how many these are.
    fn take_until(slot: &PacketSlot, last: u64) -> u64 {
        let patience = Instant::now() + Duration::from_secs(3600);
        let (mut mine, mut n_taken, mut before) = (Stamped::empty(), 0, None);
        while before != Some(last) {
            assert!(slot.take(&mut mine, patience));
            let number = mine.position as u8;
            let ends = [mine.bytes[0], mine.bytes[PACKET_BYTES - 1]];
            assert_eq!(ends, [number, number], "whole, and of its place");
            assert!(Some(mine.position) > before, "newer than the one before");
            before = Some(mine.position);
            n_taken += 1;
        }
        n_taken
    }

    #[test]
    fn the_last_packet_is_always_taken_and_the_others_are_taken_or_counted() {
        in_many_orders(|| {
            let slot = Arc::new(PacketSlot::new());
            let library = offering(&slot, 0..4);
            let n_taken = take_until(&slot, 3);
            library.join().unwrap();
            let counts = slot.counts();
            assert_eq!((counts.good, counts.lost), (4, 0));
            assert_eq!(n_taken + counts.superseded, 4);
        });
    }

    #[test]
    fn positions_rise_over_a_stream_that_begins_anew() {
        in_many_orders(|| {
            let slot = Arc::new(PacketSlot::new());
            let camera = slot.clone();
            let taking = thread::spawn(move || take_until(&camera, 3));
            offering(&slot, 0..2).join().unwrap();
            slot.begin_stream();
            // The device's numbers begin anew; what they fill is told by the place.
            let mut bytes = vec![0; PACKET_BYTES];
            for (sequence, place) in [(0, 2), (1, 3)] {
                bytes.fill(place);
                offer(&slot, &bytes, sequence, sequence);
            }
            taking.join().unwrap();
            assert_eq!(slot.counts().out_of_order, 0);
        });
    }

    #[test]
    fn numbers_and_clock_go_on_over_their_wrap() {
        check_random(wraps, 1);
    }

    fn wraps() {
        let (slot, bytes) = (PacketSlot::new(), vec![1; PACKET_BYTES]);
        let mut mine = Stamped::empty();
        offer(&slot, &bytes, u32::MAX - 7, u32::MAX);
        assert!(slot.take(&mut mine, Instant::now()));
        let start_secs = mine.device_time_secs;
        offer(&slot, &bytes, 258, 1);
        assert!(slot.take(&mut mine, Instant::now()));
        assert_eq!(mine.position, 2);
        assert!((mine.device_time_secs - start_secs - 266.0 * TICK_SECS).abs() < 1e-9);
        assert_eq!(slot.counts().lost, 1);
        assert!(!slot.take(&mut mine, Instant::now()));
    }

    #[test]
    fn a_device_that_numbers_anew_is_believed_after_a_while() {
        check_random(numbers_anew, 1);
    }

    fn numbers_anew() {
        let (slot, bytes) = (PacketSlot::new(), vec![1; PACKET_BYTES]);
        let mut mine = Stamped::empty();
        let mut taken = |numbers: &mut dyn Iterator<Item = u32>| {
            let mut positions = Vec::new();
            for number in numbers {
                offer(&slot, &bytes, 266 * number, number);
                if slot.take(&mut mine, Instant::now()) {
                    positions.push((mine.position, mine.device_time_secs));
                }
            }
            positions
        };
        let first = taken(&mut [1000].into_iter());
        // One that is in order between them, and the others are late, that is all.
        let in_order = taken(&mut (0..MAX_BEHIND - 1).chain([1001]));
        assert_eq!((first[0].0, in_order.len(), in_order[0].0), (0, 1, 1));
        let anew = taken(&mut (0..MAX_BEHIND + 2));
        assert_eq!(anew.iter().map(|(n, _)| *n).collect::<Vec<_>>(), [2, 3]);
        assert!(anew[0].1 > in_order[0].1, "device time goes on");
        assert!((anew[1].1 - anew[0].1 - 266.0 * TICK_SECS).abs() < 1e-9);
        // One number over and over is no reason to begin anew.
        assert!(taken(&mut [MAX_BEHIND + 1; 100].into_iter().chain([5])).is_empty());
        let n_refused = u64::from(2 * MAX_BEHIND - 1 + 101);
        assert_eq!(slot.counts().out_of_order, n_refused);
        assert_eq!(slot.counts().lost, 0);
    }

    #[test]
    fn only_the_newest_is_kept_and_buffers_change_hands() {
        check_random(changes_hands, 1);
    }

    fn changes_hands() {
        let slot = PacketSlot::new();
        let mut mine = Stamped::empty();
        let buffer = mine.bytes.as_ptr();
        for sequence in 0..5 {
            offer(
                &slot,
                &vec![sequence as u8; PACKET_BYTES],
                sequence,
                sequence,
            );
        }
        assert!(slot.take(&mut mine, Instant::now()));
        assert_eq!((mine.bytes[0], mine.position), (4, 4));
        assert_eq!(slot.counts().superseded, 4);
        assert_eq!(slot.counts().lost, 0);
        // Nothing is copied on this side: the buffer handed in is the one that the slot goes on with.
        assert_eq!(lock(&slot.state).newest.bytes.as_ptr(), buffer);
    }
}
