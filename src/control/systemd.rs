//! What the service manager is told: `sd_notify(3)`, over the datagram socket that `NOTIFY_SOCKET` names.

use std::{
    env,
    ffi::OsStr,
    io,
    os::{
        linux::net::SocketAddrExt,
        unix::{
            ffi::OsStrExt,
            net::{SocketAddr, UnixDatagram},
        },
    },
    time::Duration,
};

/// The service manager, if one listens.
#[derive(Debug, Default)]
pub struct ServiceManager {
    socket: Option<(UnixDatagram, SocketAddr)>,
    watchdog: Option<Duration>,
}

impl ServiceManager {
    /// The service manager that started this process, by the environment; nobody if there is none.
    pub fn from_env() -> Self {
        let Some(name) = env::var_os("NOTIFY_SOCKET") else {
            return ServiceManager::default();
        };
        match connect(&name) {
            Ok(socket) => ServiceManager {
                socket: Some(socket),
                watchdog: watchdog_interval(),
            },
            Err(error) => {
                tracing::warn!(%error, "the service manager cannot be told of anything");
                ServiceManager::default()
            }
        }
    }

    /// Within which time it wants to hear that all is well; `None` if it does not ask.
    pub fn watchdog(&self) -> Option<Duration> {
        self.watchdog
    }

    /// Requests are answered from now on.
    pub fn ready(&self, status: &str) {
        self.tell(&format!("READY=1\nSTATUS={status}"));
    }

    /// What the daemon is doing, in one line.
    pub fn status(&self, status: &str) {
        self.tell(&format!("STATUS={status}"));
    }

    /// The configuration is being read anew; [`ServiceManager::ready`] ends that.
    pub fn reloading(&self) {
        let now = rustix::time::clock_gettime(rustix::time::ClockId::Monotonic);
        let micros = now.tv_sec as u64 * 1_000_000 + now.tv_nsec as u64 / 1000;
        self.tell(&format!("RELOADING=1\nMONOTONIC_USEC={micros}"));
    }

    /// The daemon is ending, and needs at most so long for its next step.
    pub fn stopping(&self, next_step: Duration) {
        self.tell(&format!(
            "STOPPING=1\nSTATUS=draining\nEXTEND_TIMEOUT_USEC={}",
            next_step.as_micros()
        ));
    }

    /// Every stage has moved, or has nothing to do.
    pub fn all_is_well(&self) {
        self.tell("WATCHDOG=1");
    }

    fn tell(&self, text: &str) {
        if let Some((socket, address)) = &self.socket {
            // Who does not listen any more misses nothing that the daemon needs.
            let _ = socket.send_to_addr(text.as_bytes(), address);
        }
    }
}

fn connect(name: &OsStr) -> io::Result<(UnixDatagram, SocketAddr)> {
    let address = match name.as_bytes().strip_prefix(b"@") {
        Some(abstract_name) => SocketAddr::from_abstract_name(abstract_name)?,
        None => SocketAddr::from_pathname(name)?,
    };
    let socket = UnixDatagram::unbound()?;
    socket.set_nonblocking(true)?;
    Ok((socket, address))
}

/// The interval of `WATCHDOG_USEC`, if it is meant for this process.
fn watchdog_interval() -> Option<Duration> {
    let number = |name| env::var(name).ok()?.parse::<u64>().ok();
    let is_ours = number("WATCHDOG_PID").is_none_or(|pid| pid == u64::from(std::process::id()));
    let micros = number("WATCHDOG_USEC").filter(|micros| *micros > 0)?;
    is_ours.then_some(Duration::from_micros(micros))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_service_manager_hears_what_it_is_told() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("notify");
        let ear = UnixDatagram::bind(&path).unwrap();
        let manager = ServiceManager {
            socket: Some(connect(path.as_os_str()).unwrap()),
            watchdog: None,
        };
        manager.ready("idle");
        manager.all_is_well();
        let mut heard = [0; 256];
        let n = ear.recv(&mut heard).unwrap();
        assert_eq!(&heard[..n], b"READY=1\nSTATUS=idle");
        let n = ear.recv(&mut heard).unwrap();
        assert_eq!(&heard[..n], b"WATCHDOG=1");
    }

    #[test]
    fn a_name_after_an_at_sign_is_abstract() {
        let (_, address) = connect(OsStr::new("@relief/test")).unwrap();
        assert_eq!(address.as_abstract_name(), Some(&b"relief/test"[..]));
    }
}
