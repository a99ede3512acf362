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
use crate::capture::Tracked;
use crossbeam::channel::{Receiver, Sender, TrySendError, bounded};
use depth_camera::Frame;
pub use handover::WhenFull;
use handover::{QueueReceiver, QueueSender};
use std::sync::{
    Arc,
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
    queue: QueueSender<Arc<Frame>>,
    status: StatusSlot,
}

/// Device → fusion, receiving end.
pub type FrameReceiver = QueueReceiver<Arc<Frame>>;

/// Device → fusion.
pub fn frames(when_full: WhenFull, status: &StatusSlot) -> (FrameSender, FrameReceiver) {
    let of_queue = status.clone();
    let (queue, receiver) = handover::queue(FRAMES, when_full, move || dropped(&of_queue));
    let status = status.clone();
    (FrameSender { queue, status }, receiver)
}

impl FrameSender {
    /// Sends a frame; false if nobody listens any more.
    pub fn send(&self, frame: Arc<Frame>) -> bool {
        // Before it is sent: whoever takes it out accounts for it.
        self.status.update(|status| status.frames.sent());
        self.queue.send(frame)
    }
}

fn dropped(status: &StatusSlot) {
    status.update(|status| status.frames.arrived(Place::Dropped));
}

/// Device → recorder, sending end.
pub struct RecordingSender {
    channel: Sender<Arc<Frame>>,
    when_full: WhenFull,
    counts: Arc<DropCounts>,
}

/// Device → recorder, frames.
pub fn recording(
    when_full: WhenFull,
    counts: &Arc<DropCounts>,
) -> (RecordingSender, Receiver<Arc<Frame>>) {
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
    pub fn send(&self, frame: Arc<Frame>) {
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
    fn without_ir(&self, frame: Arc<Frame>) -> Arc<Frame> {
        if frame.ir.is_none() || frame.depth.is_none() {
            return frame;
        }
        self.counts.recorded_ir.fetch_add(1, Ordering::Relaxed);
        Arc::new(Frame {
            ir: None,
            depth: frame.depth.clone(),
            ..*frame
        })
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
            sender.send(frame(frame_id));
        }
        let recorded: Vec<_> = receiver.try_iter().collect();
        assert_eq!(recorded.len(), RECORDING);
        assert!(recorded.iter().all(|frame| frame.depth.is_some()));
        let n_ir = recorded.iter().filter(|frame| frame.ir.is_some()).count();
        assert_eq!(n_ir, RECORDING_WITHOUT_IR);
        assert_eq!(counts.recorded_frames.load(Ordering::Relaxed), 6);
    }
}
