//! Every edge between two threads: its capacity, and what happens when it is full.
//!
//! | edge | capacity | when full |
//! |---|---|---|
//! | device → fusion, frames | 4 | [`WhenFull`]: a recording blocks; a live device drops the oldest frame, which is counted; while the camera is lost all but the newest two |
//! | device → recorder, frames | 64 | [`WhenFull`]: a recording blocks; a live device leaves out IR from three quarters on, then drops the frame; both are counted |
//! | device, fusion → recorder, events and poses | 1024 | blocks: nothing of it may be lost, and the recorder never waits for its sender |
//! | outside → fusion, commands | 8 | refused: whoever asks never waits |
//! | fusion → sewing, changed patches of the surface | 1 | not made: the next ones are newer |
//! | fusion → refine, the fused scan | 1 | never: one scan is sent |

use super::{
    accounts::Place, command::Command, event_log::EventLog, fusion_stage::FusedScan,
    live::surface::SurfaceUpdate, status::StatusSlot,
};
use crate::capture::{DeliveredFrame, Tracked};
use crossbeam::channel::{Receiver, Sender, TrySendError, bounded};
use depth_camera::Frame;
use std::sync::{
    Arc, Weak,
    atomic::{AtomicU64, Ordering},
};

const FRAMES: usize = 4;
const RECORDING: usize = 64;
/// From this fill on IR is not recorded.
const RECORDING_WITHOUT_IR: usize = RECORDING / 4 * 3;
const TRACKED: usize = 1024;
const COMMANDS: usize = 8;
const SURFACES: usize = 1;
const SCANS: usize = 1;

/// What the device thread does when its consumers are slower than the device.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum WhenFull {
    /// Waits: every frame of a recording is used, and results do not depend on the machine.
    #[default]
    Block,
    /// Drops and counts, so that the device never waits.
    Drop,
}

/// Frames that were not, or not wholly, recorded because the disk was busy.
#[derive(Debug, Default)]
pub struct DropCounts {
    /// Frames that were recorded without their IR.
    pub recorded_ir: AtomicU64,
    /// Frames that were not recorded.
    pub recorded_frames: AtomicU64,
}

/// Device → fusion, sending end.
pub struct FrameSender {
    channel: Sender<Arc<Frame>>,
    /// There if the oldest frame makes way: what takes it out, and whether fusion still listens.
    overflow: Option<(Receiver<Arc<Frame>>, Weak<()>)>,
    status: StatusSlot,
}

/// Device → fusion, receiving end.
pub struct FrameReceiver {
    channel: Receiver<Arc<Frame>>,
    when_full: WhenFull,
    /// Tells a sender, which holds a receiver of its own, that nobody listens any more.
    alive: Option<Arc<()>>,
    status: StatusSlot,
}

/// Device → fusion.
pub fn frames(when_full: WhenFull, status: &StatusSlot) -> (FrameSender, FrameReceiver) {
    let (sender, receiver) = bounded(FRAMES);
    let alive = Arc::new(());
    let overflow = match when_full {
        WhenFull::Block => None,
        WhenFull::Drop => Some((receiver.clone(), Arc::downgrade(&alive))),
    };
    let sender = FrameSender {
        channel: sender,
        overflow,
        status: status.clone(),
    };
    let receiver = FrameReceiver {
        channel: receiver,
        when_full,
        alive: Some(alive),
        status: status.clone(),
    };
    (sender, receiver)
}

impl FrameSender {
    /// Sends a frame; false if nobody listens any more.
    pub fn send(&self, frame: Arc<Frame>) -> bool {
        self.status.update(|status| status.frames.sent());
        let is_wanted = match &self.overflow {
            None => self.channel.send(frame).is_ok(),
            Some((oldest, alive)) => {
                self.send_newest(frame, oldest);
                alive.strong_count() > 0
            }
        };
        if !is_wanted {
            self.unwanted();
        }
        is_wanted
    }

    /// Puts a frame in, the oldest one out if there is no room.
    fn send_newest(&self, mut frame: Arc<Frame>, oldest: &Receiver<Arc<Frame>>) {
        while let Err(TrySendError::Full(refused)) = self.channel.try_send(frame) {
            frame = refused;
            if oldest.try_recv().is_ok() {
                dropped(&self.status);
            }
        }
    }

    /// Accounts for what nobody will take out: a frame that was put in, or refused, after the receiver was dropped.
    fn unwanted(&self) {
        match &self.overflow {
            None => dropped(&self.status),
            Some((left, _)) => left.try_iter().for_each(|_| dropped(&self.status)),
        }
    }
}

impl FrameReceiver {
    /// The channel itself, to be waited for among others.
    pub fn channel(&self) -> &Receiver<Arc<Frame>> {
        &self.channel
    }

    /// Of a frame that was taken out and those behind it the newest two, the older first; the others are dropped. Where nothing
    /// may be dropped, the frame alone.
    pub fn newest_two(&self, frame: Arc<Frame>) -> impl Iterator<Item = Arc<Frame>> {
        let (mut older, mut newest) = (None, frame);
        if self.when_full == WhenFull::Drop {
            for newer in self.channel.try_iter().take(FRAMES) {
                let before = older.replace(std::mem::replace(&mut newest, newer));
                before.into_iter().for_each(|_| dropped(&self.status));
            }
        }
        older.into_iter().chain([newest])
    }
}

impl Drop for FrameReceiver {
    fn drop(&mut self) {
        // In this order: what a sender puts in later it takes out itself.
        self.alive = None;
        self.channel.try_iter().for_each(|_| dropped(&self.status));
    }
}

fn dropped(status: &StatusSlot) {
    status.update(|status| status.frames.arrived(Place::Dropped));
}

/// Device → recorder, sending end.
pub struct RecordingSender {
    channel: Sender<DeliveredFrame>,
    when_full: WhenFull,
    counts: Arc<DropCounts>,
}

/// Device → recorder, frames.
pub fn recording(
    when_full: WhenFull,
    counts: &Arc<DropCounts>,
) -> (RecordingSender, Receiver<DeliveredFrame>) {
    let (sender, receiver) = bounded(RECORDING);
    let sender = RecordingSender {
        channel: sender,
        when_full,
        counts: counts.clone(),
    };
    (sender, receiver)
}

impl RecordingSender {
    /// Sends a frame; one that finds no room is counted, one that finds no recorder is not.
    pub fn send(&self, frame: DeliveredFrame) {
        if self.when_full == WhenFull::Block {
            // A recorder that is gone has told why.
            let _ = self.channel.send(frame);
            return;
        }
        let frame = match self.channel.len() {
            n if n >= RECORDING_WITHOUT_IR => self.without_ir(frame),
            _ => frame,
        };
        if let Err(TrySendError::Full(_)) = self.channel.try_send(frame) {
            self.counts.recorded_frames.fetch_add(1, Ordering::Relaxed);
        }
    }

    /// The frame's depth alone, if it has both.
    fn without_ir(&self, frame: DeliveredFrame) -> DeliveredFrame {
        if frame.ir.is_none() || frame.frame.depth.is_none() {
            return frame;
        }
        self.counts.recorded_ir.fetch_add(1, Ordering::Relaxed);
        DeliveredFrame { ir: None, ..frame }
    }
}

/// Device and fusion → recorder, sending end.
#[derive(Clone)]
pub struct TrackedSender {
    channel: Sender<Tracked>,
    log: EventLog,
}

/// Device and fusion → recorder, events and poses; events also go to the log of the newest.
pub fn tracked(log: &EventLog) -> (TrackedSender, Receiver<Tracked>) {
    let (channel, receiver) = bounded(TRACKED);
    let log = log.clone();
    (TrackedSender { channel, log }, receiver)
}

impl TrackedSender {
    /// Sends; a recorder that is gone is told of where its thread is joined, and the others go on without it.
    pub fn send(&self, tracked: Tracked) {
        if let Tracked::Event(event) = &tracked {
            self.log.push(event.clone());
        }
        let _ = self.channel.send(tracked);
    }
}

/// Outside → fusion.
pub fn commands() -> (Sender<Command>, Receiver<Command>) {
    bounded(COMMANDS)
}

/// Fusion → sewing.
pub fn surfaces() -> (Sender<SurfaceUpdate>, Receiver<SurfaceUpdate>) {
    bounded(SURFACES)
}

/// Fusion → refine.
pub fn scans() -> (Sender<Arc<FusedScan>>, Receiver<Arc<FusedScan>>) {
    bounded(SCANS)
}

#[cfg(test)]
mod tests {
    use super::*;
    use depth_camera::Image;
    use std::time::Instant;

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
    }
}
