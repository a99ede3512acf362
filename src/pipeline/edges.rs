//! Every edge between two threads: its capacity, and what happens when it is full.
//!
//! | edge | capacity | when full |
//! |---|---|---|
//! | device → fusion, frames | 4 | [`WhenFull`]: a recording blocks; a live device drops the oldest frame, which is counted; while the camera is lost all but the newest two |
//! | device → recorder, frames | 64 | [`WhenFull`]: a recording blocks; a live device leaves out IR from three quarters on, then drops the frame; both are counted |
//! | device, fusion → recorder, events, poses and candidates | 1024 | blocks: nothing of it may be lost, and the recorder never waits for its sender |
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
        let has_both = frame.ir.is_some() && frame.frame.depth.is_some();
        let without_ir = has_both && self.channel.len() >= RECORDING_WITHOUT_IR;
        let sent = self.channel.try_send(match without_ir {
            true => DeliveredFrame { ir: None, ..frame },
            false => frame,
        });
        let count = match sent {
            Ok(()) if without_ir => &self.counts.recorded_ir,
            Err(TrySendError::Full(_)) => &self.counts.recorded_frames,
            Ok(()) | Err(TrySendError::Disconnected(_)) => return,
        };
        count.fetch_add(1, Ordering::Relaxed);
    }
}

/// Device and fusion → recorder, sending end.
#[derive(Clone)]
pub struct TrackedSender {
    channel: Sender<Tracked>,
    log: EventLog,
}

/// Device and fusion → recorder, events, poses and candidates; events also go to the log of the newest.
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
mod tests;
