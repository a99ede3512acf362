//! The camera as the rest of the program sees it.

use std::{
    cell::{Cell, RefCell},
    convert::Infallible,
    sync::Arc,
    thread,
    time::{Duration, Instant},
};

use crossbeam::channel::{Receiver, RecvTimeoutError, bounded};
use depth_camera::{CameraError, CameraInfo, DepthCamera, Frame};
use udev_monitor::UsbMonitor;

use crate::{
    announcements::Announcements,
    assembly::{Assembler, Captured, RawFrame},
    context::Context,
    control::{Control, LOOK_INTERVAL, check_ir_gain, ended},
    device_thread::DeviceThread,
    disparity::ZeroPlane,
    exchange::{Command, Event, Outlet, Shared},
    frames::{DeviceRecord, FrameDecoder},
    settings::Settings,
    streams::{IrSize, Streams},
    supervision::OPEN_LIMIT,
};

/// Frames that wait to be fetched; older ones make room for newer ones.
const EVENT_CAPACITY: usize = 4;

const COMMAND_CAPACITY: usize = 4;

/// How long closing may take before the thread is left to itself.
const CLOSE_LIMIT: Duration = Duration::from_secs(3);

/// Serial numbers of the devices that are plugged in and may be opened, in no particular order.
///
/// Models 1473 and 1517 report the number of their audio part, since their camera has none.
///
/// # Errors
/// [`CameraError::PermissionDenied`] if there are devices and none may be opened; [`CameraError::Unresponsive`].
pub fn attached() -> Result<Vec<String>, CameraError> {
    let context = Context::new()?;
    let serials = context.serials()?;
    match serials.is_empty() && context.n_cameras()? > 0 {
        true => Err(CameraError::PermissionDenied),
        false => Ok(serials),
    }
}

/// A Kinect I.
///
/// A device that is unplugged, or falls silent once its streams have come, ends in one [`CameraError::Disconnected`]. The camera then
/// looks for it by serial number: `grab` may be called again, times out while the device is away and goes on when it streams
/// again: soon after udev has announced it, where there is a monitor ([`Freenect1Camera::with_monitor`]), and at the next look
/// otherwise ([`Settings::search_interval`]). After any other error that is not recoverable the stream is over.
///
/// Dropping the camera stops and closes the device; if that does not return, the thread is left behind with it.
#[derive(Debug)]
pub struct Freenect1Camera {
    info: CameraInfo,
    device: DeviceRecord,
    decoder: FrameDecoder,
    paused_ir_size: IrSize,
    events: Receiver<Event>,
    control: Control,
    /// Nothing is ever sent; it closes when the thread ends.
    thread_lives: Receiver<Infallible>,
    over: Option<CameraError>,
}

impl Freenect1Camera {
    /// Opens the device of that serial number, or the first one, and starts its streams.
    ///
    /// # Errors
    /// [`CameraError::Disconnected`] if it is not there, [`CameraError::PermissionDenied`], [`CameraError::Busy`],
    /// [`CameraError::Invalid`] for settings or device constants that make no sense, [`CameraError::Unresponsive`].
    pub fn open(serial: Option<&str>, settings: Settings) -> Result<Self, CameraError> {
        check_ir_gain(settings.ir_gain)?;
        let shared = Arc::new(Shared::new());
        let (commands, obeyed) = bounded(COMMAND_CAPACITY);
        let (sender, events) = bounded(EVENT_CAPACITY);
        let (tell_opened, opened) = bounded(1);
        let (lives, thread_lives) = bounded(0);
        let serial = serial.map(str::to_owned);
        let outlet = Outlet {
            events: sender,
            oldest: events.clone(),
        };
        let for_thread = Arc::clone(&shared);
        let spawned = thread::Builder::new().name("freenect1".to_owned());
        let spawned = spawned.spawn(move || {
            let _lives = lives;
            let thread = DeviceThread {
                serial: RefCell::new(serial),
                streams: Cell::new(settings.streams),
                ir_gain: Cell::new(settings.ir_gain),
                shared: for_thread,
                commands: obeyed,
                outlet,
                assembler: RefCell::new(Assembler::default()),
                announcements: RefCell::new(Announcements::default()),
                search_interval: settings.search_interval,
            };
            thread.run(&tell_opened);
        });
        if let Err(error) = spawned {
            return Err(CameraError::Unresponsive(format!(
                "no thread for it: {error}"
            )));
        }
        let control = Control { commands, shared };
        let identity = match opened.recv_timeout(OPEN_LIMIT) {
            Ok(opened) => opened?,
            Err(_) => return Err(control.stuck().unwrap_or_else(ended)),
        };
        let device = DeviceRecord {
            serial: identity.serial,
            zero_plane: identity.zero_plane,
            ir_gain: control.ir_gain(),
            ir_offset_px: settings.ir_offset_px,
            lamp_position_m: settings.lamp_position_m,
        };
        Ok(Freenect1Camera {
            decoder: FrameDecoder::new(&device.zero_plane)?,
            info: device.camera_info(None),
            device,
            paused_ir_size: settings.paused_ir_size,
            events,
            control,
            thread_lives,
            over: None,
        })
    }

    /// The camera, which from now on looks for a device that has gone as soon as udev announces one.
    pub fn with_monitor(self, monitor: UsbMonitor) -> Self {
        // A thread that does not take it looks for the device by the clock.
        let _ = self.control.commands.try_send(Command::Listen(monitor));
        self
    }

    /// A handle for commands, which may be used while another thread grabs.
    pub fn control(&self) -> Control {
        self.control.clone()
    }

    /// What the device says of itself, for a recording of its disparity.
    pub fn device(&self) -> &DeviceRecord {
        &self.device
    }

    /// The constants by which the device turns disparity into depth.
    pub fn zero_plane(&self) -> &ZeroPlane {
        &self.device.zero_plane
    }

    /// As [`DepthCamera::grab`], with nothing decoded: disparity, and all rows of the IR image.
    ///
    /// # Errors
    /// As [`DepthCamera::grab`]; [`CameraError::Unresponsive`] if a stream has not come since the camera was opened, or a call to the
    /// device does not return.
    pub fn grab_raw(&mut self, timeout: Duration) -> Result<RawFrame, CameraError> {
        if let Some(error) = &self.over {
            return Err(error.clone());
        }
        let deadline = Instant::now() + timeout;
        loop {
            let remaining = deadline.saturating_duration_since(Instant::now());
            let error = match self.events.recv_timeout(remaining.min(LOOK_INTERVAL)) {
                Ok(Event::Captured(Captured::Frame(frame))) => return Ok(frame),
                Ok(Event::Captured(Captured::Damaged { frame_id, reason })) => {
                    return Err(CameraError::DamagedFrame { frame_id, reason });
                }
                Ok(Event::Failed(CameraError::Disconnected)) => {
                    return Err(CameraError::Disconnected);
                }
                Ok(Event::Failed(error)) => error,
                Err(RecvTimeoutError::Disconnected) => ended(),
                Err(RecvTimeoutError::Timeout) => match self.control.stuck() {
                    Some(error) => error,
                    None if remaining.is_zero() => {
                        return Err(CameraError::Timeout { waited: timeout });
                    }
                    None => continue,
                },
            };
            self.over = Some(error.clone());
            return Err(error);
        }
    }

    /// The frame that [`DepthCamera::grab`] makes of raw data.
    pub fn decode(&self, raw: RawFrame) -> Frame {
        self.decoder.frame(raw)
    }
}

impl DepthCamera for Freenect1Camera {
    fn info(&self) -> &CameraInfo {
        &self.info
    }

    /// Depth in metres and IR at 640×480, the IR image not yet moved by the offset that calibration knows; one of 1280×1024
    /// pixels is reduced to that size, so that all images have one camera.
    fn grab(&mut self, timeout: Duration) -> Result<Option<Frame>, CameraError> {
        let raw = self.grab_raw(timeout)?;
        Ok(Some(self.decode(raw)))
    }

    fn n_missed(&self) -> u64 {
        self.control.statistics().n_missed()
    }

    fn pause_depth(&mut self) -> Result<(), CameraError> {
        self.control
            .set_streams(Streams::ir_alone(self.paused_ir_size))
    }

    fn resume_depth(&mut self) -> Result<(), CameraError> {
        self.control.set_streams(Streams::DepthAndIr)
    }
}

impl Drop for Freenect1Camera {
    fn drop(&mut self) {
        let stop = self
            .control
            .commands
            .send_timeout(Command::Stop, CLOSE_LIMIT);
        if stop.is_ok() {
            // Ends when the thread does; a thread inside a call that never returns cannot be helped.
            let _ = self.thread_lives.recv_timeout(CLOSE_LIMIT);
        }
    }
}
