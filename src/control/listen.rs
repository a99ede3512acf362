//! Where the daemon listens: on the machine itself, or where the service manager listens for it; for other machines only
//! where a certificate and the token guard it.

use super::tls::{Tls, TlsError};
use crate::config::ControlParams;
use listenfd::ListenFd;
use std::{
    io,
    net::{SocketAddr, TcpListener},
    sync::Arc,
};

/// Why the daemon cannot listen.
#[derive(Debug, thiserror::Error)]
pub enum ListenError {
    /// The address can be reached from other machines, and what that needs is missing.
    #[error(
        "the address to listen on is {address}, which can be reached from other machines: {missing}; \
         otherwise listen on 127.0.0.1 or [::1] and come by way of ssh"
    )]
    Unguarded {
        /// The address.
        address: SocketAddr,
        /// What is missing.
        missing: String,
    },
    /// The certificate or its key cannot be used.
    #[error(transparent)]
    Tls(#[from] TlsError),
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

/// What lies between the socket and whoever can reach it.
#[derive(Clone, Debug)]
pub struct Protection {
    /// The certificate, where there is one.
    pub tls: Option<Arc<Tls>>,
    /// Whether every request must bring the token.
    pub requires_token: bool,
}

impl Protection {
    /// As the configuration and the command line say.
    ///
    /// # Errors
    /// For a certificate or a key that cannot be used.
    pub fn of(params: &ControlParams, requires_token: bool) -> Result<Self, TlsError> {
        Ok(Protection {
            tls: Tls::of_files(params)?.map(Arc::new),
            requires_token,
        })
    }

    fn check(&self, address: SocketAddr) -> Result<(), ListenError> {
        if address.ip().to_canonical().is_loopback() {
            return Ok(());
        }
        let missing = match (&self.tls, self.requires_token) {
            (Some(_), true) => return Ok(()),
            (Some(_), false) => "--require-token is not given",
            (None, true) => "control.tls_certificate and control.tls_key are not set",
            (None, false) => {
                "control.tls_certificate and control.tls_key are not set, and --require-token is not given"
            }
        };
        Err(ListenError::Unguarded {
            address,
            missing: missing.to_owned(),
        })
    }
}

/// The socket that the service manager hands over, if it does, else a new one at the address.
///
/// # Errors
/// If other machines may reach it without certificate and token, or the system refuses.
pub fn listen(address: SocketAddr, protection: &Protection) -> Result<TcpListener, ListenError> {
    let handed = ListenFd::from_env()
        .take_tcp_listener(0)
        .map_err(ListenError::Activation)?;
    let listener = match handed {
        Some(listener) => listener,
        None => bind(address, protection)?,
    };
    let bound = listener.local_addr().map_err(ListenError::Activation)?;
    protection.check(bound)?;
    listener
        .set_nonblocking(true)
        .map_err(ListenError::Activation)?;
    Ok(listener)
}

fn bind(address: SocketAddr, protection: &Protection) -> Result<TcpListener, ListenError> {
    protection.check(address)?;
    TcpListener::bind(address).map_err(|source| ListenError::Io { address, source })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::control::tls::tests::self_signed;

    fn message(address: &str, protection: &Protection) -> String {
        let error = listen(address.parse().unwrap(), protection).unwrap_err();
        assert!(matches!(error, ListenError::Unguarded { .. }), "{error}");
        error.to_string()
    }

    #[test]
    fn without_guard_only_this_machine_is_listened_to() {
        let bare = Protection::of(&ControlParams::default(), false).unwrap();
        for address in [
            "0.0.0.0:0",
            "192.168.1.7:0",
            "[::]:0",
            "[::ffff:10.0.0.1]:0",
        ] {
            let error = message(address, &bare);
            assert!(error.contains(address), "{error}");
            assert!(
                error.contains("tls_key") && error.contains("--require-token"),
                "{error}"
            );
        }
        let listener = listen("127.0.0.1:0".parse().unwrap(), &bare).unwrap();
        assert_ne!(listener.local_addr().unwrap().port(), 0);
    }

    #[test]
    fn other_machines_need_certificate_and_token() {
        let token_alone = Protection::of(&ControlParams::default(), true).unwrap();
        let error = message("0.0.0.0:0", &token_alone);
        assert!(
            error.contains("tls_key") && !error.contains("--require-token"),
            "{error}"
        );

        let folder = tempfile::tempdir().unwrap();
        let params = self_signed(folder.path(), &["scanner.local"]);
        let certificate_alone = Protection::of(&params, false).unwrap();
        let error = message("0.0.0.0:0", &certificate_alone);
        assert!(
            !error.contains("tls_key") && error.contains("--require-token"),
            "{error}"
        );

        let both = Protection::of(&params, true).unwrap();
        let listener = listen("0.0.0.0:0".parse().unwrap(), &both).unwrap();
        assert!(listener.local_addr().unwrap().ip().is_unspecified());
    }
}
