//! Who may ask, and how often: every request passes here before it reaches its handler.
//!
//! Against pages of other sites in the operator's own browser: the `Host` must be a name of this daemon (DNS rebinding): one
//! of the machine for itself, or one that the certificate is for. An
//! `Origin` must be the daemon's own (forged requests, hijacked WebSockets). Against everybody: bodies and time are limited,
//! commands are rationed, and where others reach the daemon a token can be asked for.

use super::{
    App,
    body::{MAX_BODY_BYTES, too_long},
    problem::Problem,
};
use crate::{
    control::{tls::Tls, token::Token},
    lock::lock,
};
use axum::{
    extract::{Request, State},
    http::{HeaderMap, HeaderName, HeaderValue, Method, StatusCode, header, uri::Authority},
    middleware::Next,
    response::{IntoResponse, Response},
};
use std::{
    sync::{Arc, Mutex},
    time::{Duration, Instant},
};
use tokio::time;

/// How long a request may take until its answer begins.
const PATIENCE: Duration = Duration::from_secs(20);

/// Commands in a row, and commands a second in the long run.
const COMMANDS: f64 = 20.0;
const COMMANDS_PER_SEC: f64 = 10.0;

/// Names under which the machine itself reaches the daemon.
const LOOPBACK_NAMES: [&str; 3] = ["localhost", "127.0.0.1", "[::1]"];

/// Said with every answer.
const HEADERS: [(HeaderName, HeaderValue); 6] = [
    (
        header::CONTENT_SECURITY_POLICY,
        HeaderValue::from_static(
            "default-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'",
        ),
    ),
    (
        header::X_CONTENT_TYPE_OPTIONS,
        HeaderValue::from_static("nosniff"),
    ),
    (header::X_FRAME_OPTIONS, HeaderValue::from_static("DENY")),
    (
        header::REFERRER_POLICY,
        HeaderValue::from_static("no-referrer"),
    ),
    (
        HeaderName::from_static("cross-origin-resource-policy"),
        HeaderValue::from_static("same-origin"),
    ),
    (
        HeaderName::from_static("cross-origin-opener-policy"),
        HeaderValue::from_static("same-origin"),
    ),
];

/// What a request must bring.
#[derive(Debug)]
pub struct Access {
    /// The token, where one is asked for.
    pub token: Option<Token>,
    /// The certificate, where the daemon speaks TLS.
    pub tls: Option<Arc<Tls>>,
}

impl Access {
    fn check(&self, headers: &HeaderMap) -> Result<(), Problem> {
        let host = self.own_host(headers)?;
        self.check_origin(headers, &host)?;
        self.check_token(headers)
    }

    /// The scheme of the daemon's addresses.
    pub fn scheme(&self) -> &'static str {
        match self.tls {
            Some(_) => "https",
            None => "http",
        }
    }

    fn own_host(&self, headers: &HeaderMap) -> Result<Authority, Problem> {
        let mut hosts = headers.get_all(header::HOST).iter();
        let host = match (hosts.next(), hosts.next()) {
            (Some(host), None) => host.to_str().ok(),
            _ => None,
        };
        let authority = host.and_then(|host| host.parse::<Authority>().ok());
        let is_known = |name: &str| {
            LOOPBACK_NAMES
                .iter()
                .any(|known| known.eq_ignore_ascii_case(name))
                || self.tls.as_ref().is_some_and(|tls| tls.is_for(name))
        };
        authority
            .filter(|authority| is_known(authority.host()))
            .ok_or_else(|| {
                let detail = "the request is for a host that this daemon is not";
                Problem::new(StatusCode::MISDIRECTED_REQUEST, "foreign_host", detail)
            })
    }

    fn check_origin(&self, headers: &HeaderMap, host: &Authority) -> Result<(), Problem> {
        let Some(origin) = headers.get(header::ORIGIN) else {
            return Ok(());
        };
        let own = format!("{}://{host}", self.scheme());
        match origin.as_bytes().eq_ignore_ascii_case(own.as_bytes()) {
            true => Ok(()),
            false => Err(Problem::new(
                StatusCode::FORBIDDEN,
                "foreign_origin",
                "the request comes from a page of another site",
            )),
        }
    }

    fn check_token(&self, headers: &HeaderMap) -> Result<(), Problem> {
        let Some(token) = &self.token else {
            return Ok(());
        };
        let brought = headers.get(header::AUTHORIZATION);
        match brought.is_some_and(|brought| token.is_in(brought.as_bytes())) {
            true => Ok(()),
            false => Err(Problem::new(
                StatusCode::UNAUTHORIZED,
                "no_token",
                "the daemon's token is needed, as Bearer or as the password of Basic",
            )),
        }
    }
}

/// Rations commands: so many at once, then so many a second.
#[derive(Debug)]
pub struct Ration(Mutex<(f64, Instant)>);

impl Default for Ration {
    fn default() -> Self {
        Ration(Mutex::new((COMMANDS, Instant::now())))
    }
}

impl Ration {
    /// Takes a command at a moment, if there is one left.
    fn take(&self, now: Instant) -> Result<(), Problem> {
        let mut ration = lock(&self.0);
        let (left, since) = *ration;
        // Who looked at the clock first may come second.
        let now = now.max(since);
        let left = COMMANDS.min(left + COMMANDS_PER_SEC * (now - since).as_secs_f64());
        if left < 1.0 {
            *ration = (left, now);
            return Err(Problem::new(
                StatusCode::TOO_MANY_REQUESTS,
                "too_many_commands",
                format!("more than {COMMANDS_PER_SEC} commands a second"),
            ));
        }
        *ration = (left - 1.0, now);
        Ok(())
    }
}

/// Lets a request pass, or says why not.
pub async fn guard(State(app): State<Arc<App>>, request: Request, next: Next) -> Response {
    let mut response = match check(&app, &request) {
        Ok(()) => match time::timeout(PATIENCE, next.run(request)).await {
            Ok(response) => response,
            Err(_) => timed_out().into_response(),
        },
        Err(problem) => problem.into_response(),
    };
    if response.status() == StatusCode::UNAUTHORIZED {
        let challenge = HeaderValue::from_static("Basic realm=\"relief\"");
        response
            .headers_mut()
            .insert(header::WWW_AUTHENTICATE, challenge);
    }
    for (name, value) in HEADERS {
        response.headers_mut().entry(name).or_insert(value);
    }
    response
}

fn check(app: &App, request: &Request) -> Result<(), Problem> {
    app.access.check(request.headers())?;
    let length = request.headers().get(header::CONTENT_LENGTH);
    let length = length.and_then(|length| length.to_str().ok()?.parse::<u64>().ok());
    if length.is_some_and(|length| length > MAX_BODY_BYTES as u64) {
        return Err(too_long());
    }
    match *request.method() {
        Method::GET | Method::HEAD => Ok(()),
        _ => app.ration.take(Instant::now()),
    }
}

/// What is told of a handler that takes too long. Not 408: that is a client's own delay, after which browsers send a command again by
/// themselves, though the first may still be obeyed.
fn timed_out() -> Problem {
    Problem::new(
        StatusCode::SERVICE_UNAVAILABLE,
        "timed_out",
        format!("no answer within {PATIENCE:?}"),
    )
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::control::tls::tests::self_signed;

    fn headers(pairs: &[(HeaderName, &'static str)]) -> HeaderMap {
        let pairs = pairs.iter().cloned();
        pairs
            .map(|(name, value)| (name, HeaderValue::from_static(value)))
            .collect()
    }

    fn access() -> Access {
        Access {
            token: None,
            tls: None,
        }
    }

    fn code_of(pairs: &[(HeaderName, &'static str)]) -> Option<StatusCode> {
        let answer = access().check(&headers(pairs));
        answer.err().map(|problem| problem.into_response().status())
    }

    #[test]
    fn only_own_names_are_hosts() {
        for host in ["127.0.0.1:8047", "localhost", "[::1]:1", "LocalHost:80"] {
            assert_eq!(code_of(&[(header::HOST, host)]), None, "{host}");
        }
        for host in ["evil.example:8047", "127.0.0.1.evil.example", "a b", ""] {
            let code = code_of(&[(header::HOST, host)]);
            assert_eq!(code, Some(StatusCode::MISDIRECTED_REQUEST), "{host}");
        }
        assert_eq!(code_of(&[]), Some(StatusCode::MISDIRECTED_REQUEST));
    }

    #[test]
    fn an_origin_must_be_the_host_itself() {
        let with = |origin| code_of(&[(header::HOST, "127.0.0.1:8047"), (header::ORIGIN, origin)]);
        assert_eq!(with("http://127.0.0.1:8047"), None);
        for origin in [
            "null",
            "http://localhost:8047",
            "http://127.0.0.1:8048",
            "https://127.0.0.1:8047",
            "http://evil.example",
        ] {
            assert_eq!(with(origin), Some(StatusCode::FORBIDDEN), "{origin}");
        }
    }

    #[test]
    fn with_a_certificate_its_names_are_hosts_and_origins_are_of_https() {
        let folder = tempfile::tempdir().unwrap();
        let params = self_signed(folder.path(), &["scanner.local"]);
        let access = Access {
            token: None,
            tls: Tls::of_files(&params).unwrap().map(Arc::new),
        };
        let code_of = |host, origin| {
            let headers = headers(&[(header::HOST, host), (header::ORIGIN, origin)]);
            let answer = access.check(&headers).err();
            answer.map(|problem| problem.into_response().status())
        };
        let own = "https://scanner.local:8047";
        assert_eq!(code_of("scanner.local:8047", own), None);
        assert_eq!(code_of("localhost:8047", "https://localhost:8047"), None);
        for origin in ["http://scanner.local:8047", "https://localhost:8047"] {
            let code = code_of("scanner.local:8047", origin);
            assert_eq!(code, Some(StatusCode::FORBIDDEN), "{origin}");
        }
        let code = code_of("evil.example:8047", "https://evil.example:8047");
        assert_eq!(code, Some(StatusCode::MISDIRECTED_REQUEST));
    }

    #[test]
    fn a_slow_answer_does_not_ask_for_the_command_again() {
        let status = timed_out().into_response().status();
        assert_eq!(status, StatusCode::SERVICE_UNAVAILABLE);
    }

    #[test]
    fn commands_are_rationed() {
        let ration = Ration::default();
        let begin = Instant::now();
        let taken_after = |secs: u64| {
            let now = begin + Duration::from_secs(secs);
            (0..100).filter(|_| ration.take(now).is_ok()).count()
        };
        assert_eq!([0, 1, 3600, 3600].map(taken_after), [20, 10, 20, 0]);
    }
}
