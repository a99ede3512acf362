//! Where the daemon listens: on the machine itself, or where the service manager listens for it.

use listenfd::ListenFd;
use std::{
    io,
    net::{SocketAddr, TcpListener},
};

/// Why the daemon cannot listen.
#[derive(Debug, thiserror::Error)]
pub enum ListenError {
    /// The address can be reached from other machines.
    #[error(
        "{0} can be reached from other machines, and the daemon speaks no TLS: listen on 127.0.0.1 or [::1] and come by way of ssh or a proxy"
    )]
    NotLoopback(SocketAddr),
    /// The system refuses.
    #[error("cannot listen on {address}: {source}")]
    Io {
        /// Where.
        address: SocketAddr,
        /// What the system said.
        source: io::Error,
    },
    /// The service manager's socket cannot be used.
    #[error("cannot use the socket of the service manager: {0}")]
    Activation(io::Error),
}

/// The socket that the service manager hands over, if it does, else a new one at the address; nobody but this machine may
/// reach it.
///
/// # Errors
/// If other machines may reach it, or the system refuses.
pub fn listen(address: SocketAddr) -> Result<TcpListener, ListenError> {
    let handed = ListenFd::from_env()
        .take_tcp_listener(0)
        .map_err(ListenError::Activation)?;
    let listener = match handed {
        Some(listener) => listener,
        None => bind(address)?,
    };
    let bound = listener.local_addr().map_err(ListenError::Activation)?;
    check_loopback(bound)?;
    listener
        .set_nonblocking(true)
        .map_err(ListenError::Activation)?;
    Ok(listener)
}

fn bind(address: SocketAddr) -> Result<TcpListener, ListenError> {
    check_loopback(address)?;
    TcpListener::bind(address).map_err(|source| ListenError::Io { address, source })
}

fn check_loopback(address: SocketAddr) -> Result<(), ListenError> {
    match address.ip().to_canonical().is_loopback() {
        true => Ok(()),
        false => Err(ListenError::NotLoopback(address)),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_this_machine_is_listened_to() {
        for address in [
            "0.0.0.0:0",
            "192.168.1.7:0",
            "[::]:0",
            "[::ffff:10.0.0.1]:0",
        ] {
            let error = listen(address.parse().unwrap()).unwrap_err();
            assert!(matches!(error, ListenError::NotLoopback(_)), "{address}");
        }
        let listener = listen("127.0.0.1:0".parse().unwrap()).unwrap();
        assert_ne!(listener.local_addr().unwrap().port(), 0);
    }
}
