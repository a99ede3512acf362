//! What the library calls with packets and frames.
//!
//! Callbacks run inside the library's calls that pump events, stop a stream or close, where the assembler is not
//! borrowed; if it were, the image would stay where it is and the next one come over it.

use std::{
    cell::RefCell,
    ffi::{c_int, c_void},
    ops::Range,
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
    let next = |assembler: &mut Assembler, emit: &dyn Fn(Captured)| {
        assembler.depth_filled(ticks, host, emit);
        assembler.depth_buffer().as_mut_ptr()
    };
    // SAFETY: the library calls with an open device, whose user pointer `connect` set.
    if let Some(next) = unsafe { with_assembler(sys::freenect_get_user(device), next) } {
        // SAFETY: the buffer is of the size of the mode and stays until this function names another.
        unsafe { sys::freenect_set_depth_buffer(device, next.cast()) };
    }
}

unsafe extern "C" fn ir_filled(device: *mut sys::freenect_device, _image: *mut c_void, ticks: u32) {
    let host = Instant::now();
    let next = |assembler: &mut Assembler, emit: &dyn Fn(Captured)| {
        assembler.ir_filled(ticks, host, emit);
        assembler.ir_buffer().as_mut_ptr()
    };
    // SAFETY: the library calls with an open device, whose user pointer `connect` set.
    if let Some(next) = unsafe { with_assembler(sys::freenect_get_user(device), next) } {
        // SAFETY: the buffer is of the size of the mode and stays until this function names another.
        unsafe { sys::freenect_set_video_buffer(device, next.cast()) };
    }
}

unsafe extern "C" fn depth_packet(
    frame: *mut c_void,
    packet: *mut c_void,
    number: c_int,
    bytes: c_int,
    user: *mut c_void,
) {
    let place = |assembler: &mut Assembler, number, bytes, emit: &dyn Fn(Captured)| {
        assembler.depth_packet(number, bytes, emit)
    };
    // SAFETY: the library's frame holds what the packed mode has, the packet `bytes`, and the user pointer is `connect`'s.
    unsafe { take_packet((frame, packet), (number, bytes), user, place) };
}

unsafe extern "C" fn ir_packet(
    frame: *mut c_void,
    packet: *mut c_void,
    number: c_int,
    bytes: c_int,
    user: *mut c_void,
) {
    let place = |assembler: &mut Assembler, number, bytes, _: &dyn Fn(Captured)| {
        assembler.ir_packet(number, bytes)
    };
    // SAFETY: as in `depth_packet`.
    unsafe { take_packet((frame, packet), (number, bytes), user, place) };
}

/// What `work` makes of the assembler that `user` leads to; `None` if there is none, or it is borrowed.
///
/// # Safety
/// As of [`sink`].
unsafe fn with_assembler<T>(
    user: *mut c_void,
    work: impl FnOnce(&mut Assembler, &dyn Fn(Captured)) -> T,
) -> Option<T> {
    // SAFETY: as asked of the caller.
    let sink = unsafe { sink(user) }?;
    let mut assembler = sink.assembler.try_borrow_mut().ok()?;
    Some(work(&mut assembler, sink.emit))
}

/// Puts a packet of so many bytes where `place` says that it belongs, which also counts it.
///
/// # Safety
/// The frame must hold every place of the stream's layout and the packet its bytes; `user` as of [`sink`].
unsafe fn take_packet(
    (frame, packet): (*mut c_void, *const c_void),
    (number, bytes): (c_int, c_int),
    user: *mut c_void,
    place: impl FnOnce(&mut Assembler, usize, usize, &dyn Fn(Captured)) -> Option<Range<usize>>,
) {
    let (Ok(number), Ok(bytes)) = (usize::try_from(number), usize::try_from(bytes)) else {
        return;
    };
    // SAFETY: as asked of the caller.
    let place = unsafe { with_assembler(user, |a, emit| place(a, number, bytes, emit)) };
    if let Some(place) = place.flatten() {
        // SAFETY: `place` is a part of the frame and as long as the packet.
        unsafe { copy_packet(frame, packet, place) };
    }
}

/// Does what the library leaves to those who want to see its packets.
///
/// # Safety
/// `frame` must hold `place`, and `packet` as many bytes as that is long; they must not overlap.
unsafe fn copy_packet(frame: *mut c_void, packet: *const c_void, place: Range<usize>) {
    // SAFETY: as asked of the caller.
    unsafe {
        ptr::copy_nonoverlapping(
            packet.cast::<u8>(),
            frame.cast::<u8>().add(place.start),
            place.len(),
        );
    }
}
