//! USB devices that come and go, as the system's udev tells of them.
//!
//! udev sends what the kernel tells it on to a netlink group, after its rules have been applied: a device that is announced here
//! has its permissions. Without udev nothing is ever announced, which nobody can tell from a bus on which nothing happens: who
//! waits for a device must look for it now and then all the same. Whoever may send to the group is believed: an event is a
//! reason to look, not a fact.

mod event;

pub use event::{Action, UsbEvent};

use rustix::{
    event::{PollFd, PollFlags, Timespec, poll},
    io::{Errno, IoSliceMut, retry_on_intr},
    net::{
        AddressFamily, RecvAncillaryBuffer, RecvFlags, SocketFlags, SocketType, bind,
        netlink::{self, SocketAddrNetlink},
        recvmsg, socket_with,
    },
};
use std::{
    io,
    os::fd::OwnedFd,
    time::{Duration, Instant},
};

/// The group of what udev has dealt with; 1 is that of the kernel.
const UDEV_GROUP: u32 = 2;

/// udev's own limit is half of this.
const MAX_MESSAGE_BYTES: usize = 16_384;

/// Listens from when it is opened.
#[derive(Debug)]
pub struct UsbMonitor {
    socket: OwnedFd,
    message: Vec<u8>,
}

impl UsbMonitor {
    /// Begins to listen; needs no permission.
    ///
    /// # Errors
    /// If the system has no such sockets, or allows none.
    pub fn open() -> io::Result<Self> {
        let flags = SocketFlags::CLOEXEC | SocketFlags::NONBLOCK;
        let protocol = Some(netlink::KOBJECT_UEVENT);
        let socket = socket_with(AddressFamily::NETLINK, SocketType::RAW, flags, protocol)?;
        bind(&socket, &SocketAddrNetlink::new(0, UDEV_GROUP))?;
        Ok(UsbMonitor {
            socket,
            message: vec![0; MAX_MESSAGE_BYTES],
        })
    }

    /// The next event of a USB device; `None` if there is none within `timeout`.
    ///
    /// # Errors
    /// If the socket fails. More events than it holds are no failure: those that found no room are lost.
    pub fn next(&mut self, timeout: Duration) -> io::Result<Option<UsbEvent>> {
        let deadline = Instant::now() + timeout;
        loop {
            match self.receive() {
                Ok(n_bytes) => {
                    if let Some(event) = UsbEvent::parse(&self.message[..n_bytes]) {
                        return Ok(Some(event));
                    }
                }
                Err(Errno::AGAIN) => {
                    let remaining = deadline.saturating_duration_since(Instant::now());
                    if remaining.is_zero() {
                        return Ok(None);
                    }
                    self.wait(remaining)?;
                }
                Err(Errno::NOBUFS) => {}
                Err(error) => return Err(error.into()),
            }
        }
    }

    fn receive(&mut self) -> Result<usize, Errno> {
        retry_on_intr(|| {
            let mut parts = [IoSliceMut::new(&mut self.message)];
            let mut control = RecvAncillaryBuffer::default();
            let received = recvmsg(&self.socket, &mut parts, &mut control, RecvFlags::empty())?;
            Ok(received.bytes)
        })
    }

    fn wait(&self, timeout: Duration) -> io::Result<()> {
        // An hour is as good as for ever, and fits.
        let timeout = Timespec::try_from(timeout.min(Duration::from_secs(3600)));
        let timeout = timeout.map_err(io::Error::other)?;
        match poll(
            &mut [PollFd::new(&self.socket, PollFlags::IN)],
            Some(&timeout),
        ) {
            Ok(_) | Err(Errno::INTR) => Ok(()),
            Err(error) => Err(error.into()),
        }
    }
}
