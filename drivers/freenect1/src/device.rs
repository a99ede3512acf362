//! An open device, with the library's rules made into a type.
//!
//! It borrows its context, so that it is closed first; its `Drop` stops video, then depth, then closes.

use std::{
    cell::{Cell, RefCell},
    ffi::CString,
    ptr::{self, NonNull},
    time::Instant,
};

use depth_camera::CameraError;
use freenect1_sys as sys;

use crate::{
    assembly::{Assembler, Captured},
    callbacks::{self, Sink},
    context::{Context, failure, forget_warnings},
    disparity::ZeroPlane,
    streams::IrSize,
    supervision::{Activity, Heartbeat},
};

/// An open camera.
pub(crate) struct Device<'a> {
    raw: NonNull<sys::freenect_device>,
    /// Boxed: the library holds its address.
    sink: Box<Sink<'a>>,
    heartbeat: &'a Heartbeat,
    depth_runs: Cell<bool>,
    ir_runs: Cell<Option<IrSize>>,
    _context: &'a Context,
}

impl<'a> Device<'a> {
    /// Opens the camera of that serial number; what its streams bring goes to `emit`.
    ///
    /// # Errors
    /// [`CameraError::Disconnected`] if it is not there, [`CameraError::PermissionDenied`], [`CameraError::Busy`].
    pub(crate) fn open(
        context: &'a Context,
        serial: &str,
        assembler: &'a RefCell<Assembler>,
        heartbeat: &'a Heartbeat,
        emit: &'a dyn Fn(Captured),
    ) -> Result<Self, CameraError> {
        heartbeat.enter(Activity::Opening);
        let serials = context.serials()?;
        if !serials.iter().any(|listed| listed == serial) {
            // The library leaves out of its list what it may not open.
            return Err(match serials.len() < context.n_cameras()? {
                true => CameraError::PermissionDenied,
                false => CameraError::Disconnected,
            });
        }
        let name = CString::new(serial)
            .map_err(|_| CameraError::Invalid(format!("serial {serial:?} holds a zero byte")))?;
        let mut raw = ptr::null_mut();
        let code = {
            // SAFETY: the context lives, `raw` is a valid place for the result, `name` ends with zero.
            unsafe {
                sys::freenect_open_device_by_camera_serial(context.raw(), &mut raw, name.as_ptr())
            }
        };
        // The library may fail and leave a device behind, which is then closed by `Drop`.
        let device = NonNull::new(raw).map(|raw| Device {
            raw,
            sink: Box::new(Sink::new(assembler, emit)),
            heartbeat,
            depth_runs: Cell::new(false),
            ir_runs: Cell::new(None),
            _context: context,
        });
        match device {
            Some(device) if code >= 0 => {
                // SAFETY: the device is open; its sink is boxed and dropped after `Drop` has closed it.
                unsafe { callbacks::connect(device.raw, &device.sink) };
                forget_warnings();
                Ok(device)
            }
            _ => Err(failure("opening the camera", code)),
        }
    }

    /// The constants of triangulation that the device reports of itself.
    pub(crate) fn zero_plane(&self) -> ZeroPlane {
        // SAFETY: the device is open.
        let mut registration = unsafe { sys::freenect_copy_registration(self.raw.as_ptr()) };
        let zero_plane = ZeroPlane {
            emitter_distance_cm: registration.zero_plane_info.dcmos_emitter_dist.into(),
            reference_distance_mm: registration.zero_plane_info.reference_distance.into(),
            reference_pixel_size_mm: registration.zero_plane_info.reference_pixel_size.into(),
            const_shift: registration.const_shift,
        };
        // SAFETY: the registration was made above and its tables are not used afterwards.
        unsafe { sys::freenect_destroy_registration(&mut registration) };
        zero_plane
    }

    /// Sets the gain of the IR image, 1 to 50, and returns what the device says it is then.
    pub(crate) fn set_ir_gain(&self, gain: u16) -> Result<u16, CameraError> {
        self.heartbeat.enter(Activity::SettingGain);
        // SAFETY: the device is open.
        let code = unsafe { sys::freenect_set_ir_brightness(self.raw.as_ptr(), gain) };
        if code < 0 {
            return Err(failure("freenect_set_ir_brightness", code));
        }
        // SAFETY: the device is open.
        let gain = unsafe { sys::freenect_get_ir_brightness(self.raw.as_ptr()) };
        u16::try_from(gain).map_err(|_| failure("freenect_get_ir_brightness", gain))
    }

    /// Starts depth, if it does not run.
    pub(crate) fn start_depth(&self) -> Result<(), CameraError> {
        if self.depth_runs.get() {
            return Ok(());
        }
        self.heartbeat.enter(Activity::StartingDepth);
        let buffer = {
            let mut assembler = self.sink.assembler.borrow_mut();
            assembler.start_depth(Instant::now(), self.sink.emit);
            assembler.depth_buffer().as_mut_ptr()
        };
        // SAFETY: asks for a description, no device is involved.
        let mode = unsafe {
            sys::freenect_find_depth_mode(
                sys::FREENECT_RESOLUTION_MEDIUM,
                sys::FREENECT_DEPTH_11BIT,
            )
        };
        check_mode("depth", &mode)?;
        // SAFETY: the device is open, depth is stopped, the mode is one of the library's.
        let code = unsafe { sys::freenect_set_depth_mode(self.raw.as_ptr(), mode) };
        if code < 0 {
            return Err(failure("freenect_set_depth_mode", code));
        }
        // SAFETY: the buffer holds 640×480 values of 16 bits, as the mode asks, and stays until `depth_filled` names another.
        let code = unsafe { sys::freenect_set_depth_buffer(self.raw.as_ptr(), buffer.cast()) };
        if code < 0 {
            return Err(failure("freenect_set_depth_buffer", code));
        }
        // SAFETY: the device is open, its callbacks and its buffer are set.
        let code = unsafe { sys::freenect_start_depth(self.raw.as_ptr()) };
        if code < 0 {
            return Err(failure("freenect_start_depth", code));
        }
        self.depth_runs.set(true);
        Ok(())
    }

    /// Starts IR, if it does not run at that size; at another size it must have been stopped.
    pub(crate) fn start_ir(&self, size: IrSize) -> Result<(), CameraError> {
        if self.ir_runs.get() == Some(size) {
            return Ok(());
        }
        self.heartbeat.enter(Activity::StartingIr);
        let buffer = {
            let mut assembler = self.sink.assembler.borrow_mut();
            assembler.start_ir(size, Instant::now(), self.sink.emit);
            assembler.ir_buffer().as_mut_ptr()
        };
        let resolution = match size {
            IrSize::Medium => sys::FREENECT_RESOLUTION_MEDIUM,
            IrSize::High => sys::FREENECT_RESOLUTION_HIGH,
        };
        // SAFETY: asks for a description, no device is involved.
        let mode =
            unsafe { sys::freenect_find_video_mode(resolution, sys::FREENECT_VIDEO_IR_10BIT) };
        check_mode("IR", &mode)?;
        // SAFETY: the device is open, video is stopped, the mode is one of the library's.
        let code = unsafe { sys::freenect_set_video_mode(self.raw.as_ptr(), mode) };
        if code < 0 {
            return Err(failure("freenect_set_video_mode", code));
        }
        // SAFETY: the buffer holds as many values of 16 bits as the mode asks, and stays until `ir_filled` names another.
        let code = unsafe { sys::freenect_set_video_buffer(self.raw.as_ptr(), buffer.cast()) };
        if code < 0 {
            return Err(failure("freenect_set_video_buffer", code));
        }
        // SAFETY: the device is open, its callbacks and its buffer are set.
        let code = unsafe { sys::freenect_start_video(self.raw.as_ptr()) };
        if code < 0 {
            return Err(failure("freenect_start_video", code));
        }
        self.ir_runs.set(Some(size));
        Ok(())
    }

    /// Stops IR, if it runs.
    pub(crate) fn stop_ir(&self) {
        if self.ir_runs.take().is_none() {
            return;
        }
        self.heartbeat.enter(Activity::StoppingIr);
        // SAFETY: the device is open. A failure says that the stream was stopped already, as it is when the device has gone.
        unsafe { sys::freenect_stop_video(self.raw.as_ptr()) };
        self.sink.assembler.borrow_mut().stop_ir(self.sink.emit);
    }

    /// Stops depth, if it runs.
    pub(crate) fn stop_depth(&self) {
        if !self.depth_runs.replace(false) {
            return;
        }
        self.heartbeat.enter(Activity::StoppingDepth);
        // SAFETY: as in `stop_ir`.
        unsafe { sys::freenect_stop_depth(self.raw.as_ptr()) };
        self.sink.assembler.borrow_mut().stop_depth(self.sink.emit);
    }

    /// The size at which IR runs, if it does.
    pub(crate) fn ir_runs(&self) -> Option<IrSize> {
        self.ir_runs.get()
    }
}

impl Drop for Device<'_> {
    fn drop(&mut self) {
        // Closed with both streams running, the library stops depth alone and crashes over the transfers of the other.
        self.stop_ir();
        self.stop_depth();
        self.heartbeat.enter(Activity::Closing);
        // SAFETY: the device is open and its streams are stopped; nothing uses it afterwards.
        unsafe { sys::freenect_close_device(self.raw.as_ptr()) };
    }
}

fn check_mode(stream: &str, mode: &sys::freenect_frame_mode) -> Result<(), CameraError> {
    match mode.is_valid {
        0 => Err(CameraError::Unresponsive(format!(
            "libfreenect does not know the mode of {stream}"
        ))),
        _ => Ok(()),
    }
}
