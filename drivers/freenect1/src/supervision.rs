//! What the device thread does and since when, so that a call that never returns is noticed from outside.
//!
//! libfreenect's control transfers have no time limit, and it asks again for as long as the answer is empty.

use std::{
    sync::atomic::{AtomicBool, AtomicU64, Ordering},
    time::{Duration, Instant},
};

/// A call that takes longer will not return: starting both streams takes a dozen control transfers of a millisecond each.
pub(crate) const CALL_LIMIT: Duration = Duration::from_secs(2);

/// How long opening may take: a device of the later models resets its audio part meanwhile, which takes a second.
pub(crate) const OPEN_LIMIT: Duration = Duration::from_secs(10);

/// What the device thread is inside of.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(u8)]
pub enum Activity {
    /// Looks for the device.
    Searching,
    /// Opens it and asks for its constants.
    Opening,
    /// Sets or reads the gain of IR.
    SettingGain,
    /// Starts depth.
    StartingDepth,
    /// Starts IR.
    StartingIr,
    /// Waits for packets.
    Streaming,
    /// Stops depth.
    StoppingDepth,
    /// Stops IR.
    StoppingIr,
    /// Closes the device.
    Closing,
}

impl Activity {
    const ALL: [Activity; 9] = [
        Activity::Searching,
        Activity::Opening,
        Activity::SettingGain,
        Activity::StartingDepth,
        Activity::StartingIr,
        Activity::Streaming,
        Activity::StoppingDepth,
        Activity::StoppingIr,
        Activity::Closing,
    ];

    /// In words, for a message.
    pub fn name(self) -> &'static str {
        match self {
            Activity::Searching => "looking for the device",
            Activity::Opening => "opening the device",
            Activity::SettingGain => "setting the IR gain",
            Activity::StartingDepth => "starting depth",
            Activity::StartingIr => "starting IR",
            Activity::Streaming => "taking packets",
            Activity::StoppingDepth => "stopping depth",
            Activity::StoppingIr => "stopping IR",
            Activity::Closing => "closing the device",
        }
    }
}

/// What the device thread says of itself, and others read.
#[derive(Debug)]
pub struct Heartbeat {
    epoch: Instant,
    /// Milliseconds since `epoch` above eight bits of [`Activity`].
    state: AtomicU64,
    /// Whether the device has gone or fallen silent, and does not stream again yet.
    is_returning: AtomicBool,
}

impl Heartbeat {
    /// A thread that begins now.
    pub fn new(activity: Activity) -> Self {
        Heartbeat {
            epoch: Instant::now(),
            state: AtomicU64::new(activity as u64),
            is_returning: AtomicBool::new(false),
        }
    }

    /// Tells that something is done from now on.
    pub fn enter(&self, activity: Activity) {
        let millis = self.epoch.elapsed().as_millis() as u64;
        self.state
            .store(millis << 8 | activity as u64, Ordering::Relaxed);
    }

    /// What is being done, and for how long.
    pub fn now(&self) -> (Activity, Duration) {
        let state = self.state.load(Ordering::Relaxed);
        let activity = Activity::ALL[(state & 0xff) as usize];
        let since = Duration::from_millis(state >> 8);
        (activity, self.epoch.elapsed().saturating_sub(since))
    }

    /// From now on the device is closed and opened again, which may take as long as opening it at first.
    pub fn begin_return(&self) {
        self.is_returning.store(true, Ordering::Relaxed);
    }

    /// The device streams.
    pub fn end_return(&self) {
        self.is_returning.store(false, Ordering::Relaxed);
    }

    /// What is being done, and for how long, if that is longer than it may take.
    pub fn overdue(&self) -> Option<(Activity, Duration)> {
        let limit = match self.is_returning.load(Ordering::Relaxed) {
            true => OPEN_LIMIT,
            false => CALL_LIMIT,
        };
        let (activity, since) = self.now();
        (since > limit).then_some((activity, since))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_done_and_since_when_is_read_back() {
        let heartbeat = Heartbeat::new(Activity::Opening);
        for activity in Activity::ALL {
            heartbeat.enter(activity);
            let (told, since) = heartbeat.now();
            assert_eq!(told, activity);
            assert!(since < Duration::from_secs(5));
        }
    }

    #[test]
    fn a_device_that_returns_is_given_the_time_of_an_opening() {
        let begun = |secs| Heartbeat {
            epoch: Instant::now() - Duration::from_secs(secs),
            ..Heartbeat::new(Activity::StartingIr)
        };
        let heartbeat = begun(4);
        let overdue = || heartbeat.overdue().map(|(activity, _)| activity);
        assert_eq!(overdue(), Some(Activity::StartingIr));
        heartbeat.begin_return();
        assert_eq!(overdue(), None);
        heartbeat.end_return();
        assert_eq!(overdue(), Some(Activity::StartingIr));
        let never = begun(60);
        never.begin_return();
        assert!(never.overdue().is_some());
    }
}
