//! The shim's table with its states as types: a context, a device that streams, nothing in between.

use std::{
    ffi::{CStr, CString, c_char, c_void},
    ptr::{self, NonNull},
    slice,
    sync::Arc,
};

use depth_camera::CameraError;
use freenect2_sys::{
    F2SHIM_NOT_FOUND, F2SHIM_OK, f2shim_api, f2shim_context, f2shim_device, f2shim_ir_parameters,
    f2shim_packet, f2shim_status,
};

use super::slot::{Incoming, PacketSlot};
use crate::{ir_parameters::IrParameters, p0_tables::P0_RESPONSE_BYTES, recording::DeviceRecord};

/// Longest text that is asked for: serials and versions are shorter, messages are cut.
const TEXT_BYTES: usize = 512;

/// An implementation of the shim's interface, which devices are reached through.
#[derive(Clone, Copy, Debug)]
pub struct Library(&'static f2shim_api);

impl Library {
    /// The library that this program was linked with.
    #[cfg(feature = "kinect2")]
    pub fn libfreenect2() -> Self {
        Library(freenect2_sys::libfreenect2())
    }

    /// An implementation by its table.
    ///
    /// # Safety
    /// Every function of the table must be there and keep to what the shim's header says of it.
    pub unsafe fn from_table(api: &'static f2shim_api) -> Self {
        Library(api)
    }
}

/// Calls a function of the table, which [`Library::from_table`] promises to be there.
macro_rules! call {
    ($library:expr, $function:ident ( $($argument:expr),* )) => {{
        let function = $library.0.$function.expect("the table is whole");
        function($($argument),*)
    }};
}

/// A library context; made, used and freed on one thread.
#[derive(Debug)]
pub(super) struct Context {
    library: Library,
    raw: NonNull<f2shim_context>,
}

impl Context {
    pub fn new(library: Library) -> Result<Self, CameraError> {
        let mut raw = ptr::null_mut();
        // SAFETY: the place for the handle outlives the call.
        let status = unsafe { call!(library, context_create(&mut raw)) };
        match NonNull::new(raw) {
            Some(raw) if status == F2SHIM_OK => Ok(Context { library, raw }),
            _ => Err(last_error(library, "libfreenect2 has not started")),
        }
    }

    /// Serials of the devices that are plugged in.
    pub fn serials(&self) -> Result<Vec<String>, CameraError> {
        let mut n_devices = 0;
        // SAFETY: the context is alive and used by this thread alone.
        let status = unsafe { call!(self.library, enumerate(self.raw.as_ptr(), &mut n_devices)) };
        if status != F2SHIM_OK {
            return Err(last_error(self.library, "devices cannot be listed"));
        }
        let serial = |index| {
            read_text(|buffer, capacity| {
                // SAFETY: the context is alive, the buffer has that capacity.
                unsafe {
                    call!(
                        self.library,
                        serial(self.raw.as_ptr(), index, buffer, capacity)
                    )
                }
            })
        };
        Ok((0..n_devices).filter_map(serial).collect())
    }

    /// Why a device was not among those that were just listed: the library leaves out what it cannot open.
    pub fn why_missing(&self) -> CameraError {
        match last_error(self.library, "devices cannot be listed") {
            denied @ (CameraError::PermissionDenied | CameraError::Busy) => denied,
            _ => CameraError::Disconnected,
        }
    }

    /// Opens a device and starts depth; packets go to `slot`.
    pub fn stream(&self, serial: &str, slot: Arc<PacketSlot>) -> Result<Stream<'_>, CameraError> {
        let library = self.library;
        let name = CString::new(serial).map_err(|_| CameraError::Disconnected)?;
        let mut raw = ptr::null_mut();
        // SAFETY: the context is alive, the text ends in zero, the place for the handle outlives the call.
        let status = unsafe {
            call!(
                library,
                device_open(self.raw.as_ptr(), name.as_ptr(), &mut raw)
            )
        };
        let raw = match NonNull::new(raw) {
            Some(raw) if status == F2SHIM_OK => raw,
            _ if status == F2SHIM_NOT_FOUND => {
                return Err(CameraError::Disconnected);
            }
            _ => return Err(last_error(library, "the device cannot be opened")),
        };
        // From here on dropping it closes the device, also if it does not start.
        let stream = Stream {
            _context: self,
            library,
            raw,
            slot,
        };
        stream.slot.begin_stream();
        let user = Arc::as_ptr(&stream.slot).cast_mut().cast::<c_void>();
        // SAFETY: the device is open and not streaming; the slot lives in `stream` until the device is closed.
        let status = unsafe { call!(library, device_start(raw.as_ptr(), Some(on_packet), user)) };
        if status != F2SHIM_OK {
            return Err(last_error(library, "depth cannot be started"));
        }
        Ok(stream)
    }
}

impl Drop for Context {
    fn drop(&mut self) {
        // SAFETY: streams borrow the context, so that all are closed; the handle is given back once.
        unsafe { call!(self.library, context_destroy(self.raw.as_ptr())) };
    }
}

/// A device that streams packets into a slot; closed when dropped, which may take a while.
#[derive(Debug)]
pub(super) struct Stream<'context> {
    _context: &'context Context,
    library: Library,
    raw: NonNull<f2shim_device>,
    slot: Arc<PacketSlot>,
}

impl Stream<'_> {
    /// What the device says of itself.
    pub fn record(&self, serial: &str) -> Result<DeviceRecord, CameraError> {
        let (library, raw) = (self.library, self.raw.as_ptr());
        let failed = |status: f2shim_status, what| {
            if status == F2SHIM_OK {
                Ok(())
            } else {
                Err(last_error(library, what))
            }
        };
        let firmware = read_text(|buffer, capacity| {
            // SAFETY: the device streams, the buffer has that capacity.
            unsafe { call!(library, device_firmware(raw, buffer, capacity)) }
        });
        let mut p = f2shim_ir_parameters::default();
        // SAFETY: the device streams, the place for the parameters outlives the call.
        let status = unsafe { call!(library, device_ir_parameters(raw, &mut p)) };
        failed(status, "its IR parameters cannot be read")?;
        let mut p0_response = vec![0; P0_RESPONSE_BYTES];
        let mut length = 0;
        // SAFETY: the device streams, the buffer has that capacity.
        let status = unsafe {
            call!(
                library,
                device_p0_tables(
                    raw,
                    p0_response.as_mut_ptr(),
                    p0_response.len(),
                    &mut length
                )
            )
        };
        failed(status, "its phase tables cannot be read")?;
        p0_response.truncate(length);
        Ok(DeviceRecord {
            serial: serial.to_owned(),
            firmware: firmware.unwrap_or_default(),
            ir_parameters: IrParameters {
                fx: p.fx.into(),
                fy: p.fy.into(),
                cx: p.cx.into(),
                cy: p.cy.into(),
                k1: p.k1.into(),
                k2: p.k2.into(),
                k3: p.k3.into(),
                p1: p.p1.into(),
                p2: p.p2.into(),
            },
            p0_response,
        })
    }
}

impl Drop for Stream<'_> {
    fn drop(&mut self) {
        // SAFETY: the device is open and given back once; no callback runs after this, and only then does the slot go.
        unsafe { call!(self.library, device_close(self.raw.as_ptr())) };
    }
}

/// Hands a packet from the library's thread to the slot that the stream was started with.
unsafe extern "C" fn on_packet(user: *mut c_void, packet: *const f2shim_packet) {
    // SAFETY: `user` is the slot of a stream that is not closed yet.
    let slot = unsafe { &*user.cast::<PacketSlot>() };
    // SAFETY: the packet is the library's for the time of this call.
    let packet = unsafe { &*packet };
    let bytes = if packet.data.is_null() {
        &[]
    } else {
        // SAFETY: the data have that length for the time of this call.
        unsafe { slice::from_raw_parts(packet.data, packet.length) }
    };
    slot.offer(Incoming {
        bytes,
        timestamp: packet.timestamp,
        sequence: packet.sequence,
        status: packet.status,
    });
}

/// A text that the library writes into a buffer; `None` if it fails.
fn read_text(write: impl FnOnce(*mut c_char, usize) -> f2shim_status) -> Option<String> {
    let mut buffer = [0u8; TEXT_BYTES];
    let status = write(buffer.as_mut_ptr().cast(), buffer.len());
    let text = CStr::from_bytes_until_nul(&buffer).ok()?;
    (status == F2SHIM_OK).then(|| text.to_string_lossy().into_owned())
}

/// The errors that a library has logged since the newest call that may fail began; empty without any.
pub(super) fn errors(library: Library) -> String {
    let text = read_text(|buffer, capacity| {
        // SAFETY: the buffer has that capacity.
        unsafe { call!(library, last_error(buffer, capacity)) }
    });
    text.unwrap_or_default()
}

/// What the library has said of the call, as an error that a caller can act on.
fn last_error(library: Library, what: &str) -> CameraError {
    let text = errors(library);
    if text.contains("LIBUSB_ERROR_ACCESS") {
        CameraError::PermissionDenied
    } else if text.contains("LIBUSB_ERROR_BUSY") {
        CameraError::Busy
    } else if text.contains("LIBUSB_ERROR_NO_DEVICE") {
        CameraError::Disconnected
    } else {
        CameraError::Invalid(format!("{what}: {text}"))
    }
}
