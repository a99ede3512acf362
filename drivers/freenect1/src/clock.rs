//! The device's clock: 60 million ticks a second in 32 bits, over again after 71.6 s.
//!
//! The firmware stops the stamps of the IR stream while the depth stream is off, and a device that was plugged in anew starts
//! from anywhere. Device time goes on all the same: where ticks cannot be right, the host's clock says how much has passed.
//! The host's clock is used for nothing else here.

use std::time::Instant;

/// Ticks in a second.
pub const TICKS_PER_SEC: f64 = 60e6;

/// Ticks and host may disagree by so much between two stamps: frames wait for their packets and for a busy host.
const MAX_DISAGREEMENT_SECS: f64 = 0.25;

/// Device time without wraps, jumps and halts.
#[derive(Clone, Debug, Default)]
pub struct DeviceClock {
    newest: Option<Reading>,
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
    pub fn at(&mut self, ticks: u32, host: Instant) -> f64 {
        let Some(newest) = self.newest else {
            return self.keep(ticks, host, i64::from(ticks));
        };
        let by_host = ticks_between(newest.host, host);
        // Two stamps are never half a wrap apart where host and device agree; one may be a little older than the other.
        let by_ticks = i64::from(ticks.wrapping_sub(newest.ticks) as i32);
        let disagreement = (by_ticks - by_host).abs() as f64 / TICKS_PER_SEC;
        let passed = match disagreement <= MAX_DISAGREEMENT_SECS {
            true => by_ticks,
            false => by_host,
        };
        self.keep(ticks, host, newest.total + passed)
    }

    /// Device time at `host`, seconds, while stamps stand still.
    pub fn without_stamp(&mut self, host: Instant) -> f64 {
        let Some(newest) = self.newest else {
            return self.keep(0, host, 0);
        };
        (newest.total + ticks_between(newest.host, host)) as f64 / TICKS_PER_SEC
    }

    fn keep(&mut self, ticks: u32, host: Instant, total: i64) -> f64 {
        self.newest = Some(Reading { ticks, host, total });
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
