//! What can be set about the daemon's listener.

use serde::{Deserialize, Serialize};
use std::path::PathBuf;

/// How the daemon is reached.
#[derive(Clone, Debug, Default, PartialEq, Deserialize, Serialize)]
#[serde(default, deny_unknown_fields)]
pub struct ControlParams {
    /// PEM file of the certificate and those that vouch for it, the daemon's own first; with it the daemon speaks TLS alone.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub tls_certificate: Option<PathBuf>,
    /// PEM file of the certificate's private key, for the daemon's user alone.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub tls_key: Option<PathBuf>,
}

impl ControlParams {
    /// Checks that certificate and key come together.
    ///
    /// # Errors
    /// Names the key that is set, its value, and the one that is missing.
    pub fn validate(&self) -> Result<(), String> {
        let lone = |key, path: &PathBuf, missing| {
            let path = path.display();
            Err(format!(
                "control.{key} is \"{path}\", but control.{missing} is not set: both are needed"
            ))
        };
        match (&self.tls_certificate, &self.tls_key) {
            (Some(path), None) => lone("tls_certificate", path, "tls_key"),
            (None, Some(path)) => lone("tls_key", path, "tls_certificate"),
            (Some(_), Some(_)) | (None, None) => Ok(()),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_certificate_needs_its_key() {
        let mut params = ControlParams::default();
        assert_eq!(params.validate(), Ok(()));
        params.tls_key = Some("/etc/relief/key.pem".into());
        let error = params.validate().unwrap_err();
        assert!(
            error.starts_with("control.tls_key is \"/etc/relief/key.pem\""),
            "{error}"
        );
        assert!(error.contains("control.tls_certificate is not set"));
        params.tls_certificate = Some("/etc/relief/certificate.pem".into());
        assert_eq!(params.validate(), Ok(()));
    }
}
