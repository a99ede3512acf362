//! A live Kinect II as a depth camera.

use std::{
    sync::{
        Arc,
        mpsc::{self, Receiver, RecvTimeoutError, SyncSender},
    },
    thread::{self, JoinHandle},
    time::{Duration, Instant},
};

use depth_camera::{CameraError, CameraInfo, DepthCamera, Frame, whole_microseconds};
use udev_monitor::{Action, UsbMonitor};

use super::{
    device_thread::{DeviceThread, Reopen, Report},
    listening::Listening,
    shim::{self, Library},
    slot::{PacketCounts, PacketSlot, Stamped},
};
use crate::{
    frames::{self, FrameDecoder},
    options::DecoderOptions,
    packet::RawPacket,
    recording::DeviceRecord,
};

/// How often udev and the device's silence are listened to while something is awaited.
const LISTEN_INTERVAL: Duration = Duration::from_millis(20);

/// How a live device is used.
#[derive(Clone, Debug)]
pub struct LiveOptions {
    /// Which device; the first one's if `None`.
    pub serial: Option<String>,
    /// How its packets are decoded; frames are never mirrored.
    pub decoder: DecoderOptions,
    /// How long opening may take, until its calibration is read. Opening resets the device.
    pub open_timeout: Duration,
    /// How long the first packet may take to come after that.
    pub first_packet_timeout: Duration,
    /// Silence after which the device counts as unplugged, which is all that libfreenect2 lets see: 15 frames.
    pub max_silence: Duration,
    /// How long packets may come of which none is whole and in order, before the device counts as unplugged.
    pub max_without_good: Duration,
    /// How often an unplugged device is looked for.
    pub reopen_interval: Duration,
    /// How long closing may take before the thread that waits for it is left behind.
    pub close_timeout: Duration,
}

impl Default for LiveOptions {
    fn default() -> Self {
        LiveOptions {
            serial: None,
            decoder: DecoderOptions::default(),
            open_timeout: Duration::from_secs(10),
            first_packet_timeout: Duration::from_secs(3),
            max_silence: Duration::from_millis(500),
            max_without_good: Duration::from_secs(3),
            reopen_interval: Duration::from_millis(500),
            close_timeout: Duration::from_secs(2),
        }
    }
}

/// A live Kinect II.
///
/// `grab` decodes the newest packet; older ones that nobody took are left out, and `frame_id` counts them and those that were
/// lost. A device that sends nothing at all once it is open ends in [`CameraError::Unresponsive`]. Silence after that, some seconds
/// without a good packet, or udev's word that the device has gone, ends in one [`CameraError::Disconnected`]; from then on the device
/// is looked for by its serial, `grab` gives [`CameraError::Timeout`] until it is back, and the stream goes on with higher `frame_id`s
/// and later times.
#[derive(Debug)]
pub struct Freenect2Camera {
    library: Library,
    info: CameraInfo,
    record: DeviceRecord,
    options: LiveOptions,
    decoder: FrameDecoder,
    slot: Arc<PacketSlot>,
    packet: Stamped,
    /// The time with the present stream; `None` while the device is gone.
    listening: Option<Listening>,
    /// Tells of unplugging before silence does, and of plugging in before it is looked for again.
    monitor: Option<UsbMonitor>,
    /// Taken when the camera is dropped, which ends the thread.
    commands: Option<SyncSender<Reopen>>,
    reports: Receiver<Report>,
    thread: Option<JoinHandle<()>>,
}

impl Freenect2Camera {
    /// Opens a device, starts depth and reads its calibration.
    ///
    /// # Errors
    /// [`CameraError::Disconnected`] without such a device, [`CameraError::Busy`], [`CameraError::PermissionDenied`],
    /// [`CameraError::Unresponsive`] if the library does not answer in time, [`CameraError::Invalid`] for options or a calibration
    /// that make no sense, and with the library's own words for all else.
    pub fn open(library: Library, options: LiveOptions) -> Result<Self, CameraError> {
        let slot = Arc::new(PacketSlot::new());
        // One of each is under way at most; a second command has nothing to add.
        let (commands, from_camera) = mpsc::sync_channel(1);
        let (to_camera, reports) = mpsc::sync_channel(1);
        let device = DeviceThread {
            library,
            serial: options.serial.clone(),
            slot: slot.clone(),
            reopen_interval: options.reopen_interval,
            commands: from_camera,
            reports: to_camera,
        };
        let thread = thread::Builder::new()
            .name("k2-device".to_owned())
            .spawn(|| device.run())
            .map_err(|error| CameraError::Invalid(format!("no thread for the device: {error}")))?;
        let record = match wait_for_report(&reports, options.open_timeout) {
            Err(CameraError::Timeout { waited }) => {
                let secs = waited.as_secs_f64();
                let what = format!("opening has taken {secs} s");
                return Err(CameraError::Unresponsive(what));
            }
            report => report?,
        };
        Ok(Freenect2Camera {
            library,
            info: frames::camera_info(&record.serial, &record.ir_parameters, None),
            decoder: decoder_of(&record, options.decoder)?,
            record,
            options,
            slot,
            packet: Stamped::empty(),
            listening: Some(Listening::begin(Instant::now())),
            monitor: None,
            commands: Some(commands),
            reports,
            thread: Some(thread),
        })
    }

    /// The camera, which from now on believes what udev says of its device.
    pub fn with_monitor(mut self, monitor: UsbMonitor) -> Self {
        self.monitor = Some(monitor);
        self
    }

    /// What the device says of itself, for a recording of its packets.
    pub fn device(&self) -> &DeviceRecord {
        &self.record
    }

    /// What became of the packets so far.
    pub fn counts(&self) -> PacketCounts {
        self.slot.counts()
    }

    /// The packet of the last frame, to be recorded; all zero before the first.
    pub fn last_packet(&self) -> RawPacket<'_> {
        RawPacket::new(&self.packet.bytes).expect("a slot holds whole packets alone")
    }

    /// Waits until the device is back.
    fn wait_for_return(&mut self, timeout: Duration) -> Result<(), CameraError> {
        let deadline = Instant::now() + timeout;
        let record = loop {
            // A report that waits already comes first, so that nothing is asked for that has been done.
            match wait_for_report(&self.reports, Duration::ZERO) {
                Err(CameraError::Timeout { .. }) => {}
                report => break report?,
            }
            if self.heard() == Some(Action::Added) {
                self.look_for_device();
            }
            let remaining = deadline.saturating_duration_since(Instant::now());
            match wait_for_report(&self.reports, remaining.min(LISTEN_INTERVAL)) {
                Err(CameraError::Timeout { .. }) if remaining > LISTEN_INTERVAL => {}
                Err(CameraError::Timeout { .. }) => {
                    return Err(CameraError::Timeout { waited: timeout });
                }
                report => break report?,
            }
        };
        // Opening resets the device, which is no unplugging.
        self.heard();
        if record != self.record {
            self.decoder = decoder_of(&record, self.options.decoder)?;
            self.info = frames::camera_info(&record.serial, &record.ir_parameters, None);
            self.record = record;
        }
        self.listening = Some(Listening::begin(Instant::now()));
        Ok(())
    }

    /// Waits until then for the newest packet.
    fn take(&mut self, until: Instant) -> bool {
        let is_taken = self.slot.take(&mut self.packet, until);
        if let Some(listening) = &mut self.listening {
            listening.turn(Instant::now());
        }
        is_taken
    }

    /// Gives the device up and has it looked for if it counts as unplugged, by udev's word or by what comes from it: bad packets are a
    /// sign of life for a while.
    fn give_up(&mut self) -> Result<(), CameraError> {
        let is_removed = self.heard() == Some(Action::Removed);
        let (heard, now) = (self.slot.heard(), Instant::now());
        let is_silent = |listening: Listening| listening.is_gone(now, heard, &self.options);
        if !is_removed && !self.listening.is_none_or(is_silent) {
            return Ok(());
        }
        self.listening = None;
        self.look_for_device();
        match heard.any {
            None if !is_removed => Err(self.never_heard()),
            _ => Err(CameraError::Disconnected),
        }
    }

    /// Says that nothing has come since the device was opened, and what the library makes of that.
    fn never_heard(&self) -> CameraError {
        let secs = self.options.first_packet_timeout.as_secs_f64();
        let mut what = format!("no packet within {secs} s of the start");
        let errors = shim::errors(self.library);
        if !errors.is_empty() {
            what = format!("{what}: {errors}");
        }
        CameraError::Unresponsive(what)
    }

    fn look_for_device(&self) {
        if let Some(commands) = &self.commands {
            // Full means that it is being looked for already.
            let _ = commands.try_send(Reopen);
        }
    }

    /// The newest that udev has said of the device since it was listened to last.
    fn heard(&mut self) -> Option<Action> {
        let mut newest = None;
        while let Some(monitor) = &mut self.monitor {
            match monitor.next(Duration::ZERO) {
                Ok(Some(event)) if event.serial.as_ref() == Some(&self.record.serial) => {
                    newest = Some(event.action);
                }
                Ok(Some(_)) => {}
                Ok(None) => break,
                // Without it silence tells.
                Err(_) => self.monitor = None,
            }
        }
        newest
    }
}

impl DepthCamera for Freenect2Camera {
    fn info(&self) -> &CameraInfo {
        &self.info
    }

    fn grab(&mut self, timeout: Duration) -> Result<Option<Frame>, CameraError> {
        let deadline = Instant::now() + timeout;
        if self.listening.is_none() {
            self.wait_for_return(timeout)?;
        }
        while !self.take(deadline.min(Instant::now() + LISTEN_INTERVAL)) {
            self.give_up()?;
            if Instant::now() >= deadline {
                return Err(CameraError::Timeout { waited: timeout });
            }
        }
        let packet = RawPacket::new(&self.packet.bytes).expect("a slot holds whole packets alone");
        Ok(Some(self.decoder.frame(
            packet,
            self.packet.position,
            whole_microseconds(self.packet.device_time_secs),
            self.packet.host_time,
        )))
    }

    fn n_missed(&self) -> u64 {
        self.counts().n_missed()
    }
}

impl Drop for Freenect2Camera {
    fn drop(&mut self) {
        self.commands = None;
        let deadline = Instant::now() + self.options.close_timeout;
        // The thread drops its end when it is done; a device that came back meanwhile is of no use.
        loop {
            let remaining = deadline.saturating_duration_since(Instant::now());
            match self.reports.recv_timeout(remaining) {
                Ok(_) => {}
                Err(RecvTimeoutError::Timeout) => return,
                Err(RecvTimeoutError::Disconnected) => break,
            }
        }
        if let Some(thread) = self.thread.take() {
            // A panic there was told of by its hook.
            let _ = thread.join();
        }
    }
}

fn wait_for_report(
    reports: &Receiver<Report>,
    timeout: Duration,
) -> Result<DeviceRecord, CameraError> {
    match reports.recv_timeout(timeout) {
        Ok(report) => report,
        Err(RecvTimeoutError::Timeout) => Err(CameraError::Timeout { waited: timeout }),
        Err(RecvTimeoutError::Disconnected) => Err(CameraError::Disconnected),
    }
}

fn decoder_of(record: &DeviceRecord, options: DecoderOptions) -> Result<FrameDecoder, CameraError> {
    let serial = &record.serial;
    let invalid = |what: &dyn std::fmt::Display| CameraError::Invalid(format!("{serial}: {what}"));
    let tables = record.p0_tables().map_err(|error| invalid(&error))?;
    FrameDecoder::new(&tables, &record.ir_parameters, options).map_err(|error| invalid(&error))
}
