//! Commands to a camera that another thread grabs from.

use std::{
    sync::{Arc, atomic::Ordering},
    thread,
    time::Duration,
};

use crossbeam::channel::{Receiver, RecvTimeoutError, SendTimeoutError, Sender, bounded};
use depth_camera::CameraError;

use crate::{
    assembly::Statistics,
    exchange::{Command, Shared},
    streams::{ProjectorState, Streams},
    supervision::CALL_LIMIT,
};

/// How often one who waits looks whether the device thread is stuck.
pub(crate) const LOOK_INTERVAL: Duration = Duration::from_millis(100);

/// A handle on a camera's streams, gain and figures; clones speak to the same camera.
///
/// This is how a shading image of a Kinect I is taken by software: `set_streams(Streams::Ir)` stops depth while IR goes on, the
/// frames that follow carry IR alone, and `set_streams(Streams::DepthAndIr)` ends it. Whether the projector is dark
/// then, only the image can say (see [`ProjectorState`]).
#[derive(Clone, Debug)]
pub struct Control {
    pub(crate) commands: Sender<Command>,
    pub(crate) shared: Arc<Shared>,
}

impl Control {
    /// Asks for these streams and waits until they are started or stopped.
    ///
    /// # Errors
    /// [`CameraError::Disconnected`] while the device is gone (the streams are started when it is back), and
    /// [`CameraError::Unresponsive`] if it does not obey in time.
    pub fn set_streams(&self, streams: Streams) -> Result<(), CameraError> {
        let (answer, answered) = bounded(1);
        self.call(Command::Streams(streams, answer), &answered)
    }

    /// Sets the gain of the IR image, from 1 to 50, and returns what the device then says it is.
    ///
    /// # Errors
    /// [`CameraError::Invalid`] for another value, else as [`Control::set_streams`].
    pub fn set_ir_gain(&self, gain: u16) -> Result<u16, CameraError> {
        check_ir_gain(gain)?;
        let (answer, answered) = bounded(1);
        self.call(Command::IrGain(gain, answer), &answered)
    }

    /// The gain of the IR image as the device last reported it.
    pub fn ir_gain(&self) -> u16 {
        self.shared.ir_gain.load(Ordering::Relaxed) as u16
    }

    /// What is known of the speckle projector.
    pub fn projector(&self) -> ProjectorState {
        match self.shared.depth_runs.load(Ordering::Relaxed) {
            true => ProjectorState::Lit,
            false => ProjectorState::Unknown,
        }
    }

    /// What became of the frames so far.
    pub fn statistics(&self) -> Statistics {
        self.shared.statistics()
    }

    fn call<T>(
        &self,
        command: Command,
        answered: &Receiver<Result<T, CameraError>>,
    ) -> Result<T, CameraError> {
        let mut command = command;
        while let Err(error) = self.commands.send_timeout(command, CALL_LIMIT) {
            let SendTimeoutError::Timeout(waiting) = error else {
                // What it did last was to close the device, however long ago.
                return Err(ended());
            };
            if let Some(error) = self.stuck() {
                return Err(error);
            }
            command = waiting;
        }
        loop {
            match answered.recv_timeout(LOOK_INTERVAL) {
                Ok(answer) => return answer,
                Err(RecvTimeoutError::Disconnected) => return Err(ended()),
                Err(RecvTimeoutError::Timeout) => match self.stuck() {
                    Some(error) => return Err(error),
                    None => continue,
                },
            }
        }
    }

    /// The error that says so, if the device thread is inside a call that has taken too long.
    pub(crate) fn stuck(&self) -> Option<CameraError> {
        self.shared.heartbeat.overdue()?;
        // Where the whole process was stopped, its threads go on together: the device thread is given the time for that.
        thread::sleep(LOOK_INTERVAL);
        let (activity, since) = self.shared.heartbeat.overdue()?;
        let secs = since.as_secs_f64();
        Some(CameraError::Unresponsive(format!(
            "{} has taken {secs:.1} s",
            activity.name()
        )))
    }
}

/// The error of a camera whose thread is no more.
pub(crate) fn ended() -> CameraError {
    CameraError::Unresponsive("its thread has ended".to_owned())
}

/// # Errors
/// [`CameraError::Invalid`] naming value and bound.
pub(crate) fn check_ir_gain(gain: u16) -> Result<(), CameraError> {
    match gain {
        1..=50 => Ok(()),
        _ => Err(CameraError::Invalid(format!(
            "ir_gain is {gain}, must be 1 to 50"
        ))),
    }
}
