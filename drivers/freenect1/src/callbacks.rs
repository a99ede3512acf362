//! What the library calls with packets and frames.
//!
//! Callbacks run inside the library's calls that pump events, stop a stream or close, where the assembler is not
//! borrowed; if it were, the image would stay where it is and the next one come over it.

use std::{
    cell::RefCell,
    ffi::{c_int, c_void},
    ptr::{self, NonNull},
    time::Instant,
};

use freenect1_sys as sys;

use crate::assembly::{Assembler, Captured};

/// What the callbacks of one device work on.
pub(crate) struct Sink<'a> {
    pub(crate) assembler: &'a RefCell<Assembler>,
    pub(crate) emit: &'a dyn Fn(Captured),
}

impl<'a> Sink<'a> {
    pub(crate) fn new(assembler: &'a RefCell<Assembler>, emit: &'a dyn Fn(Captured)) -> Self {
        Sink { assembler, emit }
    }
}

/// Lends the callbacks to a device, and what they work on.
///
/// # Safety
/// The device must be open, and closed before the sink is dropped or moved.
pub(crate) unsafe fn connect(device: NonNull<sys::freenect_device>, sink: &Sink<'_>) {
    let raw = device.as_ptr();
    let sink = ptr::from_ref(sink).cast_mut().cast::<c_void>();
    // SAFETY: as asked of the caller.
    unsafe { sys::freenect_set_user(raw, sink) };
    // SAFETY: the device is open; the callbacks find the sink that was set above.
    unsafe { sys::freenect_set_depth_callback(raw, Some(depth_filled)) };
    // SAFETY: as above.
    unsafe { sys::freenect_set_video_callback(raw, Some(ir_filled)) };
    // SAFETY: as above.
    unsafe { sys::freenect_set_depth_chunk_callback(raw, Some(depth_packet)) };
    // SAFETY: as above.
    unsafe { sys::freenect_set_video_chunk_callback(raw, Some(ir_packet)) };
}

/// The sink of a device, as the library hands it back.
///
/// # Safety
/// `user` must be what [`connect`] set, and the device must not be closed.
unsafe fn sink<'a>(user: *mut c_void) -> Option<&'a Sink<'a>> {
    // SAFETY: as asked of the caller.
    unsafe { user.cast_const().cast::<Sink<'a>>().as_ref() }
}

unsafe extern "C" fn depth_filled(
    device: *mut sys::freenect_device,
    _image: *mut c_void,
    ticks: u32,
) {
    let host = Instant::now();
    // SAFETY: the library calls with an open device, whose user pointer `connect` set.
    let sink = unsafe { sink(sys::freenect_get_user(device)) };
    let Some((sink, mut assembler)) =
        sink.and_then(|s| Some((s, s.assembler.try_borrow_mut().ok()?)))
    else {
        return;
    };
    assembler.depth_filled(ticks, host, sink.emit);
    let next = assembler.depth_buffer().as_mut_ptr();
    // SAFETY: the buffer is of the size of the mode and stays until this function names another.
    unsafe { sys::freenect_set_depth_buffer(device, next.cast()) };
}

unsafe extern "C" fn ir_filled(device: *mut sys::freenect_device, _image: *mut c_void, ticks: u32) {
    let host = Instant::now();
    // SAFETY: the library calls with an open device, whose user pointer `connect` set.
    let sink = unsafe { sink(sys::freenect_get_user(device)) };
    let Some((sink, mut assembler)) =
        sink.and_then(|s| Some((s, s.assembler.try_borrow_mut().ok()?)))
    else {
        return;
    };
    assembler.ir_filled(ticks, host, sink.emit);
    let next = assembler.ir_buffer().as_mut_ptr();
    // SAFETY: the buffer is of the size of the mode and stays until this function names another.
    unsafe { sys::freenect_set_video_buffer(device, next.cast()) };
}

unsafe extern "C" fn depth_packet(
    frame: *mut c_void,
    packet: *mut c_void,
    number: c_int,
    bytes: c_int,
    user: *mut c_void,
) {
    // SAFETY: the library hands back the user pointer that `connect` set.
    let Some(sink) = (unsafe { sink(user) }) else {
        return;
    };
    let (Ok(number), Ok(bytes)) = (usize::try_from(number), usize::try_from(bytes)) else {
        return;
    };
    let place = sink.assembler.try_borrow_mut().ok();
    let place = place.and_then(|mut a| a.depth_packet(number, bytes, sink.emit));
    if let Some(place) = place {
        // SAFETY: the library's frame holds what the packed mode has, of which `place` is a part; the packet has `bytes`.
        unsafe { copy_packet(frame, packet, place) };
    }
}

unsafe extern "C" fn ir_packet(
    frame: *mut c_void,
    packet: *mut c_void,
    number: c_int,
    bytes: c_int,
    user: *mut c_void,
) {
    // SAFETY: the library hands back the user pointer that `connect` set.
    let Some(sink) = (unsafe { sink(user) }) else {
        return;
    };
    let (Ok(number), Ok(bytes)) = (usize::try_from(number), usize::try_from(bytes)) else {
        return;
    };
    let place = sink.assembler.try_borrow_mut().ok();
    let place = place.and_then(|mut a| a.ir_packet(number, bytes));
    if let Some(place) = place {
        // SAFETY: as in `depth_packet`.
        unsafe { copy_packet(frame, packet, place) };
    }
}

/// Does what the library leaves to those who want to see its packets.
///
/// # Safety
/// `frame` must hold `place`, and `packet` as many bytes as that is long; they must not overlap.
unsafe fn copy_packet(frame: *mut c_void, packet: *const c_void, place: std::ops::Range<usize>) {
    // SAFETY: as asked of the caller.
    unsafe {
        ptr::copy_nonoverlapping(
            packet.cast::<u8>(),
            frame.cast::<u8>().add(place.start),
            place.len(),
        );
    }
}
