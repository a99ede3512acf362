//! The device's clock: 60 million ticks a second in 32 bits, over again after 71.6 s.
//!
//! The firmware stops the stamps of the IR stream while the depth stream is off, and a device that was plugged in anew starts
//! from anywhere. Device time goes on all the same: where ticks cannot be right, the host's clock says how much has passed.
//! The host's clock is used for nothing else here: an image was taken before it arrived, and after a stall of the host one arrives long
//! after it was taken, with the next one, taken after the stall, at once behind it.

use std::time::Instant;

/// Ticks in a second.
pub const TICKS_PER_SEC: f64 = 60e6;

/// A stamp may be so much older than the newest one, or newer than the host's clock says: the two streams' images come in either order,
/// and the punctual one waited for its packets too. A quarter of a second, arbitrary.
const TOLERANCE_TICKS: i64 = 15_000_000;

/// The two clocks run apart by no more than one part in so many: a millisecond a second.
const DRIFT: i64 = 1000;

/// Device time without wraps, jumps and halts.
#[derive(Clone, Debug, Default)]
pub struct DeviceClock {
    newest: Option<Reading>,
    /// The last one whose image came as soon as any: by it the host's clock says what time it is on the device. `None`
    /// until the first stamp of a device that was opened anew.
    punctual: Option<Reading>,
}

#[derive(Clone, Copy, Debug)]
struct Reading {
    ticks: u32,
    host: Instant,
    /// Ticks without wraps.
    total: i64,
}

impl DeviceClock {
    /// Device time of a stamp that was read at `host`, seconds.
    ///
    /// An image cannot have been taken after it arrived, nor, but for the other stream's, before one that came earlier. Between the two
    /// its stamp is right, however late it comes.
    pub fn at(&mut self, ticks: u32, host: Instant) -> f64 {
        let (newest, punctual) = match (self.newest, self.punctual) {
            (None, _) => return self.keep_punctual(ticks, host, i64::from(ticks)),
            (Some(newest), None) => {
                let total = newest.total + ticks_between(newest.host, host);
                return self.keep_punctual(ticks, host, total);
            }
            (Some(newest), Some(punctual)) => (newest, punctual),
        };
        let by_host = ticks_between(punctual.host, host);
        let by_ticks = i64::from(ticks.wrapping_sub(punctual.ticks));
        // With the number of wraps that makes it the least.
        let late = i64::from((by_host - by_ticks) as i32);
        let total = punctual.total + by_host - late;
        let is_possible = late >= -TOLERANCE_TICKS && total >= newest.total - TOLERANCE_TICKS;
        match is_possible {
            true if late <= by_host / DRIFT => self.keep_punctual(ticks, host, total),
            true => self.keep(ticks, host, total),
            false => self.keep_punctual(ticks, host, punctual.total + by_host),
        }
    }

    /// The device was opened anew, and its stamps begin anywhere: device time goes on by the host's clock.
    pub fn restart(&mut self) {
        self.punctual = None;
    }

    /// Device time at `host`, seconds, while stamps stand still.
    pub fn without_stamp(&mut self, host: Instant) -> f64 {
        let Some(newest) = self.newest else {
            return self.keep_punctual(0, host, 0);
        };
        let total = newest.total + ticks_between(newest.host, host);
        self.keep(newest.ticks, host, total)
    }

    fn keep_punctual(&mut self, ticks: u32, host: Instant, total: i64) -> f64 {
        self.punctual = Some(Reading { ticks, host, total });
        self.keep(ticks, host, total)
    }

    fn keep(&mut self, ticks: u32, host: Instant, total: i64) -> f64 {
        if self.newest.is_none_or(|newest| newest.total <= total) {
            self.newest = Some(Reading { ticks, host, total });
        }
        total as f64 / TICKS_PER_SEC
    }
}

fn ticks_between(from: Instant, to: Instant) -> i64 {
    let secs = match to.checked_duration_since(from) {
        Some(later) => later.as_secs_f64(),
        None => -(from - to).as_secs_f64(),
    };
    (secs * TICKS_PER_SEC).round() as i64
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::time::Duration;

    fn assert_close(secs: f64, expected: f64) {
        assert!(
            (secs - expected).abs() < 1e-6,
            "{secs} instead of {expected}"
        );
    }

    #[test]
    fn time_goes_on_over_the_wrap() {
        let start = Instant::now();
        let mut clock = DeviceClock::default();
        let mut ticks = u32::MAX - 3_000_000;
        let first = clock.at(ticks, start);
        for frame in 1..10 {
            ticks = ticks.wrapping_add(2_000_000);
            // The host is late by up to 8 ms.
            let host = start + Duration::from_micros(33_333 * frame + 1000 * (frame % 8));
            assert_close(clock.at(ticks, host) - first, frame as f64 / 30.0);
        }
        assert!(ticks < u32::MAX / 2);
    }

    #[test]
    fn stamps_of_a_device_that_was_opened_anew_are_not_those_of_before() {
        let start = Instant::now();
        let mut clock = DeviceClock::default();
        let first = clock.at(5_000_000, start);
        clock.restart();
        // Taken for the old clock's it would have been held back for a second.
        let later = clock.at(5_000_000, start + Duration::from_millis(1100));
        assert_close(later - first, 1.1);
    }

    #[test]
    fn a_stamp_a_little_older_than_the_newest_goes_back_a_little() {
        let start = Instant::now();
        let mut clock = DeviceClock::default();
        let first = clock.at(10, start);
        let older = clock.at(
            10_u32.wrapping_sub(600_000),
            start + Duration::from_millis(2),
        );
        assert_close(older - first, -0.01);
    }

    #[test]
    fn stamps_that_go_back_step_by_step_are_not_followed() {
        let start = Instant::now();
        let mut clock = DeviceClock::default();
        let first = clock.at(60_000_000, start);
        for (millis, ticks, expected) in [(10, 48_000_000, -0.2), (20, 36_000_000, 0.02)] {
            let host = start + Duration::from_millis(millis);
            assert_close(clock.at(ticks, host) - first, expected);
        }
    }

    #[test]
    fn an_image_that_a_stall_of_the_host_held_back_keeps_its_own_time() {
        let start = Instant::now();
        let at = |millis| start + Duration::from_millis(millis);
        let ticks = |millis: u64| (u32::MAX - 1_000_000).wrapping_add((60_000 * millis) as u32);
        for stall in [450, 1900, 20_000] {
            let mut clock = DeviceClock::default();
            let first = clock.at(ticks(0), at(0));
            // Taken before the stall and read after it, and at once behind it one that was taken meanwhile.
            let held_back = (33, 33 + stall);
            let next = (33 + stall, 35 + stall);
            for (taken, read) in [held_back, next, (66 + stall, 67 + stall)] {
                let time = clock.at(ticks(taken), at(read)) - first;
                assert_close(time, 1e-3 * taken as f64);
            }
        }
    }

    #[test]
    fn the_host_bridges_pauses_and_new_clocks() {
        let start = Instant::now();
        let mut clock = DeviceClock::default();
        let first = clock.at(1_000_000, start);
        let after_pause = start + Duration::from_secs(100);
        // 100 s are 1.4 wraps; the ticks alone would say 28.4 s.
        let ticks = 1_000_000_u32.wrapping_add((100_u64 * 60_000_000) as u32);
        assert_close(clock.at(ticks, after_pause) - first, 100.0);
        let replugged = after_pause + Duration::from_secs(3);
        assert_close(clock.at(77, replugged) - first, 103.0);
        let next = clock.at(77 + 2_000_000, replugged + Duration::from_millis(35));
        assert_close(next - first, 103.0 + 1.0 / 30.0);
    }

    #[test]
    fn while_stamps_stand_still_the_host_tells_the_time() {
        let start = Instant::now();
        let mut clock = DeviceClock::default();
        let first = clock.at(60_000_000, start);
        assert_close(first, 1.0);
        let later = start + Duration::from_millis(500);
        assert_close(clock.without_stamp(later), 1.5);
        assert_close(clock.without_stamp(later), 1.5);
        let mut unset = DeviceClock::default();
        assert_close(unset.without_stamp(start), 0.0);
        assert_close(unset.without_stamp(later), 0.5);
    }
}
