//! What the daemon takes of its clients: how many there may be, how much they may ask, and how long they may take.

use crate::{daemon_process::Daemon, http_client::exchange};
use std::{
    io::{ErrorKind, Read, Write},
    net::TcpStream,
};

#[test]
fn commands_are_rationed() {
    let daemon = Daemon::start(&[]);
    let ask = || daemon.client.post("/api/v1/scan/pause", "").status;
    assert_eq!(ask(), 409);
    // More at a time on a machine that takes its time over them.
    assert!((0..2000).any(|_| ask() == 429));
}

/// Whether the daemon closes a connection while it is waited for.
fn is_closed(mut stream: TcpStream) -> bool {
    match stream.read_to_end(&mut Vec::new()) {
        Ok(_) => true,
        Err(error) => error.kind() == ErrorKind::ConnectionReset,
    }
}

#[test]
fn connections_are_counted_and_are_closed_without_a_request() {
    let daemon = Daemon::start(&[]);
    let client = daemon.client;
    let idle: Vec<TcpStream> = (0..64).map(|_| client.connect()).collect();
    // Half of them begin a request, and go no further.
    for mut stream in &idle[..32] {
        stream
            .write_all(b"GET /healthz HTTP/1.1\r\nHost: lo")
            .unwrap();
    }
    let mut refused = String::new();
    client.connect().read_to_string(&mut refused).unwrap();
    assert!(refused.starts_with("HTTP/1.1 503"), "{refused}");
    assert!(idle.into_iter().all(is_closed));
    assert_eq!(client.get("/healthz").status, 200);
}

#[test]
fn a_head_of_too_many_lines_or_bytes_is_refused() {
    const MAX_LINES: usize = 100;
    const MAX_BYTES: usize = 32 * 1024;
    let daemon = Daemon::start(&[]);
    let client = daemon.client;
    let begin = format!(
        "GET /healthz HTTP/1.1\r\nHost: {}\r\nConnection: close\r\n",
        client.0
    );
    // The status that answers so many lines more, each so long.
    let answer = |n_lines: usize, line_bytes: usize| {
        let padding = "x".repeat(line_bytes - "X-Padding: \r\n".len());
        let rest = format!("X-Padding: {padding}\r\n").repeat(n_lines) + "\r\n";
        // A daemon that refuses a long head does not read all of it.
        exchange(client.connect(), &begin, rest.as_bytes()).status
    };
    for (n_lines, status) in [(MAX_LINES - 2, 200), (MAX_LINES - 1, 431), (200, 431)] {
        assert_eq!(answer(n_lines, 32), status, "{n_lines}");
    }
    let room = MAX_BYTES - begin.len() - "\r\n".len();
    for (line_bytes, status) in [(room, 200), (room + 1, 431), (40_000, 431)] {
        assert_eq!(answer(1, line_bytes), status, "{line_bytes}");
    }
    // What lines take together counts.
    assert_eq!(answer(80, 500), 431);
    assert_eq!(client.status()["state"], "idle");
}

#[test]
fn a_body_that_is_too_long_is_refused_before_its_end() {
    let daemon = Daemon::start(&[]);
    let client = daemon.client;
    // Its length is not told beforehand, and it does not end.
    let long = vec![b' '; 64 * 1024 + 1];
    let head = format!(
        "POST /api/v1/scan HTTP/1.1\r\nHost: {}\r\nConnection: close\r\n\
         Transfer-Encoding: chunked\r\n\r\n{:x}\r\n",
        client.0,
        long.len()
    );
    exchange(client.connect(), &head, &long).assert_problem(413, "body_too_long");
    assert_eq!(client.status()["state"], "idle");
}
