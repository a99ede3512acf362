//! The camera as the rest of the program sees it.

use std::{
    cell::{Cell, RefCell},
    convert::Infallible,
    sync::Arc,
    thread,
    time::{Duration, Instant},
};

use crossbeam::channel::{Receiver, RecvTimeoutError, bounded};
use depth_camera::{
    CameraError, CameraInfo, DepthCamera, Frame, ImagePool, Intrinsics, Light, LightKind, Sensor,
};

use crate::{
    assembly::{Assembler, Captured, RawFrame},
    context::Context,
    control::{Control, LOOK_INTERVAL, check_ir_gain, ended},
    device_thread::{Command, DeviceThread, Event, Identity, Outlet, Shared},
    disparity::{DisparityTable, ZeroPlane},
    streams::{DEPTH_SIZE, IrSize, Streams},
};

/// How far right of and below its place in the depth image a point lies in the IR image, pixels, where the device has not been
/// calibrated: what the correlation window of 9×7 pixels does. Units differ; calibration's `ir_offset_px` is the measured value.
pub const NOMINAL_IR_OFFSET_PX: [f64; 2] = [5.0, 4.0];

/// Principal point of the IR image where the device has not been calibrated, pixels.
const NOMINAL_IR_CENTRE_PX: [f64; 2] = [319.5, 239.5];

/// Frames that wait to be fetched; older ones make room for newer ones.
const EVENT_CAPACITY: usize = 4;

const COMMAND_CAPACITY: usize = 4;

/// Depth images on their way through the pipeline whose buffers are used again.
const POOL_CAPACITY: usize = 16;

/// A device of the later models resets its audio part when it is opened, which takes a second.
const OPEN_LIMIT: Duration = Duration::from_secs(10);

/// How long closing may take before the thread is left to itself.
const CLOSE_LIMIT: Duration = Duration::from_secs(3);

/// What is decided before the device is opened.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Settings {
    /// What to deliver at first.
    pub streams: Streams,
    /// Gain of the IR image, 1 to 50. Light strength and albedo scale with it: keep it for a whole scan.
    pub ir_gain: u16,
    /// Where the lamp of the shading images is, IR camera's frame, metres; `None` if there is none.
    pub lamp_position_m: Option<[f64; 3]>,
}

impl Default for Settings {
    fn default() -> Self {
        Settings {
            streams: Streams::default(),
            // What the device starts with.
            ir_gain: 30,
            lamp_position_m: None,
        }
    }
}

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
/// After [`CameraError::Disconnected`] the camera looks for its device by serial number: `grab` may be called again, times out
/// while the device is away and goes on when it is back. After any other error that is not recoverable the stream is over.
///
/// Dropping the camera stops and closes the device; if that does not return, the thread is left behind with it.
#[derive(Debug)]
pub struct Freenect1Camera {
    info: CameraInfo,
    zero_plane: ZeroPlane,
    table: DisparityTable,
    metres: ImagePool<f32>,
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
        Ok(Freenect1Camera {
            table: DisparityTable::new(&identity.zero_plane)?,
            zero_plane: identity.zero_plane,
            info: describe(identity, &settings),
            metres: ImagePool::new(POOL_CAPACITY),
            events,
            control,
            thread_lives,
            over: None,
        })
    }

    /// A handle for commands, which may be used while another thread grabs.
    pub fn control(&self) -> Control {
        self.control.clone()
    }

    /// The constants by which the device turns disparity into depth.
    pub fn zero_plane(&self) -> &ZeroPlane {
        &self.zero_plane
    }

    /// As [`DepthCamera::grab`], with nothing decoded: disparity, and all rows of the IR image.
    ///
    /// # Errors
    /// As [`DepthCamera::grab`]; [`CameraError::Unresponsive`] if a stream is silent or a call to the device does not return.
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

    fn decode(&self, raw: RawFrame) -> Frame {
        let depth = raw.disparity.map(|disparity| {
            let (width, height) = (disparity.width(), disparity.height());
            let mut metres = self.metres.take(width * height);
            self.table.convert(&disparity, &mut metres);
            self.metres.image(width, height, metres)
        });
        // Row 0 is the depth image's; what is more lies at the bottom.
        let (_, depth_rows) = DEPTH_SIZE;
        let ir = raw
            .ir
            .map(|ir| match ir.width() == IrSize::Medium.pixels().0 {
                true => ir.top_rows(depth_rows),
                false => ir,
            });
        Frame {
            frame_id: raw.frame_id,
            device_time_secs: raw.device_time_secs,
            host_time: raw.host_time,
            depth,
            ir,
        }
    }
}

impl DepthCamera for Freenect1Camera {
    fn info(&self) -> &CameraInfo {
        &self.info
    }

    /// Depth in metres and IR at 640×480, the IR image not yet moved by the offset that calibration knows; at
    /// [`Streams::IrHigh`] the IR image is 1280×1024 and has the camera of no other image.
    fn grab(&mut self, timeout: Duration) -> Result<Option<Frame>, CameraError> {
        let raw = self.grab_raw(timeout)?;
        Ok(Some(self.decode(raw)))
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

/// The device with nominal lens: a focal length by its own constants, no distortion.
fn describe(identity: Identity, settings: &Settings) -> CameraInfo {
    let (width, height) = DEPTH_SIZE;
    let focal_px = identity.zero_plane.focal_px();
    CameraInfo {
        sensor: Sensor::Kinect1,
        serial: identity.serial,
        driver: Some("libfreenect".to_owned()),
        intrinsics: Intrinsics {
            width,
            height,
            fx: focal_px,
            fy: focal_px,
            cx: NOMINAL_IR_CENTRE_PX[0] - NOMINAL_IR_OFFSET_PX[0],
            cy: NOMINAL_IR_CENTRE_PX[1] - NOMINAL_IR_OFFSET_PX[1],
            k1: 0.0,
            k2: 0.0,
            p1: 0.0,
            p2: 0.0,
            k3: 0.0,
        },
        ir_full_scale: Some(1023.0),
        light: settings.lamp_position_m.map(|position_m| Light {
            position_m,
            kind: LightKind::Lamp,
        }),
        n_frames: None,
    }
}
