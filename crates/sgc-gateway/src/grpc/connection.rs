//! [`Connection`]: the peer of a connection and its guests; [`AcceptedStream`]: its byte stream.

use std::fmt;
use std::net::SocketAddr;
use std::pin::Pin;
use std::sync::{Arc, Mutex};
use std::task::{Context, Poll};

use sgc_sync::lock;
use sgc_trust::VerifiedPeer;
use tokio::io::{AsyncRead, AsyncWrite, ReadBuf};
use tonic::transport::server::Connected;

use super::guest::GuestEntry;
use super::serving_task::ServingTask;
use crate::access::Client;

/// A connection as its acceptor knows it. Clones share it.
#[derive(Clone)]
pub struct Connection(Arc<Inner>);

struct Inner {
    peer: SocketAddr,
    is_encrypted: bool,
    certificate: Option<VerifiedPeer>,
    known: Mutex<Vec<GuestEntry>>,
    /// Woken when the rights of a client on the connection end.
    serving: ServingTask,
}

impl Connection {
    /// Creates a connection without TLS.
    pub fn plain(peer: SocketAddr) -> Self {
        Self::new(peer, false, None)
    }

    /// Creates a connection over TLS, with the identity that the client's certificate proves, if there is one.
    pub fn encrypted(peer: SocketAddr, certificate: Option<VerifiedPeer>) -> Self {
        Self::new(peer, true, certificate)
    }

    fn new(peer: SocketAddr, is_encrypted: bool, certificate: Option<VerifiedPeer>) -> Self {
        let (known, serving) = (Mutex::default(), ServingTask::default());
        Self(Arc::new(Inner { peer, is_encrypted, certificate, known, serving }))
    }

    /// Returns the address of the client.
    pub fn peer(&self) -> SocketAddr {
        self.0.peer
    }

    /// Returns `true` if the connection is encrypted.
    pub fn is_encrypted(&self) -> bool {
        self.0.is_encrypted
    }

    /// Returns the identity that the client's certificate proves.
    pub fn certificate(&self) -> Option<&VerifiedPeer> {
        self.0.certificate.as_ref()
    }

    /// Returns the first client whose rights have not ended. The task is woken when rights end.
    pub(crate) fn poll_admitted(&self, cx: &mut Context<'_>) -> Option<Client> {
        self.0.serving.register(cx);
        let known = lock(&self.0.known);
        known.iter().find(|known| known.is_admitted()).map(|known| known.client().clone())
    }

    /// Returns the task that serves the connection.
    pub(super) fn serving_task(&self) -> ServingTask {
        self.0.serving.clone()
    }

    /// Returns the guests of the connection.
    pub(super) fn known(&self) -> &Mutex<Vec<GuestEntry>> {
        &self.0.known
    }
}

impl fmt::Debug for Connection {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_tuple("Connection").field(&self.0.peer).finish()
    }
}

/// An accepted byte stream. Dropping it at the end of the connection drops everything that `IO` holds.
#[derive(Debug)]
pub struct AcceptedStream<IO> {
    io: IO,
    connection: Connection,
}

impl<IO> AcceptedStream<IO> {
    /// Combines a byte stream with its connection.
    pub fn new(io: IO, connection: Connection) -> Self {
        Self { io, connection }
    }
}

impl<IO> Connected for AcceptedStream<IO> {
    type ConnectInfo = Connection;

    fn connect_info(&self) -> Connection {
        self.connection.clone()
    }
}

impl<IO: AsyncRead + Unpin> AsyncRead for AcceptedStream<IO> {
    fn poll_read(
        mut self: Pin<&mut Self>,
        cx: &mut Context<'_>,
        buf: &mut ReadBuf<'_>,
    ) -> Poll<std::io::Result<()>> {
        Pin::new(&mut self.io).poll_read(cx, buf)
    }
}

impl<IO: AsyncWrite + Unpin> AsyncWrite for AcceptedStream<IO> {
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
