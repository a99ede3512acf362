//! The functions of libusb that libfreenect 0.5.3 calls.
//!
//! Each does what libusb's documentation says, for pointers that came from here; that is what makes every `unsafe` below sound.
#![allow(
    clippy::undocumented_unsafe_blocks,
    reason = "callers hold to libusb's rules, see the module's documentation"
)]

use std::{
    ffi::{c_char, c_int, c_uchar, c_uint, c_void},
    ptr, slice, thread,
    time::Duration,
};

use crate::{
    abi::*,
    bus::{Context, Handle, Unit},
    kinect::{DEPTH, Role, VIDEO},
};

unsafe extern "C" {
    fn calloc(count: usize, size: usize) -> *mut c_void;
    fn free(pointer: *mut c_void);
}

unsafe fn unit_of<'a>(handle: *mut Handle) -> &'a Unit {
    unsafe { &*(*handle).unit }
}

#[unsafe(no_mangle)]
unsafe extern "C" fn libusb_init(context: *mut *mut Context) -> c_int {
    match Context::new() {
        Ok(made) => {
            unsafe { *context = Box::into_raw(made) };
            SUCCESS
        }
        Err(what) => {
            eprintln!("usb-stand-in: {what}");
            ERROR_NOT_FOUND
        }
    }
}

#[unsafe(no_mangle)]
unsafe extern "C" fn libusb_exit(context: *mut Context) {
    drop(unsafe { Box::from_raw(context) });
}

#[unsafe(no_mangle)]
unsafe extern "C" fn libusb_error_name(code: c_int) -> *const c_char {
    let name = match code {
        SUCCESS => c"LIBUSB_SUCCESS",
        ERROR_ACCESS => c"LIBUSB_ERROR_ACCESS",
        ERROR_NO_DEVICE => c"LIBUSB_ERROR_NO_DEVICE",
        ERROR_NOT_FOUND => c"LIBUSB_ERROR_NOT_FOUND",
        ERROR_BUSY => c"LIBUSB_ERROR_BUSY",
        ERROR_PIPE => c"LIBUSB_ERROR_PIPE",
        ERROR_NO_MEM => c"LIBUSB_ERROR_NO_MEM",
        _ => c"LIBUSB_ERROR_OTHER",
    };
    name.as_ptr()
}

#[unsafe(no_mangle)]
unsafe extern "C" fn libusb_get_device_list(
    context: *mut Context,
    list: *mut *mut *const Unit,
) -> isize {
    let units: Vec<*const Unit> = unsafe { &*context }.units().map(ptr::from_ref).collect();
    let count = units.len();
    unsafe {
        // Zeroed, so that a null pointer ends it.
        let array = calloc(count + 1, size_of::<*const Unit>()).cast::<*const Unit>();
        ptr::copy_nonoverlapping(units.as_ptr(), array, count);
        *list = array;
    }
    count as isize
}

#[unsafe(no_mangle)]
unsafe extern "C" fn libusb_free_device_list(list: *mut *const Unit, _unreference: c_int) {
    unsafe { free(list.cast()) };
}

#[unsafe(no_mangle)]
unsafe extern "C" fn libusb_get_device_descriptor(
    unit: *const Unit,
    descriptor: *mut DeviceDescriptor,
) -> c_int {
    let unit = unsafe { &*unit };
    let (product, device_version) = unit.kinect.ids(unit.role);
    let described = DeviceDescriptor {
        length: size_of::<DeviceDescriptor>() as u8,
        descriptor_type: 1,
        usb_version: 0x0200,
        class: 0,
        subclass: 0,
        protocol: 0,
        max_packet_size: 64,
        vendor: 0x045e,
        product,
        device_version,
        manufacturer_index: 1,
        product_index: 2,
        serial_index: if unit.role == Role::Motor { 0 } else { 3 },
        n_configurations: 1,
    };
    unsafe { *descriptor = described };
    SUCCESS
}

#[unsafe(no_mangle)]
unsafe extern "C" fn libusb_get_active_config_descriptor(
    _unit: *const Unit,
    descriptor: *mut *mut ConfigDescriptor,
) -> c_int {
    let described = ConfigDescriptor {
        length: 9,
        descriptor_type: 2,
        total_length: 9,
        n_interfaces: 1,
        value: 1,
        index: 0,
        attributes: 0x80,
        max_power: 50,
        interfaces: ptr::null(),
        extra: ptr::null(),
        extra_length: 0,
    };
    unsafe { *descriptor = Box::into_raw(Box::new(described)) };
    SUCCESS
}

#[unsafe(no_mangle)]
unsafe extern "C" fn libusb_free_config_descriptor(descriptor: *mut ConfigDescriptor) {
    drop(unsafe { Box::from_raw(descriptor) });
}

#[unsafe(no_mangle)]
unsafe extern "C" fn libusb_get_bus_number(_unit: *const Unit) -> u8 {
    1
}

#[unsafe(no_mangle)]
unsafe extern "C" fn libusb_get_parent(unit: *const Unit) -> *const c_void {
    // The parts of one Kinect hang on one hub, which nobody looks into.
    ptr::from_ref(unsafe { &*unit }.kinect).cast()
}

#[unsafe(no_mangle)]
unsafe extern "C" fn libusb_get_max_iso_packet_size(
    _unit: *const Unit,
    endpoint: c_uchar,
) -> c_int {
    match endpoint {
        VIDEO => 1920,
        DEPTH => 1760,
        _ => ERROR_NOT_FOUND,
    }
}

#[unsafe(no_mangle)]
unsafe extern "C" fn libusb_open(unit: *const Unit, handle: *mut *mut Handle) -> c_int {
    let kinect = unsafe { &*unit }.kinect;
    if !kinect.is_plugged() {
        return ERROR_NO_DEVICE;
    }
    if kinect.has("denied") {
        return ERROR_ACCESS;
    }
    kinect.trace(format_args!("open {:?}", unsafe { &*unit }.role));
    unsafe { *handle = Box::into_raw(Box::new(Handle { unit, claim: None })) };
    SUCCESS
}

#[unsafe(no_mangle)]
unsafe extern "C" fn libusb_close(handle: *mut Handle) {
    let unit = unsafe { unit_of(handle) };
    unit.kinect.trace(format_args!("close {:?}", unit.role));
    drop(unsafe { Box::from_raw(handle) });
}

#[unsafe(no_mangle)]
unsafe extern "C" fn libusb_get_device(handle: *mut Handle) -> *const Unit {
    unsafe { unit_of(handle) }
}

#[unsafe(no_mangle)]
unsafe extern "C" fn libusb_get_string_descriptor_ascii(
    handle: *mut Handle,
    _index: u8,
    data: *mut c_uchar,
    length: c_int,
) -> c_int {
    let unit = unsafe { unit_of(handle) };
    let serial = unit.kinect.serial(unit.role).as_bytes();
    let count = serial.len().min(length as usize - 1);
    let data = unsafe { slice::from_raw_parts_mut(data, count + 1) };
    data[..count].copy_from_slice(&serial[..count]);
    data[count] = 0;
    count as c_int
}

#[unsafe(no_mangle)]
unsafe extern "C" fn libusb_kernel_driver_active(_handle: *mut Handle, _interface: c_int) -> c_int {
    1
}

#[unsafe(no_mangle)]
unsafe extern "C" fn libusb_detach_kernel_driver(handle: *mut Handle, _interface: c_int) -> c_int {
    unsafe { unit_of(handle) }
        .kinect
        .trace(format_args!("detach kernel driver"));
    SUCCESS
}

#[unsafe(no_mangle)]
unsafe extern "C" fn libusb_attach_kernel_driver(handle: *mut Handle, _interface: c_int) -> c_int {
    unsafe { unit_of(handle) }
        .kinect
        .trace(format_args!("attach kernel driver"));
    SUCCESS
}

#[unsafe(no_mangle)]
unsafe extern "C" fn libusb_claim_interface(handle: *mut Handle, _interface: c_int) -> c_int {
    let unit = unsafe { unit_of(handle) };
    let claim = match unit.role {
        Role::Camera => unit.kinect.claim(),
        Role::Motor | Role::Audio => None,
    };
    let is_free = claim.is_some() || unit.role != Role::Camera;
    unsafe { (*handle).claim = claim };
    match is_free && !unit.kinect.has("busy") {
        true => SUCCESS,
        false => ERROR_BUSY,
    }
}

#[unsafe(no_mangle)]
unsafe extern "C" fn libusb_release_interface(handle: *mut Handle, _interface: c_int) -> c_int {
    unsafe { (*handle).claim = None };
    SUCCESS
}

#[unsafe(no_mangle)]
unsafe extern "C" fn libusb_set_interface_alt_setting(
    handle: *mut Handle,
    _interface: c_int,
    setting: c_int,
) -> c_int {
    let kinect = unsafe { unit_of(handle) }.kinect;
    kinect.trace(format_args!("alternate setting {setting}"));
    SUCCESS
}

#[unsafe(no_mangle)]
unsafe extern "C" fn libusb_reset_device(_handle: *mut Handle) -> c_int {
    SUCCESS
}

#[unsafe(no_mangle)]
unsafe extern "C" fn libusb_control_transfer(
    handle: *mut Handle,
    request_type: u8,
    _request: u8,
    _value: u16,
    _index: u16,
    data: *mut c_uchar,
    length: u16,
    _timeout: c_uint,
) -> c_int {
    let unit = unsafe { unit_of(handle) };
    let kinect = unit.kinect;
    while kinect.has("wedged") && kinect.is_plugged() {
        thread::sleep(Duration::from_millis(5));
    }
    if !kinect.is_plugged() {
        return ERROR_NO_DEVICE;
    }
    match (unit.role, request_type) {
        (Role::Camera, 0x40) => {
            kinect.command(unsafe { slice::from_raw_parts(data, length.into()) });
            length.into()
        }
        (Role::Camera, 0xc0) => {
            let answer = kinect.answer();
            let count = answer.len().min(length.into());
            unsafe { ptr::copy_nonoverlapping(answer.as_ptr(), data, count) };
            count as c_int
        }
        (role, _) => {
            kinect.trace(format_args!("control {role:?}"));
            ERROR_PIPE
        }
    }
}

#[unsafe(no_mangle)]
unsafe extern "C" fn libusb_bulk_transfer(
    handle: *mut Handle,
    endpoint: c_uchar,
    data: *mut c_uchar,
    length: c_int,
    transferred: *mut c_int,
    _timeout: c_uint,
) -> c_int {
    let kinect = unsafe { unit_of(handle) }.kinect;
    if !kinect.is_plugged() {
        return ERROR_NO_DEVICE;
    }
    if endpoint & 0x80 == 0 {
        kinect.led_command(unsafe { slice::from_raw_parts(data, length as usize) });
        unsafe { *transferred = length };
    } else {
        let answer = kinect.led_answer();
        let count = answer.len().min(length as usize);
        unsafe { ptr::copy_nonoverlapping(answer.as_ptr(), data, count) };
        unsafe { *transferred = count as c_int };
    }
    SUCCESS
}

#[unsafe(no_mangle)]
unsafe extern "C" fn libusb_alloc_transfer(n_packets: c_int) -> *mut Transfer {
    let bytes = size_of::<Transfer>() + n_packets as usize * size_of::<IsoPacket>();
    unsafe { calloc(1, bytes) }.cast()
}

#[unsafe(no_mangle)]
unsafe extern "C" fn libusb_free_transfer(transfer: *mut Transfer) {
    unsafe { free(transfer.cast()) };
}

#[unsafe(no_mangle)]
unsafe extern "C" fn libusb_submit_transfer(transfer: *mut Transfer) -> c_int {
    let unit = unsafe { unit_of((*transfer).handle.cast()) };
    if !unit.kinect.is_plugged() {
        return ERROR_NO_DEVICE;
    }
    if unit.kinect.has("no-memory") {
        return ERROR_NO_MEM;
    }
    unit.submit(transfer);
    SUCCESS
}

#[unsafe(no_mangle)]
unsafe extern "C" fn libusb_cancel_transfer(transfer: *mut Transfer) -> c_int {
    match unsafe { unit_of((*transfer).handle.cast()) }.cancel(transfer) {
        true => SUCCESS,
        false => ERROR_NOT_FOUND,
    }
}

#[unsafe(no_mangle)]
unsafe extern "C" fn libusb_handle_events(context: *mut Context) -> c_int {
    unsafe { &*context }.handle_events(Duration::from_secs(60));
    SUCCESS
}

#[unsafe(no_mangle)]
unsafe extern "C" fn libusb_handle_events_timeout(
    context: *mut Context,
    timeout: *mut Timeval,
) -> c_int {
    let timeout = unsafe { &*timeout };
    let secs = Duration::from_secs(timeout.secs as u64);
    unsafe { &*context }.handle_events(secs + Duration::from_micros(timeout.micros as u64));
    SUCCESS
}
