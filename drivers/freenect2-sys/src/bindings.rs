//! Made by bindgen of `shim/freenect2_shim.h`; `tests/bindings.rs` compares the two.
#![allow(missing_docs, non_camel_case_types, clippy::all, clippy::undocumented_unsafe_blocks, reason = "generated")]

pub type f2shim_status = u32;
pub const F2SHIM_OK: _bindgen_ty_1 = 0;
pub const F2SHIM_FAILED: _bindgen_ty_1 = 1;
pub const F2SHIM_NOT_FOUND: _bindgen_ty_1 = 2;
pub const F2SHIM_TOO_SMALL: _bindgen_ty_1 = 3;
pub const F2SHIM_WRONG_STATE: _bindgen_ty_1 = 4;
pub type _bindgen_ty_1 = ::std::os::raw::c_uint;
#[repr(C)]
#[derive(Debug)]
pub struct f2shim_context {
    _unused: [u8; 0],
}
#[repr(C)]
#[derive(Debug)]
pub struct f2shim_device {
    _unused: [u8; 0],
}
#[repr(C)]
#[derive(Debug, Default, Copy, Clone)]
pub struct f2shim_ir_parameters {
    pub fx: f32,
    pub fy: f32,
    pub cx: f32,
    pub cy: f32,
    pub k1: f32,
    pub k2: f32,
    pub k3: f32,
    pub p1: f32,
    pub p2: f32,
}
#[allow(clippy::unnecessary_operation, clippy::identity_op)]
const _: () = {
    [
        "Size of f2shim_ir_parameters",
    ][::std::mem::size_of::<f2shim_ir_parameters>() - 36usize];
    [
        "Alignment of f2shim_ir_parameters",
    ][::std::mem::align_of::<f2shim_ir_parameters>() - 4usize];
    [
        "Offset of field: f2shim_ir_parameters::fx",
    ][::std::mem::offset_of!(f2shim_ir_parameters, fx) - 0usize];
    [
        "Offset of field: f2shim_ir_parameters::fy",
    ][::std::mem::offset_of!(f2shim_ir_parameters, fy) - 4usize];
    [
        "Offset of field: f2shim_ir_parameters::cx",
    ][::std::mem::offset_of!(f2shim_ir_parameters, cx) - 8usize];
    [
        "Offset of field: f2shim_ir_parameters::cy",
    ][::std::mem::offset_of!(f2shim_ir_parameters, cy) - 12usize];
    [
        "Offset of field: f2shim_ir_parameters::k1",
    ][::std::mem::offset_of!(f2shim_ir_parameters, k1) - 16usize];
    [
        "Offset of field: f2shim_ir_parameters::k2",
    ][::std::mem::offset_of!(f2shim_ir_parameters, k2) - 20usize];
    [
        "Offset of field: f2shim_ir_parameters::k3",
    ][::std::mem::offset_of!(f2shim_ir_parameters, k3) - 24usize];
    [
        "Offset of field: f2shim_ir_parameters::p1",
    ][::std::mem::offset_of!(f2shim_ir_parameters, p1) - 28usize];
    [
        "Offset of field: f2shim_ir_parameters::p2",
    ][::std::mem::offset_of!(f2shim_ir_parameters, p2) - 32usize];
};
#[repr(C)]
#[derive(Debug, Copy, Clone)]
pub struct f2shim_packet {
    pub data: *const u8,
    pub length: usize,
    pub timestamp: u32,
    pub sequence: u32,
    pub status: u32,
}
#[allow(clippy::unnecessary_operation, clippy::identity_op)]
const _: () = {
    ["Size of f2shim_packet"][::std::mem::size_of::<f2shim_packet>() - 32usize];
    ["Alignment of f2shim_packet"][::std::mem::align_of::<f2shim_packet>() - 8usize];
    [
        "Offset of field: f2shim_packet::data",
    ][::std::mem::offset_of!(f2shim_packet, data) - 0usize];
    [
        "Offset of field: f2shim_packet::length",
    ][::std::mem::offset_of!(f2shim_packet, length) - 8usize];
    [
        "Offset of field: f2shim_packet::timestamp",
    ][::std::mem::offset_of!(f2shim_packet, timestamp) - 16usize];
    [
        "Offset of field: f2shim_packet::sequence",
    ][::std::mem::offset_of!(f2shim_packet, sequence) - 20usize];
    [
        "Offset of field: f2shim_packet::status",
    ][::std::mem::offset_of!(f2shim_packet, status) - 24usize];
};
impl Default for f2shim_packet {
    fn default() -> Self {
        let mut s = ::std::mem::MaybeUninit::<Self>::uninit();
        unsafe {
            ::std::ptr::write_bytes(s.as_mut_ptr(), 0, 1);
            s.assume_init()
        }
    }
}
pub type f2shim_packet_callback = ::std::option::Option<
    unsafe extern "C" fn(user: *mut ::std::os::raw::c_void, packet: *const f2shim_packet),
>;
#[repr(C)]
#[derive(Debug, Default, Copy, Clone)]
pub struct f2shim_api {
    pub context_create: ::std::option::Option<
        unsafe extern "C" fn(out: *mut *mut f2shim_context) -> f2shim_status,
    >,
    pub context_destroy: ::std::option::Option<
        unsafe extern "C" fn(context: *mut f2shim_context),
    >,
    pub enumerate: ::std::option::Option<
        unsafe extern "C" fn(
            context: *mut f2shim_context,
            n_devices: *mut u32,
        ) -> f2shim_status,
    >,
    pub serial: ::std::option::Option<
        unsafe extern "C" fn(
            context: *mut f2shim_context,
            index: u32,
            buffer: *mut ::std::os::raw::c_char,
            capacity: usize,
        ) -> f2shim_status,
    >,
    pub device_open: ::std::option::Option<
        unsafe extern "C" fn(
            context: *mut f2shim_context,
            serial: *const ::std::os::raw::c_char,
            out: *mut *mut f2shim_device,
        ) -> f2shim_status,
    >,
    pub device_start: ::std::option::Option<
        unsafe extern "C" fn(
            device: *mut f2shim_device,
            callback: f2shim_packet_callback,
            user: *mut ::std::os::raw::c_void,
        ) -> f2shim_status,
    >,
    pub device_stop: ::std::option::Option<
        unsafe extern "C" fn(device: *mut f2shim_device) -> f2shim_status,
    >,
    pub device_close: ::std::option::Option<
        unsafe extern "C" fn(device: *mut f2shim_device),
    >,
    pub device_firmware: ::std::option::Option<
        unsafe extern "C" fn(
            device: *mut f2shim_device,
            buffer: *mut ::std::os::raw::c_char,
            capacity: usize,
        ) -> f2shim_status,
    >,
    pub device_ir_parameters: ::std::option::Option<
        unsafe extern "C" fn(
            device: *mut f2shim_device,
            out: *mut f2shim_ir_parameters,
        ) -> f2shim_status,
    >,
    pub device_p0_tables: ::std::option::Option<
        unsafe extern "C" fn(
            device: *mut f2shim_device,
            buffer: *mut u8,
            capacity: usize,
            length: *mut usize,
        ) -> f2shim_status,
    >,
    pub last_error: ::std::option::Option<
        unsafe extern "C" fn(
            buffer: *mut ::std::os::raw::c_char,
            capacity: usize,
        ) -> f2shim_status,
    >,
}
#[allow(clippy::unnecessary_operation, clippy::identity_op)]
const _: () = {
    ["Size of f2shim_api"][::std::mem::size_of::<f2shim_api>() - 96usize];
    ["Alignment of f2shim_api"][::std::mem::align_of::<f2shim_api>() - 8usize];
    [
        "Offset of field: f2shim_api::context_create",
    ][::std::mem::offset_of!(f2shim_api, context_create) - 0usize];
    [
        "Offset of field: f2shim_api::context_destroy",
    ][::std::mem::offset_of!(f2shim_api, context_destroy) - 8usize];
    [
        "Offset of field: f2shim_api::enumerate",
    ][::std::mem::offset_of!(f2shim_api, enumerate) - 16usize];
    [
        "Offset of field: f2shim_api::serial",
    ][::std::mem::offset_of!(f2shim_api, serial) - 24usize];
    [
        "Offset of field: f2shim_api::device_open",
    ][::std::mem::offset_of!(f2shim_api, device_open) - 32usize];
    [
        "Offset of field: f2shim_api::device_start",
    ][::std::mem::offset_of!(f2shim_api, device_start) - 40usize];
    [
        "Offset of field: f2shim_api::device_stop",
    ][::std::mem::offset_of!(f2shim_api, device_stop) - 48usize];
    [
        "Offset of field: f2shim_api::device_close",
    ][::std::mem::offset_of!(f2shim_api, device_close) - 56usize];
    [
        "Offset of field: f2shim_api::device_firmware",
    ][::std::mem::offset_of!(f2shim_api, device_firmware) - 64usize];
    [
        "Offset of field: f2shim_api::device_ir_parameters",
    ][::std::mem::offset_of!(f2shim_api, device_ir_parameters) - 72usize];
    [
        "Offset of field: f2shim_api::device_p0_tables",
    ][::std::mem::offset_of!(f2shim_api, device_p0_tables) - 80usize];
    [
        "Offset of field: f2shim_api::last_error",
    ][::std::mem::offset_of!(f2shim_api, last_error) - 88usize];
};
unsafe extern "C" {
    pub fn f2shim_libfreenect2() -> *const f2shim_api;
}
