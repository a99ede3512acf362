//! The device thread's loop: takes frames from a camera until it ends, fails, or is told to stop.
//!
//! A live device, which does not know how many frames will come, may be unplugged or fall silent: once it has delivered a
//! frame it is awaited, and the stream goes on when it is back. A recording ends at its end; played at its own pace it is waited
//! for through its gaps.

mod missed;

use self::missed::Missed;
use super::{CaptureParams, Event, EventKind, continuity::Continuity};
use depth_camera::{CameraError, DepthCamera, Frame};
use serde::Serialize;
use std::{
    sync::atomic::{AtomicBool, Ordering},
    thread,
    time::{Duration, Instant},
};

/// A live device stalls when so many waits in a row are in vain.
const STALLED_AFTER: usize = 2;

/// A gap of a recording is a device that had fallen silent after so long at most: the daemon's watchdog waits twice as long for frames.
const LONG_GAP: Duration = Duration::from_secs(10);

/// What the device thread hands on.
#[derive(Clone, Debug)]
pub enum Delivery {
    /// A frame.
    Frame(Frame),
    /// Something that happened, never to be dropped.
    Event(Event),
    /// The device is doing otherwise than before. After a gap this comes before the first frame.
    Health(DeviceHealth),
    /// What the driver had and let go, as [`CaptureSummary::n_missed`], has become so many.
    Missed(u64),
}

/// How a device is doing, or was when it was recorded.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum DeviceHealth {
    /// Frames come.
    #[default]
    Streaming,
    /// It is there, and no frames come.
    Stalled,
    /// It is not there, or silent for long; it is waited for.
    Gone,
}

/// How the stream ended.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum CaptureEnd {
    /// The stream came to its end.
    EndOfStream,
    /// Somebody asked to stop.
    Stopped,
    /// The consumer of the frames is gone.
    Unwanted,
    /// The camera failed for good.
    Failed(CameraError),
}

/// What the device delivered.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct CaptureSummary {
    /// Frames that came or were announced, damaged ones too.
    pub n_frames: u64,
    /// Frames that came damaged.
    pub n_damaged: u64,
    /// Waits for a frame that were in vain.
    pub n_timeouts: u64,
    /// Frames, and infrared images that frames lack, which the driver had and let go; none of them is among the frames above.
    pub n_missed: u64,
    /// What is wrong with the first damaged frame.
    pub first_damage: Option<String>,
    /// How the stream ended.
    pub end: CaptureEnd,
}

/// Runs a camera to the end of its stream, until `stop` is set, or until `deliver` returns false: nobody wants frames.
pub fn run_device(
    camera: &mut dyn DepthCamera,
    params: &CaptureParams,
    stop: &AtomicBool,
    mut deliver: impl FnMut(Delivery) -> bool,
) -> CaptureSummary {
    let mut device = Device {
        params,
        is_live: camera.info().n_frames.is_none(),
        health: DeviceHealth::default(),
        n_in_vain: 0,
        continuity: Continuity::default(),
        missed: Missed::default(),
        summary: CaptureSummary {
            n_frames: 0,
            n_damaged: 0,
            n_timeouts: 0,
            n_missed: 0,
            first_damage: None,
            end: CaptureEnd::Stopped,
        },
        last_heard: Instant::now(),
    };
    while !stop.load(Ordering::Relaxed) {
        let grabbed = camera.grab(params.grab_timeout());
        let end = device.handle(grabbed, &mut deliver);
        device.account(camera, &mut deliver);
        if let Some(end) = end {
            device.summary.end = end;
            break;
        }
    }
    device.missed.pause(camera);
    device.tell_missed(&mut deliver);
    let summary = device.summary;
    tracing::debug!(
        n_frames = summary.n_frames,
        n_damaged = summary.n_damaged,
        n_timeouts = summary.n_timeouts,
        n_missed = summary.n_missed,
        end = ?summary.end,
        "capture ended"
    );
    summary
}

struct Device<'a> {
    params: &'a CaptureParams,
    /// Whether it may come back.
    is_live: bool,
    health: DeviceHealth,
    /// Waits in vain since it was heard last.
    n_in_vain: usize,
    continuity: Continuity,
    missed: Missed,
    summary: CaptureSummary,
    last_heard: Instant,
}

impl Device<'_> {
    /// Handles what a call to `grab` gave; returns how the stream ended, if it did.
    fn handle(
        &mut self,
        grabbed: Result<Option<Frame>, CameraError>,
        deliver: &mut impl FnMut(Delivery) -> bool,
    ) -> Option<CaptureEnd> {
        match grabbed {
            Ok(None) => Some(CaptureEnd::EndOfStream),
            Ok(Some(frame)) => {
                self.heard(deliver);
                self.summary.n_frames += 1;
                let frame = self.continuity.carry_on(frame);
                let is_wanted = deliver(Delivery::Frame(frame));
                (!is_wanted).then_some(CaptureEnd::Unwanted)
            }
            Err(CameraError::DamagedFrame { frame_id, reason }) => {
                self.heard(deliver);
                let frame_id = self.continuity.number(frame_id);
                let is_wanted = deliver(self.damaged(frame_id, reason));
                (!is_wanted).then_some(CaptureEnd::Unwanted)
            }
            Err(CameraError::Timeout { .. }) => self.timed_out(deliver),
            Err(CameraError::NotDue) => {
                self.waits(deliver);
                None
            }
            Err(error) if self.may_return(&error) => self.gone(error, deliver),
            Err(error) => {
                tracing::error!(%error, "the camera failed");
                Some(CaptureEnd::Failed(error))
            }
        }
    }

    /// Keeps account of what the driver misses.
    fn account(&mut self, camera: &dyn DepthCamera, deliver: &mut impl FnMut(Delivery) -> bool) {
        match self.summary.n_frames > 0 && self.health != DeviceHealth::Gone {
            true => self.missed.follow(camera),
            false => self.missed.pause(camera),
        }
        self.tell_missed(deliver);
    }

    /// Tells how much the driver has missed, if that is more than was told.
    fn tell_missed(&mut self, deliver: &mut impl FnMut(Delivery) -> bool) {
        let total = self.missed.total();
        if total > self.summary.n_missed {
            self.summary.n_missed = total;
            // Whether frames are wanted shows when there is one.
            deliver(Delivery::Missed(total));
        }
    }

    fn damaged(&mut self, frame_id: u64, reason: String) -> Delivery {
        tracing::warn!(frame_id, reason, "damaged frame skipped");
        self.summary.n_frames += 1;
        self.summary.n_damaged += 1;
        self.summary
            .first_damage
            .get_or_insert_with(|| reason.clone());
        Delivery::Event(Event {
            frame_id,
            device_time_secs: None,
            kind: EventKind::Damaged { reason },
        })
    }

    fn timed_out(&mut self, deliver: &mut impl FnMut(Delivery) -> bool) -> Option<CaptureEnd> {
        self.summary.n_timeouts += 1;
        let waited: Duration = self.last_heard.elapsed();
        let error = CameraError::Timeout { waited };
        if waited >= self.params.max_silence() {
            return self.gone(error, deliver);
        }
        self.n_in_vain += 1;
        let is_stalled = self.n_in_vain >= STALLED_AFTER && self.is_awaited();
        if is_stalled && self.health == DeviceHealth::Streaming {
            self.turn(DeviceHealth::Stalled, deliver);
        }
        None
    }

    /// A recording waits for its next moment; after so long the device that was recorded had fallen silent.
    fn waits(&mut self, deliver: &mut impl FnMut(Delivery) -> bool) {
        let is_long = self.last_heard.elapsed() >= self.params.max_silence().min(LONG_GAP);
        if is_long && self.health == DeviceHealth::Streaming {
            self.turn(DeviceHealth::Stalled, deliver);
        }
    }

    /// Whether the device may be waited for: it is a live one, and did stream.
    fn is_awaited(&self) -> bool {
        self.is_live && self.summary.n_frames > 0
    }

    /// Whether a device with this error may come back: what was unplugged may at first be refused to us.
    fn may_return(&self, error: &CameraError) -> bool {
        let is_gone = self.health == DeviceHealth::Gone;
        match error {
            CameraError::Disconnected => self.is_awaited(),
            CameraError::Busy | CameraError::PermissionDenied => self.is_awaited() && is_gone,
            _ => false,
        }
    }

    /// Waits for a device that is not there, unless that has taken too long.
    fn gone(
        &mut self,
        error: CameraError,
        deliver: &mut impl FnMut(Delivery) -> bool,
    ) -> Option<CaptureEnd> {
        let patience = match self.is_awaited() {
            true => self.params.max_silence().max(self.params.reconnect()),
            false => Duration::ZERO,
        };
        if self.last_heard.elapsed() >= patience {
            tracing::error!(%error, "the camera is given up");
            return Some(CaptureEnd::Failed(error));
        }
        if self.health != DeviceHealth::Gone {
            tracing::warn!(%error, "the camera is gone; waiting for it");
            self.turn(DeviceHealth::Gone, deliver);
        }
        // A camera may say at once that it is not there.
        if !matches!(error, CameraError::Timeout { .. }) {
            thread::sleep(self.params.grab_timeout());
        }
        None
    }

    /// The device has delivered something.
    fn heard(&mut self, deliver: &mut impl FnMut(Delivery) -> bool) {
        self.n_in_vain = 0;
        self.last_heard = Instant::now();
        if self.health != DeviceHealth::Streaming {
            tracing::info!("the camera is back");
            self.turn(DeviceHealth::Streaming, deliver);
        }
    }

    fn turn(&mut self, health: DeviceHealth, deliver: &mut impl FnMut(Delivery) -> bool) {
        self.health = health;
        self.continuity.interrupt();
        // Whether frames are wanted shows when there is one.
        deliver(Delivery::Health(health));
    }
}

#[cfg(test)]
mod tests;
