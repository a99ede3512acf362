//! What goes between the device thread and those who use the camera.

use std::sync::{
    Mutex, PoisonError,
    atomic::{AtomicBool, AtomicU64, Ordering},
};

use crossbeam::channel::{Receiver, Sender, TrySendError};
use depth_camera::CameraError;
use udev_monitor::UsbMonitor;

use crate::{
    assembly::{Captured, Statistics},
    disparity::ZeroPlane,
    streams::Streams,
    supervision::{Activity, Heartbeat},
};

/// What the device thread reports.
#[derive(Debug)]
pub(crate) enum Event {
    Captured(Captured),
    Failed(CameraError),
}

/// What the device thread is told.
#[derive(Debug)]
pub(crate) enum Command {
    /// Deliver these streams from now on.
    Streams(Streams, Sender<Result<(), CameraError>>),
    /// Set the gain of IR; the answer is what the device then says it is.
    IrGain(u16, Sender<Result<u16, CameraError>>),
    /// Listen to udev while the device is gone.
    Listen(UsbMonitor),
    /// Close the device and end.
    Stop,
}

/// What others may look at meanwhile.
#[derive(Debug)]
pub(crate) struct Shared {
    pub(crate) heartbeat: Heartbeat,
    pub(crate) depth_runs: AtomicBool,
    pub(crate) ir_gain: AtomicU64,
    n_overrun: AtomicU64,
    statistics: Mutex<Statistics>,
}

impl Shared {
    pub(crate) fn new() -> Self {
        Shared {
            heartbeat: Heartbeat::new(Activity::Opening),
            depth_runs: AtomicBool::new(false),
            ir_gain: AtomicU64::new(0),
            n_overrun: AtomicU64::new(0),
            statistics: Mutex::default(),
        }
    }

    pub(crate) fn statistics(&self) -> Statistics {
        let held = self
            .statistics
            .lock()
            .unwrap_or_else(PoisonError::into_inner);
        Statistics {
            n_overrun: self.n_overrun.load(Ordering::Relaxed),
            ..*held
        }
    }

    /// Lets others see these figures; overruns are counted here.
    pub(crate) fn publish(&self, statistics: Statistics) {
        let mut held = self
            .statistics
            .lock()
            .unwrap_or_else(PoisonError::into_inner);
        *held = statistics;
    }
}

/// The way out: newest wins, for the thread must never wait.
#[derive(Debug)]
pub(crate) struct Outlet {
    pub(crate) events: Sender<Event>,
    /// The other end, to make room.
    pub(crate) oldest: Receiver<Event>,
}

impl Outlet {
    pub(crate) fn offer(&self, event: Event, shared: &Shared) {
        let mut event = event;
        while let Err(TrySendError::Full(refused)) = self.events.try_send(event) {
            if matches!(self.oldest.try_recv(), Ok(Event::Captured(_))) {
                shared.n_overrun.fetch_add(1, Ordering::Relaxed);
            }
            event = refused;
        }
    }
}

/// What the device says of itself.
#[derive(Clone, Debug)]
pub(crate) struct Identity {
    pub(crate) serial: String,
    pub(crate) zero_plane: ZeroPlane,
}
