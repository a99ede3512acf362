//! One stream of frames from a device that went away and came back: its numbers and its clock may begin anew.

use depth_camera::Frame;
use std::time::Instant;

/// A device's clock that says this much more than has passed here, seconds, is another clock than before; arbitrary.
const MAX_AHEAD_SECS: f64 = 5.0;

/// Carries numbers and times on over gaps.
#[derive(Debug, Default)]
pub(super) struct Continuity {
    /// Added to the device's own.
    n_before: u64,
    offset_secs: f64,
    /// Number, time (s) and arrival of the last frame, as handed on.
    last: Option<(u64, f64, Instant)>,
    is_after_gap: bool,
}

impl Continuity {
    /// The stream has stopped: the next frame may be of another one.
    pub(super) fn interrupt(&mut self) {
        self.is_after_gap = true;
    }

    /// The number of a frame in the whole stream.
    pub(super) fn number(&self, frame_id: u64) -> u64 {
        frame_id + self.n_before
    }

    /// The frame as one of the whole stream; without gaps that is the frame as it is.
    pub(super) fn carry_on(&mut self, mut frame: Frame) -> Frame {
        if let Some(last) = self.last.filter(|_| self.is_after_gap) {
            self.join(&frame, last);
        }
        self.is_after_gap = false;
        frame.frame_id += self.n_before;
        frame.device_time_secs += self.offset_secs;
        self.last = Some((frame.frame_id, frame.device_time_secs, frame.host_time));
        frame
    }

    fn join(&mut self, frame: &Frame, (last_id, last_secs, last_host): (u64, f64, Instant)) {
        if self.number(frame.frame_id) <= last_id {
            self.n_before = last_id + 1 - frame.frame_id;
        }
        let passed = frame.host_time.saturating_duration_since(last_host);
        let passed_secs = passed.as_secs_f64();
        let told_secs = frame.device_time_secs + self.offset_secs - last_secs;
        if !(told_secs > 0.0 && told_secs < passed_secs + MAX_AHEAD_SECS) {
            self.offset_secs = last_secs + passed_secs - frame.device_time_secs;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::time::Duration;

    fn frame(frame_id: u64, device_time_secs: f64, host_time: Instant) -> Frame {
        Frame {
            frame_id,
            device_time_secs,
            host_time,
            depth: None,
            ir: None,
        }
    }

    #[test]
    fn a_device_that_begins_anew_carries_on() {
        let start = Instant::now();
        let at = |secs: f64| start + Duration::from_secs_f64(secs);
        let mut stream = Continuity::default();
        let told = |stream: &mut Continuity, id: u64, device_secs: f64, host_secs: f64| {
            let frame = stream.carry_on(frame(id, device_secs, at(host_secs)));
            (frame.frame_id, frame.device_time_secs)
        };
        assert_eq!(told(&mut stream, 7, 100.0, 0.0), (7, 100.0));
        // Without a gap nothing is touched, whatever the device says.
        assert_eq!(told(&mut stream, 9, 100.5, 0.1), (9, 100.5));
        stream.interrupt();
        // The same clock, three seconds later.
        assert_eq!(told(&mut stream, 10, 103.5, 3.1), (10, 103.5));
        stream.interrupt();
        // A new clock and new numbers.
        let (id, secs) = told(&mut stream, 0, 0.25, 5.1);
        assert_eq!(id, 11);
        assert!((secs - 105.5).abs() < 1e-9, "{secs}");
        let (id, secs) = told(&mut stream, 3, 0.35, 5.2);
        assert_eq!((id, stream.number(4)), (14, 15));
        assert!((secs - 105.6).abs() < 1e-9, "{secs}");
    }
}
