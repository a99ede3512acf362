//! Contexts, devices, handles and transfers: what lies behind libusb's pointers.

use std::{
    collections::VecDeque,
    fs::File,
    path::PathBuf,
    ptr,
    sync::{Mutex, MutexGuard, OnceLock, PoisonError},
    thread,
    time::{Duration, Instant},
};

use crate::{
    abi::{TRANSFER_CANCELLED, TRANSFER_COMPLETED, TRANSFER_NO_DEVICE, Transfer},
    kinect::{Kinect, Packet, Role},
    scenario::Folder,
};

/// How long one sleep is between looks at clock and files.
const NAP: Duration = Duration::from_micros(500);

/// All Kinects of the scenario.
pub(crate) fn kinects() -> Result<&'static [Kinect], String> {
    static KINECTS: OnceLock<Result<Vec<Kinect>, String>> = OnceLock::new();
    let loaded = KINECTS.get_or_init(|| {
        let root = std::env::var_os("USB_STAND_IN").ok_or("USB_STAND_IN is not set")?;
        let folders = Folder::all(&PathBuf::from(root)).into_iter();
        folders.map(Kinect::load).collect()
    });
    loaded.as_deref().map_err(String::clone)
}

/// What a `libusb_device` points to; it lives as long as its context.
pub(crate) struct Unit {
    pub(crate) kinect: &'static Kinect,
    pub(crate) role: Role,
    context: *const Context,
}

/// What a `libusb_device_handle` points to.
pub(crate) struct Handle {
    pub(crate) unit: *const Unit,
    /// Locked while the camera is claimed.
    pub(crate) claim: Option<File>,
}

struct Pending {
    transfer: *mut Transfer,
    kinect: &'static Kinect,
    n_filled: usize,
    is_cancelled: bool,
}

/// What a `libusb_context` points to.
pub(crate) struct Context {
    units: Vec<Unit>,
    pending: Mutex<VecDeque<Pending>>,
}

impl Context {
    pub(crate) fn new() -> Result<Box<Self>, String> {
        let mut context = Box::new(Context {
            units: Vec::new(),
            pending: Mutex::default(),
        });
        let address = ptr::from_ref(&*context);
        for kinect in kinects()? {
            let roles = kinect.roles().iter();
            context.units.extend(roles.map(|role| Unit {
                kinect,
                role: *role,
                context: address,
            }));
        }
        Ok(context)
    }

    /// What is plugged in.
    pub(crate) fn units(&self) -> impl Iterator<Item = &Unit> {
        self.units.iter().filter(|unit| unit.kinect.is_plugged())
    }

    fn pending(&self) -> MutexGuard<'_, VecDeque<Pending>> {
        self.pending.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Transfers that are done now, their status set.
    fn done(&self) -> Vec<*mut Transfer> {
        let mut pending = self.pending();
        let mut done = Vec::new();
        let mut finish = |transfer: *mut Transfer, status| {
            // SAFETY: a transfer that was submitted is the library's own until its callback has run.
            unsafe { (*transfer).status = status };
            done.push(transfer);
        };
        pending.retain(|entry| {
            let status = match (entry.is_cancelled, entry.kinect.is_plugged()) {
                (true, _) => TRANSFER_CANCELLED,
                (_, false) => TRANSFER_NO_DEVICE,
                _ => return true,
            };
            finish(entry.transfer, status);
            false
        });
        let mut kinects: Vec<&Kinect> = pending.iter().map(|entry| entry.kinect).collect();
        kinects.dedup_by(|a, b| ptr::eq(*a, *b));
        for kinect in kinects {
            kinect.advance(|endpoint, packet| {
                let waiting = pending.iter().position(|entry| {
                    // SAFETY: as above.
                    ptr::eq(entry.kinect, kinect)
                        && unsafe { (*entry.transfer).endpoint } == endpoint
                });
                let Some(index) = waiting else {
                    return false;
                };
                let entry = &mut pending[index];
                // SAFETY: as above; packets are filled in order and their number is looked at below.
                unsafe { fill(entry.transfer, entry.n_filled, packet) };
                entry.n_filled += 1;
                // SAFETY: as above.
                if entry.n_filled == unsafe { (*entry.transfer).n_packets } as usize {
                    finish(entry.transfer, TRANSFER_COMPLETED);
                    pending.remove(index);
                }
                true
            });
        }
        done
    }

    /// Waits at most `timeout` for transfers that are done, and calls back for each.
    pub(crate) fn handle_events(&self, timeout: Duration) {
        let deadline = Instant::now() + timeout;
        loop {
            let done = self.done();
            for transfer in &done {
                // SAFETY: the transfer is the library's until its callback has run, which it does here.
                if let Some(callback) = unsafe { (**transfer).callback } {
                    // SAFETY: the library asked for this call. Nothing of the bus is locked: it may submit anew.
                    unsafe { callback(*transfer) };
                }
            }
            let now = Instant::now();
            if !done.is_empty() || now >= deadline {
                return;
            }
            thread::sleep(NAP.min(deadline - now));
        }
    }
}

impl Unit {
    /// Takes a transfer to be filled.
    pub(crate) fn submit(&self, transfer: *mut Transfer) {
        // SAFETY: a context outlives its units.
        let context = unsafe { &*self.context };
        context.pending().push_back(Pending {
            transfer,
            kinect: self.kinect,
            n_filled: 0,
            is_cancelled: false,
        });
    }

    /// Whether such a transfer was waiting; it is called back as cancelled.
    pub(crate) fn cancel(&self, transfer: *mut Transfer) -> bool {
        // SAFETY: a context outlives its units.
        let context = unsafe { &*self.context };
        let mut pending = context.pending();
        let entry = pending
            .iter_mut()
            .find(|entry| ptr::eq(entry.transfer, transfer));
        entry.map(|entry| entry.is_cancelled = true).is_some()
    }
}

/// Writes one packet into its slot of a transfer.
///
/// # Safety
/// `transfer` must be a submitted isochronous transfer with more than `index` packets.
unsafe fn fill(transfer: *mut Transfer, index: usize, packet: Packet<'_>) {
    // SAFETY: packet descriptions follow the transfer; slots of the length that they tell lie one after the other.
    unsafe {
        let description = (&raw mut (*transfer).packets)
            .cast::<crate::abi::IsoPacket>()
            .add(index);
        let length = (*description).length as usize;
        let slot = std::slice::from_raw_parts_mut((*transfer).buffer.add(index * length), length);
        (*description).actual_length = packet(slot) as u32;
        (*description).status = TRANSFER_COMPLETED;
    }
}
