//! libfreenect's context, and what the library says when something fails.

use std::{
    cell::{Cell, RefCell},
    ffi::{CStr, c_char, c_int},
    ptr::{self, NonNull},
    time::Duration,
};

use depth_camera::CameraError;
use freenect1_sys as sys;

// libusb's codes, which libfreenect hands on.
const LIBUSB_ERROR_ACCESS: c_int = -3;
const LIBUSB_ERROR_NO_DEVICE: c_int = -4;
const LIBUSB_ERROR_BUSY: c_int = -6;
const LIBUSB_ERROR_INTERRUPTED: c_int = -10;

/// What libfreenect returns for a device that has gone while it streamed, and for much else.
const FAILED: c_int = -1;

thread_local! {
    /// The newest warning of the library on this thread; it tells there what its return values do not.
    static NEWEST_WARNING: RefCell<String> = const { RefCell::new(String::new()) };

    /// The newest of libusb's codes that ended a warning on this thread; 0 if there was none.
    static NEWEST_CODE: Cell<c_int> = const { Cell::new(0) };
}

/// What the library warned of so far explains nothing that happens from now on.
pub(crate) fn forget_warnings() {
    NEWEST_WARNING.with_borrow_mut(String::clear);
    NEWEST_CODE.set(0);
}

/// What the library warned of last on this thread, in brackets for the end of a message; empty if it did not.
pub(crate) fn newest_warning() -> String {
    NEWEST_WARNING.with_borrow(|warning| match warning.is_empty() {
        true => String::new(),
        false => format!(" (libfreenect: {warning})"),
    })
}

/// The error of a call that returned `code`.
pub(crate) fn failure(what: &str, code: c_int) -> CameraError {
    // Version 0.5.3 returns -1 for whatever keeps it from opening a device, and writes libusb's code into its log alone.
    let cause = match code {
        FAILED => NEWEST_CODE.get(),
        code => code,
    };
    match cause {
        LIBUSB_ERROR_ACCESS => CameraError::PermissionDenied,
        LIBUSB_ERROR_NO_DEVICE => CameraError::Disconnected,
        LIBUSB_ERROR_BUSY => CameraError::Busy,
        _ => CameraError::Unresponsive(format!("{what} failed with {code}{}", newest_warning())),
    }
}

/// A context of the library, with a USB context of its own: devices of two contexts do not know of each other.
///
/// It stays on the thread that made it.
pub(crate) struct Context {
    raw: NonNull<sys::freenect_context>,
}

impl Context {
    pub(crate) fn new() -> Result<Self, CameraError> {
        forget_warnings();
        let mut raw = ptr::null_mut();
        // SAFETY: `raw` is a valid place for the result; a null USB context asks for one of its own.
        let code = unsafe { sys::freenect_init(&mut raw, ptr::null_mut()) };
        let raw = match NonNull::new(raw) {
            Some(raw) if code >= 0 => raw,
            _ => return Err(failure("freenect_init", code)),
        };
        // SAFETY: the context was made above and is shut down in `Drop` alone.
        unsafe { sys::freenect_set_log_level(raw.as_ptr(), sys::FREENECT_LOG_WARNING) };
        // SAFETY: as above; the callback is a function, which stays.
        unsafe { sys::freenect_set_log_callback(raw.as_ptr(), Some(keep_warning)) };
        // SAFETY: as above. Neither motor nor audio: with the camera alone no firmware is loaded and nothing moves.
        unsafe { sys::freenect_select_subdevices(raw.as_ptr(), sys::FREENECT_DEVICE_CAMERA) };
        Ok(Context { raw })
    }

    pub(crate) fn raw(&self) -> *mut sys::freenect_context {
        self.raw.as_ptr()
    }

    /// How many cameras are plugged in; none is opened for it.
    pub(crate) fn n_cameras(&self) -> Result<usize, CameraError> {
        // SAFETY: the context lives.
        let count = unsafe { sys::freenect_num_devices(self.raw.as_ptr()) };
        usize::try_from(count).map_err(|_| failure("freenect_num_devices", count))
    }

    /// Serial numbers of the cameras that may be opened, in the library's order.
    pub(crate) fn serials(&self) -> Result<Vec<String>, CameraError> {
        let mut list = ptr::null_mut();
        // SAFETY: the context lives, and `list` is a valid place for the result.
        let code = unsafe { sys::freenect_list_device_attributes(self.raw.as_ptr(), &mut list) };
        if code < 0 {
            return Err(failure("freenect_list_device_attributes", code));
        }
        let mut serials = Vec::new();
        let mut item = list;
        // SAFETY: items of the list are valid or null until the list is freed below.
        while let Some(attributes) = unsafe { item.as_ref() } {
            // SAFETY: the library makes every serial a string of its own, ended by zero.
            let serial = unsafe { CStr::from_ptr(attributes.camera_serial) };
            serials.push(serial.to_string_lossy().into_owned());
            item = attributes.next;
        }
        // SAFETY: the list is the library's, and nothing refers to it any more.
        unsafe { sys::freenect_free_device_attributes(list) };
        Ok(serials)
    }

    /// Waits at most `timeout` for events and lets the library handle them: callbacks run in here.
    ///
    /// # Errors
    /// [`CameraError::Disconnected`] when a device has gone; its streams are stopped then.
    pub(crate) fn pump(&self, timeout: Duration) -> Result<(), CameraError> {
        let mut timeout = sys::timeval {
            tv_sec: 0,
            tv_usec: timeout.as_micros().min(999_999) as i64,
        };
        // SAFETY: the context lives, and `timeout` for the call.
        let code = unsafe { sys::freenect_process_events_timeout(self.raw.as_ptr(), &mut timeout) };
        match code {
            0.. | LIBUSB_ERROR_INTERRUPTED => Ok(()),
            FAILED => Err(CameraError::Disconnected),
            code => Err(failure("freenect_process_events_timeout", code)),
        }
    }
}

impl Drop for Context {
    fn drop(&mut self) {
        // SAFETY: devices borrow the context, so none is open; nothing uses it afterwards.
        unsafe { sys::freenect_shutdown(self.raw.as_ptr()) };
    }
}

unsafe extern "C" fn keep_warning(
    _context: *mut sys::freenect_context,
    level: sys::freenect_loglevel,
    message: *const c_char,
) {
    if level > sys::FREENECT_LOG_WARNING || message.is_null() {
        return;
    }
    // SAFETY: the library calls with a string of its own, ended by zero.
    let message = unsafe { CStr::from_ptr(message) }.to_string_lossy();
    let message = message.trim_end();
    if let Some(code) = code_of(message) {
        NEWEST_CODE.set(code);
    }
    NEWEST_WARNING.with_borrow_mut(|kept| {
        kept.clear();
        kept.push_str(message);
    });
}

/// The code of libusb's that ends a warning, as a number or as a name.
fn code_of(warning: &str) -> Option<c_int> {
    let (_, code) = warning.rsplit_once(": ")?;
    match code {
        "LIBUSB_ERROR_ACCESS" => Some(LIBUSB_ERROR_ACCESS),
        "LIBUSB_ERROR_NO_DEVICE" => Some(LIBUSB_ERROR_NO_DEVICE),
        "LIBUSB_ERROR_BUSY" => Some(LIBUSB_ERROR_BUSY),
        number => number.parse().ok(),
    }
}
