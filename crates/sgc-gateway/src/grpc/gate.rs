//! [`Gate`]: who is admitted, and what is known of who calls ([`Caller`], [`Connection`]). Deciding is for others.

use std::fmt;
use std::net::SocketAddr;
use std::pin::Pin;
use std::sync::{Arc, Mutex};
use std::task::{Context, Poll};

use sgc_trust::VerifiedPeer;
use tokio::io::{AsyncRead, AsyncWrite, ReadBuf};
use tonic::transport::server::Connected;

use super::client::Known;
use crate::access::Client;

/// Decides who is admitted.
pub trait Gate: Send + Sync + 'static {
    /// Who this is, and what it may do. Asked once for each credential on a connection, and again once it does not hold.
    ///
    /// # Errors
    /// Why it may do nothing.
    fn admit(&self, caller: &Caller<'_>) -> Result<Client, Refusal>;

    /// Whether one that was admitted is so still: at each call, and again and again while streams last.
    ///
    /// # Errors
    /// Why not: it has expired, was revoked, or may do something else now.
    fn still_admits(&self, client: &Client) -> Result<(), Refusal> {
        let _ = client;
        Ok(())
    }
}

/// One that admits for good.
impl<F: Fn(&Caller<'_>) -> Result<Client, Refusal> + Send + Sync + 'static> Gate for F {
    fn admit(&self, caller: &Caller<'_>) -> Result<Client, Refusal> {
        self(caller)
    }
}

/// What is known of who calls.
#[derive(Clone, Copy)]
pub struct Caller<'a> {
    /// Its connection.
    pub connection: &'a Connection,
    /// The token that it showed: `authorization: Bearer TOKEN`.
    pub token: Option<&'a str>,
    /// Its `Origin`, if it sent that header: then it is a page in a browser, through some proxy.
    pub origin: Option<&'a str>,
}

impl fmt::Debug for Caller<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let (connection, has_token) = (self.connection, self.token.is_some());
        f.debug_struct("Caller").field("connection", connection).field("has_token", &has_token).finish()
    }
}

/// Why somebody is not admitted, as the other end is told: UNAUTHENTICATED.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("{0}")]
pub struct Refusal(pub String);

/// A connection, as whoever accepted it knows it. Clones are the same one.
#[derive(Clone)]
pub struct Connection(Arc<Inner>);

struct Inner {
    peer: SocketAddr,
    is_encrypted: bool,
    certificate: Option<VerifiedPeer>,
    known: Mutex<Vec<Known>>,
}

impl Connection {
    /// One from there.
    pub fn plain(peer: SocketAddr) -> Self {
        Self(Arc::new(Inner { peer, is_encrypted: false, certificate: None, known: Mutex::default() }))
    }

    /// One over TLS, with what the certificate of its client proves, if it showed one.
    pub fn encrypted(peer: SocketAddr, certificate: Option<VerifiedPeer>) -> Self {
        Self(Arc::new(Inner { peer, is_encrypted: true, certificate, known: Mutex::default() }))
    }

    /// Who is at the other end.
    pub fn peer(&self) -> SocketAddr {
        self.0.peer
    }

    /// Whether nobody on the way can read it.
    pub fn is_encrypted(&self) -> bool {
        self.0.is_encrypted
    }

    /// What its certificate proves.
    pub fn certificate(&self) -> Option<&VerifiedPeer> {
        self.0.certificate.as_ref()
    }

    /// Who was admitted on it.
    pub(super) fn known(&self) -> &Mutex<Vec<Known>> {
        &self.0.known
    }
}

impl fmt::Debug for Connection {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_tuple("Connection").field(&self.0.peer).finish()
    }
}

/// A stream of bytes that was accepted. What `IO` holds besides is dropped when the connection has ended.
#[derive(Debug)]
pub struct Accepted<IO> {
    io: IO,
    connection: Connection,
}

impl<IO> Accepted<IO> {
    /// One, and what is known of it.
    pub fn new(io: IO, connection: Connection) -> Self {
        Self { io, connection }
    }
}

impl<IO> Connected for Accepted<IO> {
    type ConnectInfo = Connection;

    fn connect_info(&self) -> Connection {
        self.connection.clone()
    }
}

impl<IO: AsyncRead + Unpin> AsyncRead for Accepted<IO> {
    fn poll_read(
        mut self: Pin<&mut Self>,
        cx: &mut Context<'_>,
        buf: &mut ReadBuf<'_>,
    ) -> Poll<std::io::Result<()>> {
        Pin::new(&mut self.io).poll_read(cx, buf)
    }
}

impl<IO: AsyncWrite + Unpin> AsyncWrite for Accepted<IO> {
    fn poll_write(
        mut self: Pin<&mut Self>,
        cx: &mut Context<'_>,
        buf: &[u8],
    ) -> Poll<std::io::Result<usize>> {
        Pin::new(&mut self.io).poll_write(cx, buf)
    }

    fn poll_flush(mut self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<std::io::Result<()>> {
        Pin::new(&mut self.io).poll_flush(cx)
    }

    fn poll_shutdown(mut self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<std::io::Result<()>> {
        Pin::new(&mut self.io).poll_shutdown(cx)
    }

    fn poll_write_vectored(
        mut self: Pin<&mut Self>,
        cx: &mut Context<'_>,
        bufs: &[std::io::IoSlice<'_>],
    ) -> Poll<std::io::Result<usize>> {
        Pin::new(&mut self.io).poll_write_vectored(cx, bufs)
    }

    fn is_write_vectored(&self) -> bool {
        self.io.is_write_vectored()
    }
}
