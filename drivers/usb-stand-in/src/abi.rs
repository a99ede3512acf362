//! libusb's structures, as its header has them for 64-bit Linux.

use std::ffi::{c_int, c_uchar, c_uint, c_void};

pub(crate) const SUCCESS: c_int = 0;
pub(crate) const ERROR_ACCESS: c_int = -3;
pub(crate) const ERROR_NO_DEVICE: c_int = -4;
pub(crate) const ERROR_NOT_FOUND: c_int = -5;
pub(crate) const ERROR_BUSY: c_int = -6;
pub(crate) const ERROR_PIPE: c_int = -9;
pub(crate) const ERROR_NO_MEM: c_int = -11;

pub(crate) const TRANSFER_COMPLETED: c_int = 0;
pub(crate) const TRANSFER_CANCELLED: c_int = 3;
pub(crate) const TRANSFER_NO_DEVICE: c_int = 5;

#[repr(C)]
pub(crate) struct Timeval {
    pub(crate) secs: i64,
    pub(crate) micros: i64,
}

#[repr(C)]
#[derive(Clone, Copy)]
pub(crate) struct DeviceDescriptor {
    pub(crate) length: u8,
    pub(crate) descriptor_type: u8,
    pub(crate) usb_version: u16,
    pub(crate) class: u8,
    pub(crate) subclass: u8,
    pub(crate) protocol: u8,
    pub(crate) max_packet_size: u8,
    pub(crate) vendor: u16,
    pub(crate) product: u16,
    pub(crate) device_version: u16,
    pub(crate) manufacturer_index: u8,
    pub(crate) product_index: u8,
    pub(crate) serial_index: u8,
    pub(crate) n_configurations: u8,
}

/// The beginning of a configuration's descriptor; nothing behind it is looked at.
#[repr(C)]
pub(crate) struct ConfigDescriptor {
    pub(crate) length: u8,
    pub(crate) descriptor_type: u8,
    pub(crate) total_length: u16,
    pub(crate) n_interfaces: u8,
    pub(crate) value: u8,
    pub(crate) index: u8,
    pub(crate) attributes: u8,
    pub(crate) max_power: u8,
    pub(crate) interfaces: *const c_void,
    pub(crate) extra: *const c_uchar,
    pub(crate) extra_length: c_int,
}

#[repr(C)]
#[derive(Clone, Copy, Default)]
pub(crate) struct IsoPacket {
    pub(crate) length: c_uint,
    pub(crate) actual_length: c_uint,
    pub(crate) status: c_int,
}

/// A transfer; `n_packets` [`IsoPacket`]s follow it in memory.
#[repr(C)]
pub(crate) struct Transfer {
    pub(crate) handle: *mut c_void,
    pub(crate) flags: u8,
    pub(crate) endpoint: c_uchar,
    pub(crate) kind: c_uchar,
    pub(crate) timeout: c_uint,
    pub(crate) status: c_int,
    pub(crate) length: c_int,
    pub(crate) actual_length: c_int,
    pub(crate) callback: Option<unsafe extern "C" fn(*mut Transfer)>,
    pub(crate) user_data: *mut c_void,
    pub(crate) buffer: *mut c_uchar,
    pub(crate) n_packets: c_int,
    pub(crate) packets: [IsoPacket; 0],
}

const _: () = {
    assert!(size_of::<Transfer>() == 64);
    assert!(std::mem::offset_of!(Transfer, callback) == 32);
    assert!(std::mem::offset_of!(Transfer, packets) == 60);
    assert!(size_of::<DeviceDescriptor>() == 18);
    assert!(std::mem::offset_of!(ConfigDescriptor, interfaces) == 16);
};
