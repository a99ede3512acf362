//! Depth and IR images of one exposure, which arrive one after the other.
//!
//! While both streams run, images belong together whose stamps lie within half a frame. The stamps of IR stand still while depth
//! is off and until its first image is there, and what comes then has no counterpart. Where they stand still for good, arrival
//! decides, by the host's clock.

use std::time::{Duration, Instant};

/// Half of a frame at 30 Hz, ticks.
const HALF_FRAME_TICKS: i32 = 1_000_000;

/// Half of a frame at 30 Hz.
const HALF_FRAME: Duration = Duration::from_micros(16_667);

/// When an image was taken, as far as is known.
#[derive(Clone, Copy, Debug)]
pub struct Stamp {
    /// When it had arrived.
    pub host: Instant,
    /// The device's stamp; `None` where it stands still.
    pub ticks: Option<u32>,
}

impl Stamp {
    /// Whether both are of one exposure.
    fn matches(&self, other: &Stamp) -> bool {
        match (self.ticks, other.ticks) {
            (Some(a), Some(b)) => {
                (a.wrapping_sub(b) as i32).unsigned_abs() <= HALF_FRAME_TICKS as u32
            }
            _ => self.host.max(other.host) - self.host.min(other.host) <= HALF_FRAME,
        }
    }
}

/// What belongs to one moment.
#[derive(Clone, Debug, PartialEq)]
pub enum Moment<T> {
    /// Depth and IR.
    Both(T, T),
    /// Depth, whose IR did not come or is not asked for.
    Depth(T),
    /// IR, whose depth did not come or is not asked for.
    Ir(T),
}

/// Moments that are complete now, in order.
pub type Complete<T> = [Option<Moment<T>>; 2];

/// Which streams run.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Running {
    /// Depth and IR: an image waits for its counterpart.
    Both,
    /// One of them, or none: no image waits.
    One,
}

/// Images that wait for their counterpart, one of each stream at most.
#[derive(Clone, Debug)]
pub struct Pairing<T> {
    running: Running,
    depth: Option<(Stamp, T)>,
    ir: Option<(Stamp, T)>,
}

impl<T> Pairing<T> {
    /// Nothing waits yet.
    pub fn new(running: Running) -> Self {
        Pairing {
            running,
            depth: None,
            ir: None,
        }
    }

    /// From now on other streams run; returns what waited.
    pub fn set_running(&mut self, running: Running) -> Complete<T> {
        self.running = running;
        let ir = self.ir.take().map(|(_, ir)| Moment::Ir(ir));
        let depth = self.depth.take().map(|(_, depth)| Moment::Depth(depth));
        [ir, depth]
    }

    /// A depth image has come.
    pub fn depth(&mut self, stamp: Stamp, depth: T) -> Complete<T> {
        if self.running == Running::One {
            return [Some(Moment::Depth(depth)), None];
        }
        let alone = self.depth.take().map(|(_, alone)| Moment::Depth(alone));
        match self.ir.take() {
            Some((at, ir)) if at.matches(&stamp) => [alone, Some(Moment::Both(depth, ir))],
            older => {
                self.depth = Some((stamp, depth));
                [alone, older.map(|(_, ir)| Moment::Ir(ir))]
            }
        }
    }

    /// An IR image has come.
    pub fn ir(&mut self, stamp: Stamp, ir: T) -> Complete<T> {
        if self.running == Running::One {
            return [Some(Moment::Ir(ir)), None];
        }
        let alone = self.ir.take().map(|(_, alone)| Moment::Ir(alone));
        match self.depth.take() {
            Some((at, depth)) if at.matches(&stamp) => [alone, Some(Moment::Both(depth, ir))],
            older => {
                self.ir = Some((stamp, ir));
                [alone, older.map(|(_, depth)| Moment::Depth(depth))]
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use Moment::{Both, Depth, Ir};

    /// A stamp of frame `frame`, which arrives `late_ms` after it was taken.
    fn stamp(start: Instant, frame: u32, late_ms: u64) -> Stamp {
        Stamp {
            host: start + Duration::from_micros(33_333 * u64::from(frame) + 1000 * late_ms),
            ticks: Some((u32::MAX - 1_000_000).wrapping_add(2_000_000 * frame)),
        }
    }

    fn frozen(stamp: Stamp) -> Stamp {
        Stamp {
            ticks: None,
            ..stamp
        }
    }

    #[test]
    fn stamps_pair_images_in_either_order_and_over_the_wrap() {
        let start = Instant::now();
        let mut pairing = Pairing::new(Running::Both);
        let mut moments = Vec::new();
        for frame in 0..4 {
            // The host is late by a whole frame and a half, which ticks do not mind.
            let (depth, ir) = (stamp(start, frame, 50), stamp(start, frame, 0));
            if frame % 2 == 0 {
                moments.extend(pairing.depth(depth, frame).into_iter().flatten());
                moments.extend(pairing.ir(ir, frame).into_iter().flatten());
            } else {
                moments.extend(pairing.ir(ir, frame).into_iter().flatten());
                moments.extend(pairing.depth(depth, frame).into_iter().flatten());
            }
        }
        assert_eq!(moments, [0, 1, 2, 3].map(|frame| Both(frame, frame)));
    }

    #[test]
    fn an_image_without_counterpart_goes_alone() {
        let start = Instant::now();
        let mut pairing = Pairing::new(Running::Both);
        let mut moments = Vec::new();
        moments.extend(pairing.depth(stamp(start, 0, 0), 0).into_iter().flatten());
        moments.extend(pairing.depth(stamp(start, 1, 0), 1).into_iter().flatten());
        moments.extend(pairing.ir(stamp(start, 1, 0), 1).into_iter().flatten());
        moments.extend(pairing.ir(stamp(start, 2, 0), 2).into_iter().flatten());
        moments.extend(pairing.ir(stamp(start, 3, 0), 3).into_iter().flatten());
        moments.extend(pairing.depth(stamp(start, 4, 0), 4).into_iter().flatten());
        moments.extend(pairing.ir(stamp(start, 5, 0), 5).into_iter().flatten());
        let expected = [Depth(0), Both(1, 1), Ir(2), Ir(3), Depth(4)];
        assert_eq!(moments, expected);
        moments.extend(pairing.set_running(Running::One).into_iter().flatten());
        assert_eq!(moments[5..], [Ir(5)]);
    }

    #[test]
    fn while_stamps_stand_still_arrival_pairs() {
        let start = Instant::now();
        let mut pairing = Pairing::new(Running::Both);
        let mut moments = Vec::new();
        for frame in 0..3 {
            moments.extend(
                pairing
                    .ir(frozen(stamp(start, frame, 2)), frame)
                    .into_iter()
                    .flatten(),
            );
            moments.extend(
                pairing
                    .depth(stamp(start, frame, 9), frame)
                    .into_iter()
                    .flatten(),
            );
        }
        assert_eq!(moments, [0, 1, 2].map(|frame| Both(frame, frame)));
        moments.extend(
            pairing
                .ir(frozen(stamp(start, 3, 0)), 3)
                .into_iter()
                .flatten(),
        );
        moments.extend(pairing.depth(stamp(start, 4, 0), 4).into_iter().flatten());
        assert_eq!(moments[3..], [Ir(3)]);
    }

    #[test]
    fn with_one_stream_nothing_waits() {
        let start = Instant::now();
        let mut pairing = Pairing::new(Running::One);
        let mut moments = Vec::new();
        moments.extend(pairing.ir(stamp(start, 0, 0), 0).into_iter().flatten());
        moments.extend(pairing.depth(stamp(start, 0, 0), 0).into_iter().flatten());
        assert_eq!(moments, [Ir(0), Depth(0)]);
    }
}
