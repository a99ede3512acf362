// Made by bindgen from libfreenect's headers, see `lib.rs`; not to be edited.

pub type __time_t = ::core::ffi::c_long;
pub type __suseconds_t = ::core::ffi::c_long;
#[repr(C)]
#[derive(Debug, Copy, Clone)]
pub struct timeval {
    pub tv_sec: __time_t,
    pub tv_usec: __suseconds_t,
}
#[allow(clippy::unnecessary_operation, clippy::identity_op)]
const _: () = {
    ["Size of timeval"][::core::mem::size_of::<timeval>() - 16usize];
    ["Alignment of timeval"][::core::mem::align_of::<timeval>() - 8usize];
    [
        "Offset of field: timeval::tv_sec",
    ][::core::mem::offset_of!(timeval, tv_sec) - 0usize];
    [
        "Offset of field: timeval::tv_usec",
    ][::core::mem::offset_of!(timeval, tv_usec) - 8usize];
};
pub const FREENECT_DEVICE_MOTOR: freenect_device_flags = 1;
pub const FREENECT_DEVICE_CAMERA: freenect_device_flags = 2;
pub const FREENECT_DEVICE_AUDIO: freenect_device_flags = 4;
pub type freenect_device_flags = ::core::ffi::c_uint;
#[repr(C)]
#[derive(Debug, Copy, Clone)]
pub struct freenect_device_attributes {
    pub next: *mut freenect_device_attributes,
    pub camera_serial: *const ::core::ffi::c_char,
}
#[allow(clippy::unnecessary_operation, clippy::identity_op)]
const _: () = {
    [
        "Size of freenect_device_attributes",
    ][::core::mem::size_of::<freenect_device_attributes>() - 16usize];
    [
        "Alignment of freenect_device_attributes",
    ][::core::mem::align_of::<freenect_device_attributes>() - 8usize];
    [
        "Offset of field: freenect_device_attributes::next",
    ][::core::mem::offset_of!(freenect_device_attributes, next) - 0usize];
    [
        "Offset of field: freenect_device_attributes::camera_serial",
    ][::core::mem::offset_of!(freenect_device_attributes, camera_serial) - 8usize];
};
pub const FREENECT_RESOLUTION_LOW: freenect_resolution = 0;
pub const FREENECT_RESOLUTION_MEDIUM: freenect_resolution = 1;
pub const FREENECT_RESOLUTION_HIGH: freenect_resolution = 2;
pub const FREENECT_RESOLUTION_DUMMY: freenect_resolution = 2147483647;
pub type freenect_resolution = ::core::ffi::c_uint;
pub const FREENECT_VIDEO_RGB: freenect_video_format = 0;
pub const FREENECT_VIDEO_BAYER: freenect_video_format = 1;
pub const FREENECT_VIDEO_IR_8BIT: freenect_video_format = 2;
pub const FREENECT_VIDEO_IR_10BIT: freenect_video_format = 3;
pub const FREENECT_VIDEO_IR_10BIT_PACKED: freenect_video_format = 4;
pub const FREENECT_VIDEO_YUV_RGB: freenect_video_format = 5;
pub const FREENECT_VIDEO_YUV_RAW: freenect_video_format = 6;
pub const FREENECT_VIDEO_DUMMY: freenect_video_format = 2147483647;
pub type freenect_video_format = ::core::ffi::c_uint;
pub const FREENECT_DEPTH_11BIT: freenect_depth_format = 0;
pub const FREENECT_DEPTH_10BIT: freenect_depth_format = 1;
pub const FREENECT_DEPTH_11BIT_PACKED: freenect_depth_format = 2;
pub const FREENECT_DEPTH_10BIT_PACKED: freenect_depth_format = 3;
pub const FREENECT_DEPTH_REGISTERED: freenect_depth_format = 4;
pub const FREENECT_DEPTH_MM: freenect_depth_format = 5;
pub const FREENECT_DEPTH_DUMMY: freenect_depth_format = 2147483647;
pub type freenect_depth_format = ::core::ffi::c_uint;
#[repr(C)]
#[derive(Copy, Clone)]
pub struct freenect_frame_mode {
    pub reserved: u32,
    pub resolution: freenect_resolution,
    pub __bindgen_anon_1: freenect_frame_mode__bindgen_ty_1,
    pub bytes: i32,
    pub width: i16,
    pub height: i16,
    pub data_bits_per_pixel: i8,
    pub padding_bits_per_pixel: i8,
    pub framerate: i8,
    pub is_valid: i8,
}
#[repr(C)]
#[derive(Copy, Clone)]
pub union freenect_frame_mode__bindgen_ty_1 {
    pub dummy: i32,
    pub video_format: freenect_video_format,
    pub depth_format: freenect_depth_format,
}
#[allow(clippy::unnecessary_operation, clippy::identity_op)]
const _: () = {
    [
        "Size of freenect_frame_mode__bindgen_ty_1",
    ][::core::mem::size_of::<freenect_frame_mode__bindgen_ty_1>() - 4usize];
    [
        "Alignment of freenect_frame_mode__bindgen_ty_1",
    ][::core::mem::align_of::<freenect_frame_mode__bindgen_ty_1>() - 4usize];
    [
        "Offset of field: freenect_frame_mode__bindgen_ty_1::dummy",
    ][::core::mem::offset_of!(freenect_frame_mode__bindgen_ty_1, dummy) - 0usize];
    [
        "Offset of field: freenect_frame_mode__bindgen_ty_1::video_format",
    ][::core::mem::offset_of!(freenect_frame_mode__bindgen_ty_1, video_format) - 0usize];
    [
        "Offset of field: freenect_frame_mode__bindgen_ty_1::depth_format",
    ][::core::mem::offset_of!(freenect_frame_mode__bindgen_ty_1, depth_format) - 0usize];
};
#[allow(clippy::unnecessary_operation, clippy::identity_op)]
const _: () = {
    [
        "Size of freenect_frame_mode",
    ][::core::mem::size_of::<freenect_frame_mode>() - 24usize];
    [
        "Alignment of freenect_frame_mode",
    ][::core::mem::align_of::<freenect_frame_mode>() - 4usize];
    [
        "Offset of field: freenect_frame_mode::reserved",
    ][::core::mem::offset_of!(freenect_frame_mode, reserved) - 0usize];
    [
        "Offset of field: freenect_frame_mode::resolution",
    ][::core::mem::offset_of!(freenect_frame_mode, resolution) - 4usize];
    [
        "Offset of field: freenect_frame_mode::bytes",
    ][::core::mem::offset_of!(freenect_frame_mode, bytes) - 12usize];
    [
        "Offset of field: freenect_frame_mode::width",
    ][::core::mem::offset_of!(freenect_frame_mode, width) - 16usize];
    [
        "Offset of field: freenect_frame_mode::height",
    ][::core::mem::offset_of!(freenect_frame_mode, height) - 18usize];
    [
        "Offset of field: freenect_frame_mode::data_bits_per_pixel",
    ][::core::mem::offset_of!(freenect_frame_mode, data_bits_per_pixel) - 20usize];
    [
        "Offset of field: freenect_frame_mode::padding_bits_per_pixel",
    ][::core::mem::offset_of!(freenect_frame_mode, padding_bits_per_pixel) - 21usize];
    [
        "Offset of field: freenect_frame_mode::framerate",
    ][::core::mem::offset_of!(freenect_frame_mode, framerate) - 22usize];
    [
        "Offset of field: freenect_frame_mode::is_valid",
    ][::core::mem::offset_of!(freenect_frame_mode, is_valid) - 23usize];
};
#[repr(C)]
#[derive(Debug)]
pub struct _freenect_context {
    _unused: [u8; 0],
}
pub type freenect_context = _freenect_context;
#[repr(C)]
#[derive(Debug)]
pub struct _freenect_device {
    _unused: [u8; 0],
}
pub type freenect_device = _freenect_device;
pub type freenect_usb_context = ::core::ffi::c_void;
pub const FREENECT_LOG_FATAL: freenect_loglevel = 0;
pub const FREENECT_LOG_ERROR: freenect_loglevel = 1;
pub const FREENECT_LOG_WARNING: freenect_loglevel = 2;
pub const FREENECT_LOG_NOTICE: freenect_loglevel = 3;
pub const FREENECT_LOG_INFO: freenect_loglevel = 4;
pub const FREENECT_LOG_DEBUG: freenect_loglevel = 5;
pub const FREENECT_LOG_SPEW: freenect_loglevel = 6;
pub const FREENECT_LOG_FLOOD: freenect_loglevel = 7;
pub type freenect_loglevel = ::core::ffi::c_uint;
unsafe extern "C" {
    pub fn freenect_init(
        ctx: *mut *mut freenect_context,
        usb_ctx: *mut freenect_usb_context,
    ) -> ::core::ffi::c_int;
}
unsafe extern "C" {
    pub fn freenect_shutdown(ctx: *mut freenect_context) -> ::core::ffi::c_int;
}
pub type freenect_log_cb = ::core::option::Option<
    unsafe extern "C" fn(
        dev: *mut freenect_context,
        level: freenect_loglevel,
        msg: *const ::core::ffi::c_char,
    ),
>;
unsafe extern "C" {
    pub fn freenect_set_log_level(ctx: *mut freenect_context, level: freenect_loglevel);
}
unsafe extern "C" {
    pub fn freenect_set_log_callback(ctx: *mut freenect_context, cb: freenect_log_cb);
}
unsafe extern "C" {
    pub fn freenect_process_events_timeout(
        ctx: *mut freenect_context,
        timeout: *mut timeval,
    ) -> ::core::ffi::c_int;
}
unsafe extern "C" {
    pub fn freenect_num_devices(ctx: *mut freenect_context) -> ::core::ffi::c_int;
}
unsafe extern "C" {
    pub fn freenect_list_device_attributes(
        ctx: *mut freenect_context,
        attribute_list: *mut *mut freenect_device_attributes,
    ) -> ::core::ffi::c_int;
}
unsafe extern "C" {
    pub fn freenect_free_device_attributes(
        attribute_list: *mut freenect_device_attributes,
    );
}
unsafe extern "C" {
    pub fn freenect_select_subdevices(
        ctx: *mut freenect_context,
        subdevs: freenect_device_flags,
    );
}
unsafe extern "C" {
    pub fn freenect_open_device_by_camera_serial(
        ctx: *mut freenect_context,
        dev: *mut *mut freenect_device,
        camera_serial: *const ::core::ffi::c_char,
    ) -> ::core::ffi::c_int;
}
unsafe extern "C" {
    pub fn freenect_close_device(dev: *mut freenect_device) -> ::core::ffi::c_int;
}
unsafe extern "C" {
    pub fn freenect_set_user(dev: *mut freenect_device, user: *mut ::core::ffi::c_void);
}
unsafe extern "C" {
    pub fn freenect_get_user(dev: *mut freenect_device) -> *mut ::core::ffi::c_void;
}
pub type freenect_depth_cb = ::core::option::Option<
    unsafe extern "C" fn(
        dev: *mut freenect_device,
        depth: *mut ::core::ffi::c_void,
        timestamp: u32,
    ),
>;
pub type freenect_video_cb = ::core::option::Option<
    unsafe extern "C" fn(
        dev: *mut freenect_device,
        video: *mut ::core::ffi::c_void,
        timestamp: u32,
    ),
>;
pub type freenect_chunk_cb = ::core::option::Option<
    unsafe extern "C" fn(
        buffer: *mut ::core::ffi::c_void,
        pkt_data: *mut ::core::ffi::c_void,
        pkt_num: ::core::ffi::c_int,
        datalen: ::core::ffi::c_int,
        user_data: *mut ::core::ffi::c_void,
    ),
>;
unsafe extern "C" {
    pub fn freenect_set_depth_callback(dev: *mut freenect_device, cb: freenect_depth_cb);
}
unsafe extern "C" {
    pub fn freenect_set_video_callback(dev: *mut freenect_device, cb: freenect_video_cb);
}
unsafe extern "C" {
    pub fn freenect_set_depth_chunk_callback(
        dev: *mut freenect_device,
        cb: freenect_chunk_cb,
    );
}
unsafe extern "C" {
    pub fn freenect_set_video_chunk_callback(
        dev: *mut freenect_device,
        cb: freenect_chunk_cb,
    );
}
unsafe extern "C" {
    pub fn freenect_set_depth_buffer(
        dev: *mut freenect_device,
        buf: *mut ::core::ffi::c_void,
    ) -> ::core::ffi::c_int;
}
unsafe extern "C" {
    pub fn freenect_set_video_buffer(
        dev: *mut freenect_device,
        buf: *mut ::core::ffi::c_void,
    ) -> ::core::ffi::c_int;
}
unsafe extern "C" {
    pub fn freenect_start_depth(dev: *mut freenect_device) -> ::core::ffi::c_int;
}
unsafe extern "C" {
    pub fn freenect_start_video(dev: *mut freenect_device) -> ::core::ffi::c_int;
}
unsafe extern "C" {
    pub fn freenect_stop_depth(dev: *mut freenect_device) -> ::core::ffi::c_int;
}
unsafe extern "C" {
    pub fn freenect_stop_video(dev: *mut freenect_device) -> ::core::ffi::c_int;
}
unsafe extern "C" {
    pub fn freenect_find_video_mode(
        res: freenect_resolution,
        fmt: freenect_video_format,
    ) -> freenect_frame_mode;
}
unsafe extern "C" {
    pub fn freenect_set_video_mode(
        dev: *mut freenect_device,
        mode: freenect_frame_mode,
    ) -> ::core::ffi::c_int;
}
unsafe extern "C" {
    pub fn freenect_find_depth_mode(
        res: freenect_resolution,
        fmt: freenect_depth_format,
    ) -> freenect_frame_mode;
}
unsafe extern "C" {
    pub fn freenect_set_depth_mode(
        dev: *mut freenect_device,
        mode: freenect_frame_mode,
    ) -> ::core::ffi::c_int;
}
unsafe extern "C" {
    pub fn freenect_get_ir_brightness(dev: *mut freenect_device) -> ::core::ffi::c_int;
}
unsafe extern "C" {
    pub fn freenect_set_ir_brightness(
        dev: *mut freenect_device,
        brightness: u16,
    ) -> ::core::ffi::c_int;
}
#[repr(C)]
#[derive(Debug, Copy, Clone)]
pub struct freenect_reg_info {
    pub dx_center: i32,
    pub ax: i32,
    pub bx: i32,
    pub cx: i32,
    pub dx: i32,
    pub dx_start: i32,
    pub ay: i32,
    pub by: i32,
    pub cy: i32,
    pub dy: i32,
    pub dy_start: i32,
    pub dx_beta_start: i32,
    pub dy_beta_start: i32,
    pub rollout_blank: i32,
    pub rollout_size: i32,
    pub dx_beta_inc: i32,
    pub dy_beta_inc: i32,
    pub dxdx_start: i32,
    pub dxdy_start: i32,
    pub dydx_start: i32,
    pub dydy_start: i32,
    pub dxdxdx_start: i32,
    pub dydxdx_start: i32,
    pub dxdxdy_start: i32,
    pub dydxdy_start: i32,
    pub back_comp1: i32,
    pub dydydx_start: i32,
    pub back_comp2: i32,
    pub dydydy_start: i32,
}
#[allow(clippy::unnecessary_operation, clippy::identity_op)]
const _: () = {
    [
        "Size of freenect_reg_info",
    ][::core::mem::size_of::<freenect_reg_info>() - 116usize];
    [
        "Alignment of freenect_reg_info",
    ][::core::mem::align_of::<freenect_reg_info>() - 4usize];
    [
        "Offset of field: freenect_reg_info::dx_center",
    ][::core::mem::offset_of!(freenect_reg_info, dx_center) - 0usize];
    [
        "Offset of field: freenect_reg_info::ax",
    ][::core::mem::offset_of!(freenect_reg_info, ax) - 4usize];
    [
        "Offset of field: freenect_reg_info::bx",
    ][::core::mem::offset_of!(freenect_reg_info, bx) - 8usize];
    [
        "Offset of field: freenect_reg_info::cx",
    ][::core::mem::offset_of!(freenect_reg_info, cx) - 12usize];
    [
        "Offset of field: freenect_reg_info::dx",
    ][::core::mem::offset_of!(freenect_reg_info, dx) - 16usize];
    [
        "Offset of field: freenect_reg_info::dx_start",
    ][::core::mem::offset_of!(freenect_reg_info, dx_start) - 20usize];
    [
        "Offset of field: freenect_reg_info::ay",
    ][::core::mem::offset_of!(freenect_reg_info, ay) - 24usize];
    [
        "Offset of field: freenect_reg_info::by",
    ][::core::mem::offset_of!(freenect_reg_info, by) - 28usize];
    [
        "Offset of field: freenect_reg_info::cy",
    ][::core::mem::offset_of!(freenect_reg_info, cy) - 32usize];
    [
        "Offset of field: freenect_reg_info::dy",
    ][::core::mem::offset_of!(freenect_reg_info, dy) - 36usize];
    [
        "Offset of field: freenect_reg_info::dy_start",
    ][::core::mem::offset_of!(freenect_reg_info, dy_start) - 40usize];
    [
        "Offset of field: freenect_reg_info::dx_beta_start",
    ][::core::mem::offset_of!(freenect_reg_info, dx_beta_start) - 44usize];
    [
        "Offset of field: freenect_reg_info::dy_beta_start",
    ][::core::mem::offset_of!(freenect_reg_info, dy_beta_start) - 48usize];
    [
        "Offset of field: freenect_reg_info::rollout_blank",
    ][::core::mem::offset_of!(freenect_reg_info, rollout_blank) - 52usize];
    [
        "Offset of field: freenect_reg_info::rollout_size",
    ][::core::mem::offset_of!(freenect_reg_info, rollout_size) - 56usize];
    [
        "Offset of field: freenect_reg_info::dx_beta_inc",
    ][::core::mem::offset_of!(freenect_reg_info, dx_beta_inc) - 60usize];
    [
        "Offset of field: freenect_reg_info::dy_beta_inc",
    ][::core::mem::offset_of!(freenect_reg_info, dy_beta_inc) - 64usize];
    [
        "Offset of field: freenect_reg_info::dxdx_start",
    ][::core::mem::offset_of!(freenect_reg_info, dxdx_start) - 68usize];
    [
        "Offset of field: freenect_reg_info::dxdy_start",
    ][::core::mem::offset_of!(freenect_reg_info, dxdy_start) - 72usize];
    [
        "Offset of field: freenect_reg_info::dydx_start",
    ][::core::mem::offset_of!(freenect_reg_info, dydx_start) - 76usize];
    [
        "Offset of field: freenect_reg_info::dydy_start",
    ][::core::mem::offset_of!(freenect_reg_info, dydy_start) - 80usize];
    [
        "Offset of field: freenect_reg_info::dxdxdx_start",
    ][::core::mem::offset_of!(freenect_reg_info, dxdxdx_start) - 84usize];
    [
        "Offset of field: freenect_reg_info::dydxdx_start",
    ][::core::mem::offset_of!(freenect_reg_info, dydxdx_start) - 88usize];
    [
        "Offset of field: freenect_reg_info::dxdxdy_start",
    ][::core::mem::offset_of!(freenect_reg_info, dxdxdy_start) - 92usize];
    [
        "Offset of field: freenect_reg_info::dydxdy_start",
    ][::core::mem::offset_of!(freenect_reg_info, dydxdy_start) - 96usize];
    [
        "Offset of field: freenect_reg_info::back_comp1",
    ][::core::mem::offset_of!(freenect_reg_info, back_comp1) - 100usize];
    [
        "Offset of field: freenect_reg_info::dydydx_start",
    ][::core::mem::offset_of!(freenect_reg_info, dydydx_start) - 104usize];
    [
        "Offset of field: freenect_reg_info::back_comp2",
    ][::core::mem::offset_of!(freenect_reg_info, back_comp2) - 108usize];
    [
        "Offset of field: freenect_reg_info::dydydy_start",
    ][::core::mem::offset_of!(freenect_reg_info, dydydy_start) - 112usize];
};
#[repr(C)]
#[derive(Debug, Copy, Clone)]
pub struct freenect_reg_pad_info {
    pub start_lines: u16,
    pub end_lines: u16,
    pub cropping_lines: u16,
}
#[allow(clippy::unnecessary_operation, clippy::identity_op)]
const _: () = {
    [
        "Size of freenect_reg_pad_info",
    ][::core::mem::size_of::<freenect_reg_pad_info>() - 6usize];
    [
        "Alignment of freenect_reg_pad_info",
    ][::core::mem::align_of::<freenect_reg_pad_info>() - 2usize];
    [
        "Offset of field: freenect_reg_pad_info::start_lines",
    ][::core::mem::offset_of!(freenect_reg_pad_info, start_lines) - 0usize];
    [
        "Offset of field: freenect_reg_pad_info::end_lines",
    ][::core::mem::offset_of!(freenect_reg_pad_info, end_lines) - 2usize];
    [
        "Offset of field: freenect_reg_pad_info::cropping_lines",
    ][::core::mem::offset_of!(freenect_reg_pad_info, cropping_lines) - 4usize];
};
#[repr(C)]
#[derive(Debug, Copy, Clone)]
pub struct freenect_zero_plane_info {
    pub dcmos_emitter_dist: f32,
    pub dcmos_rcmos_dist: f32,
    pub reference_distance: f32,
    pub reference_pixel_size: f32,
}
#[allow(clippy::unnecessary_operation, clippy::identity_op)]
const _: () = {
    [
        "Size of freenect_zero_plane_info",
    ][::core::mem::size_of::<freenect_zero_plane_info>() - 16usize];
    [
        "Alignment of freenect_zero_plane_info",
    ][::core::mem::align_of::<freenect_zero_plane_info>() - 4usize];
    [
        "Offset of field: freenect_zero_plane_info::dcmos_emitter_dist",
    ][::core::mem::offset_of!(freenect_zero_plane_info, dcmos_emitter_dist) - 0usize];
    [
        "Offset of field: freenect_zero_plane_info::dcmos_rcmos_dist",
    ][::core::mem::offset_of!(freenect_zero_plane_info, dcmos_rcmos_dist) - 4usize];
    [
        "Offset of field: freenect_zero_plane_info::reference_distance",
    ][::core::mem::offset_of!(freenect_zero_plane_info, reference_distance) - 8usize];
    [
        "Offset of field: freenect_zero_plane_info::reference_pixel_size",
    ][::core::mem::offset_of!(freenect_zero_plane_info, reference_pixel_size) - 12usize];
};
#[repr(C)]
#[derive(Debug, Copy, Clone)]
pub struct freenect_registration {
    pub reg_info: freenect_reg_info,
    pub reg_pad_info: freenect_reg_pad_info,
    pub zero_plane_info: freenect_zero_plane_info,
    pub const_shift: f64,
    pub raw_to_mm_shift: *mut u16,
    pub depth_to_rgb_shift: *mut i32,
    pub registration_table: *mut [i32; 2usize],
}
#[allow(clippy::unnecessary_operation, clippy::identity_op)]
const _: () = {
    [
        "Size of freenect_registration",
    ][::core::mem::size_of::<freenect_registration>() - 176usize];
    [
        "Alignment of freenect_registration",
    ][::core::mem::align_of::<freenect_registration>() - 8usize];
    [
        "Offset of field: freenect_registration::reg_info",
    ][::core::mem::offset_of!(freenect_registration, reg_info) - 0usize];
    [
        "Offset of field: freenect_registration::reg_pad_info",
    ][::core::mem::offset_of!(freenect_registration, reg_pad_info) - 116usize];
    [
        "Offset of field: freenect_registration::zero_plane_info",
    ][::core::mem::offset_of!(freenect_registration, zero_plane_info) - 124usize];
    [
        "Offset of field: freenect_registration::const_shift",
    ][::core::mem::offset_of!(freenect_registration, const_shift) - 144usize];
    [
        "Offset of field: freenect_registration::raw_to_mm_shift",
    ][::core::mem::offset_of!(freenect_registration, raw_to_mm_shift) - 152usize];
    [
        "Offset of field: freenect_registration::depth_to_rgb_shift",
    ][::core::mem::offset_of!(freenect_registration, depth_to_rgb_shift) - 160usize];
    [
        "Offset of field: freenect_registration::registration_table",
    ][::core::mem::offset_of!(freenect_registration, registration_table) - 168usize];
};
unsafe extern "C" {
    pub fn freenect_copy_registration(
        dev: *mut freenect_device,
    ) -> freenect_registration;
}
unsafe extern "C" {
    pub fn freenect_destroy_registration(
        reg: *mut freenect_registration,
    ) -> ::core::ffi::c_int;
}
