//! A small client of the daemon: plain HTTP/1.1, events and WebSocket over a socket, nothing that hides a mistake.

use crate::support::poll;
use serde_json::Value;
use std::{
    io::{BufRead, BufReader, Read, Write},
    net::{SocketAddr, TcpStream},
    time::Duration,
};

/// Generous: a busy machine is no fault.
pub const PATIENCE: Duration = Duration::from_secs(60);

/// An answer.
pub struct Answer {
    /// The status.
    pub status: u16,
    /// Names in lower case, and values.
    pub headers: Vec<(String, String)>,
    /// The body.
    pub body: Vec<u8>,
}

impl Answer {
    /// A header's value.
    pub fn header(&self, name: &str) -> Option<&str> {
        let found = self.headers.iter().find(|(of, _)| of == name);
        found.map(|(_, value)| value.as_str())
    }

    /// The body as JSON.
    pub fn json(&self) -> Value {
        let text = String::from_utf8_lossy(&self.body);
        serde_json::from_str(&text).unwrap_or_else(|error| panic!("{error}: {text}"))
    }

    /// Asserts a mesh with a surface, in the daemon's own layout.
    pub fn assert_mesh(&self) {
        assert_eq!(self.status, 200);
        assert_eq!(self.body[..4], *b"RLM1");
        let number = |at: usize| u32::from_le_bytes(self.body[at..at + 4].try_into().unwrap());
        let (n_vertices, n_faces) = (number(8) as usize, number(12) as usize);
        assert!(n_faces > 100, "{n_faces} faces");
        let expected = (16 + 17 * n_vertices).next_multiple_of(4) + 12 * n_faces;
        assert_eq!(self.body.len(), expected);
    }

    /// Asserts a refusal.
    pub fn assert_problem(&self, status: u16, code: &str) {
        let body = String::from_utf8_lossy(&self.body);
        assert_eq!(self.status, status, "{body}");
        assert_eq!(
            self.header("content-type"),
            Some("application/problem+json")
        );
        let problem = self.json();
        assert_eq!(problem["code"], code, "{body}");
        assert_eq!(problem["status"], status);
        assert_eq!(problem["type"], format!("urn:relief:problem:{code}"));
        assert!(!problem["detail"].as_str().unwrap().is_empty());
    }
}

/// Where a daemon listens.
#[derive(Clone, Copy, Debug)]
pub struct Client(pub SocketAddr);

impl Client {
    /// Connects.
    pub fn connect(self) -> TcpStream {
        let stream = TcpStream::connect(self.0).unwrap();
        stream.set_read_timeout(Some(PATIENCE)).unwrap();
        stream.set_write_timeout(Some(PATIENCE)).unwrap();
        stream
    }

    /// `GET`.
    pub fn get(self, path: &str) -> Answer {
        self.ask("GET", path, &[], b"")
    }

    /// `POST` of a JSON body.
    pub fn post(self, path: &str, body: &str) -> Answer {
        self.ask("POST", path, &[], body.as_bytes())
    }

    /// A request with more headers; `Host` is the daemon's unless they name one.
    pub fn ask(self, method: &str, path: &str, headers: &[(&str, &str)], body: &[u8]) -> Answer {
        let mut head = format!("{method} {path} HTTP/1.1\r\nConnection: close\r\n");
        if !headers.iter().any(|(name, _)| *name == "Host") {
            head += &format!("Host: {}\r\n", self.0);
        }
        for (name, value) in headers {
            head += &format!("{name}: {value}\r\n");
        }
        head += &format!("Content-Length: {}\r\n\r\n", body.len());
        exchange(self.connect(), &head, body)
    }

    /// The daemon's status.
    pub fn status(self) -> Value {
        let answer = self.get("/api/v1/status");
        assert_eq!(answer.status, 200);
        answer.json()
    }

    /// The address of a mesh of a scan that has ended.
    pub fn mesh_of(self, id: &str, which: &str) -> String {
        let path = format!("/api/v1/sessions/{id}/mesh?which={which}");
        // It is made of what others leave of the processors.
        let made = poll("the mesh", || {
            let answer = self.get(&path);
            let is_late = answer.status == 503 && answer.json()["code"] == "timed_out";
            (!is_late).then_some(answer)
        });
        assert_eq!(made.status, 302);
        made.header("location").unwrap().to_owned()
    }

    /// Opens a WebSocket, or says with which status that was refused.
    pub fn socket(self, headers: &[(&str, &str)]) -> Result<Socket, u16> {
        let mut stream = self.connect();
        let mut head = format!(
            "GET /api/v1/ws HTTP/1.1\r\nHost: {}\r\nConnection: Upgrade\r\nUpgrade: websocket\r\n\
             Sec-WebSocket-Version: 13\r\nSec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\n",
            self.0
        );
        for (name, value) in headers {
            head += &format!("{name}: {value}\r\n");
        }
        stream.write_all((head + "\r\n").as_bytes()).unwrap();
        let mut reader = BufReader::new(stream);
        match read_head(&mut reader).0 {
            101 => Ok(Socket(reader)),
            status => Err(status),
        }
    }

    /// Opens the stream of events and returns its lines.
    pub fn events(self) -> impl Iterator<Item = String> {
        let mut stream = self.connect();
        let head = format!("GET /api/v1/events HTTP/1.1\r\nHost: {}\r\n\r\n", self.0);
        stream.write_all(head.as_bytes()).unwrap();
        let mut reader = BufReader::new(stream);
        assert_eq!(read_head(&mut reader).0, 200);
        reader.lines().map(|line| line.unwrap())
    }
}

/// Sends a request over a connection that ends with the answer.
pub fn exchange(mut stream: impl Read + Write, head: &str, body: &[u8]) -> Answer {
    stream.write_all(head.as_bytes()).unwrap();
    // A daemon that refuses a long body does not read it.
    let _ = stream.write_all(body);
    let mut reader = BufReader::new(stream);
    let (status, headers) = read_head(&mut reader);
    let mut body = Vec::new();
    reader.read_to_end(&mut body).unwrap();
    Answer {
        status,
        headers,
        body,
    }
}

/// The status and the headers of an answer.
pub fn read_head(reader: &mut impl BufRead) -> (u16, Vec<(String, String)>) {
    let mut lines = reader.lines().map(|line| line.unwrap());
    let first = lines.next().expect("the daemon answers");
    let status = first.split(' ').nth(1).unwrap().parse().unwrap();
    let headers = lines
        .take_while(|line| !line.is_empty())
        .map(|line| {
            let (name, value) = line.split_once(':').unwrap();
            (name.to_lowercase(), value.trim().to_owned())
        })
        .collect();
    (status, headers)
}

/// An open WebSocket.
pub struct Socket(BufReader<TcpStream>);

/// A message of the daemon.
pub enum Message {
    /// Text.
    Text(String),
    /// Bytes.
    Binary(Vec<u8>),
}

impl Socket {
    /// Sends a short text, masked with zeros.
    pub fn say(&mut self, text: &str) {
        assert!(text.len() < 126);
        let mut frame = vec![0x81, 0x80 | text.len() as u8, 0, 0, 0, 0];
        frame.extend(text.as_bytes());
        self.0.get_mut().write_all(&frame).unwrap();
    }

    /// Waits for the next message; `None` if the daemon closes.
    pub fn hear(&mut self) -> Option<Message> {
        let [first, second] = self.bytes()?;
        assert_eq!(second & 0x80, 0, "a server does not mask");
        let length = match second {
            126 => usize::from(u16::from_be_bytes(self.bytes()?)),
            127 => u64::from_be_bytes(self.bytes()?) as usize,
            length => usize::from(length),
        };
        let mut payload = vec![0; length];
        self.0.read_exact(&mut payload).ok()?;
        match first {
            0x81 => Some(Message::Text(String::from_utf8(payload).unwrap())),
            0x82 => Some(Message::Binary(payload)),
            0x88 => None,
            other => panic!("a frame that begins with {other:#x}"),
        }
    }

    fn bytes<const N: usize>(&mut self) -> Option<[u8; N]> {
        let mut bytes = [0; N];
        self.0.read_exact(&mut bytes).ok()?;
        Some(bytes)
    }
}
