//! A second implementation of the shim's header, for tests: no device, no library, packets from the test.
//!
//! [`Unit`] is a device on a bus that the whole process shares; tests keep apart by serial. A unit can be unplugged, which is
//! silence and nothing else, as with libfreenect2, and plugged in again; packets of any size, order and status can be sent.

use std::{
    cell::RefCell,
    collections::BTreeMap,
    ffi::{CStr, c_char, c_void},
    ptr, slice,
    sync::{Mutex, MutexGuard, PoisonError},
};

use freenect2::Library;
use freenect2_sys::{
    F2SHIM_FAILED, F2SHIM_NOT_FOUND, F2SHIM_OK, F2SHIM_TOO_SMALL, F2SHIM_WRONG_STATE, f2shim_api,
    f2shim_context, f2shim_device, f2shim_ir_parameters, f2shim_packet, f2shim_packet_callback,
    f2shim_status,
};

pub use freenect2_sys::f2shim_ir_parameters as AnsweredCamera;

/// What a unit answers when it is asked.
#[derive(Clone, Debug)]
pub struct Answers {
    /// Version of its firmware.
    pub firmware: String,
    /// The response with its phase tables, whole or not.
    pub p0_response: Vec<u8>,
    /// Its IR camera.
    pub ir_parameters: f2shim_ir_parameters,
    /// What the library logs when it cannot be opened; it can be if this is empty.
    pub open_error: String,
    /// What the library logs when it leaves the unit out of a list; it is listed if this is empty.
    pub list_error: String,
}

/// A packet to be sent.
#[derive(Clone, Copy, Debug)]
pub struct Packet<'a> {
    /// Its bytes.
    pub bytes: &'a [u8],
    /// Device clock, 0.125 ms.
    pub timestamp: u32,
    /// Its number.
    pub sequence: u32,
    /// 0 if nothing is wrong.
    pub status: u32,
}

/// A device on the bus.
#[derive(Debug)]
struct Plugged {
    answers: Answers,
    present: bool,
    /// Counts how often it was plugged in: a handle of an earlier time is dead.
    plugging: u32,
    stream: Option<Stream>,
    n_open: usize,
}

/// Where packets go.
#[derive(Clone, Copy, Debug)]
struct Stream {
    callback: f2shim_packet_callback,
    user: *mut c_void,
}

// SAFETY: the pointer is only handed to the callback that came with it, which the header lets run on any thread.
unsafe impl Send for Stream {}

static BUS: Mutex<BTreeMap<String, Plugged>> = Mutex::new(BTreeMap::new());

thread_local! {
    /// Errors of the newest call that may fail. By thread, as all calls on a context come from one: tests stay apart.
    static ERRORS: RefCell<String> = const { RefCell::new(String::new()) };
}

fn forget_errors() {
    ERRORS.with_borrow_mut(String::clear);
}

fn add_error(text: &str) {
    ERRORS.with_borrow_mut(|errors| {
        if !errors.is_empty() {
            errors.push_str("; ");
        }
        errors.push_str(text);
    });
}

fn bus() -> MutexGuard<'static, BTreeMap<String, Plugged>> {
    BUS.lock().unwrap_or_else(PoisonError::into_inner)
}

/// A unit, in the test's hands.
#[derive(Debug)]
pub struct Unit {
    serial: String,
}

impl Unit {
    /// Plugs a new unit in; its serial must be its own.
    pub fn plug(serial: &str, answers: Answers) -> Self {
        let plugged = Plugged {
            answers,
            present: true,
            plugging: 0,
            stream: None,
            n_open: 0,
        };
        bus().insert(serial.to_owned(), plugged);
        Unit {
            serial: serial.to_owned(),
        }
    }

    /// Pulls the plug: the stream falls silent.
    pub fn unplug(&self) {
        self.with(|plugged| plugged.present = false);
    }

    /// Plugs it in again, as a device that nobody has opened.
    pub fn replug(&self) {
        self.with(|plugged| {
            plugged.present = true;
            plugged.plugging += 1;
        });
    }

    /// Whether depth is streaming.
    pub fn streams(&self) -> bool {
        self.with(|plugged| plugged.present && plugged.stream.is_some())
    }

    /// Handles of this unit that are open.
    pub fn n_open(&self) -> usize {
        self.with(|plugged| plugged.n_open)
    }

    /// Runs `body` while calls to the library do not return, whichever unit they are about.
    pub fn while_stuck<R>(&self, body: impl FnOnce() -> R) -> R {
        self.with(|_| body())
    }

    /// Sends a packet if the unit is there and streams; says whether it was sent.
    pub fn send(&self, packet: Packet<'_>) -> bool {
        self.with(|plugged| {
            let Some(Stream {
                callback: Some(callback),
                user,
            }) = plugged.stream.filter(|_| plugged.present)
            else {
                return false;
            };
            let packet = f2shim_packet {
                data: packet.bytes.as_ptr(),
                length: packet.bytes.len(),
                timestamp: packet.timestamp,
                sequence: packet.sequence,
                status: packet.status,
            };
            // SAFETY: the stream was started with this pair and not stopped: stopping waits for the bus, which is held.
            unsafe { callback(user, &packet) };
            true
        })
    }

    fn with<R>(&self, body: impl FnOnce(&mut Plugged) -> R) -> R {
        let mut bus = bus();
        body(bus.get_mut(&self.serial).expect("a unit stays on the bus"))
    }
}

/// The stand-in, as a camera takes it.
pub fn library() -> Library {
    // SAFETY: the table is whole and keeps to the header.
    unsafe { Library::from_table(table()) }
}

/// The stand-in's table.
pub fn table() -> &'static f2shim_api {
    static TABLE: f2shim_api = f2shim_api {
        context_create: Some(context_create),
        context_destroy: Some(context_destroy),
        enumerate: Some(enumerate),
        serial: Some(serial),
        device_open: Some(device_open),
        device_start: Some(device_start),
        device_stop: Some(device_stop),
        device_close: Some(device_close),
        device_firmware: Some(device_firmware),
        device_ir_parameters: Some(device_ir_parameters),
        device_p0_tables: Some(device_p0_tables),
        last_error: Some(last_error),
    };
    &TABLE
}

/// What a context handle points to.
struct Context {
    serials: Vec<String>,
}

/// What a device handle points to.
struct Device {
    serial: String,
    plugging: u32,
    streaming: bool,
}

impl Device {
    /// Answers from a unit that is still there and streams.
    fn ask(&self, body: impl FnOnce(&Answers) -> f2shim_status) -> f2shim_status {
        match bus().get(&self.serial) {
            _ if !self.streaming => F2SHIM_WRONG_STATE,
            Some(plugged) => body(&plugged.answers),
            None => F2SHIM_FAILED,
        }
    }

    fn stop(&mut self) -> f2shim_status {
        if !std::mem::take(&mut self.streaming) {
            return F2SHIM_WRONG_STATE;
        }
        match bus().get_mut(&self.serial) {
            Some(plugged) if plugged.plugging == self.plugging => {
                plugged.stream = None;
                if plugged.present {
                    F2SHIM_OK
                } else {
                    F2SHIM_FAILED
                }
            }
            _ => F2SHIM_FAILED,
        }
    }
}

unsafe extern "C" fn context_create(out: *mut *mut f2shim_context) -> f2shim_status {
    let context = Box::new(Context {
        serials: Vec::new(),
    });
    // SAFETY: the caller gives a place for the handle.
    unsafe { *out = Box::into_raw(context).cast() };
    F2SHIM_OK
}

unsafe extern "C" fn context_destroy(context: *mut f2shim_context) {
    // SAFETY: the handle came from `context_create` and is given back once.
    drop(unsafe { Box::from_raw(context.cast::<Context>()) });
}

unsafe extern "C" fn enumerate(context: *mut f2shim_context, n_devices: *mut u32) -> f2shim_status {
    // SAFETY: the handle came from `context_create`, and one thread at a time uses it.
    let context = unsafe { &mut *context.cast::<Context>() };
    forget_errors();
    context.serials.clear();
    for (serial, plugged) in bus().iter().filter(|(_, plugged)| plugged.present) {
        match plugged.answers.list_error.as_str() {
            "" => context.serials.push(serial.clone()),
            error => add_error(error),
        }
    }
    // SAFETY: the caller gives a place for the number.
    unsafe { *n_devices = context.serials.len() as u32 };
    F2SHIM_OK
}

unsafe extern "C" fn serial(
    context: *mut f2shim_context,
    index: u32,
    buffer: *mut c_char,
    capacity: usize,
) -> f2shim_status {
    // SAFETY: the handle came from `context_create`, and one thread at a time uses it.
    let context = unsafe { &*context.cast::<Context>() };
    match context.serials.get(index as usize) {
        // SAFETY: the caller gives a buffer of that capacity.
        Some(serial) => unsafe { copy_text(serial, buffer, capacity) },
        None => F2SHIM_NOT_FOUND,
    }
}

unsafe extern "C" fn device_open(
    _context: *mut f2shim_context,
    serial: *const c_char,
    out: *mut *mut f2shim_device,
) -> f2shim_status {
    // SAFETY: the caller gives a zero-terminated text.
    let serial = unsafe { CStr::from_ptr(serial) }.to_string_lossy();
    forget_errors();
    let mut bus = bus();
    let Some(plugged) = bus.get_mut(serial.as_ref()).filter(|unit| unit.present) else {
        return F2SHIM_NOT_FOUND;
    };
    if !plugged.answers.open_error.is_empty() {
        add_error(&plugged.answers.open_error);
        return F2SHIM_FAILED;
    }
    plugged.n_open += 1;
    let device = Box::new(Device {
        serial: serial.into_owned(),
        plugging: plugged.plugging,
        streaming: false,
    });
    // SAFETY: the caller gives a place for the handle.
    unsafe { *out = Box::into_raw(device).cast() };
    F2SHIM_OK
}

unsafe extern "C" fn device_start(
    device: *mut f2shim_device,
    callback: f2shim_packet_callback,
    user: *mut c_void,
) -> f2shim_status {
    // SAFETY: the handle came from `device_open`, and one thread at a time uses it.
    let device = unsafe { &mut *device.cast::<Device>() };
    match bus().get_mut(&device.serial) {
        _ if device.streaming => F2SHIM_WRONG_STATE,
        Some(plugged) if plugged.present && plugged.plugging == device.plugging => {
            forget_errors();
            plugged.stream = Some(Stream { callback, user });
            device.streaming = true;
            F2SHIM_OK
        }
        _ => F2SHIM_FAILED,
    }
}

unsafe extern "C" fn device_stop(device: *mut f2shim_device) -> f2shim_status {
    // SAFETY: the handle came from `device_open`, and one thread at a time uses it.
    unsafe { &mut *device.cast::<Device>() }.stop()
}

unsafe extern "C" fn device_close(device: *mut f2shim_device) {
    // SAFETY: the handle came from `device_open` and is given back once.
    let mut device = unsafe { Box::from_raw(device.cast::<Device>()) };
    device.stop();
    if let Some(plugged) = bus().get_mut(&device.serial) {
        plugged.n_open -= 1;
        if plugged.plugging == device.plugging {
            plugged.stream = None;
        }
    }
}

unsafe extern "C" fn device_firmware(
    device: *mut f2shim_device,
    buffer: *mut c_char,
    capacity: usize,
) -> f2shim_status {
    // SAFETY: the handle came from `device_open`, and one thread at a time uses it.
    let device = unsafe { &*device.cast::<Device>() };
    // SAFETY: the caller gives a buffer of that capacity.
    device.ask(|answers| unsafe { copy_text(&answers.firmware, buffer, capacity) })
}

unsafe extern "C" fn device_ir_parameters(
    device: *mut f2shim_device,
    out: *mut f2shim_ir_parameters,
) -> f2shim_status {
    // SAFETY: the handle came from `device_open`, and one thread at a time uses it.
    let device = unsafe { &*device.cast::<Device>() };
    device.ask(|answers| {
        // SAFETY: the caller gives a place for the parameters.
        unsafe { *out = answers.ir_parameters };
        F2SHIM_OK
    })
}

unsafe extern "C" fn device_p0_tables(
    device: *mut f2shim_device,
    buffer: *mut u8,
    capacity: usize,
    length: *mut usize,
) -> f2shim_status {
    // SAFETY: the handle came from `device_open`, and one thread at a time uses it.
    let device = unsafe { &*device.cast::<Device>() };
    device.ask(|answers| {
        let response = &answers.p0_response;
        // SAFETY: the caller gives a place for the length.
        unsafe { *length = response.len() };
        if response.len() > capacity {
            return F2SHIM_TOO_SMALL;
        }
        // SAFETY: the caller gives a buffer of that capacity, of which this much is written.
        unsafe { ptr::copy_nonoverlapping(response.as_ptr(), buffer, response.len()) };
        F2SHIM_OK
    })
}

unsafe extern "C" fn last_error(buffer: *mut c_char, capacity: usize) -> f2shim_status {
    // SAFETY: the caller gives a buffer of that capacity.
    ERRORS.with_borrow(|text| unsafe { copy_text(text, buffer, capacity) })
}

/// Copies a text and its closing zero.
///
/// # Safety
/// `buffer` must have room for `capacity` bytes.
unsafe fn copy_text(text: &str, buffer: *mut c_char, capacity: usize) -> f2shim_status {
    if text.len() + 1 > capacity {
        return F2SHIM_TOO_SMALL;
    }
    // SAFETY: the text and a zero fit, as was just checked.
    let buffer = unsafe { slice::from_raw_parts_mut(buffer.cast::<u8>(), text.len() + 1) };
    buffer[..text.len()].copy_from_slice(text.as_bytes());
    buffer[text.len()] = 0;
    F2SHIM_OK
}
