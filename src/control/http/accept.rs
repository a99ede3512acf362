//! The accept loop: few connections, short patience with each, TLS where there is a certificate.

use super::write_timeout::WriteTimeout;
use axum::Router;
use hyper::{body::Incoming, server::conn::http1};
use hyper_util::rt::{TokioIo, TokioTimer};
use std::{io, pin::pin, sync::Arc, time::Duration};
use tokio::{
    io::{AsyncRead, AsyncWrite, AsyncWriteExt},
    net::{TcpListener, TcpStream},
    sync::{OwnedSemaphorePermit, Semaphore, watch},
    time,
};
use tokio_rustls::TlsAcceptor;
use tower::ServiceExt;

/// Connections at a time; who comes after is told to come back.
pub const MAX_CONNECTIONS: usize = 64;

/// How long a client may take for the head of a request, or keep a connection open without one.
const HEAD_PATIENCE: Duration = Duration::from_secs(10);

/// How long a client may take for the handshake of TLS.
const HANDSHAKE_PATIENCE: Duration = Duration::from_secs(10);

/// How long a client may take nothing of what is sent to it.
const WRITE_PATIENCE: Duration = Duration::from_secs(30);

/// What the head of a request may take, bytes, and a connection holds for one that arrives. The buffer alone bounds no head: it may
/// grow to twice as much before it is looked at.
const MAX_HEAD_BYTES: usize = 32 * 1024;

/// How long connections may take to end when the daemon does.
const GOODBYE: Duration = Duration::from_secs(2);

/// Said to who finds no place.
const FULL: &[u8] =
    b"HTTP/1.1 503 Service Unavailable\r\nRetry-After: 5\r\nContent-Length: 0\r\nConnection: close\r\n\r\n";

/// Accepts connections until dropped or [`Acceptor::goodbye`].
pub struct Acceptor {
    listener: TcpListener,
    tls: Option<TlsAcceptor>,
    router: Router,
    places: Arc<Semaphore>,
    /// Changes when the daemon ends; every connection holds a receiver.
    ending: watch::Sender<()>,
}

impl Acceptor {
    /// Serves a router to whoever connects, by TLS alone where that is given.
    pub fn new(listener: TcpListener, tls: Option<TlsAcceptor>, router: Router) -> Self {
        Acceptor {
            listener,
            tls,
            router,
            places: Arc::new(Semaphore::new(MAX_CONNECTIONS)),
            ending: watch::Sender::new(()),
        }
    }

    /// Accepts one connection after another; never returns, and may be dropped at any time.
    pub async fn accept(&self) {
        loop {
            match self.listener.accept().await {
                Ok((stream, _)) => self.admit(stream),
                Err(error) => pause_after(&error).await,
            }
        }
    }

    fn admit(&self, stream: TcpStream) {
        let Ok(place) = self.places.clone().try_acquire_owned() else {
            // Before its handshake a client of TLS could not read a refusal: it is closed.
            if self.tls.is_none() {
                refuse(stream);
            }
            return;
        };
        // Previews are small messages that must not wait for one another.
        let _ = stream.set_nodelay(true);
        let stream = WriteTimeout::new(stream, WRITE_PATIENCE);
        let (router, ending) = (self.router.clone(), self.ending.subscribe());
        match self.tls.clone() {
            Some(tls) => tokio::spawn(serve_tls(stream, tls, router, ending, place)),
            None => tokio::spawn(serve(stream, router, ending, place)),
        };
    }

    /// Takes no more connections, and gives those there are a moment to end.
    pub async fn goodbye(self) {
        drop(self.listener);
        self.ending.send_replace(());
        if time::timeout(GOODBYE, self.ending.closed()).await.is_err() {
            tracing::debug!("some connections were cut");
        }
    }
}

/// Shakes hands, then serves; a client that is slow or speaks something else is closed.
async fn serve_tls(
    stream: WriteTimeout<TcpStream>,
    tls: TlsAcceptor,
    router: Router,
    ending: watch::Receiver<()>,
    place: OwnedSemaphorePermit,
) {
    match time::timeout(HANDSHAKE_PATIENCE, tls.accept(stream)).await {
        Ok(Ok(stream)) => serve(stream, router, ending, place).await,
        Ok(Err(error)) => tracing::debug!(%error, "a handshake failed"),
        Err(_) => tracing::debug!("a handshake took longer than {HANDSHAKE_PATIENCE:?}"),
    }
}

async fn serve(
    stream: impl AsyncRead + AsyncWrite + Unpin + Send + 'static,
    router: Router,
    mut ending: watch::Receiver<()>,
    _place: OwnedSemaphorePermit,
) {
    let service = hyper::service::service_fn(move |request: hyper::Request<Incoming>| {
        router.clone().oneshot(request)
    });
    let connection = http1::Builder::new()
        .timer(TokioTimer::new())
        .header_read_timeout(HEAD_PATIENCE)
        .max_buf_size(MAX_HEAD_BYTES)
        .max_header_size(MAX_HEAD_BYTES)
        .serve_connection(TokioIo::new(stream), service)
        .with_upgrades();
    let mut connection = pin!(connection);
    let served = tokio::select! {
        served = connection.as_mut() => served,
        _ = ending.changed() => {
            connection.as_mut().graceful_shutdown();
            connection.await
        }
    };
    if let Err(error) = served {
        tracing::debug!(%error, "a connection ended");
    }
}

/// Says that there is no place, as far as that can be done without waiting.
fn refuse(mut stream: TcpStream) {
    tokio::spawn(async move {
        let _ = time::timeout(Duration::from_secs(1), stream.write_all(FULL)).await;
    });
}

/// A connection that ended before it was accepted costs nothing; without file descriptors a moment has to pass.
async fn pause_after(error: &io::Error) {
    let is_of_client = matches!(
        error.kind(),
        io::ErrorKind::ConnectionAborted
            | io::ErrorKind::ConnectionReset
            | io::ErrorKind::ConnectionRefused
    );
    if !is_of_client {
        tracing::warn!(%error, "connections cannot be accepted");
        time::sleep(Duration::from_millis(500)).await;
    }
}
