//! The daemon as other machines reach it: by TLS, with the token, and not otherwise.

use crate::{
    daemon_process::{Daemon, refused},
    http_client::{Answer, PATIENCE, exchange, read_head},
    support::Workbench,
};
use std::{
    fs,
    io::{BufReader, ErrorKind, Read, Write},
    net::TcpStream,
    os::unix::fs::PermissionsExt,
    path::Path,
    sync::Arc,
};
use tokio_rustls::rustls::{
    ClientConfig, ClientConnection, RootCertStore, StreamOwned, crypto::ring,
    pki_types::CertificateDer,
};

/// The name that the certificate is for.
const HOST: &str = "scanner.local";

/// What a daemon with a certificate is started with, and what a client needs to believe it.
struct Certified {
    config: String,
    certificate: CertificateDer<'static>,
}

impl Certified {
    fn new(bench: &Workbench) -> Self {
        let made = rcgen::generate_simple_self_signed([HOST.to_owned()]).unwrap();
        let certificate = bench.write("certificate.pem", &made.cert.pem());
        let key = bench.write("key.pem", &made.signing_key.serialize_pem());
        set_mode(&key, 0o600);
        let config = format!("[control]\ntls_certificate = {certificate:?}\ntls_key = {key:?}\n");
        let config = bench.write("tls.toml", &config);
        Certified {
            config: config.to_str().unwrap().to_owned(),
            certificate: made.cert.der().clone(),
        }
    }

    fn connect(&self, port: u16) -> StreamOwned<ClientConnection, TcpStream> {
        let mut roots = RootCertStore::empty();
        roots.add(self.certificate.clone()).unwrap();
        let config = ClientConfig::builder_with_provider(Arc::new(ring::default_provider()))
            .with_safe_default_protocol_versions()
            .unwrap()
            .with_root_certificates(roots)
            .with_no_client_auth();
        let name = HOST.try_into().unwrap();
        let connection = ClientConnection::new(Arc::new(config), name).unwrap();
        StreamOwned::new(connection, connect(port))
    }

    fn get(&self, port: u16, path: &str, headers: &[&str]) -> Answer {
        let head = head(path, &[&["Connection: close"], headers].concat());
        exchange(self.connect(port), &head, b"")
    }

    /// The status of the answer to a WebSocket.
    fn socket(&self, port: u16, headers: &[&str]) -> u16 {
        let upgrade = [
            "Connection: Upgrade",
            "Upgrade: websocket",
            "Sec-WebSocket-Version: 13",
            "Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==",
        ];
        let head = head("/api/v1/ws", &[&upgrade, headers].concat());
        let mut stream = self.connect(port);
        stream.write_all(head.as_bytes()).unwrap();
        read_head(&mut BufReader::new(stream)).0
    }
}

fn connect(port: u16) -> TcpStream {
    let stream = TcpStream::connect(("127.0.0.1", port)).unwrap();
    stream.set_read_timeout(Some(PATIENCE)).unwrap();
    stream
}

fn head(path: &str, headers: &[&str]) -> String {
    let named = headers.iter().any(|header| header.starts_with("Host: "));
    let host = if named { "" } else { "Host: scanner.local\r\n" };
    format!(
        "GET {path} HTTP/1.1\r\n{host}{}\r\n\r\n",
        headers.join("\r\n")
    )
}

fn set_mode(path: &Path, mode: u32) {
    fs::set_permissions(path, fs::Permissions::from_mode(mode)).unwrap();
}

/// What a daemon says to bytes that are no handshake, until it closes.
fn answer_to_noise(port: u16, noise: &[u8]) -> Vec<u8> {
    let mut stream = connect(port);
    stream.write_all(noise).unwrap();
    let mut said = Vec::new();
    match stream.read_to_end(&mut said) {
        Ok(_) => {}
        // What the daemon did not read makes the system reset the connection.
        Err(error) => assert_eq!(error.kind(), ErrorKind::ConnectionReset, "{error}"),
    }
    said
}

#[test]
fn other_machines_are_answered_by_tls_and_with_the_token_alone() {
    let bench = Workbench::with_frames(1);
    let certified = Certified::new(&bench);
    let arguments = ["--listen", "0.0.0.0:0", "--require-token", "--config"];
    let arguments = [&arguments[..], &[certified.config.as_str()]].concat();
    let daemon = Daemon::start_in(bench, &arguments);
    let lock = fs::read_to_string(daemon.bench.path("data/daemon.lock")).unwrap();
    assert!(lock.starts_with("https://0.0.0.0:"), "{lock}");
    let port = daemon.client.0.port();
    // It never says a word, and is closed below.
    let mut silent = connect(port);

    let status = "/api/v1/status";
    let token = fs::read_to_string(daemon.bench.path("data/token")).unwrap();
    let token = format!("Authorization: Bearer {}", token.trim());
    certified
        .get(port, status, &[])
        .assert_problem(401, "no_token");
    let answer = certified.get(port, status, &[&token]);
    assert_eq!(
        (answer.status, &answer.json()["state"]),
        (200, &"idle".into())
    );
    certified
        .get(port, status, &[&token, "Host: evil.example"])
        .assert_problem(421, "foreign_host");

    let own = "Origin: https://scanner.local";
    assert_eq!(certified.get(port, status, &[&token, own]).status, 200);
    assert_eq!(certified.socket(port, &[&token, own]), 101);
    assert_eq!(certified.socket(port, &[own]), 401);
    let plain = "Origin: http://scanner.local";
    assert_eq!(certified.socket(port, &[&token, plain]), 403);

    let request = head(status, &[&token]);
    let said = answer_to_noise(port, request.as_bytes());
    // An alert of TLS, if anything: its first byte is 21.
    assert!(said.first().is_none_or(|&first| first == 21), "{said:?}");
    assert_eq!(silent.read(&mut [0]).unwrap(), 0);
    assert_eq!(certified.get(port, status, &[&token]).status, 200);
}

#[test]
fn an_unguarded_address_and_an_open_key_are_refused() {
    let bench = Workbench::with_frames(1);
    let certified = Certified::new(&bench);
    let wide = ["--listen", "0.0.0.0:0"];
    let refusal = |arguments: &[&str], pieces: &[&str]| {
        let (code, said) = refused(&bench, arguments);
        assert_eq!(code, Some(3), "{said}");
        for piece in pieces {
            assert!(said.contains(piece), "{piece} in {said}");
        }
    };
    let needs_files = "control.tls_certificate and control.tls_key are not set";
    let needs_token = "--require-token is not given";
    refusal(&wide, &["0.0.0.0:0", needs_files, needs_token]);

    set_mode(&bench.path("key.pem"), 0o644);
    let guarded = ["--config", certified.config.as_str(), "--require-token"];
    let guarded = [&wide[..], &guarded].concat();
    refusal(
        &guarded,
        &["control.tls_key", "key.pem", "0644", "chmod 600"],
    );
}
