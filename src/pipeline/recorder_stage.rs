//! The recorder thread: what device and fusion send goes to the disk until both are done.

use super::{
    deliver::Outbox,
    edges::DropCounts,
    event_log::EventLog,
    status::{RecordingStatus, StatusSlot},
};
use crate::capture::{DeliveredFrame, EVENTS_FILE, Recorder, RecorderSummary, Tracked};
use crossbeam::{
    channel::{Receiver, never},
    select,
};
use std::{
    sync::{Arc, atomic::Ordering},
    time::Duration,
};

/// So often the recorder does what is due though nothing comes.
const TICK: Duration = Duration::from_millis(100);

/// Where the recorder tells how it stands, and what it is told of losses on the way to it.
pub struct Telling {
    /// Everybody reads the newest.
    pub status: StatusSlot,
    /// The newest events.
    pub events: EventLog,
    /// What found no room on the edge.
    pub drops: Arc<DropCounts>,
}

impl Telling {
    fn tell(&self, recorder: &mut Recorder) {
        let n_frames = self.drops.recorded_frames.load(Ordering::Relaxed);
        let n_infrared = self.drops.recorded_ir.load(Ordering::Relaxed);
        recorder.note_dropped(n_frames, n_infrared);
        for event in recorder.take_events() {
            self.events.push(event);
        }
        let refusal = recorder.events_refusal().map(str::to_owned);
        self.status
            .update(|status| status.note_unwritten(EVENTS_FILE, refusal));
        let has_failed = recorder.has_failed();
        let Some(standing) = recorder.standing() else {
            return self
                .status
                .update(|status| status.recording.has_failed = has_failed);
        };
        let recording = RecordingStatus {
            active: standing.active,
            bytes: standing.bytes,
            recorded: standing.recorded,
            dropped_ir: n_infrared,
            dropped_frames: n_frames,
            disk_free_bytes: standing.disk_free_bytes,
            disk_floor_bytes: standing.disk_floor_bytes,
            reason: standing.reason.clone(),
            has_failed,
        };
        self.status.update(|status| status.recording = recording);
    }
}

/// Records until both senders are gone, then writes the trajectory, and the events that waited for room.
pub fn run(
    mut recorder: Recorder,
    frames: Receiver<DeliveredFrame>,
    tracked: Receiver<Tracked>,
    outbox: &Outbox,
    telling: &Telling,
) -> RecorderSummary {
    let (mut frames, mut tracked) = (Some(frames), Some(tracked));
    while frames.is_some() || tracked.is_some() {
        select! {
            recv(frames.as_ref().unwrap_or(&never())) -> frame => match frame {
                Ok(frame) => recorder.frame(&frame),
                Err(_) => frames = None,
            },
            recv(tracked.as_ref().unwrap_or(&never())) -> message => match message {
                Ok(message) => recorder.tracked(message),
                Err(_) => tracked = None,
            },
            default(TICK) => recorder.tick(),
        }
        telling.tell(&mut recorder);
    }
    recorder.end_frames();
    telling.tell(&mut recorder);
    // It waits for room where that is wanted; then there is some for the events, too.
    outbox.trajectory(recorder.trajectory());
    let summary = recorder.finish();
    telling
        .status
        .update(|status| status.note_unwritten(EVENTS_FILE, None));
    outbox.recorded(&summary);
    summary
}
