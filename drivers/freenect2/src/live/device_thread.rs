//! The thread that opens, starts and closes a device: calls that take long, and on a broken device for ever.

use std::{
    sync::{
        Arc,
        mpsc::{Receiver, RecvTimeoutError, SyncSender},
    },
    time::Duration,
};

use depth_camera::CameraError;

use super::{
    shim::{Context, Library, Stream},
    slot::PacketSlot,
};
use crate::recording::DeviceRecord;

/// What the camera asks of the thread; dropping the sender ends it.
#[derive(Clone, Copy, Debug)]
pub(super) struct Reopen;

/// What the thread tells: the device streams, or it never will.
pub(super) type Report = Result<DeviceRecord, CameraError>;

/// All that the thread is given.
pub(super) struct DeviceThread {
    pub library: Library,
    /// The device's serial; the first one's if `None`.
    pub serial: Option<String>,
    pub slot: Arc<PacketSlot>,
    pub reopen_interval: Duration,
    pub commands: Receiver<Reopen>,
    pub reports: SyncSender<Report>,
}

impl DeviceThread {
    /// Streams until the camera is gone. The first opening must succeed; later ones are tried until they do.
    pub fn run(self) {
        let context = match Context::new(self.library) {
            Ok(context) => context,
            Err(error) => return self.report(Err(error)),
        };
        let serial = match self.find(&context) {
            Ok(serial) => serial,
            Err(error) => return self.report(Err(error)),
        };
        let mut stream = match self.open(&context, &serial) {
            Ok((stream, record)) => {
                self.is_back(record);
                stream
            }
            Err(error) => return self.report(Err(error)),
        };
        while self.commands.recv().is_ok() {
            drop(stream);
            match self.reopen(&context, &serial) {
                Some((again, record)) => {
                    self.is_back(record);
                    stream = again;
                }
                None => return,
            }
        }
    }

    /// Tries until the device is back; `None` when the camera is gone.
    fn reopen<'c>(&self, context: &'c Context, serial: &str) -> Option<(Stream<'c>, DeviceRecord)> {
        loop {
            let present = context
                .serials()
                .is_ok_and(|all| all.iter().any(|other| other == serial));
            if present && let Ok(opened) = self.open(context, serial) {
                return Some(opened);
            }
            match self.commands.recv_timeout(self.reopen_interval) {
                Ok(Reopen) | Err(RecvTimeoutError::Timeout) => {}
                Err(RecvTimeoutError::Disconnected) => return None,
            }
        }
    }

    /// The serial that is asked for, or the first there is.
    fn find(&self, context: &Context) -> Result<String, CameraError> {
        let found = context.serials()?;
        match &self.serial {
            Some(serial) if found.contains(serial) => Ok(serial.clone()),
            Some(_) => Err(context.why_missing()),
            None => found
                .into_iter()
                .next()
                .ok_or_else(|| context.why_missing()),
        }
    }

    fn open<'c>(
        &self,
        context: &'c Context,
        serial: &str,
    ) -> Result<(Stream<'c>, DeviceRecord), CameraError> {
        let stream = context.stream(serial, self.slot.clone())?;
        let record = stream.record(serial)?;
        Ok((stream, record))
    }

    /// Tells the camera of the stream. What it asked for while the device was being opened is done by that.
    fn is_back(&self, record: DeviceRecord) {
        while self.commands.try_recv().is_ok() {}
        self.report(Ok(record));
    }

    /// Tells the camera; one that is gone needs no telling.
    fn report(&self, report: Report) {
        let _ = self.reports.send(report);
    }
}
