//! Single scenes, and random steps of those at both ends. How threads may meet at them is tried in `handover`.

use super::*;
use crate::pipeline::accounts::FrameAccounts;
use depth_camera::Image;
use proptest::{collection::vec, prelude::*};
use std::{collections::VecDeque, time::Instant};

fn frame(frame_id: u64) -> Arc<Frame> {
    Arc::new(Frame {
        frame_id,
        device_time_secs: frame_id as f64,
        host_time: Instant::now(),
        depth: Some(Image::filled(1, 1, 1.0)),
        ir: Some(Image::filled(1, 1, 1)),
    })
}

#[test]
fn the_newest_frames_win_and_the_rest_is_counted() {
    let status = StatusSlot::default();
    let (sender, receiver) = frames(WhenFull::Drop, &status);
    for frame_id in 0..10 {
        assert!(sender.send(frame(frame_id)));
    }
    let accounts = status.get().frames;
    assert_eq!((accounts.dropped, accounts.in_flight), (6, 4));
    assert_eq!(receiver.channel().recv().unwrap().frame_id, 6);
    drop(receiver);
    assert!(!sender.send(frame(10)));
    // The one that was taken out is still in somebody's hands.
    let accounts = status.get().frames;
    assert_eq!((accounts.dropped, accounts.in_flight), (10, 1));
    assert_eq!((accounts.produced, accounts.unaccounted()), (11, 0));
}

#[test]
fn of_frames_that_wait_the_newest_two_are_taken_where_some_may_be_dropped() {
    for (when_full, expected) in [(WhenFull::Drop, vec![2, 3]), (WhenFull::Block, vec![0])] {
        let status = StatusSlot::default();
        let (sender, receiver) = frames(when_full, &status);
        for frame_id in 0..4 {
            assert!(sender.send(frame(frame_id)));
        }
        let first = receiver.channel().recv().unwrap();
        let taken: Vec<u64> = receiver.newest_two(first).map(|f| f.frame_id).collect();
        assert_eq!(taken, expected);
        let accounts = status.get().frames;
        assert_eq!(accounts.dropped, 2 * u64::from(when_full == WhenFull::Drop));
        assert_eq!(accounts.unaccounted(), 0);
    }
}

#[test]
fn a_full_recording_loses_infrared_before_depth() {
    let counts = Arc::new(DropCounts::default());
    let (sender, receiver) = recording(WhenFull::Drop, &counts);
    for frame_id in 0..70 {
        sender.send(DeliveredFrame::unmoved(frame(frame_id)));
    }
    let recorded: Vec<_> = receiver.try_iter().collect();
    assert_eq!(recorded.len(), RECORDING);
    assert!(recorded.iter().all(|frame| frame.frame.depth.is_some()));
    let n_ir = recorded.iter().filter(|frame| frame.infrared().is_some());
    let n_ir = n_ir.count();
    assert_eq!(n_ir, RECORDING_WITHOUT_IR);
    assert_eq!(counts.recorded_frames.load(Ordering::Relaxed), 6);
    assert_eq!(
        counts.recorded_ir.load(Ordering::Relaxed),
        16,
        "those that were recorded without"
    );
}

/// What happens at the edge of frames to fusion.
#[derive(Clone, Copy, Debug)]
enum FrameStep {
    Send,
    /// Fusion takes the oldest.
    Take,
    /// Fusion looks for a lost camera.
    TakeNewestTwo,
    /// The fusion thread ends.
    Leave,
}

fn frame_step() -> impl Strategy<Value = FrameStep> {
    prop_oneof![
        8 => Just(FrameStep::Send),
        3 => Just(FrameStep::Take),
        2 => Just(FrameStep::TakeNewestTwo),
        1 => Just(FrameStep::Leave),
    ]
}

/// What the edge of frames to fusion should be, in the plainest words.
#[derive(Default)]
struct FrameEdge {
    waiting: VecDeque<u64>,
    is_left: bool,
    accounts: FrameAccounts,
}

impl FrameEdge {
    fn send(&mut self, frame_id: u64, when_full: WhenFull) {
        self.accounts.produced += 1;
        self.waiting.push_back(frame_id);
        let n_dropped = match when_full {
            _ if self.is_left => 1,
            WhenFull::Drop => self.waiting.len().saturating_sub(FRAMES),
            WhenFull::Block => 0,
        };
        self.drop_oldest(n_dropped);
    }

    fn take(&mut self) -> Vec<u64> {
        let taken = Vec::from_iter(self.waiting.pop_front());
        self.accounts.fused += taken.len() as u64;
        taken
    }

    fn take_newest_two(&mut self, when_full: WhenFull) -> Vec<u64> {
        if when_full == WhenFull::Block {
            return self.take();
        }
        self.drop_oldest(self.waiting.len().saturating_sub(2));
        let taken = Vec::from(std::mem::take(&mut self.waiting));
        self.accounts.fused += taken.len() as u64;
        taken
    }

    fn leave(&mut self) {
        self.is_left = true;
        self.drop_oldest(self.waiting.len());
    }

    fn drop_oldest(&mut self, n_dropped: usize) {
        self.waiting.drain(..n_dropped);
        self.accounts.dropped += n_dropped as u64;
    }

    fn accounts(&self) -> FrameAccounts {
        FrameAccounts {
            in_flight: self.waiting.len() as u64,
            ..self.accounts
        }
    }
}

/// Notes frames as fused; their numbers.
fn fuse(frames: impl Iterator<Item = Arc<Frame>>, status: &StatusSlot) -> Vec<u64> {
    let arrived = frames.map(|frame| {
        status.update(|status| status.frames.arrived(Place::Fused));
        frame.frame_id
    });
    arrived.collect()
}

proptest! {
    #[test]
    fn after_any_steps_every_frame_was_taken_dropped_or_waits(
        steps in vec(frame_step(), 0..60),
        may_drop in any::<bool>(),
    ) {
        let when_full = if may_drop { WhenFull::Drop } else { WhenFull::Block };
        let status = StatusSlot::default();
        let (sender, receiver) = frames(when_full, &status);
        let (mut receiver, mut expected) = (Some(receiver), FrameEdge::default());
        for (frame_id, step) in (0..).zip(steps) {
            let would_wait = !may_drop && expected.waiting.len() == FRAMES;
            match (step, &receiver) {
                (FrameStep::Send, _) if would_wait => continue,
                (FrameStep::Send, _) => {
                    prop_assert_eq!(sender.send(frame(frame_id)), !expected.is_left);
                    expected.send(frame_id, when_full);
                }
                (FrameStep::Take, Some(receiver)) => {
                    let taken = receiver.channel().try_recv().into_iter();
                    prop_assert_eq!(fuse(taken, &status), expected.take());
                }
                (FrameStep::TakeNewestTwo, Some(receiver)) => {
                    let first = receiver.channel().try_recv().into_iter();
                    let taken = first.flat_map(|first| receiver.newest_two(first));
                    prop_assert_eq!(fuse(taken, &status), expected.take_newest_two(when_full));
                }
                (FrameStep::Leave, _) => {
                    receiver = None;
                    expected.leave();
                }
                (FrameStep::Take | FrameStep::TakeNewestTwo, None) => {}
            }
            prop_assert_eq!(status.get().frames, expected.accounts());
        }
    }

    #[test]
    fn after_any_steps_every_frame_is_recorded_recorded_without_infrared_or_counted(
        bursts in vec((any::<bool>(), 1..40usize), 0..40),
    ) {
        let counts = Arc::new(DropCounts::default());
        let (sender, receiver) = recording(WhenFull::Drop, &counts);
        let lost = || [&counts.recorded_ir, &counts.recorded_frames].map(|n| n.load(Ordering::Relaxed));
        let (mut n_sent, mut recorded) = (0, Vec::new());
        for (is_sent, n) in bursts {
            if !is_sent {
                recorded.extend(receiver.try_iter().take(n));
                continue;
            }
            for _ in 0..n {
                let [n_ir, n_frames] = lost();
                let expected = match receiver.len() {
                    RECORDING => [n_ir, n_frames + 1],
                    RECORDING_WITHOUT_IR.. => [n_ir + 1, n_frames],
                    _ => [n_ir, n_frames],
                };
                sender.send(DeliveredFrame::unmoved(frame(n_sent)));
                n_sent += 1;
                prop_assert_eq!(lost(), expected);
            }
        }
        recorded.extend(receiver.try_iter());
        prop_assert!(recorded.is_sorted_by(|a, b| a.frame.frame_id < b.frame.frame_id));
        prop_assert!(recorded.iter().all(|frame| frame.frame.depth.is_some()));
        let n_without_ir = recorded.iter().filter(|frame| frame.infrared().is_none()).count() as u64;
        prop_assert_eq!(lost(), [n_without_ir, n_sent - recorded.len() as u64]);
    }
}
