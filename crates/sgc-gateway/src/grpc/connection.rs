//! [`Connection`]: what is known of one, and who was admitted on it; [`Accepted`]: its stream of bytes.

use std::fmt;
use std::net::SocketAddr;
use std::pin::Pin;
use std::sync::{Arc, Mutex};
use std::task::{Context, Poll};

use sgc_trust::VerifiedPeer;
use tokio::io::{AsyncRead, AsyncWrite, ReadBuf};
use tonic::transport::server::Connected;

use super::client::Known;
use crate::hub::lock;

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

    /// What the client is called that was admitted on it first, once one was.
    pub(crate) fn admitted_name(&self) -> Option<Arc<str>> {
        lock(&self.0.known).first().map(|known| known.client().name.clone())
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
