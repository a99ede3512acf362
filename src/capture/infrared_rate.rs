//! Which infrared images are recorded: they are noise to a compressor, and most of what a recording takes on the disk.

use super::DeliveredFrame;
use depth_camera::Frame;
use serde::{Deserialize, Serialize};
use std::{collections::VecDeque, fmt, sync::Arc};

/// Frames before and after a candidate for a shading image whose infrared is recorded with it: half a second each; arbitrary.
const BURST: u64 = 15;
/// Frames whose infrared was left out and may still be wanted; replay waits for it a second and a half.
const HELD: usize = 32;
const HELD_SECS: f64 = 1.0;

/// Which infrared images of a recording are kept beside the depth; those of a covered projector, that come without depth, always are.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Deserialize, Serialize)]
#[serde(try_from = "String", into = "String")]
pub enum InfraredRate {
    /// All: what is recorded replays exactly.
    #[default]
    All,
    /// Every so manieth, and those around candidates for shading images.
    Every(u32),
    /// Those around candidates for shading images.
    Snapshots,
}

impl TryFrom<String> for InfraredRate {
    type Error = String;

    fn try_from(text: String) -> Result<Self, String> {
        let every = || text.strip_prefix("every:")?.parse().ok();
        match (text.as_str(), every()) {
            ("all", _) => Ok(InfraredRate::All),
            ("snapshots", _) => Ok(InfraredRate::Snapshots),
            (_, Some(n @ 1..=1000)) => Ok(InfraredRate::Every(n)),
            _ => Err(format!(
                "\"{text}\", must be \"all\", \"snapshots\" or \"every:N\" with N from 1 to 1000"
            )),
        }
    }
}

impl From<InfraredRate> for String {
    fn from(rate: InfraredRate) -> String {
        rate.to_string()
    }
}

impl fmt::Display for InfraredRate {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            InfraredRate::All => f.write_str("all"),
            InfraredRate::Every(n) => write!(f, "every:{n}"),
            InfraredRate::Snapshots => f.write_str("snapshots"),
        }
    }
}

/// Lets infrared images through at a rate, and those around candidates for shading images, which are known only some frames later.
#[derive(Debug)]
pub(super) struct InfraredGate {
    rate: InfraredRate,
    /// With no more valid depth than this share the projector is covered, and an image may be an exposure.
    max_covered_depth_share: f64,
    /// Frames whose infrared was left out, oldest first.
    held: VecDeque<Arc<Frame>>,
    /// Up to this frame all infrared is let through.
    burst_end: Option<u64>,
}

impl InfraredGate {
    /// A gate that has seen nothing.
    pub(super) fn new(rate: InfraredRate, max_covered_depth_share: f64) -> Self {
        InfraredGate {
            rate,
            max_covered_depth_share,
            held: VecDeque::new(),
            burst_end: None,
        }
    }

    /// Whether the frame's infrared is to be recorded with it; what is not is held for a second.
    pub(super) fn admits(&mut self, delivered: &DeliveredFrame) -> bool {
        let frame = &delivered.frame;
        let is_due = match self.rate {
            InfraredRate::All => true,
            InfraredRate::Every(n) => frame.frame_id.is_multiple_of(u64::from(n)),
            InfraredRate::Snapshots => false,
        };
        let is_burst = self.burst_end.is_some_and(|end| frame.frame_id <= end);
        let Some(ir) = &delivered.ir else {
            return true;
        };
        if is_due || is_burst || frame.depth_share() <= self.max_covered_depth_share {
            return true;
        }
        self.held.push_back(ir.clone());
        let newest_secs = frame.device_time_secs;
        while self.held.len() > HELD
            || self
                .held
                .front()
                .is_some_and(|frame| newest_secs - frame.device_time_secs > HELD_SECS)
        {
            self.held.pop_front();
        }
        false
    }

    /// A frame is a candidate for a shading image: the frames before it whose infrared is to be recorded after all.
    pub(super) fn candidate(&mut self, frame_id: u64) -> Vec<Arc<Frame>> {
        self.burst_end = self.burst_end.max(Some(frame_id + BURST));
        let first = frame_id.saturating_sub(BURST);
        let wanted = first..=frame_id + BURST;
        let is_wanted = |frame: &Arc<Frame>| wanted.contains(&frame.frame_id);
        let frames = self.held.iter().filter(|frame| is_wanted(frame)).cloned();
        let frames = frames.collect();
        self.held.retain(|frame| !is_wanted(frame));
        frames
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use depth_camera::Image;
    use std::time::Instant;

    fn frame(frame_id: u64) -> DeliveredFrame {
        DeliveredFrame::unmoved(Arc::new(Frame {
            frame_id,
            device_time_secs: frame_id as f64 / 30.0,
            host_time: Instant::now(),
            depth: Some(Image::filled(1, 1, 1.0)),
            ir: Some(Image::filled(1, 1, 1)),
        }))
    }

    const MAX_COVERED: f64 = 0.04;

    /// The frames whose infrared is recorded at once, and later, when frame 50 is a candidate and told of at 54.
    fn recorded(rate: InfraredRate) -> (Vec<u64>, Vec<u64>) {
        let mut gate = InfraredGate::new(rate, MAX_COVERED);
        let (mut at_once, mut later) = (Vec::new(), Vec::new());
        for frame_id in 0..100 {
            if gate.admits(&frame(frame_id)) {
                at_once.push(frame_id);
            }
            if frame_id == 54 {
                let wanted = gate.candidate(50);
                later.extend(wanted.iter().map(|frame| frame.frame_id));
            }
        }
        (at_once, later)
    }

    #[test]
    fn bursts_lie_around_candidates() {
        let (at_once, later) = recorded(InfraredRate::Snapshots);
        assert_eq!(at_once, (55..=65).collect::<Vec<_>>());
        assert_eq!(later, (35..=54).collect::<Vec<_>>());
        let (at_once, later) = recorded(InfraredRate::Every(6));
        assert!((0..100).step_by(6).all(|n| at_once.contains(&n)));
        assert_eq!(at_once.len(), 17 + 11 - 1);
        assert_eq!(later.len(), 20 - 4);
        assert!(later.iter().all(|n| n % 6 != 0));
        let (at_once, later) = recorded(InfraredRate::All);
        assert_eq!((at_once.len(), later.len()), (100, 0));
    }

    #[test]
    fn infrared_without_depth_is_always_recorded() {
        let mut gate = InfraredGate::new(InfraredRate::Snapshots, MAX_COVERED);
        let mut with_depth = |depth: Option<Image<f32>>| {
            let frame = Frame {
                depth,
                ..(*frame(1).frame).clone()
            };
            gate.admits(&DeliveredFrame::unmoved(Arc::new(frame)))
        };
        assert!(with_depth(None));
        // A covered projector leaves an image of no depth, and a little of it at its rim.
        let with_n = |n_measured: usize| {
            let depth = (0..100).map(|pixel| if pixel < n_measured { 1.0 } else { 0.0 });
            Some(Image::from_vec(10, 10, depth.collect()))
        };
        assert!(with_depth(with_n(0)));
        assert!(with_depth(with_n(4)));
        assert!(!with_depth(with_n(5)));
    }

    #[test]
    fn rates_are_written_as_they_are_read() {
        for text in ["all", "snapshots", "every:6"] {
            let rate = InfraredRate::try_from(text.to_owned()).unwrap();
            assert_eq!(String::from(rate), text);
        }
        for text in ["none", "every:0", "every:x", "every:1001"] {
            let error = InfraredRate::try_from(text.to_owned()).unwrap_err();
            assert_eq!(
                error,
                format!(
                    "\"{text}\", must be \"all\", \"snapshots\" or \"every:N\" with N from 1 to 1000"
                )
            );
        }
    }
}
