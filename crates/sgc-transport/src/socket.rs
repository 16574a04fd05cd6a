//! UDP sockets, with the options of links.
//!
//! Quinn sends and receives wherever that will do. A link that is marked (DSCP) or goes without offloads has a socket
//! that works datagram by datagram: quinn writes the whole type-of-service byte of each datagram for ECN, and lets the
//! kernel join received datagrams.

use std::fmt;
use std::future::Future;
use std::io::{self, IoSliceMut};
use std::net::{Ipv4Addr, Ipv6Addr, SocketAddr};
use std::pin::Pin;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::task::{Context, Poll, ready};

use quinn::udp::{RecvMeta, Transmit, UdpSocketState};
use quinn::{AsyncUdpSocket, UdpPoller};
use socket2::{Domain, Protocol, SockRef, Socket, Type};
use tokio::io::Interest;
use tokio::io::unix::AsyncFd;

use crate::options::LinkOptions;

/// Requested buffer for each direction, bytes; the system may give less (`net.core.rmem_max`, `wmem_max`).
const BUFFER_BYTES: usize = 4 << 20;
/// The greatest code point of differentiated services (RFC 2474).
pub(crate) const DSCP_MAX: u8 = 63;

/// Returns the address of every interface and any port, of the same family.
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
    // A smaller buffer is logged and used.
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
        true => Arc::new(BatchSocket::new(socket)?),
        false => Arc::new(PlainSocket { io: tokio::net::UdpSocket::from_std(socket)? }),
    };
    Ok((socket, local))
}

/// Marks the datagrams of a socket, in both families if it serves both.
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

/// A socket for one datagram at a time: no segmentation or receive offload, no ECN, the system's choice of source
/// address, and no MTU discovery.
#[derive(Debug)]
struct PlainSocket {
    io: tokio::net::UdpSocket,
}

impl AsyncUdpSocket for PlainSocket {
    fn create_io_poller(self: Arc<Self>) -> Pin<Box<dyn UdpPoller>> {
        RoomPoller::new(self)
    }

    fn try_send(&self, transmit: &Transmit<'_>) -> io::Result<()> {
        let size = transmit.segment_size.unwrap_or(transmit.contents.len()).max(1);
        for datagram in transmit.contents.chunks(size) {
            match self.io.try_send_to(datagram, transmit.destination) {
                Err(error) if error.kind() == io::ErrorKind::WouldBlock => return Err(error),
                // As in quinn's own socket, any other error is a lost datagram: the path may come back.
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
                    // The error reports an earlier datagram that nobody took; the socket lives on.
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

/// Quinn's sending and receiving, with offloads, on a socket whose runtime hears of received datagrams only. Otherwise
/// it would hear of room after each datagram that left, and wake a thread for it.
#[derive(Debug)]
struct BatchSocket {
    io: AsyncFd<std::net::UdpSocket>,
    state: UdpSocketState,
    /// Whether the last datagram found no room.
    is_full: AtomicBool,
}

impl BatchSocket {
    fn new(socket: std::net::UdpSocket) -> io::Result<Self> {
        let state = UdpSocketState::new((&socket).into())?;
        let io = watch(socket, Interest::READABLE)?;
        Ok(Self { io, state, is_full: AtomicBool::new(false) })
    }
}

/// Registers a socket with the runtime for one direction only.
#[expect(
    deprecated,
    reason = "what replaces it is unsafe, for descriptors that close early; this one is the socket's own"
)]
fn watch(socket: std::net::UdpSocket, interest: Interest) -> io::Result<AsyncFd<std::net::UdpSocket>> {
    AsyncFd::with_interest(socket, interest)
}

impl AsyncUdpSocket for BatchSocket {
    fn create_io_poller(self: Arc<Self>) -> Pin<Box<dyn UdpPoller>> {
        RoomPoller::new(self)
    }

    fn try_send(&self, transmit: &Transmit<'_>) -> io::Result<()> {
        let result = self.state.send(self.io.get_ref().into(), transmit);
        let is_full = matches!(&result, Err(error) if error.kind() == io::ErrorKind::WouldBlock);
        if is_full || self.is_full.load(Ordering::Relaxed) {
            self.is_full.store(is_full, Ordering::Relaxed);
        }
        result
    }

    fn poll_recv(
        &self,
        cx: &mut Context<'_>,
        bufs: &mut [IoSliceMut<'_>],
        meta: &mut [RecvMeta],
    ) -> Poll<io::Result<usize>> {
        loop {
            let mut ready = ready!(self.io.poll_read_ready(cx))?;
            if let Ok(result) = ready.try_io(|io| self.state.recv(io.get_ref().into(), bufs, meta)) {
                return Poll::Ready(result);
            }
        }
    }

    fn local_addr(&self) -> io::Result<SocketAddr> {
        self.io.get_ref().local_addr()
    }

    fn may_fragment(&self) -> bool {
        self.state.may_fragment()
    }

    fn max_transmit_segments(&self) -> usize {
        self.state.max_gso_segments()
    }

    fn max_receive_segments(&self) -> usize {
        self.state.gro_segments()
    }
}

/// A socket whose senders may have to wait.
trait SendSocket: fmt::Debug + Send + Sync + 'static {
    /// Returns `true` if a sender has to wait for room.
    fn may_be_full(&self) -> bool;

    /// Waits until the socket takes more.
    fn room(self: Arc<Self>) -> impl Future<Output = io::Result<()>> + Send + Sync;
}

impl SendSocket for BatchSocket {
    fn may_be_full(&self) -> bool {
        self.is_full.load(Ordering::Relaxed)
    }

    /// Registers with the runtime only while somebody waits. Earlier room is reported, too.
    async fn room(self: Arc<Self>) -> io::Result<()> {
        let room = watch(self.io.get_ref().try_clone()?, Interest::WRITABLE)?;
        room.writable().await.map(drop)
    }
}

impl SendSocket for PlainSocket {
    /// The runtime knows.
    fn may_be_full(&self) -> bool {
        true
    }

    async fn room(self: Arc<Self>) -> io::Result<()> {
        self.io.writable().await
    }
}

type Waiting = Pin<Box<dyn Future<Output = io::Result<()>> + Send + Sync>>;

/// A sender that waits until a socket takes more.
struct RoomPoller<S> {
    socket: Arc<S>,
    waiting: Option<Waiting>,
}

impl<S: SendSocket> RoomPoller<S> {
    fn new(socket: Arc<S>) -> Pin<Box<Self>> {
        Box::pin(Self { socket, waiting: None })
    }
}

impl<S: SendSocket> fmt::Debug for RoomPoller<S> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_tuple("RoomPoller").field(&self.socket).finish()
    }
}

impl<S: SendSocket> UdpPoller for RoomPoller<S> {
    fn poll_writable(mut self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<io::Result<()>> {
        let Self { socket, waiting } = &mut *self;
        if waiting.is_none() && !socket.may_be_full() {
            return Poll::Ready(Ok(()));
        }
        let future = waiting.get_or_insert_with(|| Box::pin(Arc::clone(socket).room()));
        let done = ready!(future.as_mut().poll(cx));
        *waiting = None;
        Poll::Ready(done)
    }
}

#[cfg(test)]
mod tests {
    use std::future::poll_fn;
    use std::time::Duration;

    use tokio::time::timeout;

    use super::*;

    const PATIENCE: Duration = Duration::from_secs(20);

    #[tokio::test]
    async fn datagrams_pass_and_who_found_no_room_hears_of_it() {
        let new = || {
            let socket = std::net::UdpSocket::bind((Ipv4Addr::LOCALHOST, 0)).unwrap();
            socket.set_nonblocking(true).unwrap();
            Arc::new(BatchSocket::new(socket).unwrap())
        };
        let (from, to) = (new(), new());
        let destination = to.local_addr().unwrap();
        let mut room = from.clone().create_io_poller();
        // As if the last datagram had found no room.
        from.is_full.store(true, Ordering::Relaxed);
        timeout(PATIENCE, poll_fn(|cx| room.as_mut().poll_writable(cx))).await.unwrap().unwrap();
        let contents = [7; 3 * 1000];
        let segments = from.max_transmit_segments().min(3);
        for part in contents.chunks(segments * 1000) {
            let transmit =
                Transmit { destination, ecn: None, contents: part, segment_size: Some(1000), src_ip: None };
            from.try_send(&transmit).unwrap();
        }
        assert!(!from.is_full.load(Ordering::Relaxed));
        let (mut buffer, mut got) = (vec![0; 64 << 10], 0);
        while got < contents.len() {
            let mut meta = [RecvMeta::default()];
            let mut bufs = [IoSliceMut::new(&mut buffer)];
            let received = poll_fn(|cx| to.poll_recv(cx, &mut bufs, &mut meta));
            assert_eq!(timeout(PATIENCE, received).await.unwrap().unwrap(), 1);
            assert_eq!(meta[0].stride, 1000);
            got += meta[0].len;
        }
    }
}
