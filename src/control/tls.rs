//! The daemon's certificate: read at the start, shown to whoever connects, and the list of the names it may be called by.
//!
//! TLS 1.3 alone, by rustls with ring. Not handled: certificates of clients (the token says who they are), and renewal while
//! the daemon runs.

use crate::config::ControlParams;
use std::{
    fs::{self, File},
    io::{self, Read},
    os::unix::fs::MetadataExt,
    path::{Path, PathBuf},
    sync::Arc,
};
use tokio_rustls::{
    TlsAcceptor,
    rustls::{
        self, ServerConfig,
        client::verify_server_name,
        crypto::ring,
        pki_types::{
            CertificateDer, PrivateKeyDer, ServerName,
            pem::{self, PemObject},
        },
        server::ParsedCertificate,
        version::TLS13,
    },
};

/// Rights of anybody but the owner.
const RIGHTS_OF_OTHERS: u32 = 0o077;

/// Why the certificate or its key cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum TlsError {
    /// A file cannot be read.
    #[error("{key} is {}, which cannot be read: {source}", path.display())]
    Read {
        /// The key of the configuration.
        key: &'static str,
        /// Its value.
        path: PathBuf,
        /// What the system said.
        source: io::Error,
    },
    /// A file holds something else.
    #[error("{key} is {}, which is no PEM file with {expected}: {source}", path.display())]
    Pem {
        /// The key of the configuration.
        key: &'static str,
        /// Its value.
        path: PathBuf,
        /// What the file should hold.
        expected: &'static str,
        /// What is wrong with it.
        source: pem::Error,
    },
    /// The key is no secret.
    #[error(
        "control.tls_key is {}, of mode {mode:04o}: the key must be for its owner alone (chmod 600)",
        path.display()
    )]
    Open {
        /// The file.
        path: PathBuf,
        /// Its mode, of which 0600 may be set.
        mode: u32,
    },
    /// Certificate and key do not belong together, or are of an unknown kind.
    #[error(
        "control.tls_certificate {} and control.tls_key {} cannot be used together: {source}",
        certificate.display(),
        key.display()
    )]
    Unusable {
        /// The certificate's file.
        certificate: PathBuf,
        /// The key's file.
        key: PathBuf,
        /// What is wrong.
        source: rustls::Error,
    },
}

/// What is needed to answer by TLS.
#[derive(Debug)]
pub struct Tls {
    config: Arc<ServerConfig>,
    certificate: CertificateDer<'static>,
}

impl Tls {
    /// Reads certificate and key; `None` where the configuration names none.
    ///
    /// # Errors
    /// For a file that cannot be read or holds something else, a key that others can read, and a key that is another
    /// certificate's; names the key of the configuration and the file.
    pub fn of_files(params: &ControlParams) -> Result<Option<Self>, TlsError> {
        let (Some(certificate), Some(key)) = (&params.tls_certificate, &params.tls_key) else {
            return Ok(None);
        };
        let chain = read_chain(certificate)?;
        let own = chain[0].clone();
        let mut config = server_config(chain, read_key(key)?).map_err(|source| {
            let (certificate, key) = (certificate.clone(), key.clone());
            TlsError::Unusable {
                certificate,
                key,
                source,
            }
        })?;
        config.alpn_protocols = vec![b"http/1.1".to_vec()];
        Ok(Some(Tls {
            config: Arc::new(config),
            certificate: own,
        }))
    }

    /// Whether the certificate is one for a host: a DNS name, or an address (version 6 in brackets or not).
    pub fn is_for(&self, host: &str) -> bool {
        let bare = host.trim_start_matches('[').trim_end_matches(']');
        let certificate = ParsedCertificate::try_from(&self.certificate);
        match (certificate, ServerName::try_from(bare)) {
            (Ok(certificate), Ok(name)) => verify_server_name(&certificate, &name).is_ok(),
            _ => false,
        }
    }

    /// What shakes hands with clients.
    pub fn acceptor(&self) -> TlsAcceptor {
        TlsAcceptor::from(self.config.clone())
    }
}

fn server_config(
    chain: Vec<CertificateDer<'static>>,
    key: PrivateKeyDer<'static>,
) -> Result<ServerConfig, rustls::Error> {
    ServerConfig::builder_with_provider(Arc::new(ring::default_provider()))
        .with_protocol_versions(&[&TLS13])?
        .with_no_client_auth()
        .with_single_cert(chain, key)
}

/// The certificates of a file, one at least.
fn read_chain(path: &Path) -> Result<Vec<CertificateDer<'static>>, TlsError> {
    let key = "control.tls_certificate";
    let text = fs::read(path).map_err(|source| TlsError::Read {
        key,
        path: path.to_owned(),
        source,
    })?;
    let chain: Result<Vec<_>, _> = CertificateDer::pem_slice_iter(&text).collect();
    chain
        .and_then(|chain| match chain.is_empty() {
            true => Err(pem::Error::NoItemsFound),
            false => Ok(chain),
        })
        .map_err(|source| TlsError::Pem {
            key,
            path: path.to_owned(),
            expected: "a certificate",
            source,
        })
}

/// The private key of a file that nobody but its owner can read.
fn read_key(path: &Path) -> Result<PrivateKeyDer<'static>, TlsError> {
    let key = "control.tls_key";
    let read = || -> io::Result<(u32, Vec<u8>)> {
        let mut file = File::open(path)?;
        // Of the open file: another may take its name.
        let mode = file.metadata()?.mode() & 0o7777;
        let mut text = Vec::new();
        file.read_to_end(&mut text)?;
        Ok((mode, text))
    };
    let (mode, text) = read().map_err(|source| TlsError::Read {
        key,
        path: path.to_owned(),
        source,
    })?;
    if mode & RIGHTS_OF_OTHERS != 0 {
        let path = path.to_owned();
        return Err(TlsError::Open { path, mode });
    }
    PrivateKeyDer::from_pem_slice(&text).map_err(|source| TlsError::Pem {
        key,
        path: path.to_owned(),
        expected: "a private key",
        source,
    })
}

#[cfg(test)]
pub mod tests {
    use super::*;
    use std::os::unix::fs::PermissionsExt;

    /// The files of a new certificate that signs itself.
    pub fn self_signed(folder: &Path, names: &[&str]) -> ControlParams {
        let names: Vec<String> = names.iter().map(|name| name.to_string()).collect();
        let made = rcgen::generate_simple_self_signed(names).unwrap();
        let (certificate, key) = (folder.join("certificate.pem"), folder.join("key.pem"));
        fs::write(&certificate, made.cert.pem()).unwrap();
        fs::write(&key, made.signing_key.serialize_pem()).unwrap();
        fs::set_permissions(&key, fs::Permissions::from_mode(0o600)).unwrap();
        ControlParams {
            tls_certificate: Some(certificate),
            tls_key: Some(key),
        }
    }

    #[test]
    fn the_certificate_says_who_the_daemon_is() {
        let folder = tempfile::tempdir().unwrap();
        let params = self_signed(folder.path(), &["scanner.local", "192.168.1.7", "fd00::7"]);
        let tls = Tls::of_files(&params).unwrap().unwrap();
        for host in ["scanner.local", "Scanner.Local", "192.168.1.7", "[fd00::7]"] {
            assert!(tls.is_for(host), "{host}");
        }
        for host in ["local", "evil.example", "192.168.1.8", "[fd00::8]", "", "["] {
            assert!(!tls.is_for(host), "{host}");
        }
        assert!(Tls::of_files(&ControlParams::default()).unwrap().is_none());
    }

    #[test]
    fn files_that_cannot_be_used_are_named() {
        let folder = tempfile::tempdir().unwrap();
        let params = self_signed(folder.path(), &["scanner.local"]);
        let key = params.tls_key.clone().unwrap();
        let error_of = |params: &ControlParams| Tls::of_files(params).unwrap_err().to_string();

        fs::set_permissions(&key, fs::Permissions::from_mode(0o640)).unwrap();
        let error = error_of(&params);
        assert!(error.contains("key.pem, of mode 0640"), "{error}");

        let other = tempfile::tempdir().unwrap();
        let foreign = ControlParams {
            tls_certificate: params.tls_certificate.clone(),
            ..self_signed(other.path(), &["scanner.local"])
        };
        let error = error_of(&foreign);
        assert!(error.contains("cannot be used together"), "{error}");
        assert!(error.contains("certificate.pem") && error.contains("key.pem"));

        // A file of the other kind, and none.
        fs::set_permissions(&key, fs::Permissions::from_mode(0o600)).unwrap();
        let swapped = ControlParams {
            tls_certificate: Some(key.clone()),
            tls_key: Some(key),
        };
        let error = error_of(&swapped);
        assert!(error.starts_with("control.tls_certificate is "), "{error}");
        assert!(error.contains("no PEM file with a certificate"), "{error}");
        let missing = ControlParams {
            tls_key: Some(folder.path().join("nothing.pem")),
            ..params
        };
        let error = error_of(&missing);
        assert!(error.starts_with("control.tls_key is "), "{error}");
        assert!(error.contains("nothing.pem, which cannot be read"));
    }
}
