//! UDP sockets, with the options that links may have.
//!
//! Quinn's own socket is used wherever it will do. A link that is marked (DSCP) or goes without offloads has one that sends
//! and receives datagram by datagram: quinn's writes the whole type-of-service byte of each datagram for the sake of ECN, and
//! has the kernel join what it receives.

use std::future::Future;
use std::io::{self, IoSliceMut};
use std::net::{Ipv4Addr, Ipv6Addr, SocketAddr};
use std::pin::Pin;
use std::sync::Arc;
use std::task::{Context, Poll, ready};

use quinn::udp::{RecvMeta, Transmit};
use quinn::{AsyncUdpSocket, Runtime, TokioRuntime, UdpPoller};
use socket2::{Domain, Protocol, SockRef, Socket, Type};

use crate::options::LinkOptions;

/// What is asked of the system for each direction, bytes; it may give less (`net.core.rmem_max`, `wmem_max`).
const BUFFER_BYTES: usize = 4 << 20;
/// The greatest code point of differentiated services (RFC 2474).
pub(crate) const DSCP_MAX: u8 = 63;

/// The address that stands for every interface and any port, of the family of this one.
pub(crate) fn any_like(remote: SocketAddr) -> SocketAddr {
    match remote {
        SocketAddr::V4(_) => (Ipv4Addr::UNSPECIFIED, 0).into(),
        SocketAddr::V6(_) => (Ipv6Addr::UNSPECIFIED, 0).into(),
    }
}

/// Binds a socket; one for `[::]` takes IPv4 as well. Needs a tokio runtime around it.
pub(crate) fn bind(
    addr: SocketAddr,
    options: &LinkOptions,
) -> io::Result<(Arc<dyn AsyncUdpSocket>, SocketAddr)> {
    let socket = Socket::new(Domain::for_address(addr), Type::DGRAM, Some(Protocol::UDP))?;
    if addr.is_ipv6() && addr.ip().is_unspecified() {
        // A system without IPv4 has nothing to share.
        let _ = socket.set_only_v6(false);
    }
    // What the system does not give, it does not give.
    if socket.recv_buffer_size().unwrap_or(0) < BUFFER_BYTES {
        let _ = socket.set_recv_buffer_size(BUFFER_BYTES);
    }
    if socket.send_buffer_size().unwrap_or(0) < BUFFER_BYTES {
        let _ = socket.set_send_buffer_size(BUFFER_BYTES);
    }
    if let Some(dscp) = options.dscp {
        mark(&SockRef::from(&socket), addr.is_ipv6(), dscp)?;
    }
    socket.bind(&addr.into())?;
    socket.set_nonblocking(true)?;
    let socket = std::net::UdpSocket::from(socket);
    let local = socket.local_addr()?;
    let socket: Arc<dyn AsyncUdpSocket> = match options.dscp.is_none() && options.offload {
        true => TokioRuntime.wrap_udp_socket(socket)?,
        false => Arc::new(PlainSocket { io: tokio::net::UdpSocket::from_std(socket)? }),
    };
    Ok((socket, local))
}

/// Marks what a socket sends, in both families if it is of both.
pub(crate) fn mark(socket: &SockRef<'_>, is_ipv6: bool, dscp: u8) -> io::Result<()> {
    if dscp > DSCP_MAX {
        return Err(io::Error::new(io::ErrorKind::InvalidInput, "a DSCP is at most 63"));
    }
    let class = u32::from(dscp) << 2;
    if is_ipv6 {
        socket.set_tclass_v6(class)?;
        // Counts for mapped addresses; a socket for IPv6 alone may refuse it.
        let _ = socket.set_tos_v4(class);
        Ok(())
    } else {
        socket.set_tos_v4(class)
    }
}

/// One datagram at a time: no segmentation or receive offload, no ECN, the source address is the system's choice, and no
/// MTU discovery.
#[derive(Debug)]
struct PlainSocket {
    io: tokio::net::UdpSocket,
}

impl AsyncUdpSocket for PlainSocket {
    fn create_io_poller(self: Arc<Self>) -> Pin<Box<dyn UdpPoller>> {
        Box::pin(Writable { socket: self, waiting: None })
    }

    fn try_send(&self, transmit: &Transmit<'_>) -> io::Result<()> {
        let size = transmit.segment_size.unwrap_or(transmit.contents.len()).max(1);
        for datagram in transmit.contents.chunks(size) {
            match self.io.try_send_to(datagram, transmit.destination) {
                Err(error) if error.kind() == io::ErrorKind::WouldBlock => return Err(error),
                // Everything else is a datagram lost, as in quinn's own socket: the path may come back.
                Err(error) => tracing::trace!(%error, destination = %transmit.destination, "not sent"),
                Ok(_) => {}
            }
        }
        Ok(())
    }

    fn poll_recv(
        &self,
        cx: &mut Context<'_>,
        bufs: &mut [IoSliceMut<'_>],
        meta: &mut [RecvMeta],
    ) -> Poll<io::Result<usize>> {
        let mut count = 0;
        while count == 0 {
            ready!(self.io.poll_recv_ready(cx))?;
            for (buf, meta) in bufs.iter_mut().zip(meta.iter_mut()) {
                match self.io.try_recv_from(buf) {
                    Ok((len, addr)) => *meta = RecvMeta { addr, len, stride: len, ecn: None, dst_ip: None },
                    Err(error) if error.kind() == io::ErrorKind::WouldBlock || count > 0 => break,
                    // A datagram of ours that nobody took says so here; it is no end of the socket.
                    Err(error) if error.kind() == io::ErrorKind::ConnectionRefused => break,
                    Err(error) => return Poll::Ready(Err(error)),
                }
                count += 1;
            }
        }
        Poll::Ready(Ok(count))
    }

    fn local_addr(&self) -> io::Result<SocketAddr> {
        self.io.local_addr()
    }
}

type Waiting = Pin<Box<dyn Future<Output = io::Result<()>> + Send + Sync>>;

/// Waits until a socket takes more.
struct Writable {
    socket: Arc<PlainSocket>,
    waiting: Option<Waiting>,
}

impl std::fmt::Debug for Writable {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_tuple("Writable").field(&self.socket).finish()
    }
}

impl UdpPoller for Writable {
    fn poll_writable(mut self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<io::Result<()>> {
        let Self { socket, waiting } = &mut *self;
        let future = waiting.get_or_insert_with(|| {
            let socket = Arc::clone(socket);
            Box::pin(async move { socket.io.writable().await })
        });
        let done = ready!(future.as_mut().poll(cx));
        *waiting = None;
        Poll::Ready(done)
    }
}
