//! How long a device may be silent, counted while somebody listens.
//!
//! libfreenect2 does not tell that a device has gone: its packets stop, or none of those that still come is good. While the process is
//! stopped, or its machine sleeps, nobody listens, and that nothing came meanwhile says nothing of the device.

use std::time::{Duration, Instant};

use super::{camera::LiveOptions, slot::Heard};

/// A turn takes 20 ms; where it took so much longer the process was stopped, or busy with something else.
const AWAY: Duration = Duration::from_millis(250);

/// The time with one stream, as its listener knows it.
#[derive(Clone, Copy, Debug)]
pub(super) struct Listening {
    /// When the stream began.
    since: Instant,
    /// Since when the process has not been stopped.
    awake_since: Instant,
    newest_turn: Instant,
}

impl Listening {
    /// A stream that begins at `now`.
    pub fn begin(now: Instant) -> Self {
        Listening {
            since: now,
            awake_since: now,
            newest_turn: now,
        }
    }

    /// Somebody listens at `now`.
    pub fn turn(&mut self, now: Instant) {
        if now.saturating_duration_since(self.newest_turn) > AWAY {
            self.awake_since = now;
        }
        self.newest_turn = now;
    }

    /// Whether the device counts as unplugged at `now`, by what was heard of it.
    pub fn is_gone(&self, now: Instant, heard: Heard, options: &LiveOptions) -> bool {
        let in_vain = |from: Instant| now.saturating_duration_since(from.max(self.awake_since));
        let of_stream = |time: Option<Instant>| time.filter(|time| *time >= self.since);
        let good = of_stream(heard.good);
        match of_stream(heard.any) {
            None => in_vain(self.since) >= options.first_packet_timeout,
            Some(any) if good == Some(any) => in_vain(any) >= options.max_silence,
            Some(any) => {
                in_vain(any) >= options.max_silence
                    || in_vain(good.unwrap_or(self.since)) >= options.max_without_good
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const TURN: Duration = Duration::from_millis(20);

    /// Listens in turns until nothing more is to be hoped for; how long that takes. `heard` says when the device was heard of last.
    fn secs_until_gone(
        listening: &mut Listening,
        from: Instant,
        heard: impl Fn(Instant) -> Heard,
    ) -> f64 {
        let options = LiveOptions::default();
        for n in 1..1000_u32 {
            let now = from + n * TURN;
            listening.turn(now);
            if listening.is_gone(now, heard(now), &options) {
                return (now - from).as_secs_f64();
            }
        }
        f64::INFINITY
    }

    fn last_heard(at: Instant) -> Heard {
        Heard {
            any: Some(at),
            good: Some(at),
        }
    }

    fn assert_close(secs: f64, expected_secs: f64) {
        let turn_secs = TURN.as_secs_f64();
        assert!((secs - expected_secs).abs() <= turn_secs, "{secs} s");
    }

    #[test]
    fn silence_counts_from_the_newest_packet_or_the_beginning() {
        let start = Instant::now();
        let nothing = |_| Heard::default();
        let secs = secs_until_gone(&mut Listening::begin(start), start, nothing);
        assert_close(secs, 3.0);
        // What came before it is of another stream.
        let before = |_| last_heard(start - TURN);
        let secs = secs_until_gone(&mut Listening::begin(start), start, before);
        assert_close(secs, 3.0);
        let once = |_| last_heard(start + 2 * TURN);
        let secs = secs_until_gone(&mut Listening::begin(start), start, once);
        assert_close(secs, 0.54);
        let secs = secs_until_gone(&mut Listening::begin(start), start, last_heard);
        assert_eq!(secs, f64::INFINITY);
    }

    #[test]
    fn packets_of_which_none_is_good_are_no_stream() {
        let start = Instant::now();
        let bad_since = |good: Option<Instant>| {
            move |now: Instant| Heard {
                any: Some(now),
                good,
            }
        };
        let secs = secs_until_gone(&mut Listening::begin(start), start, bad_since(None));
        assert_close(secs, 3.0);
        let good = Some(start + Duration::from_secs(1));
        let secs = secs_until_gone(&mut Listening::begin(start), start, bad_since(good));
        assert_close(secs, 4.0);
    }

    #[test]
    fn a_stopped_process_hears_nothing_of_a_device_that_is_there() {
        let start = Instant::now();
        let mut listening = Listening::begin(start);
        let heard = last_heard(start + TURN);
        let options = LiveOptions::default();
        listening.turn(start + TURN);
        // As long as it takes to be stopped and to go on.
        let awake = start + Duration::from_secs(20);
        listening.turn(awake);
        assert!(!listening.is_gone(awake, heard, &options));
        let secs = secs_until_gone(&mut listening, awake, |_| heard);
        assert_close(secs, 0.5);
    }
}
