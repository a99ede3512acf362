//! The recorder thread: what device and fusion send goes to the disk until both are done.

use super::{deliver::Outbox, status::StatusSlot};
use crate::capture::{Recorder, RecorderSummary, Tracked};
use crossbeam::{
    channel::{Receiver, never},
    select,
};
use depth_camera::Frame;
use std::sync::Arc;

/// Records until both senders are gone, then writes the trajectory.
pub fn run(
    mut recorder: Recorder,
    frames: Receiver<Arc<Frame>>,
    tracked: Receiver<Tracked>,
    outbox: &Outbox,
    status: &StatusSlot,
) -> RecorderSummary {
    let (mut frames, mut tracked) = (Some(frames), Some(tracked));
    let mut has_failed = false;
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
        }
        if !has_failed && recorder.has_failed() {
            has_failed = true;
            status.update(|status| status.recording.has_failed = true);
        }
    }
    let summary = recorder.finish();
    outbox.recorded(&summary);
    summary
}
